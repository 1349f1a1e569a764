//! A record of any kind: what logs hold.

use crate::cached::{Invalid, Packed};
use crate::id::RecordId;
use crate::irradiance::Irradiance;
use crate::shrink::Shrink;

/// A record of any kind.
#[derive(Clone, Copy, PartialEq, Debug)]
pub enum Record {
    /// Diffuse indirect light at a site.
    Irradiance(Irradiance),
    /// Another record should count less far.
    Shrink(Shrink),
}

impl Record {
    /// Number of its kind on the wire.
    pub fn kind(&self) -> u32 {
        match self {
            Self::Irradiance(_) => Irradiance::KIND,
            Self::Shrink(_) => Shrink::KIND,
        }
    }

    /// Identity.
    #[inline]
    pub fn id(&self) -> RecordId {
        match self {
            Self::Irradiance(record) => record.id,
            Self::Shrink(shrink) => shrink.id,
        }
    }

    /// Appends its packed bytes.
    pub fn encode(&self, bytes: &mut Vec<u8>) {
        match self {
            Self::Irradiance(record) => record.encode(bytes),
            Self::Shrink(shrink) => shrink.encode(bytes),
        }
    }

    /// Whether it is sound, whoever made it.
    ///
    /// # Errors
    /// What is not.
    pub fn check(&self) -> Result<(), Invalid> {
        match self {
            Self::Irradiance(record) => record.check(),
            Self::Shrink(shrink) => shrink.check(),
        }
    }

    /// Bytes of a packed record of a kind; `None` for a kind this build does not know.
    pub fn bytes(kind: u32) -> Option<usize> {
        match kind {
            Irradiance::KIND => Some(Irradiance::BYTES),
            Shrink::KIND => Some(Shrink::BYTES),
            _ => None,
        }
    }

    /// Reads and checks one record of a kind; `None` for a kind this build does not know.
    ///
    /// # Errors
    /// What is unsound about it.
    pub fn decode(kind: u32, bytes: &[u8]) -> Option<Result<Self, Invalid>> {
        match kind {
            Irradiance::KIND => Some(Irradiance::decode(bytes).map(Self::Irradiance)),
            Shrink::KIND => Some(Shrink::decode(bytes).map(Self::Shrink)),
            _ => None,
        }
    }
}

impl From<Irradiance> for Record {
    fn from(record: Irradiance) -> Self {
        Self::Irradiance(record)
    }
}

impl From<Shrink> for Record {
    fn from(shrink: Shrink) -> Self {
        Self::Shrink(shrink)
    }
}

/// It is of another kind.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
#[error("a record of another kind")]
pub struct OtherKind;

impl TryFrom<Record> for Irradiance {
    type Error = OtherKind;

    fn try_from(record: Record) -> Result<Self, OtherKind> {
        if let Record::Irradiance(record) = record { Ok(record) } else { Err(OtherKind) }
    }
}
