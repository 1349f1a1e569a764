//! A record of any kind: what logs hold.

use std::any::Any;
use std::fmt;
use std::sync::Arc;

use crate::cached::{Invalid, Packed};
use crate::hsh::order;
use crate::id::RecordId;
use crate::irradiance::Irradiance;
use crate::of_order;
use crate::radiance::{ORDERS, Plain, Radiance, order_of};
use crate::shrink::Shrink;

/// A record of any kind.
#[derive(Clone, PartialEq, Debug)]
pub enum Record {
    /// Diffuse indirect light at a site.
    Irradiance(Irradiance),
    /// Another record should count less far.
    Shrink(Shrink),
    /// Incoming radiance at a site, of any order.
    Radiance(Ordered),
}

/// A record of radiance whose order its kind tells: some are thirty times as large as one of irradiance, so they are shared.
#[derive(Clone)]
pub struct Ordered(Arc<dyn Erased>);

/// What is the same for all orders.
trait Erased: Any + Send + Sync {
    fn kind(&self) -> u32;
    fn order(&self) -> usize;
    fn id(&self) -> RecordId;
    fn encode(&self, bytes: &mut Vec<u8>);
    fn check(&self) -> Result<(), Invalid>;
    fn plain(&self) -> Plain;
    fn text(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result;
}

impl<const N: usize> Erased for Radiance<N> {
    fn kind(&self) -> u32 {
        Self::KIND
    }

    fn order(&self) -> usize {
        order(N)
    }

    fn id(&self) -> RecordId {
        self.id
    }

    fn encode(&self, bytes: &mut Vec<u8>) {
        Packed::encode(self, bytes);
    }

    fn check(&self) -> Result<(), Invalid> {
        self.check()
    }

    fn plain(&self) -> Plain {
        self.into()
    }

    fn text(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Debug::fmt(self, f)
    }
}

impl Ordered {
    /// The record, if it has N coefficients.
    fn of<const N: usize>(&self) -> Option<&Radiance<N>> {
        (&*self.0 as &dyn Any).downcast_ref()
    }

    /// The order of its coefficients.
    pub fn order(&self) -> usize {
        self.0.order()
    }

    /// The record field by field.
    pub fn plain(&self) -> Plain {
        self.0.plain()
    }

    fn bytes(&self) -> Vec<u8> {
        let mut bytes = Vec::new();
        self.0.encode(&mut bytes);
        bytes
    }
}

impl PartialEq for Ordered {
    fn eq(&self, other: &Self) -> bool {
        self.0.kind() == other.0.kind() && self.bytes() == other.bytes()
    }
}

impl fmt::Debug for Ordered {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.text(f)
    }
}

impl Record {
    /// Number of its kind on the wire.
    pub fn kind(&self) -> u32 {
        match self {
            Self::Irradiance(_) => Irradiance::KIND,
            Self::Shrink(_) => Shrink::KIND,
            Self::Radiance(record) => record.0.kind(),
        }
    }

    /// Identity.
    #[inline]
    pub fn id(&self) -> RecordId {
        match self {
            Self::Irradiance(record) => record.id,
            Self::Shrink(shrink) => shrink.id,
            Self::Radiance(record) => record.0.id(),
        }
    }

    /// Appends its packed bytes.
    pub fn encode(&self, bytes: &mut Vec<u8>) {
        match self {
            Self::Irradiance(record) => record.encode(bytes),
            Self::Shrink(shrink) => shrink.encode(bytes),
            Self::Radiance(record) => record.0.encode(bytes),
        }
    }

    /// As how many records of irradiance it counts where memory is bounded: large ones as several.
    pub fn units(&self) -> usize {
        Self::bytes(self.kind()).map_or(1, |bytes| bytes.div_ceil(Irradiance::BYTES))
    }

    /// Whether it is sound, whoever made it.
    ///
    /// # Errors
    /// What is not.
    pub fn check(&self) -> Result<(), Invalid> {
        match self {
            Self::Irradiance(record) => record.check(),
            Self::Shrink(shrink) => shrink.check(),
            Self::Radiance(record) => record.0.check(),
        }
    }

    /// The record of radiance of these fields, checked.
    ///
    /// # Errors
    /// What is unsound about it.
    pub fn radiance(plain: &Plain) -> Result<Self, Invalid> {
        let many = plain.coefficients[0].len();
        let order = ORDERS.into_iter().find(|order| order * order == many);
        let record = order.and_then(|order| of_order!(order, N => Radiance::<N>::try_from(plain).map(Self::from)));
        let expected = "4, 16, 36, 64 or 100 of each channel";
        let unknown = Err(Invalid::Range { field: "coefficients", value: many as f32, expected });
        let record = record.unwrap_or(unknown)?;
        Self::check(&record).map(|()| record)
    }

    /// Bytes of a packed record of a kind; `None` for a kind this build does not know.
    pub fn bytes(kind: u32) -> Option<usize> {
        match kind {
            Irradiance::KIND => Some(Irradiance::BYTES),
            Shrink::KIND => Some(Shrink::BYTES),
            other => of_order!(order_of(other), N => Radiance::<N>::BYTES),
        }
    }

    /// Reads and checks one record of a kind; `None` for a kind this build does not know.
    ///
    /// # Errors
    /// What is unsound about it.
    pub fn decode(kind: u32, bytes: &[u8]) -> Option<Result<Self, Invalid>> {
        match kind {
            Irradiance::KIND => Some(Irradiance::decode(bytes).map(Self::from)),
            Shrink::KIND => Some(Shrink::decode(bytes).map(Self::from)),
            other => of_order!(order_of(other), N => Radiance::<N>::decode(bytes).map(Self::from)),
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

impl<const N: usize> From<Radiance<N>> for Record {
    fn from(record: Radiance<N>) -> Self {
        Self::Radiance(Ordered(Arc::new(record)))
    }
}

/// It is of another kind.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
#[error("a record of another kind")]
pub struct OtherKind;

impl TryFrom<&Record> for Irradiance {
    type Error = OtherKind;

    fn try_from(record: &Record) -> Result<Self, OtherKind> {
        if let Record::Irradiance(record) = record { Ok(*record) } else { Err(OtherKind) }
    }
}

impl<const N: usize> TryFrom<&Record> for Radiance<N> {
    type Error = OtherKind;

    fn try_from(record: &Record) -> Result<Self, OtherKind> {
        if let Record::Radiance(record) = record { record.of().copied().ok_or(OtherKind) } else { Err(OtherKind) }
    }
}
