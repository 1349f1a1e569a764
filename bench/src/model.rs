//! Scenes that are made up: surfaces by material, a sun, a sky and a view, written as files others can read.
//!
//! In a .rad file sun and sky are sources, as in Radiance. glTF has no sky: a .glb has a beam for a sun, and a dome far
//! away that leaves open where the sun stands.

use std::fmt::Write as _;
use std::path::Path;

use cache_core::math::{Frame, sin_cos};
use glam::{Vec2, Vec3};
use serde_json::json;

/// One triangle.
pub type Corners = [Vec3; 3];

/// Full angle of the sun, degrees.
const SUN_ANGLE: f64 = 0.533;

/// Solid angle of the sun, sr.
const SUN_SOLID: f64 = 6.796e-5;

/// Radius of the dome over the extent of the surfaces, and the half angle it leaves open round the sun, radians: wider
/// than the surfaces are seen from the dome.
const DOME: (f32, f32) = (20.0, 0.06);

/// Surfaces of one material.
pub struct Matter {
    /// Its name in the files.
    pub name: &'static str,
    /// What a diffuse surface reflects; of a metal, what its lobe reflects.
    pub color: [f32; 3],
    /// GGX's and Ward's alpha of a metal; `None`: diffuse.
    pub metal: Option<f32>,
    /// Both sides count.
    pub surface: Vec<Corners>,
}

/// A scene of metres, +Y up, and its view, as high as wide.
pub struct Model {
    /// What the files are called.
    pub name: &'static str,
    /// All surfaces.
    pub matters: Vec<Matter>,
    /// Unit direction to the sun.
    pub to_sun: Vec3,
    /// Irradiance of the sun on a facing surface, W/m².
    pub sun: [f32; 3],
    /// Radiance of the sky, W/(sr m²).
    pub sky: [f32; 3],
    /// Where the view is taken from.
    pub eye: Vec3,
    /// Unit direction it looks to.
    pub forward: Vec3,
    /// Its full angle, degrees.
    pub angle: f32,
}

impl Model {
    /// Number of triangles.
    pub fn triangles(&self) -> usize {
        self.matters.iter().map(|m| m.surface.len()).sum()
    }

    /// Writes NAME.rad, NAME.vf and NAME.glb.
    ///
    /// # Errors
    /// The disk's.
    pub fn write(&self, folder: &Path) -> std::io::Result<()> {
        std::fs::create_dir_all(folder)?;
        let file = |ending| folder.join(format!("{}.{ending}", self.name));
        std::fs::write(file("rad"), self.rad())?;
        let [[x, y, z], [dx, dy, dz]] = [self.eye, self.forward].map(|v| v.to_array());
        let view = format!("rvu -vtv -vp {x} {y} {z} -vd {dx} {dy} {dz} -vu 0 1 0 -vh {0} -vv {0}\n", self.angle);
        std::fs::write(file("vf"), view)?;
        std::fs::write(file("glb"), self.glb())
    }

    fn rad(&self) -> String {
        let mut text = format!("# {}: metres, +Y up; view in {0}.vf\n", self.name);
        let mut line = |words: std::fmt::Arguments| {
            // A string does not fail.
            let _ = writeln!(text, "{words}");
        };
        let spaced = |numbers: &[f32]| numbers.iter().map(f32::to_string).collect::<Vec<_>>().join(" ");
        let (sun, to_sun) = (self.sun.map(|e| (f64::from(e) / SUN_SOLID) as f32), self.to_sun.to_array());
        line(format_args!("void light sun 0 0 3 {}", spaced(&sun)));
        line(format_args!("sun source disc 0 0 4 {} {SUN_ANGLE}", spaced(&to_sun)));
        line(format_args!("void glow sky 0 0 4 {} 0", spaced(&self.sky)));
        line(format_args!("sky source dome 0 0 4 0 1 0 180"));
        for Matter { name, color, metal, surface } in &self.matters {
            match metal {
                None => line(format_args!("void plastic {name} 0 0 5 {} 0 0", spaced(color))),
                Some(alpha) => line(format_args!("void metal {name} 0 0 5 {} 1 {alpha}", spaced(color))),
            }
            for (i, corners) in surface.iter().enumerate() {
                let numbers = corners.map(|c| c.to_array());
                line(format_args!("{name} polygon {name}.{i} 0 0 9 {}", spaced(numbers.as_flattened())));
            }
        }
        text
    }

    fn glb(&self) -> Vec<u8> {
        let diffuse = json!({ "KHR_materials_specular": { "specularFactor": 0.0 } });
        let mut materials: Vec<_> = self
            .matters
            .iter()
            .map(|Matter { name, color: [r, g, b], metal, .. }| {
                let (metallic, roughness) = metal.map_or((0.0, 1.0), |alpha| (1.0, alpha.sqrt()));
                json!({
                    "name": name, "doubleSided": true, "extensions": diffuse,
                    "pbrMetallicRoughness": {
                        "baseColorFactor": [r, g, b, 1.0], "metallicFactor": metallic, "roughnessFactor": roughness,
                    },
                })
            })
            .collect();
        let strongest = self.sky.into_iter().fold(f32::MIN_POSITIVE, f32::max);
        materials.push(json!({
            "name": "sky", "emissiveFactor": self.sky.map(|c| c / strongest),
            "pbrMetallicRoughness": { "baseColorFactor": [0.0, 0.0, 0.0, 1.0], "metallicFactor": 0.0 },
            "extensions": {
                "KHR_materials_specular": { "specularFactor": 0.0 },
                "KHR_materials_emissive_strength": { "emissiveStrength": strongest },
            },
        }));
        let dome = self.dome();
        let surfaces: Vec<_> = self.matters.iter().map(|m| &m.surface).chain([&dome]).collect();
        let (mut bytes, mut views, mut accessors, mut meshes, mut nodes) = (vec![], vec![], vec![], vec![], vec![]);
        for (i, surface) in surfaces.iter().enumerate() {
            let corners = surface.as_flattened();
            let low = corners.iter().copied().fold(Vec3::INFINITY, Vec3::min).to_array();
            let high = corners.iter().copied().fold(Vec3::NEG_INFINITY, Vec3::max).to_array();
            let start = bytes.len();
            bytes.extend(corners.iter().flat_map(|c| c.to_array()).flat_map(f32::to_le_bytes));
            views.push(json!({ "buffer": 0, "byteOffset": start, "byteLength": bytes.len() - start }));
            let count = corners.len();
            accessors.push(json!({
                "bufferView": i, "componentType": 5126, "count": count, "type": "VEC3", "min": low, "max": high,
            }));
            meshes.push(json!({ "primitives": [{ "attributes": { "POSITION": i }, "material": i }] }));
            nodes.push(json!({ "mesh": i }));
        }
        let right = self.forward.cross(Vec3::Y).normalize();
        nodes.push(node([right, right.cross(self.forward), -self.forward], self.eye, "camera", json!(0)));
        let sun = Frame::around(self.to_sun);
        let light = json!({ "KHR_lights_punctual": { "light": 0 } });
        nodes.push(node([sun.x, sun.y, sun.z], Vec3::ZERO, "extensions", light));
        let brightest = self.sun.into_iter().fold(f32::MIN_POSITIVE, f32::max);
        let sun = json!({ "type": "directional", "color": self.sun.map(|c| c / brightest), "intensity": brightest });
        let yfov = f64::from(self.angle).to_radians();
        let document = json!({
            "asset": { "version": "2.0" }, "scene": 0, "scenes": [{ "nodes": (0..nodes.len()).collect::<Vec<_>>() }],
            "nodes": nodes, "meshes": meshes, "materials": materials, "accessors": accessors, "bufferViews": views,
            "buffers": [{ "byteLength": bytes.len() }],
            "cameras": [{ "type": "perspective", "perspective": { "yfov": yfov, "aspectRatio": 1.0, "znear": 0.01 } }],
            "extensions": { "KHR_lights_punctual": { "lights": [sun] } },
            "extensionsUsed": ["KHR_lights_punctual", "KHR_materials_emissive_strength", "KHR_materials_specular"],
        });
        let mut text = document.to_string().into_bytes();
        text.resize(text.len().next_multiple_of(4), b' ');
        let mut glb = b"glTF".to_vec();
        let number = |glb: &mut Vec<u8>, n: usize| glb.extend((n as u32).to_le_bytes());
        number(&mut glb, 2);
        number(&mut glb, 28 + text.len() + bytes.len());
        for (kind, chunk) in [(b"JSON", text), (b"BIN\0", bytes)] {
            number(&mut glb, chunk.len());
            glb.extend(kind);
            glb.extend(chunk);
        }
        glb
    }

    /// The sky: a sphere, open towards the sun; downwards from there, the front is inside.
    fn dome(&self) -> Vec<Corners> {
        let corners = || self.matters.iter().flat_map(|m| m.surface.as_flattened());
        let low = corners().copied().fold(Vec3::INFINITY, Vec3::min);
        let high = corners().copied().fold(Vec3::NEG_INFINITY, Vec3::max);
        let (middle, radius) = ((low + high) / 2.0, DOME.0 * (high - low).length());
        let (frame, mut dome) = (Frame::around(self.to_sun), Vec::new());
        sheet(
            16,
            12,
            |s| {
                let (sin, cos) = sin_cos(DOME.1 + (std::f32::consts::PI - DOME.1) * s.y * 0.9999);
                let (sin_phi, cos_phi) = sin_cos(std::f32::consts::TAU * s.x);
                middle + frame.to_world(Vec3::new(sin * cos_phi, sin * sin_phi, cos)) * radius
            },
            &mut dome,
        );
        dome
    }
}

fn node(axes: [Vec3; 3], origin: Vec3, what: &str, of: serde_json::Value) -> serde_json::Value {
    let [x, y, z] = axes.map(|a| [a.x, a.y, a.z, 0.0]);
    let matrix = [x, y, z, [origin.x, origin.y, origin.z, 1.0]];
    json!({ "matrix": matrix.as_flattened(), what: of })
}

/// A surface over the unit square in `columns` x `rows` cells of two triangles, or of one where an edge is a point.
pub fn sheet(columns: u32, rows: u32, at: impl Fn(Vec2) -> Vec3, soup: &mut Vec<Corners>) {
    let corner = |x: u32, y: u32| at(Vec2::new(x as f32 / columns as f32, y as f32 / rows as f32));
    for y in 0..rows {
        for x in 0..columns {
            let [a, b, c, d] = [corner(x, y), corner(x + 1, y), corner(x + 1, y + 1), corner(x, y + 1)];
            soup.extend([[a, b, c], [a, c, d]].into_iter().filter(|[a, b, c]| a != b && b != c && c != a));
        }
    }
}

/// The six sides of a box.
pub fn block(low: Vec3, high: Vec3, soup: &mut Vec<Corners>) {
    let corner =
        |i: usize| Vec3::from(std::array::from_fn(|axis| if i >> axis & 1 == 0 { low[axis] } else { high[axis] }));
    for side in [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]] {
        let [a, b, c, d] = side.map(corner);
        soup.extend([[a, b, c], [a, c, d]]);
    }
}

/// A profile of (radius, height), from below, turned round a vertical axis.
pub fn turned(foot: Vec3, profile: &[(f32, f32)], around: u32, soup: &mut Vec<Corners>) {
    for ends in profile.windows(2) {
        sheet(
            around,
            1,
            |s| {
                let ((r0, y0), (r1, y1)) = (ends[0], ends[1]);
                let (sin, cos) = sin_cos(std::f32::consts::TAU * s.x);
                let radius = r0 + (r1 - r0) * s.y;
                foot + Vec3::new(radius * sin, y0 + (y1 - y0) * s.y, radius * cos)
            },
            soup,
        );
    }
}
