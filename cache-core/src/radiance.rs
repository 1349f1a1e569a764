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

/// Coefficients of cos θ at (0, 0) and (1, 0): √(2π)/2 and √(2π/3)/2. All others are 0.
pub const COSINE: [f32; 2] = [1.253_314_1, 0.723_601_2];

/// E of incoming radiance, W/m²: exact, the cosine is the sum of two harmonics.
pub fn irradiance<const N: usize>(coefficients: &Coefficients<N>) -> Rgb {
    const { assert!(N > 1, "the cosine needs two bands") };
    Rgb::from(coefficients.map(|c| COSINE[0] * c[0] + COSINE[1] * c[2]))
}

/// Radiance that a lobe of these coefficients reflects, W/(sr m²); may be negative where a sum rings.
#[inline]
pub fn reflected<const N: usize>(lobe: &Coefficients<N>, incoming: &Coefficients<N>) -> Rgb {
    let dot = |c: usize| lobe[c].iter().zip(&incoming[c]).map(|(f, l)| f * l).sum();
    Rgb::new(dot(0), dot(1), dot(2))
}

/// How far an error of each coefficient reaches what such a lobe reflects, 1/√sr; root mean square over the channels.
pub fn gain<const N: usize>(lobe: &Coefficients<N>) -> f32 {
    (lobe.as_flattened().iter().map(|f| f * f).sum::<f32>() * (1.0 / 3.0)).sqrt()
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
    /// (xx, xy, yy) of M, 1/m², as of [`crate::Irradiance::ellipse`]: how far E could be known by its gradient.
    pub ellipse: [f32; 3],
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
    /// Incoming radiance along the axes of `Frame::around` the query's shading normal, W/(√sr m²).
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

    /// That of Ward 1988 eq. 5 or the ellipse's, for turns a rotation is known for.
    #[inline]
    fn error(&self, query: &Query, radius: f32, a: f32) -> f32 {
        match site::error((self.position, self.normal, self.ellipse), query, radius, a) {
            Some((error, rotation)) if rotation <= TURN_MAX => error,
            _ => f32::INFINITY,
        }
    }

    /// A summand of Krivanek 2005 eq. 12: R_i (Λ_i + d_x ∂Λ_i/∂x + d_y ∂Λ_i/∂y); R_i turns to the shading normal, so that bumps
    /// cost no records.
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
        if query.shading != self.normal {
            Rotation::between(&frame, &Frame::around(query.shading)).apply(&mut moved);
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
    const KIND: u32 = kind(order(N));
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
            ellipse: [f[9], f[10], f[11]],
            noise: f[12],
            coefficients: coefficients(),
            gradient: [coefficients(), coefficients()],
        };
        record.check().map(|()| record)
    }
}

/// A record of any order, field by field as [`Radiance`] has them: for those who read and write text.
#[derive(Clone, PartialEq, Debug)]
pub struct Plain {
    /// Identity.
    pub id: RecordId,
    /// Site, world.
    pub position: Vec3,
    /// Unit normal.
    pub normal: Vec3,
    /// R at birth.
    pub radius: f32,
    /// Least and greatest R it counts with.
    pub radius_bounds: (f32, f32),
    /// M.
    pub ellipse: [f32; 3],
    /// Standard error of each coefficient.
    pub noise: f32,
    /// Λ of each channel.
    pub coefficients: [Vec<f32>; 3],
    /// ∂Λ/∂x and ∂Λ/∂y of each channel.
    pub gradient: [[Vec<f32>; 3]; 2],
}

impl<const N: usize> From<&Radiance<N>> for Plain {
    fn from(r: &Radiance<N>) -> Self {
        let channels = |c: &Coefficients<N>| c.each_ref().map(|c| c.to_vec());
        Self {
            id: r.id,
            position: r.position,
            normal: r.normal,
            radius: r.radius,
            radius_bounds: r.radius_bounds(),
            ellipse: r.ellipse,
            noise: r.noise,
            coefficients: channels(&r.coefficients),
            gradient: r.gradient.each_ref().map(channels),
        }
    }
}

impl<const N: usize> TryFrom<&Plain> for Radiance<N> {
    type Error = Invalid;

    /// The record, unchecked but for the number of its coefficients.
    fn try_from(plain: &Plain) -> Result<Self, Invalid> {
        let channels = |c: &[Vec<f32>; 3]| -> Result<Coefficients<N>, Invalid> {
            let mut channels = [[0.0; N]; 3];
            for (channel, values) in channels.iter_mut().zip(c) {
                let length = |_| Invalid::Length { expected: 4 * N, got: 4 * values.len() };
                *channel = values.as_slice().try_into().map_err(length)?;
            }
            Ok(channels)
        };
        let [along_x, along_y] = &plain.gradient;
        Ok(Self {
            id: plain.id,
            position: plain.position,
            normal: plain.normal,
            radius: plain.radius,
            radius_min: plain.radius_bounds.0,
            radius_max: plain.radius_bounds.1,
            ellipse: plain.ellipse,
            noise: plain.noise,
            coefficients: channels(&plain.coefficients)?,
            gradient: [channels(along_x)?, channels(along_y)?],
        })
    }
}

/// A record's kind on the wire less its order.
const KIND_BASE: u32 = 16;

/// Kind on the wire of records of an order.
pub const fn kind(order: usize) -> u32 {
    KIND_BASE + order as u32
}

/// Order of the records of a kind; none of [`ORDERS`] for other kinds.
pub(crate) fn order_of(kind: u32) -> usize {
    kind.saturating_sub(KIND_BASE) as usize
}

/// Orders there are records of.
pub const ORDERS: [usize; 5] = [2, 4, 6, 8, 10];

/// `$work` with `$N` being the number of coefficients of an order; `None` for an order that is none of
/// [`ORDERS`].
#[macro_export]
macro_rules! of_order {
    ($order:expr, $N:ident => $work:expr) => {
        match $order {
            2 => $crate::of_order!(@ 4, $N => $work),
            4 => $crate::of_order!(@ 16, $N => $work),
            6 => $crate::of_order!(@ 36, $N => $work),
            8 => $crate::of_order!(@ 64, $N => $work),
            10 => $crate::of_order!(@ 100, $N => $work),
            _ => None,
        }
    };
    (@ $coefficients:literal, $N:ident => $work:expr) => {{
        const $N: usize = $coefficients;
        Some($work)
    }};
}

/// Floats between the id and the coefficients.
const HEAD: usize = 13;

impl<const N: usize> Radiance<N> {
    fn head(&self) -> [f32; HEAD] {
        let ([p, n], [xx, xy, yy]) = ([self.position, self.normal], self.ellipse);
        let radii = [self.radius, self.radius_min, self.radius_max];
        [p.x, p.y, p.z, n.x, n.y, n.z, radii[0], radii[1], radii[2], xx, xy, yy, self.noise]
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
        finite("ellipse", &self.ellipse)?;
        finite("noise", &[self.noise])?;
        finite("coefficients", self.coefficients.as_flattened())?;
        finite("gradient", self.gradient.as_flattened().as_flattened())?;
        site::check(self.position, self.normal, self.radius, self.radius_bounds())?;
        site::check_ellipse(self.ellipse)?;
        if self.noise < 0.0 {
            return Err(Invalid::Range { field: "noise", value: self.noise, expected: "0 or more" });
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::details::{Details, Weighting};
    use crate::id::Random;
    use crate::sealed::Sealed;

    fn sound<const N: usize>(seed: u64) -> Radiance<N> {
        let mut random = Random::named("radiance", &[seed]);
        let mut next = || random.uniform();
        let mut coefficients = || std::array::from_fn(|_| std::array::from_fn(|_| next() - 0.25));
        Radiance {
            id: RecordId(0x0123_4567_89ab_cdef_0011_2233_4455_6677 + u128::from(seed)),
            position: Vec3::new(1.0, 2.0, 3.0),
            normal: Vec3::Y,
            radius: 2.0,
            radius_min: 0.1,
            radius_max: 10.0,
            ellipse: [0.1, 0.05, 0.1],
            noise: 0.125,
            coefficients: coefficients(),
            gradient: [coefficients(), coefficients()],
        }
    }

    fn packed<const N: usize>(record: &Radiance<N>) -> Vec<u8> {
        let mut bytes = Vec::new();
        record.encode(&mut bytes);
        bytes
    }

    fn survives<const N: usize>(kind: u32, size: usize) {
        let bytes = packed(&sound::<N>(1));
        assert_eq!((Radiance::<N>::KIND, Radiance::<N>::BYTES, bytes.len()), (kind, size, size));
        assert_eq!(bytes[..4], [0x78, 0x66, 0x55, 0x44]);
        assert_eq!(Radiance::<N>::decode(&bytes), Ok(sound(1)));
        assert!(matches!(Radiance::<N>::decode(&bytes[1..]), Err(Invalid::Length { .. })));
        // Memory holds no more than the wire.
        assert_eq!(size_of::<Radiance<N>>(), size.next_multiple_of(8));
    }

    #[test]
    fn records_survive_packing_and_have_the_size_stated() {
        survives::<4>(18, 212);
        survives::<16>(20, 644);
        survives::<36>(22, 1364);
        survives::<64>(24, 2372);
        survives::<100>(26, 3668);
    }

    #[test]
    fn unsound_records_are_refused_by_name() {
        type Spoil = fn(&mut Radiance<16>);
        let spoilt: [(&str, Spoil); 15] = [
            ("position", |r| r.position.x = f32::NAN),
            ("normal", |r| r.normal.z = f32::INFINITY),
            ("normal", |r| r.normal = Vec3::new(0.0, 2.0, 0.0)),
            ("radius", |r| r.radius = f32::INFINITY),
            ("radius", |r| r.radius = 0.0),
            ("radius", |r| r.radius = 1e-30),
            ("radius_min", |r| r.radius_min = -1.0),
            ("radius_max", |r| r.radius_max = 0.01),
            ("ellipse", |r| r.ellipse[2] = f32::NAN),
            ("ellipse", |r| r.ellipse = [1.0, 2.0, 1.0]),
            ("noise", |r| r.noise = f32::NAN),
            ("noise", |r| r.noise = -1.0),
            ("coefficients", |r| r.coefficients[2][15] = f32::NAN),
            ("gradient", |r| r.gradient[0][0][0] = f32::INFINITY),
            ("gradient", |r| r.gradient[1][2][15] = f32::NEG_INFINITY),
        ];
        for (field, spoil) in spoilt {
            let mut record = sound(1);
            spoil(&mut record);
            let message = Radiance::<16>::decode(&packed(&record)).expect_err(field).to_string();
            assert!(message.contains(field), "{field}: {message}");
        }
    }

    proptest! {
        /// Whatever bytes come, what is read from them is sound and packs to the same.
        #[test]
        fn any_bytes_are_refused_or_sound(bytes in prop::collection::vec(any::<u8>(), 212), keep in 0usize..212) {
            let mut mixed = packed(&sound::<4>(1));
            mixed[keep..].copy_from_slice(&bytes[keep..]);
            if let Ok(record) = Radiance::<4>::decode(&mixed) {
                prop_assert_eq!(packed(&record), mixed);
            }
        }
    }

    /// Λ + d ∂Λ, then the rotation, then the weighted mean.
    #[test]
    fn interpolation_moves_turns_and_weighs() {
        let frame = Frame::around(Vec3::Y);
        let mut near = sound::<16>(1);
        let far = Radiance { position: near.position + frame.x * 0.3, ..sound(2) };
        near.noise = 0.25;
        let mut sealed = Sealed::with(0.5, Details { neighbor_clamping: false, ..Details::default() });
        sealed.extend([near, far]);
        let query = Query::new(near.position + frame.x * 0.1 + frame.y * 0.2, Vec3::Y);
        let answer = sealed.ask(&query).expect("both count");
        let weight = |r: &Radiance<16>| Weighting::InverseToZero.weight(r.error(&query, 2.0, 0.5), 0.5);
        let [v, w] = [&near, &far].map(weight);
        let moved = |r: &Radiance<16>, x: f32, y: f32, c: usize, i: usize| {
            r.coefficients[c][i] + x * r.gradient[0][c][i] + y * r.gradient[1][c][i]
        };
        for (c, i) in (0..48).map(|i| (i / 16, i % 16)) {
            let mean = (moved(&near, 0.1, 0.2, c, i) * v + moved(&far, -0.2, 0.2, c, i) * w) / (v + w);
            assert!((answer.coefficients[c][i] - mean).abs() < 1e-5, "{c} {i}");
        }
        let noise = ((0.25 * v).powi(2) + (0.125 * w).powi(2)).sqrt() / (v + w);
        assert_eq!(answer.records, 2);
        assert!((answer.noise - noise).abs() < 1e-6);
        // Seen from another normal, the same rotated.
        let mut alone = Sealed::new(0.5);
        alone.extend([Radiance { gradient: [[[0.0; 16]; 3]; 2], ..near }]);
        let shading = Vec3::new(0.2, 1.0, 0.1).normalize();
        let mut expected = near.coefficients;
        Rotation::between(&frame, &Frame::around(shading)).apply(&mut expected);
        // A bump costs nothing, a bend of the surface an error.
        let bump = Query { shading, ..Query::new(near.position, Vec3::Y) };
        for (query, error) in [(bump, 0.0), (Query::new(near.position, shading), 0.15)] {
            assert!((near.error(&query, 2.0, 0.5) - error).abs() < 0.01);
            let answer = alone.ask(&query).expect("counts");
            let off = answer.coefficients.iter().flatten().zip(expected.iter().flatten()).map(|(a, b)| (a - b).abs());
            assert!(off.fold(0.0, f32::max) < 1e-5);
        }
    }

    #[test]
    fn a_record_counts_no_farther_than_rotations_are_known() {
        let at = |degrees: f32| {
            let (s, c) = degrees.to_radians().sin_cos();
            let query = Query::new(sound::<4>(1).position, Vec3::new(s, c, 0.0));
            sound::<4>(1).error(&query, 2.0, 10.0)
        };
        assert!((at(60.0) - 0.5f32.sqrt()).abs() < 1e-5);
        assert!(at(68.0).is_finite() && at(70.0) == f32::INFINITY);
    }

    /// The furnace, whose every answer is the same, from any record at any normal.
    #[test]
    fn a_furnace_answers_the_same_everywhere() {
        let mut lit = Radiance { gradient: [[[0.0; 36]; 3]; 2], coefficients: [[0.0; 36]; 3], ..sound::<36>(1) };
        lit.coefficients.iter_mut().for_each(|c| c[0] = std::f32::consts::TAU.sqrt());
        let mut sealed = Sealed::new(0.8);
        sealed.extend([lit, Radiance { id: RecordId(9), normal: Vec3::new(0.6, 0.8, 0.0), ..lit }]);
        for x in [0.0, 0.2, 0.5] {
            let answer = sealed.ask(&Query::new(lit.position, Vec3::new(x, 1.0, x).normalize()));
            let light = irradiance(&answer.expect("counts").coefficients);
            assert!((light - std::f32::consts::PI).abs().max_element() < 1e-5, "{light}");
        }
    }
}
