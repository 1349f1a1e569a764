//! The empty room: a record that knows where it lies and answers nothing. It proves that the door asks for no more
//! than filing, clamping and sealing need.

use glam::Vec3;

use crate::cached::{Cached, Invalid, Packed, Query};
use crate::id::RecordId;

/// A record without content.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Null {
    /// Identity.
    pub id: RecordId,
    /// World position.
    pub position: Vec3,
    /// R at birth, world length.
    pub radius: f32,
}

impl Cached for Null {
    /// How many records count at the query.
    type Answer = u32;

    fn position(&self) -> Vec3 {
        self.position
    }

    fn radius(&self) -> f32 {
        self.radius
    }

    fn radius_bounds(&self) -> (f32, f32) {
        (1e-18, 1e18)
    }

    fn error(&self, query: &Query, radius: f32, _: f32) -> f32 {
        query.position.distance(self.position) / radius
    }

    fn add(&self, _: &Query, _: f32, _: f32, answer: &mut u32) {
        *answer += 1;
    }

    fn finish(_: &mut u32, _: f32) {}
}

impl Packed for Null {
    const KIND: u32 = 0;
    const BYTES: usize = 32;

    fn id(&self) -> RecordId {
        self.id
    }

    fn encode(&self, bytes: &mut Vec<u8>) {
        bytes.extend_from_slice(&self.id.0.to_le_bytes());
        for v in [self.position.x, self.position.y, self.position.z, self.radius] {
            bytes.extend_from_slice(&v.to_le_bytes());
        }
    }

    fn decode(bytes: &[u8]) -> Result<Self, Invalid> {
        let Ok(bytes) = <&[u8; 32]>::try_from(bytes) else {
            return Err(Invalid::Length { expected: Self::BYTES, got: bytes.len() });
        };
        let float = |at: usize| f32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
        let (position, radius) = (Vec3::new(float(16), float(20), float(24)), float(28));
        if !position.is_finite() {
            return Err(Invalid::NotFinite { field: "position" });
        }
        if !(radius > 0.0 && radius.is_finite()) {
            return Err(Invalid::Range { field: "radius", value: radius, expected: "more than 0 and finite" });
        }
        let id = RecordId(bytes[..16].iter().rev().fold(0, |id, &b| id << 8 | u128::from(b)));
        Ok(Self { id, position, radius })
    }
}
