//! glTF 2.0, .glb and .gltf: the triangles, materials, punctual lights and cameras of the default scene.
//!
//! What would change the picture and is not supported is an error, never left out: skins, morph targets in effect,
//! alpha, vertex colours, normal maps, unknown material extensions. What cannot be shown in a still picture of real
//! light (animations, baked occlusion, the range hint of lights) is left out with a warning.

mod accessor;
mod container;
mod light;
mod material;
mod picture;
mod placement;
mod primitive;
#[cfg(test)]
mod tests;
mod viewpoint;

use std::path::Path;

use ::gltf::json::scene::{Node, Scene as Tree};
use ::gltf::json::{Index, Root};

use super::{Files, Scene, SceneError};
use container::{Document, beyond};
use material::Materials;
use placement::Placement;
use primitive::{Meshes, Target};

/// What is wrong and where in the file; `load` puts the file's name in front.
type Fault = String;

/// Longest message, in characters.
const LONGEST_LINE: usize = 2000;

/// Reads the default scene (the first where the file names none). The hash is left to the caller.
pub(super) fn load(path: &Path, files: &Files) -> Result<Scene, SceneError> {
    let name = path.display();
    // One line of bearable length, whatever a file has in its names and URIs.
    let line = |text: Fault| -> String {
        let text = format!("{name}: {text}").replace(|c: char| c.is_control(), " ");
        text.chars().take(LONGEST_LINE).collect()
    };
    let document = Document::open(path, files).map_err(|fault| SceneError(line(fault)))?;
    let mut scene = read(&document).map_err(|fault| SceneError(line(fault)))?;
    scene.warnings = scene.warnings.into_iter().map(line).collect();
    Ok(scene)
}

fn read(document: &Document) -> Result<Scene, Fault> {
    let root = &document.root;
    let mut scene = Scene { warnings: general_warnings(document), ..Scene::default() };
    let mut meshes = Meshes::new(document);
    let mut materials = Materials::new(document);
    walk(root, |node, place| {
        if let Some(mesh) = node.mesh {
            let target = Target { triangles: &mut scene.triangles, materials: &mut materials };
            meshes.place(mesh, node, place, target)?;
        }
        if let Some(camera) = node.camera {
            scene.cameras.push(viewpoint::camera(root, camera, node, place)?);
        }
        if let Some(reference) = node.extensions.as_ref().and_then(|e| e.khr_lights_punctual.as_ref()) {
            light::place(root, reference.light, place, &mut scene)?;
        }
        Ok(())
    })?;
    scene.warnings.extend(materials.warnings);
    scene.warnings.extend(meshes.warnings());
    (scene.materials, scene.textures) = (materials.materials, materials.textures);
    Ok(scene)
}

/// Visits the nodes of the default scene, parents first, in the file's order. The stack is our own, so that deep
/// hierarchies cannot overflow it.
fn walk(root: &Root, mut visit: impl FnMut(&Node, &Placement) -> Result<(), Fault>) -> Result<(), Fault> {
    let tree = default_scene(root)?;
    let mut seen = vec![false; root.nodes.len()];
    let mut pending: Vec<(Index<Node>, Placement)> =
        tree.nodes.iter().rev().map(|&child| (child, Placement::WORLD)).collect();
    while let Some((index, parent)) = pending.pop() {
        let node = root.get(index).ok_or_else(|| format!("node {index} {}", beyond(root.nodes.len())))?;
        let named = |fault: Fault| format!("{}: {fault}", name("node", node.name.as_deref(), index.value()));
        // Each node has one parent. Visiting it again would never end in a cycle, and grow exponentially in a lattice.
        if std::mem::replace(&mut seen[index.value()], true) {
            return Err(named("is reached twice; expected a tree, where each node has one parent".into()));
        }
        let place = check_extensions(node).and_then(|()| parent.child(node)).map_err(named)?;
        visit(node, &place).map_err(|fault| if node.mesh.is_some() { fault } else { named(fault) })?;
        pending.extend(node.children.iter().flatten().rev().map(|&child| (child, place)));
    }
    Ok(())
}

fn default_scene(root: &Root) -> Result<&Tree, Fault> {
    match root.scene {
        Some(index) => root.get(index).ok_or_else(|| format!("scene {index} {}", beyond(root.scenes.len()))),
        None => root.scenes.first().ok_or_else(|| "scenes: is empty; expected at least one scene".into()),
    }
}

/// Refuses extensions of nodes that multiply or hide what is there.
fn check_extensions(node: &Node) -> Result<(), Fault> {
    let mut extensions = node.extensions.iter().flat_map(|e| e.others.keys());
    match extensions.find(|e| ["EXT_mesh_gpu_instancing", "KHR_node_visibility"].contains(&e.as_str())) {
        Some(extension) => Err(format!("extension {extension} is not supported")),
        None => Ok(()),
    }
}

fn general_warnings(document: &Document) -> Vec<String> {
    let mut warnings = Vec::new();
    if !document.root.animations.is_empty() {
        warnings.push(format!("{} animations are ignored; nodes stay where they are", document.root.animations.len()));
    }
    warnings.extend(
        document
            .ignored_extensions()
            .map(|extension| format!("extensionsUsed: {extension:?} is not supported and ignored")),
    );
    warnings.extend(light::warnings(&document.root));
    warnings
}

/// How messages call a thing: by its name, or its index where it has none.
fn name(kind: &str, name: Option<&str>, index: usize) -> String {
    match name {
        Some(name) if !name.is_empty() => format!("{kind} {name:?}"),
        _ => format!("{kind} {index}"),
    }
}
