//! From mesh primitives to world triangles.

use std::collections::BTreeMap;

use ::gltf::json::Index;
use ::gltf::json::accessor::{Accessor, Type};
use ::gltf::json::mesh::{Mesh, Mode, Primitive, Semantic};
use ::gltf::json::scene::Node;
use ::gltf::json::validation::Checked;
use glam::{DVec3, Vec2, Vec3};

use super::container::{Document, beyond};
use super::material::Materials;
use super::placement::Placement;
use super::{Fault, name};
use crate::scene::Triangle;

/// Largest coordinate. The squared length of a cross product of edges grows with the fourth power and must stay in the
/// range of f32.
const LARGEST_COORDINATE: f32 = 1e9;

/// The meshes of a document, and what was left out of them so far.
pub(super) struct Meshes<'a> {
    document: &'a Document,
    /// By mesh and primitive, summed over all nodes that show the mesh.
    flaws: BTreeMap<(usize, usize), Flaws>,
}

/// Where triangles and their materials go.
pub(super) struct Target<'t, 'a> {
    /// All triangles so far.
    pub(super) triangles: &'t mut Vec<Triangle>,
    /// All materials so far.
    pub(super) materials: &'t mut Materials<'a>,
}

#[derive(Clone, Copy, Default)]
struct Flaws {
    degenerate: usize,
    bad_normals: usize,
}

/// The attributes of a primitive, in world coordinates.
struct Vertices {
    positions: Vec<Vec3>,
    /// `None` in place of a zero or NaN normal.
    normals: Option<Vec<Option<Vec3>>>,
    uvs: Option<Vec<Vec2>>,
}

impl<'a> Meshes<'a> {
    /// None placed yet.
    pub(super) fn new(document: &'a Document) -> Self {
        Self { document, flaws: BTreeMap::new() }
    }

    /// Adds the triangles of the mesh that `node` shows.
    pub(super) fn place(
        &mut self,
        index: Index<Mesh>,
        node: &Node,
        place: &Placement,
        target: Target<'_, 'a>,
    ) -> Result<(), Fault> {
        let root = &self.document.root;
        let mesh = root.get(index).ok_or_else(|| format!("mesh {index} {}", beyond(root.meshes.len())))?;
        let mesh_name = name("mesh", mesh.name.as_deref(), index.value());
        check_shape(mesh, node).map_err(|fault| format!("{mesh_name}: {fault}"))?;
        for (number, primitive) in mesh.primitives.iter().enumerate() {
            let flaws = self.flaws.entry((index.value(), number)).or_default();
            add_primitive(self.document, primitive, place, target.triangles, target.materials, flaws)
                .map_err(|fault| format!("{mesh_name} primitive {number}: {fault}"))?;
        }
        Ok(())
    }

    /// What the reader should know about the meshes placed.
    pub(super) fn warnings(&self) -> Vec<String> {
        let mut warnings = Vec::new();
        for (&(mesh, primitive), flaws) in &self.flaws {
            let mesh_name = self.document.root.meshes.get(mesh).and_then(|m| m.name.as_deref());
            let place = format!("{} primitive {primitive}", name("mesh", mesh_name, mesh));
            if flaws.degenerate > 0 {
                warnings.push(format!("{place}: {} degenerate triangles left out", flaws.degenerate));
            }
            if flaws.bad_normals > 0 {
                warnings.push(format!(
                    "{place}: {} triangles have a zero or NaN normal and are shaded flat",
                    flaws.bad_normals
                ));
            }
        }
        warnings
    }
}

/// Refuses what would move the vertices.
fn check_shape(mesh: &Mesh, node: &Node) -> Result<(), Fault> {
    if node.skin.is_some() {
        return Err("is skinned, which is not supported; apply the skin before writing the file".into());
    }
    let morphs = mesh.primitives.iter().any(|p| p.targets.as_ref().is_some_and(|t| !t.is_empty()));
    let weights = node.weights.as_ref().or(mesh.weights.as_ref());
    if morphs && weights.is_some_and(|w| w.iter().any(|&w| w != 0.0)) {
        return Err("has morph target weights, which are not supported; expected all to be 0".into());
    }
    Ok(())
}

fn add_primitive(
    document: &Document,
    primitive: &Primitive,
    place: &Placement,
    triangles: &mut Vec<Triangle>,
    materials: &mut Materials,
    flaws: &mut Flaws,
) -> Result<(), Fault> {
    if attribute(primitive, Semantic::Colors(0)).is_some() {
        return Err("COLOR_0: vertex colours are not supported; use a texture".into());
    }
    let material = materials.get(primitive.material)?;
    let vertices = read_vertices(document, primitive, place, material.uv_set)?;
    let corners = read_corners(document, primitive, vertices.positions.len())?;
    triangles.try_reserve(corners.len()).map_err(|_| format!("no memory for {} more triangles", corners.len()))?;
    for corners in corners {
        // Reversed by exchanging two, so that the first corner stays first.
        let corners = if place.mirrors() { [corners[0], corners[2], corners[1]] } else { corners };
        let positions = corners.map(|c| vertices.positions[c]);
        if is_degenerate(positions) {
            flaws.degenerate += 1;
            continue;
        }
        let normals = vertices.normals.as_ref().and_then(|normals| {
            let all = all_of(corners.map(|c| normals[c]));
            flaws.bad_normals += usize::from(all.is_none());
            all
        });
        let uvs = vertices.uvs.as_ref().map_or([Vec2::ZERO; 3], |uvs| corners.map(|c| uvs[c]));
        triangles.push(Triangle { positions, normals, uvs, material: material.index });
    }
    Ok(())
}

fn all_of<T>([a, b, c]: [Option<T>; 3]) -> Option<[T; 3]> {
    Some([a?, b?, c?])
}

/// No area, or too little for a normal in f32. Corners of f32 have an all but exact cross product in f64.
fn is_degenerate([a, b, c]: [Vec3; 3]) -> bool {
    let exact = (b.as_dvec3() - a.as_dvec3()).cross(c.as_dvec3() - a.as_dvec3());
    exact == DVec3::ZERO || (b - a).cross(c - a).try_normalize().is_none()
}

fn attribute(primitive: &Primitive, semantic: Semantic) -> Option<Index<Accessor>> {
    primitive.attributes.get(&Checked::Valid(semantic)).copied()
}

/// Reads positions, normals and the texture coordinates `uv_set` that the material's texture asks for (set 0 without).
fn read_vertices(
    document: &Document,
    primitive: &Primitive,
    place: &Placement,
    uv_set: Option<u32>,
) -> Result<Vertices, Fault> {
    let positions = attribute(primitive, Semantic::Positions).ok_or("POSITION: is missing")?;
    let positions: Vec<[f32; 3]> = read(document, positions, Type::Vec3).map_err(|fault| at("POSITION", fault))?;
    let count = positions.len();
    let positions = positions.into_iter().enumerate().map(|(vertex, p)| world_position(place, vertex, p.into()));
    let positions = positions.collect::<Result<_, Fault>>().map_err(|fault| at("POSITION", fault))?;

    let normals = attribute(primitive, Semantic::Normals)
        .map(|index| same_count(read::<3>(document, index, Type::Vec3)?, count))
        .transpose()
        .map_err(|fault| at("NORMAL", fault))?
        .map(|normals| normals.into_iter().map(|n| place.normal(n.into())).collect());

    let uv_name = format!("TEXCOORD_{}", uv_set.unwrap_or(0));
    let uvs = attribute(primitive, Semantic::TexCoords(uv_set.unwrap_or(0)))
        .map(|index| finite_uvs(same_count(read::<2>(document, index, Type::Vec2)?, count)?))
        .transpose()
        .map_err(|fault| at(&uv_name, fault))?;
    if uvs.is_none() && uv_set.is_some() {
        return Err(format!("{uv_name}: is missing, but the material's texture uses it"));
    }
    Ok(Vertices { positions, normals, uvs })
}

fn at(attribute: &str, fault: Fault) -> Fault {
    format!("{attribute}: {fault}")
}

fn read<const N: usize>(document: &Document, index: Index<Accessor>, kind: Type) -> Result<Vec<[f32; N]>, Fault> {
    document.elements(index, kind)?.floats()
}

fn world_position(place: &Placement, vertex: usize, local: Vec3) -> Result<Vec3, Fault> {
    if !local.is_finite() {
        return Err(format!("vertex {vertex} is {:?}; expected finite numbers", local.to_array()));
    }
    let world = place.point(local);
    if !world.to_array().into_iter().all(|v| v.abs() <= LARGEST_COORDINATE) {
        return Err(format!(
            "vertex {vertex} lies at {:?} in the world; expected coordinates of at most {LARGEST_COORDINATE:e}",
            world.to_array()
        ));
    }
    Ok(world)
}

fn same_count<T>(values: Vec<T>, expected: usize) -> Result<Vec<T>, Fault> {
    match values.len() {
        count if count == expected => Ok(values),
        count => Err(format!("has {count} elements; expected {expected}, as many as POSITION")),
    }
}

fn finite_uvs(uvs: Vec<[f32; 2]>) -> Result<Vec<Vec2>, Fault> {
    match uvs.iter().position(|uv| !Vec2::from(*uv).is_finite()) {
        Some(vertex) => Err(format!("vertex {vertex} is {:?}; expected finite numbers", uvs[vertex])),
        None => Ok(uvs.into_iter().map(Vec2::from).collect()),
    }
}

/// Vertex numbers of the triangles, all below `vertices`.
fn read_corners(document: &Document, primitive: &Primitive, vertices: usize) -> Result<Vec<[usize; 3]>, Fault> {
    let indices = primitive.indices.map(|index| read_indices(document, index, vertices)).transpose()?;
    let count = indices.as_ref().map_or(vertices, Vec::len);
    let vertex = |i: usize| indices.as_ref().map_or(i, |indices| indices[i]);
    let between = |first: usize| [vertex(first), vertex(first + 1), vertex(first + 2)];
    match primitive.mode {
        Checked::Valid(Mode::Triangles) if count % 3 != 0 => {
            Err(format!("mode TRIANGLES has {count} corners; expected a multiple of 3"))
        }
        Checked::Valid(Mode::TriangleStrip | Mode::TriangleFan) if count < 3 => {
            Err(format!("a strip or fan has {count} corners; expected at least 3"))
        }
        Checked::Valid(Mode::Triangles) => Ok((0..count / 3).map(|i| between(3 * i)).collect()),
        // Every other triangle of a strip runs the other way round.
        Checked::Valid(Mode::TriangleStrip) => {
            Ok((0..count - 2).map(|i| [vertex(i), vertex(i + 1 + i % 2), vertex(i + 2 - i % 2)]).collect())
        }
        Checked::Valid(Mode::TriangleFan) => {
            Ok((0..count - 2).map(|i| [vertex(i + 1), vertex(i + 2), vertex(0)]).collect())
        }
        Checked::Valid(mode) => Err(format!("mode {mode:?} is not supported; expected triangles")),
        Checked::Invalid => Err("unknown mode; expected 4 (triangles), 5 (strip) or 6 (fan)".into()),
    }
}

fn read_indices(document: &Document, index: Index<Accessor>, vertices: usize) -> Result<Vec<usize>, Fault> {
    let elements = document.elements(index, Type::Scalar).map_err(|fault| at("indices", fault))?;
    let indices = elements.indices().map_err(|fault| at("indices", fault))?;
    match indices.iter().position(|&vertex| vertex as usize >= vertices) {
        Some(i) => Err(format!("indices: number {i} is {}; expected less than {vertices}, the vertices", indices[i])),
        None => Ok(indices.into_iter().map(|vertex| vertex as usize).collect()),
    }
}
