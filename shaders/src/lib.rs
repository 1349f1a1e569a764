//! Splat nodes: the interpolation of records turned round (Gautron et al. 2005). Instead of asking the octree for every pixel,
//! every record is drawn onto the pixels it reaches, by a GPU, or by Mesa's lavapipe where there is none.
//!
//! `wgsl/` has one file for each step of a pass; each has its twin here:
//!
//! - [`layout`]: what passes read and write (`types.wgsl`).
//! - [`reach`]: which pixels a record may reach (`reach.wgsl`).
//! - [`twin`]: how much records count and what they say (`weigh.wgsl`, `estimate_*.wgsl`), blended (`splat.wgsl`, `sum.wgsl`) and
//!   divided by their weights (`normalise.wgsl`).
//!
//! What runs them:
//!
//! - [`device`]: the adapter.
//! - [`passes`]; their pipelines.
//! - [`splatter`]: records on the device, and points that ask them.
//! - [`node`]: the worker that has one.

pub mod layout;
pub mod reach;
pub mod twin;

pub mod device;
pub mod node;
pub mod passes;
pub mod splatter;
