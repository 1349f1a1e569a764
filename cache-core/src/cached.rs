//! The first door: what every kind of record must be able to do.
//!
//! A room behind it says how its record is laid out, whether one is sound, how much it counts at a query and what it
//! adds to the answer. Filing, clamping, shrinking, merging and sealing are the same for all rooms and live outside.

use glam::Vec3;

use crate::id::RecordId;

/// Where an answer is wanted: a point of a surface.
#[derive(Clone, Copy, Debug)]
pub struct Query {
    /// World position.
    pub position: Vec3,
    /// Unit normal of the surface, by which records are found and weighed.
    pub normal: Vec3,
    /// Unit normal the answer is for: another one where the surface has bumps too small for records of their own.
    pub shading: Vec3,
}

impl Query {
    /// Where a surface has no bumps.
    pub fn new(position: Vec3, normal: Vec3) -> Self {
        Self { position, normal, shading: normal }
    }
}

/// What makes a record unfit to be kept. Checked in one place, [`Packed::decode`], whoever sent the bytes.
#[derive(Clone, Copy, PartialEq, Debug, thiserror::Error)]
pub enum Invalid {
    /// Not a whole number of records.
    #[error("a record of this kind has {expected} bytes, got {got}")]
    Length {
        /// Bytes of one record.
        expected: usize,
        /// Bytes there were.
        got: usize,
    },
    /// A field that is NaN or infinite.
    #[error("{field} is not a finite number")]
    NotFinite {
        /// Which.
        field: &'static str,
    },
    /// A normal that is not of unit length.
    #[error("normal has length {length}, expected 1")]
    Normal {
        /// Its length.
        length: f32,
    },
    /// An id that does not belong to the rest.
    #[error("id is not that of the content")]
    Id,
    /// A field outside its range.
    #[error("{field} is {value}, expected {expected}")]
    Range {
        /// Which.
        field: &'static str,
        /// What it was.
        value: f32,
        /// What would have been right.
        expected: &'static str,
    },
}

/// A kind of record as it is kept and sent: an identity and bytes.
pub trait Packed: Copy + Send + Sync + 'static {
    /// Number of the kind on the wire; never re-used.
    const KIND: u32;
    /// Bytes of one packed record.
    const BYTES: usize;

    /// Identity.
    fn id(&self) -> RecordId;

    /// Appends the record's [`Self::BYTES`] bytes.
    fn encode(&self, bytes: &mut Vec<u8>);
    /// Reads and checks one record: the only way bytes become one.
    ///
    /// # Errors
    /// What is unsound about it.
    fn decode(bytes: &[u8]) -> Result<Self, Invalid>;
}

/// A kind of record that answers. Records are immutable: what changes later (the clamped R, a) is derived and kept outside.
pub trait Cached: Packed {
    /// What a query gets.
    type Answer: Clone + Default;

    /// The site's position.
    fn position(&self) -> Vec3;
    /// R_i at birth: distance to the surroundings, world length, before any clamping. Positive, may be infinite.
    fn radius(&self) -> f32;
    /// Least and greatest R the record may count with, world lengths; both finite and positive.
    fn radius_bounds(&self) -> (f32, f32);

    /// Relative error e_i at a query for the clamped and bounded `radius`; the record counts where it is below the allowed
    /// error `a`, and nothing needs to be known of it where it is not. At least the query's distance over `radius`;
    /// infinite where the record must not count.
    fn error(&self, query: &Query, radius: f32, a: f32) -> f32;
    /// Adds this record's estimate at `query`, times `weight`, to `answer`. `limit` in [0, 1] scales gradients where
    /// the record counts farther than its R allows extrapolation.
    fn add(&self, query: &Query, weight: f32, limit: f32, answer: &mut Self::Answer);
    /// Divides the sum by the weights.
    fn finish(answer: &mut Self::Answer, weights: f32);
}
