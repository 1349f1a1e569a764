//! How light becomes records and records become pixels.
//!
//! In the order of the flow, one sentence each:
//!
//! - [`scene`]: plain data from glTF and Radiance files.
//! - [`settings`]: what a picture depends on besides its scene.
//! - [`bvh`]: rays against triangles.
//! - [`world`]: what a ray meets, and from where the next may start.
//! - [`bsdf`]: how light scatters at a surface.
//! - [`lobes`]: which records serve a surface, and its gloss as they see it.
//! - [`lights`]: where light comes from and how shadow rays find it.
//! - [`spherical`]: lamps as seen from a point close by.
//! - [`sampler`]: where a path's random numbers come from.
//! - [`levels`]: the sealed records of a frame, of all kinds.
//! - [`trace`]: what a ray sees where it lands: the second door, and the path tracer.
//! - [`gather`]: a record is made.
//! - [`pixel`]: one pixel as its samples come in.
//! - [`refine`]: where records make visible steps, and how far they should shrink for that.
//! - [`frame`]: the two kinds of work a worker leases: filling rounds and making pixels.
//! - [`splat`]: answers from elsewhere than the octree.
//! - [`pilot`]: settings from an error.
//! - [`solo`]: a frame without a farm.
//! - [`spec`]: settings on the wire.
//! - [`credentials`]: tokens and certificates, as a client has them.
//! - [`client`]: the connection to a server.
//! - [`replica`]: a copy of a namespace's log.
//! - [`caches`]: what a step may read, sealed: a prefix of one log, lower steps of another.
//! - [`follow`]: keeps a replica following the server, and gives back what the server lost.
//! - [`scenes`]: scenes that others send.
//! - [`traffic`]: what this machine uses of the network.
//! - [`job`]: the seam between the protocol and the work.
//! - [`task`]: the renderer's job.
//! - [`ready`]: frames made ready.
//! - [`farm`]: the worker process.
//! - [`threads`]: work off the runtime's threads.
//! - [`film`]: tiles become OUT.exr and OUT.png.
//! - [`compare`]: how far a picture is from a reference.
//! - [`math`]: functions whose bits are the same everywhere.

pub mod scene;
pub mod settings;

pub mod bvh;
pub mod world;

pub mod bsdf;
pub mod lights;
pub mod lobes;
pub mod spherical;

pub mod levels;
pub mod sampler;
pub mod trace;

pub mod gather;
pub mod pixel;
pub mod refine;

pub mod frame;
pub mod splat;

pub mod pilot;
pub mod solo;

pub mod caches;
pub mod client;
pub mod credentials;
pub mod farm;
pub mod follow;
pub mod job;
pub mod ready;
pub mod replica;
pub mod scenes;
pub mod spec;
pub mod task;
pub mod threads;
pub mod traffic;

pub mod compare;
pub mod film;

pub mod math;
