//! What a record is, where it is filed, how it answers. Pure: no I/O, clock, async or threads.
//!
//! In the order of the flow, one sentence each:
//!
//! - [`math`]: colours, tangent frames, and the transcendental functions whose bits must not depend on the C library.
//! - [`hsh`]: hemispherical harmonics, their rotation, and glossy lobes in them (Gautron 2004).
//! - [`id`]: a record's identity is made from what determines it, and so are its random numbers.
//! - [`cached`]: the first door: what every kind of record must be able to do.
//! - [`irradiance`]: the room of irradiance: record, weights, gradients, interpolation (Ward 1988, 1992).
//! - [`radiance`]: the room of incoming radiance, which glossy surfaces reflect (Krivanek 2005).
//! - [`null`]: the empty room that proves the door.
//! - [`shrink`]: a proposal that a record count less far (Krivanek 2006).
//! - [`record`]: a record of any kind.
//! - [`hemisphere`]: stratified directions of a gather, and what their samples say: E, both gradients, R.
//! - [`incoming`]: the same for radiance: cells, coefficients, derivatives (Krivanek 2005b).
//! - [`set`]: id to record, union is the only merge; with its order-free digest.
//! - [`clamp`]: neighbor clamping in its order-free form (Krivanek 2006).
//! - [`octree`]: files records by their reach, answers which may count at a point.
//! - [`sealed`]: a set nothing more will be added to, ready to be asked.
//! - [`rounds`]: the plan by which a frame is filled, coarse to fine, independent of the farm.

pub mod math;

pub mod hsh;
pub mod id;

pub mod cached;
pub mod irradiance;
pub mod null;
pub mod radiance;
pub mod shrink;
mod site;

pub mod record;

pub mod details;
pub mod hemisphere;
pub mod mesh;

pub mod incoming;

pub mod clamp;
pub mod octree;
pub mod sealed;
pub mod set;

pub mod rounds;

pub use cached::{Cached, Invalid, Packed, Query};
pub use id::{Namespace, RecordId};
pub use irradiance::Irradiance;
pub use math::Rgb;
pub use radiance::Radiance;
pub use record::Record;
pub use sealed::Sealed;
pub use set::{RecordSet, Tag};
pub use shrink::Shrink;
pub use site::radius_least;
