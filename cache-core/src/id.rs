//! A record's identity is made from what determines it, and so are its random numbers.
//!
//! Two workers that compute the same record give it the same id and the same bits; a record sent twice is recognised.

use rand_core::Rng as _;
use rand_pcg::Mcg128Xsl64;

/// Scene content and every setting that changes a record's value, digested (BLAKE3, 32 bytes).
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
pub struct Namespace(pub [u8; 32]);

impl Namespace {
    /// The draft of a frame: a namespace for what it gathers until it is filled. `base` are the records of this namespace
    /// it reads, `view` everything else that decides which records it needs.
    pub fn draft(&self, base: Digest, view: &[u8]) -> Self {
        let mut hasher = blake3::Hasher::new_derive_key("ambience draft v1");
        hasher.update(&self.0);
        hasher.update(&base.0.to_le_bytes());
        hasher.update(view);
        Self(*hasher.finalize().as_bytes())
    }
}

/// Identity of a record: 128 bits of BLAKE3.
///
/// Aligned to 8 bytes: aligned to 16, an entry of a log would take 16 more.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug)]
#[repr(C, packed(8))]
pub struct RecordId(pub u128);

impl RecordId {
    /// The id of what was hashed.
    pub(crate) fn of(hash: &blake3::Hash) -> Self {
        Self(low_half(hash))
    }
}

/// Order-free digest of a set of records: the sum of their ids modulo 2^128.
///
/// Ids are uniform, so two different sets agree by chance once in 2^128; it is no defence against a liar.
#[derive(Clone, Copy, PartialEq, Eq, Default, Debug)]
pub struct Digest(pub u128);

impl Digest {
    /// Adds one record.
    pub fn add(&mut self, id: RecordId) {
        self.0 = self.0.wrapping_add(id.0);
    }

    /// Takes one record out again.
    pub fn remove(&mut self, id: RecordId) {
        self.0 = self.0.wrapping_sub(id.0);
    }

    /// The digest of two sets that have no record in common.
    pub fn and(self, other: Self) -> Self {
        Self(self.0.wrapping_add(other.0))
    }
}

/// Everything a record is determined by.
#[derive(Clone, Copy, Debug)]
pub struct Origin<'a> {
    /// Scene and settings.
    pub namespace: &'a Namespace,
    /// Which room of the first door (`Cached::KIND`).
    pub kind: u32,
    /// Which bounce it answers for, from 1.
    pub level: u32,
    /// The site: position, normal and what else the gather depends on there.
    pub site: &'a [f32],
    /// The user's seed.
    pub seed: u64,
    /// Digest of the sealed set the gather may read.
    pub read: Digest,
}

impl Origin<'_> {
    /// The id of the one record these inputs determine.
    pub fn id(&self) -> RecordId {
        let mut hasher = blake3::Hasher::new_derive_key("ambience record v1");
        hasher.update(&self.namespace.0);
        hasher.update(&self.kind.to_le_bytes());
        hasher.update(&self.level.to_le_bytes());
        hasher.update(&self.seed.to_le_bytes());
        hasher.update(&self.read.0.to_le_bytes());
        for value in self.site {
            hasher.update(&value.to_le_bytes());
        }
        RecordId::of(&hasher.finalize())
    }
}

fn low_half(hash: &blake3::Hash) -> u128 {
    let mut half = [0; 16];
    half.copy_from_slice(&hash.as_bytes()[..16]);
    u128::from_le_bytes(half)
}

/// Random numbers that depend on nothing but an id.
#[derive(Clone, Debug)]
pub struct Random(Mcg128Xsl64);

impl Random {
    /// The numbers that belong to a record.
    pub fn of(id: RecordId) -> Self {
        Self(Mcg128Xsl64::new(id.0))
    }

    /// The numbers that belong to anything else with a name: a purpose and integers (a pixel, a sample, a seed).
    pub fn named(purpose: &str, numbers: &[u64]) -> Self {
        let mut hasher = blake3::Hasher::new_derive_key("ambience random v1");
        for n in numbers {
            hasher.update(&n.to_le_bytes());
        }
        hasher.update(purpose.as_bytes());
        Self(Mcg128Xsl64::new(low_half(&hasher.finalize())))
    }

    /// The next number, uniform in [0, 1).
    #[inline]
    pub fn uniform(&mut self) -> f32 {
        (self.0.next_u64() >> 40) as f32 * (1.0 / (1 << 24) as f32)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn origin(namespace: &Namespace) -> Origin<'_> {
        Origin { namespace, kind: 1, level: 1, site: &[1.0, 2.0], seed: 0, read: Digest(5) }
    }

    #[test]
    fn every_input_changes_the_id() {
        let (n, other) = (Namespace([1; 32]), Namespace([2; 32]));
        let base = origin(&n);
        let changed = [
            Origin { namespace: &other, ..base },
            Origin { kind: 2, ..base },
            Origin { level: 2, ..base },
            Origin { site: &[1.0, 2.0000002], ..base },
            Origin { seed: 1, ..base },
            Origin { read: Digest(6), ..base },
        ];
        assert_eq!(base.id(), origin(&n).id());
        for other in changed {
            assert_ne!(base.id(), other.id(), "{other:?}");
        }
    }

    #[test]
    fn random_numbers_replay_and_are_uniform() {
        let mut a = Random::of(RecordId(7));
        let mut b = Random::of(RecordId(7));
        let (mut sum, mut squares) = (0.0, 0.0);
        for _ in 0..100_000 {
            let x = a.uniform();
            assert_eq!(x, b.uniform());
            assert!((0.0..1.0).contains(&x));
            sum += f64::from(x);
            squares += f64::from(x) * f64::from(x);
        }
        assert!((sum / 1e5 - 0.5).abs() < 5e-3 && (squares / 1e5 - 1.0 / 3.0).abs() < 5e-3);
    }
}
