//! What a cache knows of the scene to be rendered, and if that is nothing, why.

use std::collections::BTreeSet;
use std::path::Path;

use cache_proto::v1::{FrameSpec, InfoRequest, Label};
use worker::client::{self, Address};
use worker::credentials::Credentials;
use worker::settings::ALL_BOUNCES;

use crate::failure::Failure;

/// A line for the user when the frame finds none of the records of a cache that has some.
///
/// # Errors
/// When the server does not answer.
pub async fn note(
    server: &Address,
    credentials: &Credentials,
    spec: &FrameSpec,
    cache: &Path,
) -> Result<Option<String>, Failure> {
    let line = client::connect(server, credentials).map_err(Failure::usage)?;
    let asked = client::retry(|| {
        let mut cache = client::cache(line.clone());
        async move { cache.info(InfoRequest {}).await }
    });
    let info = asked.await.map_err(|status| Failure::failed(format!("server {server}: {}", status.message())))?;
    if info.namespaces.iter().any(|known| known.namespace == spec.namespace) {
        return Ok(None);
    }
    let labels = info.namespaces.iter().filter_map(|known| known.label.as_ref());
    let others: Vec<_> = labels.filter(|label| label.draft_of.is_empty()).collect();
    let why = why(spec, &others);
    Ok(why.map(|why| format!("note: {}: {why}; a new namespace begins", cache.display())))
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
    use super::*;

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
