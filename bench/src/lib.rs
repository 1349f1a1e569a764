//! The charts: speed against accuracy, other renderers, rays, the service against the bare stream under it, farms that are simulated.
//!
//! - [`judge`]: scenes with references, and the measure pictures of them are held to; the tests use it too.
//! - [`model`]: scenes that are made up, and the files they are written to.
//! - [`arcade`]: some 65 000 triangles with sun and sky.
//! - [`louvres`]: a furnished room behind a window with louvres.
//! - [`own`]: those two with references by our own path tracer.
//! - [`pictures`]: speed against accuracy.
//! - [`asked`]: whether a picture is as far from the truth as was asked for.
//! - [`details`]: what each practical detail of irradiance caching buys.
//! - [`peers`]: what others use, on the same scenes.
//! - [`results`]: what pictures cost and how good they are, over several runs.
//! - [`rounded`]: a ball and a torus that gloss.
//! - [`gloss`]: records of radiance against sampling.
//! - [`lamps`]: a thousand lamps against one.
//! - [`start`]: from the start of the program to the first ray, and memory.
//! - [`soups`]: rooms of many triangles, and rays in them.
//! - [`rays`]: rays a second, against Embree.
//! - [`lookups`]: look-ups a second, against an octree of pointers.
//! - [`records`]: records made up, of real size.
//! - [`bare`]: the cache service with nothing behind it.
//! - [`host`]: a server in a process of its own.
//! - [`service`]: records in and out, queries and latency, as ratios to the bare stream.
//! - [`relay`]: what a relay costs, beside the same without one.
//! - [`splat`]: records drawn by a graphics adapter, against the octree.
//! - [`plane`]: a hemisphere seen through a plane: weights of its pixels, and what draws it, in Rust.
//! - [`glow`]: what surfaces send out, kept on their triangles.
//! - [`rasteriser`]: irradiance of records by a graphics adapter.
//! - [`rasterise`]: gathers rasterised, against gathers traced.
//! - [`work`]: what a simulated worker computes.
//! - [`farm`]: one frame by farms of many sizes.
//! - [`report`]: tables and charts. [`strip`]: pictures side by side.

pub mod asked;
pub mod details;
pub mod judge;
pub mod pictures;

pub mod arcade;
pub mod louvres;
pub mod model;
pub mod own;

pub mod peers;
pub mod results;

pub mod gloss;
pub mod rounded;

pub mod lamps;
pub mod lookups;
pub mod rays;
pub mod soups;
pub mod splat;
pub mod start;

pub mod glow;
pub mod plane;
pub mod rasterise;
pub mod rasteriser;

pub mod bare;
pub mod host;
pub mod records;
pub mod relay;
pub mod service;

pub mod farm;
pub mod work;

pub mod report;
pub mod strip;
