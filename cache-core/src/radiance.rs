//! The room of radiance: light that reaches a glossy surface, by direction.
//!
//! Papers: Gautron et al. 2004 (hemispherical harmonics), Krivanek et al. 2005 (record, interpolation), 2005b (gradients).
//!
//! A record holds the harmonics' coefficients of incoming radiance, and their translational derivatives, along the axes of
//! `Frame::around(n_i)`. The light a surface reflects is then the dot product with the coefficients of its lobe
//! ([`crate::hsh::lobe`]). `Radiance<N>` has N coefficients a channel, the square of its order; each order is a kind of its own, so
//! that the number of a kind tells the size of its records, and a set of them is as plain as one of irradiance.
//!
//! Fails where the lobe is sharper than the order can tell, next to small bright lamps (the sum rings and may be negative),
//! and where interpolation blurs what a sharp lobe would show.

use glam::Vec3;

use crate::cached::{Cached, Invalid, Packed, Query};
use crate::hsh::order;
use crate::hsh::rotation::{Rotation, TURN_MAX};
use crate::id::RecordId;
use crate::math::{Frame, Rgb};
use crate::site;

/// Coefficients of each colour channel.
pub type Coefficients<const N: usize> = [[f32; N]; 3];

/// E of incoming radiance, W/m²: exact, the cosine is the sum of two harmonics.
pub fn irradiance<const N: usize>(coefficients: &Coefficients<N>) -> Rgb {
    const { assert!(N > 1, "the cosine needs two bands") };
    // cos θ = √(2π)/2 H_0^0 + √(2π/3)/2 H_1^0.
    const COSINE: [f32; 2] = [1.253_314_1, 0.723_601_25];
    Rgb::from(coefficients.map(|c| COSINE[0] * c[0] + COSINE[1] * c[2]))
}

/// A record of incoming radiance.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Radiance<const N: usize> {
    /// Identity.
    pub id: RecordId,
    /// Site p_i, world.
    pub position: Vec3,
    /// Unit normal n_i.
    pub normal: Vec3,
    /// R_i at birth: harmonic mean of the distances the gather met, limited by |E| / |∇_t E|; world length.
    pub radius: f32,
    /// Least R the record counts with (from the projected pixel size), world length.
    pub radius_min: f32,
    /// Greatest R the record counts with, world length.
    pub radius_max: f32,
    /// Standard error of each coefficient, root mean square over the channels, W/(√sr m²): outgoing radiance errs by it times
    /// the length of the lobe's coefficients.
    pub noise: f32,
    /// Λ_i, W/(√sr m²).
    pub coefficients: Coefficients<N>,
    /// ∂Λ_i/∂x and ∂Λ_i/∂y along the site's tangents, W/(√sr m³).
    pub gradient: [Coefficients<N>; 2],
}

/// What a query of radiance gets.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Answer<const N: usize> {
    /// Incoming radiance along the axes of `Frame::around` the query's normal, W/(√sr m²).
    pub coefficients: Coefficients<N>,
    /// How many records answered.
    pub records: u32,
    /// Standard error of each coefficient for the records' noise, root mean square over the channels, W/(√sr m²).
    pub noise: f32,
}

impl<const N: usize> Default for Answer<N> {
    fn default() -> Self {
        Self { coefficients: [[0.0; N]; 3], records: 0, noise: 0.0 }
    }
}

impl<const N: usize> Cached for Radiance<N> {
    type Answer = Answer<N>;

    fn position(&self) -> Vec3 {
        self.position
    }

    fn radius(&self) -> f32 {
        self.radius
    }

    fn radius_bounds(&self) -> (f32, f32) {
        (self.radius_min, self.radius_max)
    }

    /// That of Ward 1988 eq. 5, for turns a rotation is known for.
    #[inline]
    fn error(&self, query: &Query, radius: f32, a: f32) -> f32 {
        match site::error(self.position, self.normal, query, radius, a) {
            Some((translation, rotation)) if rotation <= TURN_MAX => translation + rotation,
            _ => f32::INFINITY,
        }
    }

    /// A summand of Krivanek 2005 eq. 12: R_i (Λ_i + d_x ∂Λ_i/∂x + d_y ∂Λ_i/∂y).
    #[inline]
    fn add(&self, query: &Query, weight: f32, limit: f32, answer: &mut Answer<N>) {
        let frame = Frame::around(self.normal);
        let shift = frame.tangential(query.position - self.position) * limit;
        let mut moved = self.coefficients;
        let [along_x, along_y] = &self.gradient;
        for ((moved, along_x), along_y) in moved.iter_mut().zip(along_x).zip(along_y) {
            for i in 0..N {
                moved[i] = (moved[i] + shift.x * along_x[i] + shift.y * along_y[i]) * weight;
            }
        }
        if query.normal != self.normal {
            Rotation::between(&frame, &Frame::around(query.normal)).apply(&mut moved);
        }
        for (sum, moved) in answer.coefficients.iter_mut().zip(&moved) {
            sum.iter_mut().zip(moved).for_each(|(sum, moved)| *sum += moved);
        }
        answer.records += 1;
        answer.noise += (self.noise * weight).powi(2);
    }

    fn finish(answer: &mut Answer<N>, weights: f32) {
        let share = weights.recip();
        answer.coefficients.iter_mut().flatten().for_each(|c| *c *= share);
        answer.noise = answer.noise.sqrt() * share;
    }
}

impl<const N: usize> Packed for Radiance<N> {
    const KIND: u32 = KIND_BASE + order(N) as u32;
    const BYTES: usize = 16 + 4 * (HEAD + 9 * N);

    fn id(&self) -> RecordId {
        self.id
    }

    fn encode(&self, bytes: &mut Vec<u8>) {
        bytes.reserve(Self::BYTES);
        bytes.extend_from_slice(&self.id.0.to_le_bytes());
        self.head().iter().chain(self.body()).for_each(|value| bytes.extend_from_slice(&value.to_le_bytes()));
    }

    fn decode(bytes: &[u8]) -> Result<Self, Invalid> {
        if bytes.len() != Self::BYTES {
            return Err(Invalid::Length { expected: Self::BYTES, got: bytes.len() });
        }
        let (head, tail) = bytes.split_at(16);
        let id = RecordId(head.iter().rev().fold(0, |id, &b| id << 8 | u128::from(b)));
        let mut floats = tail.chunks_exact(4).map(|four| f32::from_le_bytes([four[0], four[1], four[2], four[3]]));
        // As many as the length says.
        let mut next = || floats.next().unwrap_or(f32::NAN);
        let f: [f32; HEAD] = std::array::from_fn(|_| next());
        let mut coefficients = || std::array::from_fn(|_| std::array::from_fn(|_| next()));
        let record = Self {
            id,
            position: Vec3::new(f[0], f[1], f[2]),
            normal: Vec3::new(f[3], f[4], f[5]),
            radius: f[6],
            radius_min: f[7],
            radius_max: f[8],
            noise: f[9],
            coefficients: coefficients(),
            gradient: [coefficients(), coefficients()],
        };
        record.check().map(|()| record)
    }
}

/// A record's kind on the wire less its order.
const KIND_BASE: u32 = 16;

/// Floats between the id and the coefficients.
const HEAD: usize = 10;

impl<const N: usize> Radiance<N> {
    fn head(&self) -> [f32; HEAD] {
        let [p, n] = [self.position, self.normal];
        [p.x, p.y, p.z, n.x, n.y, n.z, self.radius, self.radius_min, self.radius_max, self.noise]
    }

    fn body(&self) -> impl Iterator<Item = &f32> {
        self.coefficients.iter().chain(self.gradient.iter().flatten()).flatten()
    }

    /// Whether the record is sound, whoever made it.
    ///
    /// # Errors
    /// The first field that is not.
    pub fn check(&self) -> Result<(), Invalid> {
        let finite = |field, values: &[f32]| {
            let finite = values.iter().fold(true, |finite, value| finite & value.is_finite());
            if finite { Ok(()) } else { Err(Invalid::NotFinite { field }) }
        };
        finite("position", &self.position.to_array())?;
        finite("normal", &self.normal.to_array())?;
        finite("radius", &[self.radius])?;
        finite("radius_min", &[self.radius_min])?;
        finite("radius_max", &[self.radius_max])?;
        finite("noise", &[self.noise])?;
        finite("coefficients", self.coefficients.as_flattened())?;
        finite("gradient", self.gradient.as_flattened().as_flattened())?;
        site::check(self.position, self.normal, self.radius, self.radius_bounds())?;
        if self.noise < 0.0 {
            return Err(Invalid::Range { field: "noise", value: self.noise, expected: "0 or more" });
        }
        Ok(())
    }
}
