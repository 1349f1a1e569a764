//! Files are written here, field by field, and read back.

mod appearance;
mod broken;
mod geometry;
mod outlook;

use std::fs;

use ::gltf::json::{Value, serialize};
use serde_json::json;

use crate::scene::{Scene, SceneError, load};

/// Corners of the triangle of [`File::triangle`]. Its front faces +Z.
const CORNERS: [f32; 9] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0];

/// A glTF file in the making.
struct File {
    json: Value,
    bin: Vec<u8>,
}

impl File {
    /// No nodes, nothing.
    fn empty() -> Self {
        let json = json!({
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": []}], "nodes": [],
            "accessors": [], "bufferViews": [],
        });
        Self { json, bin: Vec::new() }
    }

    /// One node "node" with a mesh "shape" of a single triangle and the default material.
    fn triangle() -> Self {
        let mut file = Self::empty();
        let positions = file.floats("VEC3", &CORNERS);
        file.json["scenes"][0]["nodes"] = json!([0]);
        file.json["nodes"] = json!([{"name": "node", "mesh": 0}]);
        file.json["meshes"] = json!([{"name": "shape", "primitives": [{"attributes": {"POSITION": positions}}]}]);
        file
    }

    /// [`File::triangle`] with a material "paint" to be filled in.
    fn painted(material: Value) -> Self {
        let mut file = Self::triangle();
        file.json["materials"] = json!([material]);
        file.json["materials"][0]["name"] = json!("paint");
        file.primitive()["material"] = json!(0);
        file
    }

    /// [`File::painted`] with `image` (PNG or JPEG) as base colour and a texture coordinate of `uv` at all corners.
    fn textured(image: &[u8], uv: [f32; 2]) -> Self {
        let mut file = Self::painted(json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}));
        let view = file.view(image);
        file.json["images"] = json!([{"bufferView": view, "mimeType": "image/png"}]);
        file.json["textures"] = json!([{"source": 0}]);
        let uvs = file.floats("VEC2", &uv.repeat(3));
        file.primitive()["attributes"]["TEXCOORD_0"] = json!(uvs);
        file
    }

    fn primitive(&mut self) -> &mut Value {
        &mut self.json["meshes"][0]["primitives"][0]
    }

    fn node(&mut self) -> &mut Value {
        &mut self.json["nodes"][0]
    }

    fn view(&mut self, bytes: &[u8]) -> usize {
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        let view = json!({"buffer": 0, "byteOffset": self.bin.len(), "byteLength": bytes.len()});
        self.bin.extend_from_slice(bytes);
        push(&mut self.json["bufferViews"], view)
    }

    fn accessor(&mut self, kind: &str, component: u32, count: usize, bytes: &[u8]) -> usize {
        let view = self.view(bytes);
        let accessor = json!({"bufferView": view, "componentType": component, "count": count, "type": kind});
        push(&mut self.json["accessors"], accessor)
    }

    fn floats(&mut self, kind: &str, values: &[f32]) -> usize {
        let size = if kind == "VEC2" { 2 } else { 3 };
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.accessor(kind, 5126, values.len() / size, &bytes)
    }

    fn shorts(&mut self, values: &[u16]) -> usize {
        let bytes: Vec<u8> = values.iter().flat_map(|v| v.to_le_bytes()).collect();
        self.accessor("SCALAR", 5123, values.len(), &bytes)
    }

    fn glb(mut self) -> Vec<u8> {
        self.json["buffers"] = json!([{"byteLength": self.bin.len()}]);
        let mut text = serialize::to_vec(&self.json).unwrap();
        text.resize(text.len().next_multiple_of(4), b' ');
        self.bin.resize(self.bin.len().next_multiple_of(4), 0);
        let mut bytes = b"glTF\x02\0\0\0".to_vec();
        bytes.extend((28 + text.len() as u32 + self.bin.len() as u32).to_le_bytes());
        for (kind, chunk) in [(b"JSON", &text), (b"BIN\0", &self.bin)] {
            bytes.extend((chunk.len() as u32).to_le_bytes());
            bytes.extend(kind);
            bytes.extend(chunk);
        }
        bytes
    }

    fn read(self) -> Result<Scene, SceneError> {
        read_bytes(&self.glb())
    }

    fn scene(self) -> Scene {
        self.read().unwrap()
    }

    /// The error message, without the file's name.
    fn fault(self) -> String {
        without_file(self.read().unwrap_err())
    }
}

fn push(list: &mut Value, value: Value) -> usize {
    let list = list.as_array_mut().unwrap();
    list.push(value);
    list.len() - 1
}

fn read_bytes(bytes: &[u8]) -> Result<Scene, SceneError> {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.glb");
    fs::write(&path, bytes).unwrap();
    load(&path)
}

fn without_file(error: SceneError) -> String {
    let text = error.to_string();
    assert!(!text.contains('\n'), "{text}");
    text.split_once("scene.glb: ").expect("the file's name comes first").1.to_string()
}

/// A PNG of 8-bit RGBA texels.
fn png(width: u32, height: u32, rgba: &[u8]) -> Vec<u8> {
    let picture = image::RgbaImage::from_raw(width, height, rgba.to_vec()).unwrap();
    encoded(&picture.into(), image::ImageFormat::Png)
}

fn encoded(picture: &image::DynamicImage, format: image::ImageFormat) -> Vec<u8> {
    let mut bytes = std::io::Cursor::new(Vec::new());
    picture.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}
