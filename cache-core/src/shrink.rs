//! A proposal that a record count less far: adaptive a_i (Krivanek et al. 2006, 4).
//!
//! Whoever finds that record i makes a step in the picture where it still counts proposes a lower allowed error for it.
//! a_i is the least of all proposals and the global a: a minimum, so that their order, number and repetition do not matter.
//! A proposal is a record of its own, never changed; a_i is derived where records are sealed ([`crate::sealed`]).

use smallvec::SmallVec;

use crate::cached::{Invalid, Packed};
use crate::id::RecordId;

/// A proposal.
#[derive(Clone, Copy, PartialEq, Debug)]
pub struct Shrink {
    /// Identity: what is proposed for which record, digested.
    pub id: RecordId,
    /// The record it is about.
    pub of: RecordId,
    /// Allowed error it should count with at most, more than 0 and at most 10.
    pub a: f32,
}

impl Shrink {
    /// Proposes `a` for the record `of`.
    pub fn new(of: RecordId, a: f32) -> Self {
        let mut hasher = blake3::Hasher::new_derive_key("ambience shrink v1");
        hasher.update(&of.0.to_le_bytes());
        hasher.update(&a.to_le_bytes());
        Self { id: RecordId::of(&hasher.finalize()), of, a }
    }

    /// Whether the proposal is sound, whoever made it. Its id must be that of what is proposed: nobody can take another
    /// one's place.
    ///
    /// # Errors
    /// What is not.
    pub fn check(&self) -> Result<(), Invalid> {
        if !(self.a > 0.0 && self.a <= 10.0) {
            return Err(Invalid::Range { field: "a", value: self.a, expected: "more than 0 and at most 10" });
        }
        if Self::new(self.of, self.a).id == self.id { Ok(()) } else { Err(Invalid::Id) }
    }
}

impl Packed for Shrink {
    const KIND: u32 = 2;
    const BYTES: usize = 36;

    fn id(&self) -> RecordId {
        self.id
    }

    fn encode(&self, bytes: &mut Vec<u8>) {
        bytes.extend_from_slice(&self.id.0.to_le_bytes());
        bytes.extend_from_slice(&self.of.0.to_le_bytes());
        bytes.extend_from_slice(&self.a.to_le_bytes());
    }

    fn decode(bytes: &[u8]) -> Result<Self, Invalid> {
        if bytes.len() != Self::BYTES {
            return Err(Invalid::Length { expected: Self::BYTES, got: bytes.len() });
        }
        let id = |at: usize| RecordId(bytes[at..at + 16].iter().rev().fold(0, |id, &b| id << 8 | u128::from(b)));
        let shrink =
            Self { id: id(0), of: id(16), a: f32::from_le_bytes([bytes[32], bytes[33], bytes[34], bytes[35]]) };
        shrink.check().map(|()| shrink)
    }
}

/// Change of luminance that can just be seen, as a fraction (Weber's law; Krivanek 2006, 4.3).
const WEBER: f32 = 0.02;

/// What one record brings to the outgoing radiance at a point.
#[derive(Clone, Copy, Debug)]
pub struct Share {
    /// Which.
    pub id: RecordId,
    /// Its weight in the interpolation, more than 0.
    pub weight: f32,
    /// Luminance of the outgoing radiance by its estimate, W/(sr m²).
    pub luminance: f32,
    /// Standard error of that, W/(sr m²).
    pub noise: f32,
    /// Its relative error at the point: an a_i of this much excludes it there.
    pub error: f32,
    /// Least a_i it may have.
    pub a_min: f32,
}

/// Proposes to exclude records whose contribution at a point can be told from that of the others (Krivanek 2006, 4.1):
/// of those without which the outgoing radiance would be another one to the eye, that of the least weight; then again
/// without it. `direct` is the luminance of direct light at the point, asked for at most once. What noise of the records
/// may explain counts as equal (4.3).
pub fn exclude(shares: impl IntoIterator<Item = Share>, direct: impl FnOnce() -> f32, mut propose: impl FnMut(Shrink)) {
    let mut shares: SmallVec<[Share; 8]> = shares.into_iter().collect();
    let (mut direct, mut known) = (Some(direct), 0.0);
    while shares.len() > 1 {
        let sum = |of: fn(&Share) -> f32| shares.iter().map(of).sum::<f32>();
        let (weights, light) = (sum(|s| s.weight), sum(|s| s.weight * s.luminance));
        let variance = sum(|s| (s.weight * s.noise) * (s.weight * s.noise));
        let all = light / weights;
        let deviation = variance.sqrt() / weights;
        let discernible = |s: &Share, direct: f32| {
            let rest = weights - s.weight;
            let others = (light - s.weight * s.luminance) / rest;
            let own = s.weight * s.noise;
            let deviation = deviation.max((variance - own * own).max(0.0).sqrt() / rest);
            s.error > s.a_min && (all - others).abs() > WEBER * (all + direct) + deviation
        };
        if !shares.iter().any(|s| discernible(s, known)) {
            return;
        }
        // Light there makes the eye less keen; seldom is it needed to know how much there is.
        if let Some(direct) = direct.take() {
            known = direct();
        }
        let found = (0..shares.len()).filter(|i| discernible(&shares[*i], known));
        let Some(least) = found.min_by(|i, k| shares[*i].weight.total_cmp(&shares[*k].weight)) else { return };
        let excluded = shares.remove(least);
        propose(Shrink::new(excluded.id, excluded.error));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_proposal_survives_packing_and_what_is_unsound_is_named() {
        let shrink = Shrink::new(RecordId(7 << 100 | 9), 0.125);
        let mut bytes = Vec::new();
        shrink.encode(&mut bytes);
        assert_eq!(bytes.len(), Shrink::BYTES);
        assert_eq!(Shrink::decode(&bytes), Ok(shrink));
        let spoilt = |at: usize, value: u8| {
            let mut bytes = bytes.clone();
            bytes[at] = value;
            Shrink::decode(&bytes).expect_err("unsound").to_string()
        };
        assert_eq!(spoilt(0, bytes[0] ^ 1), "id is not that of the content");
        assert_eq!(spoilt(16, 1), "id is not that of the content");
        assert_eq!(spoilt(35, 0xbf), "a is -0.5, expected more than 0 and at most 10");
        assert_eq!(spoilt(35, 0x42), "a is 32, expected more than 0 and at most 10");
        let short = Shrink::decode(&bytes[1..]).expect_err("short").to_string();
        assert_eq!(short, "a record of this kind has 36 bytes, got 35");
    }

    #[test]
    fn what_is_proposed_for_which_record_makes_the_id() {
        let ids = [Shrink::new(RecordId(1), 0.1), Shrink::new(RecordId(1), 0.2), Shrink::new(RecordId(2), 0.1)];
        assert!(ids[0].id != ids[1].id && ids[0].id != ids[2].id && ids[1].id != ids[2].id);
    }

    /// Four records; the last says something else by `step`.
    fn proposed(step: f32, noise: f32, direct: f32) -> Vec<RecordId> {
        let share = |i: u8| Share {
            id: RecordId(i.into()),
            weight: 1.0 + f32::from(i),
            luminance: if i == 3 { 1.0 + step } else { 1.0 },
            noise,
            error: 0.1,
            a_min: 0.01,
        };
        let mut found = Vec::new();
        exclude((0..4).map(share), || direct, |shrink| found.push((shrink.of, shrink.a)));
        assert!(found.iter().all(|(_, a)| *a == 0.1));
        found.into_iter().map(|(of, _)| of).collect()
    }

    /// Of weights 1 to 4 in 10, one that differs by d changes the mean by 0.4 d; Weber's law allows 2 % of it.
    #[test]
    fn what_the_eye_can_tell_is_excluded() {
        assert_eq!(proposed(0.04, 0.0, 0.0), []);
        assert_eq!(proposed(0.06, 0.0, 0.0), [RecordId(3)]);
        // Light there, and noise, make less of it.
        assert_eq!(proposed(0.06, 0.0, 1.0), []);
        assert_eq!(proposed(0.06, 0.02, 0.0), []);
    }

    /// Without the third the others differ from the fourth alone: of two that say different things the lighter goes.
    #[test]
    fn the_least_weight_goes_first_and_one_stays() {
        let share = |id, weight, luminance| Share {
            id: RecordId(id),
            weight,
            luminance,
            noise: 0.0,
            error: weight.recip(),
            a_min: 0.1,
        };
        let found = |shares: &[Share]| {
            let mut found = Vec::new();
            exclude(shares.iter().copied(), || 0.0, |shrink| found.push(shrink.of.0));
            found
        };
        assert_eq!(found(&[share(1, 3.0, 1.0), share(2, 2.0, 2.0), share(3, 1.0, 4.0)]), [3, 2]);
        assert_eq!(found(&[share(1, 3.0, 1.0)]), []);
        // One that counts out to its least reach stays; the other goes in its place.
        assert_eq!(found(&[share(1, 3.0, 1.0), share(2, 11.0, 2.0)]), [1]);
    }
}
