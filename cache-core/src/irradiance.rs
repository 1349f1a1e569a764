//! The room of irradiance: diffuse indirect light, interpolated along its gradients.
//!
//! Papers: Ward, Rubinstein, Clear 1988 (weights, in-front test); Ward, Heckbert 1992 (gradients); Krivanek et al. 2006
//! and the 2007 course (weight that falls to 0, R bounded by projected pixel size, gradient limit).
//!
//! A record holds E_i [W/m²], its translational gradient [W/m³] and rotational gradient [W/m² per radian], each per
//! colour channel and along the tangents of `Frame::around(n_i)`.
//!
//! Fails where irradiance varies faster than R lets on: small bright sources the gather missed (neighbor clamping
//! mends most), and curved surfaces whose curvature exceeds what `sqrt(1 - n·n_i)` assumes.

use glam::{Vec2, Vec3};

use crate::cached::{Cached, Invalid, Packed, Query};
use crate::id::RecordId;
use crate::math::{Frame, Rgb};
use crate::site;

/// A record of irradiance.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Irradiance {
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
    /// E_i, W/m².
    pub irradiance: Rgb,
    /// ∇_t E_i, W/m³, per channel, along the site's tangents.
    pub gradient_t: [Vec2; 3],
    /// ∇_r E_i, W/m² per radian, per channel: change when the normal turns about the site's tangents.
    pub gradient_r: [Vec2; 3],
    /// (xx, xy, yy) of M along the site's tangents, 1/m²: the record counts out to (p - p_i)ᵀ M (p - p_i) = a², an ellipse
    /// whose semi-axes say how far the gradients hold (Schwarzhaupt 2012). All 0: as far as R alone lets it.
    pub ellipse: [f32; 3],
    /// Standard error of E_i, root mean square over the channels, W/m².
    pub noise: f32,
}

/// What a query of irradiance gets.
#[derive(Clone, Copy, PartialEq, Default, Debug)]
pub struct Answer {
    /// Irradiance, W/m².
    pub irradiance: Rgb,
    /// How many records answered.
    pub records: u32,
    /// Standard error of the irradiance for the records' noise, root mean square over the channels, W/m².
    pub noise: f32,
}

/// Wire and memory order of the float fields after the id.
const FLOATS: usize = 28;

impl Cached for Irradiance {
    type Answer = Answer;

    fn position(&self) -> Vec3 {
        self.position
    }

    fn radius(&self) -> f32 {
        self.radius
    }

    fn radius_bounds(&self) -> (f32, f32) {
        (self.radius_min, self.radius_max)
    }

    /// The error e is that of Ward 1988 eq. 5, or the ellipse's where that says more.
    #[inline]
    fn error(&self, query: &Query, radius: f32, a: f32) -> f32 {
        let of = (self.position, self.normal, self.ellipse);
        site::error(of, query, radius, a).map_or(f32::INFINITY, |(error, _)| error)
    }

    /// Ward 1992 eq. 6: E_i + (n_i × n)·∇_r E_i + (p - p_i)·∇_t E_i, never below 0; n is the shading normal, so that bumps
    /// cost no records.
    #[inline]
    fn add(&self, query: &Query, weight: f32, limit: f32, answer: &mut Answer) {
        let frame = Frame::around(self.normal);
        let shift = frame.tangential(query.position - self.position) * limit;
        let turn = frame.tangential(self.normal.cross(query.shading));
        let change = |c: usize| self.gradient_t[c].dot(shift) + self.gradient_r[c].dot(turn);
        let estimate = self.irradiance + Vec3::new(change(0), change(1), change(2));
        answer.irradiance += estimate.max(Vec3::ZERO) * weight;
        answer.records += 1;
        answer.noise += (self.noise * weight).powi(2);
    }

    fn finish(answer: &mut Answer, weights: f32) {
        answer.irradiance /= weights;
        answer.noise = answer.noise.sqrt() / weights;
    }
}

impl Packed for Irradiance {
    const KIND: u32 = 1;
    const BYTES: usize = 16 + 4 * FLOATS;

    fn id(&self) -> RecordId {
        self.id
    }

    fn encode(&self, bytes: &mut Vec<u8>) {
        let mut packed = [0; Self::BYTES];
        let (head, tail) = packed.split_at_mut(16);
        head.copy_from_slice(&self.id.0.to_le_bytes());
        for (four, value) in tail.chunks_exact_mut(4).zip(self.floats()) {
            four.copy_from_slice(&value.to_le_bytes());
        }
        // Once: a vector looks for room each time.
        bytes.extend_from_slice(&packed);
    }

    fn decode(bytes: &[u8]) -> Result<Self, Invalid> {
        if bytes.len() != Self::BYTES {
            return Err(Invalid::Length { expected: Self::BYTES, got: bytes.len() });
        }
        let (head, tail) = bytes.split_at(16);
        let id = RecordId(head.iter().rev().fold(0, |id, &b| id << 8 | u128::from(b)));
        let mut f = [0f32; FLOATS];
        for (value, four) in f.iter_mut().zip(tail.chunks_exact(4)) {
            *value = f32::from_le_bytes([four[0], four[1], four[2], four[3]]);
        }
        let pairs = |at: usize| [0, 2, 4].map(|i| Vec2::new(f[at + i], f[at + i + 1]));
        let record = Self {
            id,
            position: Vec3::new(f[0], f[1], f[2]),
            normal: Vec3::new(f[3], f[4], f[5]),
            radius: f[6],
            radius_min: f[7],
            radius_max: f[8],
            irradiance: Vec3::new(f[9], f[10], f[11]),
            gradient_t: pairs(12),
            gradient_r: pairs(18),
            ellipse: [f[24], f[25], f[26]],
            noise: f[27],
        };
        record.check().map(|()| record)
    }
}

impl Irradiance {
    fn floats(&self) -> [f32; FLOATS] {
        let [p, n, e] = [self.position, self.normal, self.irradiance];
        let ([t, r], m) = ([self.gradient_t, self.gradient_r], self.ellipse);
        [
            p.x,
            p.y,
            p.z,
            n.x,
            n.y,
            n.z,
            self.radius,
            self.radius_min,
            self.radius_max,
            e.x,
            e.y,
            e.z,
            t[0].x,
            t[0].y,
            t[1].x,
            t[1].y,
            t[2].x,
            t[2].y,
            r[0].x,
            r[0].y,
            r[1].x,
            r[1].y,
            r[2].x,
            r[2].y,
            m[0],
            m[1],
            m[2],
            self.noise,
        ]
    }

    /// Whether the record is sound, whoever made it.
    ///
    /// # Errors
    /// The first field that is not.
    pub fn check(&self) -> Result<(), Invalid> {
        const FIELDS: [(&str, usize); 10] = [
            ("position", 3),
            ("normal", 3),
            ("radius", 1),
            ("radius_min", 1),
            ("radius_max", 1),
            ("irradiance", 3),
            ("gradient_t", 6),
            ("gradient_r", 6),
            ("ellipse", 3),
            ("noise", 1),
        ];
        let floats = self.floats();
        // All at once: which one it was is seldom asked.
        if !floats.iter().fold(true, |finite, value| finite & value.is_finite()) {
            let mut values = floats.iter();
            let unsound = FIELDS.iter().find(|(_, count)| values.by_ref().take(*count).any(|v| !v.is_finite()));
            return Err(Invalid::NotFinite { field: unsound.map_or("a field", |(field, _)| field) });
        }
        site::check(self.position, self.normal, self.radius, self.radius_bounds())?;
        site::check_ellipse(self.ellipse)?;
        if self.noise < 0.0 {
            return Err(Invalid::Range { field: "noise", value: self.noise, expected: "0 or more" });
        }
        if self.irradiance.min_element() < 0.0 {
            let value = self.irradiance.min_element();
            return Err(Invalid::Range { field: "irradiance", value, expected: "0 or more" });
        }
        Ok(())
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::details::Weighting;

    pub(crate) fn sound() -> Irradiance {
        Irradiance {
            id: RecordId(0x0123_4567_89ab_cdef_0011_2233_4455_6677),
            position: Vec3::new(1.0, 2.0, 3.0),
            normal: Vec3::Y,
            radius: 2.0,
            radius_min: 0.1,
            radius_max: 10.0,
            irradiance: Vec3::new(1.0, 2.0, 3.0),
            gradient_t: [Vec2::new(0.1, 0.2); 3],
            gradient_r: [Vec2::new(0.3, -0.4); 3],
            ellipse: [0.0; 3],
            noise: 0.0,
        }
    }

    #[test]
    fn encoding_is_stable_and_decodes_to_the_same() {
        let mut bytes = Vec::new();
        sound().encode(&mut bytes);
        assert_eq!(bytes.len(), Irradiance::BYTES);
        assert_eq!(bytes[..4], [0x77, 0x66, 0x55, 0x44]);
        assert_eq!(bytes[16..20], 1f32.to_le_bytes());
        assert_eq!(bytes[16 + 6 * 4..16 + 7 * 4], 2f32.to_le_bytes());
        assert_eq!(Irradiance::decode(&bytes), Ok(sound()));
        assert!(matches!(Irradiance::decode(&bytes[1..]), Err(Invalid::Length { .. })));
    }

    #[test]
    fn unsound_records_are_refused_by_name() {
        type Spoil = fn(&mut Irradiance);
        let spoilt: [(&str, Spoil); 14] = [
            ("position", |r| r.position.x = f32::NAN),
            ("gradient_r", |r| r.gradient_r[2].y = f32::INFINITY),
            ("radius", |r| r.radius = f32::INFINITY),
            ("normal", |r| r.normal = Vec3::new(0.0, 2.0, 0.0)),
            ("irradiance", |r| r.irradiance.y = -1e-6),
            ("radius", |r| r.radius = 0.0),
            ("radius", |r| r.radius = 1e-30),
            ("radius", |r| (r.position, r.radius) = (Vec3::Y * -1e6, 1e-4)),
            ("radius_min", |r| r.radius_min = -1.0),
            ("radius_max", |r| r.radius_max = 0.01),
            ("radius_max", |r| (r.radius_min, r.radius_max) = (1e-40, 1e-19)),
            ("ellipse", |r| r.ellipse = [1.0, 2.0, 1.0]),
            ("ellipse", |r| r.ellipse = [1.0, 0.0, f32::NAN]),
            ("noise", |r| r.noise = -1.0),
        ];
        for (field, spoil) in spoilt {
            let mut record = sound();
            spoil(&mut record);
            let mut bytes = Vec::new();
            record.encode(&mut bytes);
            let message = Irradiance::decode(&bytes).expect_err(field).to_string();
            assert!(message.contains(field), "{field}: {message}");
        }
    }

    #[test]
    fn weight_falls_to_zero_at_the_border_and_excludes_what_lies_behind() {
        let r = sound();
        let at = |offset: Vec3| Query::new(r.position + offset, r.normal);
        let weight = |query: &Query| Weighting::InverseToZero.weight(r.error(query, 2.0, 0.3), 0.3);
        assert!(weight(&at(Vec3::X * 0.5)) > 0.0);
        assert!(weight(&at(Vec3::X * 0.599)) < 0.01);
        assert_eq!(weight(&at(Vec3::X * 0.601)), 0.0);
        // A query below the record would see what the record does not.
        assert_eq!(weight(&at(Vec3::new(0.1, -0.1, 0.0))), 0.0);
        assert!(weight(&at(Vec3::new(0.1, 0.1, 0.0))) > 0.0);
        // On the site itself the weight is finite.
        assert!(weight(&at(Vec3::ZERO)).is_finite());
    }

    #[test]
    fn the_ellipse_bounds_what_r_allows() {
        let frame = Frame::around(sound().normal);
        // Semi-axes 1 and 4: at a = 0.3, 0.3 along x and, but for R = 2, 1.2 along y.
        let r = Irradiance { ellipse: [1.0, 0.0, 1.0 / 16.0], ..sound() };
        let reaches = |offset: Vec3| {
            let query = Query::new(r.position + offset, r.normal);
            r.error(&query, 2.0, 0.3) < 0.3
        };
        assert!(reaches(frame.x * 0.29) && !reaches(frame.x * 0.31));
        assert!(reaches(frame.y * 0.59) && !reaches(frame.y * 0.61));
    }
}
