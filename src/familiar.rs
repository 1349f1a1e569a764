//! What a cache knows of the scene to be rendered: records of the frame's settings, or of others that serve as well; and if
//! that is nothing, why.

use std::collections::BTreeSet;
use std::path::Path;

use cache_proto::v1::{FrameSpec, InfoRequest, Label};
use worker::client::{self, Address};
use worker::credentials::Credentials;
use worker::settings::ALL_BOUNCES;

use crate::failure::Failure;

/// Records with this much fewer rays by deviation still reach the error asked for: the pilot aims lower.
const FEWER_RAYS: f32 = 1.5;

/// With this many more, or an a smaller by as much, a record costs more than a new namespace saves.
const BETTER: f32 = 2.1;

/// What a cache has for a frame.
pub enum Found {
    /// Records of its settings, or none at all.
    Nothing,
    /// None of its own, but those of a view that was asked for about the same error.
    Near(Box<Label>),
    /// None it can use: a line for the user.
    Foreign(String),
}

/// What a cache has for a frame.
///
/// # Errors
/// When the server does not answer.
pub async fn look(
    server: &Address,
    credentials: &Credentials,
    spec: &FrameSpec,
    cache: &Path,
) -> Result<Found, Failure> {
    let line = client::connect(server, credentials).map_err(Failure::usage)?;
    let asked = client::retry(|| {
        let mut cache = client::cache(line.clone());
        async move { cache.info(InfoRequest {}).await }
    });
    let info = asked.await.map_err(|status| Failure::failed(format!("server {server}: {}", status.message())))?;
    if info.namespaces.iter().any(|known| known.namespace == spec.namespace) {
        return Ok(Found::Nothing);
    }
    let labels = info.namespaces.iter().filter_map(|known| known.label.as_ref());
    let others: Vec<_> = labels.filter(|label| label.draft_of.is_empty()).collect();
    if let Some(label) = near(spec, &others) {
        return Ok(Found::Near(Box::new(label.clone())));
    }
    let why = why(spec, &others);
    Ok(why.map_or(Found::Nothing, |why| {
        Found::Foreign(format!("note: {}: {why}; a new namespace begins", cache.display()))
    }))
}

/// The namespace whose records reach the error a pilot chose the frame's settings for: views that look alike are told
/// settings that differ by a step.
fn near<'a>(spec: &FrameSpec, others: &[&'a Label]) -> Option<&'a Label> {
    let wanted = spec.effort?.rays;
    let serves = |label: &Label| {
        let rays = label.rays_by_deviation;
        let same = (label.rays, label.bounces, label.seed) == (spec.rays, spec.bounces, spec.seed);
        (same && label.scene_hash == spec.scene_hash && label.method == spec.method && label.least_rays > 0)
            && (wanted / FEWER_RAYS..=wanted * BETTER).contains(&rays)
            && (spec.a / BETTER..=spec.a).contains(&label.a)
    };
    let far = |label: &Label| (label.rays_by_deviation / wanted).ln().abs() + (spec.a / label.a).ln();
    let near = others.iter().copied().filter(|label| serves(label));
    near.min_by(|a, b| far(a).total_cmp(&far(b)).then_with(|| a.namespace.cmp(&b.namespace)))
}

/// Why none of the namespaces there are is the frame's; `None` when there are none.
fn why(spec: &FrameSpec, others: &[&Label]) -> Option<String> {
    if others.is_empty() {
        return None;
    }
    let scene = Path::new(&spec.scene).file_name().and_then(|name| name.to_str()).unwrap_or(&spec.scene);
    let same: Vec<_> = others.iter().filter(|label| label.scene_hash == spec.scene_hash).collect();
    if let Some(nearest) = same.iter().min_by_key(|label| differences(spec, label).len()) {
        let differences = differences(spec, nearest);
        if differences.is_empty() {
            return Some(format!("its records of {scene} were made by another version"));
        }
        return Some(format!("its records of {scene} were made with {}", differences.join(" ")));
    }
    if others.iter().any(|label| label.scene == scene) {
        return Some(format!("{scene} has changed since its records were made"));
    }
    let names: BTreeSet<_> = others.iter().map(|label| label.scene.as_str()).collect();
    Some(format!("it holds records of {} only", names.into_iter().collect::<Vec<_>>().join(", ")))
}

/// The settings a namespace was made with where they are not the frame's, as options.
fn differences(spec: &FrameSpec, label: &Label) -> Vec<String> {
    let bounces = |n: u32| if n == ALL_BOUNCES { "all".into() } else { n.to_string() };
    let by_deviation = spec.effort.map_or(0.0, |effort| effort.rays);
    let pairs = [
        ("method", label.method.clone(), spec.method.clone()),
        ("a", label.a.to_string(), spec.a.to_string()),
        ("rays", label.rays.to_string(), spec.rays.to_string()),
        ("rays-by-deviation", label.rays_by_deviation.to_string(), by_deviation.to_string()),
        ("bounces", bounces(label.bounces), bounces(spec.bounces)),
        ("seed", label.seed.to_string(), spec.seed.to_string()),
    ];
    let differing = pairs.into_iter().filter(|(_, there, here)| there != here);
    differing.map(|(name, there, _)| format!("--{name} {there}")).collect()
}

#[cfg(test)]
mod tests {
    use cache_proto::v1::Effort;

    use super::*;

    #[test]
    fn records_of_a_view_that_looks_alike_serve_and_worse_or_dearer_ones_do_not() {
        let effort = Some(Effort { rays: 100.0, least_rays: 32, samples: 1.0 });
        let spec = FrameSpec { a: 0.5, rays: 9, effort, ..Default::default() };
        let same = Label { a: 0.5, rays: 9, rays_by_deviation: 141.0, least_rays: 16, ..Default::default() };
        let [fewer, many, few] =
            [69.0, 201.0, 66.0].map(|rays_by_deviation| Label { rays_by_deviation, ..same.clone() });
        let near = |others: &[&Label]| super::near(&spec, others).map(|label| label.rays_by_deviation);
        assert_eq!(near(&[&many, &same, &fewer]), Some(141.0));
        assert_eq!(near(&[&few]), None);
        for other in [
            Label { a: 0.6, ..same.clone() },
            Label { a: 0.2, ..same.clone() },
            Label { seed: 1, ..same.clone() },
            Label { scene_hash: vec![1; 32].into(), ..same.clone() },
            Label { rays_by_deviation: 300.0, ..same.clone() },
            Label { least_rays: 0, ..same.clone() },
        ] {
            assert_eq!(near(&[&other]), None, "{other:?}");
        }
        let fixed = FrameSpec { effort: None, ..spec.clone() };
        assert!(super::near(&fixed, &[&same]).is_none());
    }

    #[test]
    fn the_reason_names_what_differs() {
        let (scene_hash, rays, bounces, a) = (vec![1; 32], 512, ALL_BOUNCES, 0.3);
        let scene = "/scenes/room.glb".into();
        let spec = FrameSpec { scene, scene_hash: scene_hash.clone().into(), rays, bounces, a, ..Default::default() };
        let scene = "room.glb".into();
        let same = Label { scene, scene_hash: scene_hash.into(), rays, bounces, a, ..Default::default() };
        let why = |others: &[Label]| why(&spec, &others.iter().collect::<Vec<_>>());
        assert_eq!(why(&[]), None);
        let fewer = Label { rays: 64, ..same.clone() };
        let others = [Label { bounces: 1, seed: 4, ..fewer.clone() }, fewer];
        assert_eq!(why(&others).as_deref(), Some("its records of room.glb were made with --rays 64"));
        let edited = Label { scene_hash: vec![2; 32].into(), ..same.clone() };
        assert_eq!(why(&[edited]).as_deref(), Some("room.glb has changed since its records were made"));
        let hall = Label { scene: "hall.rad".into(), scene_hash: vec![2; 32].into(), ..same };
        assert_eq!(why(&[hall.clone(), hall]).as_deref(), Some("it holds records of hall.rad only"));
    }
}
