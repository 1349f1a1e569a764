//! Triangles, transforms and the file around them.

use std::fs;

use glam::{Vec2, Vec3};
use serde_json::json;

use super::{CORNERS, File};
use crate::scene::{Scene, Triangle, load};

fn geometric_normal(triangle: &Triangle) -> Vec3 {
    let [a, b, c] = triangle.positions;
    (b - a).cross(c - a).normalize()
}

fn only(scene: &Scene) -> &Triangle {
    assert_eq!(scene.triangles.len(), 1);
    &scene.triangles[0]
}

#[test]
fn without_transform_coordinates_keep_their_bits() {
    let corners = [-0.0, 0.1, f32::MIN_POSITIVE, 1.0, -0.0, 1e-7, 0.3, 1.0, -0.0];
    let mut file = File::triangle();
    let positions = file.floats("VEC3", &corners);
    file.primitive()["attributes"]["POSITION"] = json!(positions);
    file.node()["scale"] = json!([1, 1, 1]);
    file.node()["rotation"] = json!([0, 0, 0, 1]);
    let scene = file.scene();
    let bits = |v: &[f32]| v.iter().map(|v| v.to_bits()).collect::<Vec<_>>();
    let read: Vec<f32> = only(&scene).positions.iter().flat_map(|p| p.to_array()).collect();
    assert_eq!(bits(&read), bits(&corners));
    assert_eq!(only(&scene).normals, None);
    assert_eq!(only(&scene).uvs, [Vec2::ZERO; 3]);
    assert!(scene.warnings.is_empty(), "{:?}", scene.warnings);
}

#[test]
fn transforms_compose_from_the_root_down() {
    let mut file = File::triangle();
    file.json["scenes"][0]["nodes"] = json!([1]);
    file.node()["translation"] = json!([1, 0, 0]);
    // A quarter turn about Z, twice as large, then up by 5.
    let half = std::f32::consts::FRAC_1_SQRT_2;
    let parent = json!({"children": [0], "translation": [0, 0, 5], "rotation": [0, 0, half, half], "scale": [2, 2, 2]});
    super::push(&mut file.json["nodes"], parent);
    let scene = file.scene();
    let expected = [Vec3::new(0.0, 2.0, 5.0), Vec3::new(0.0, 4.0, 5.0), Vec3::new(-2.0, 2.0, 5.0)];
    for (found, expected) in only(&scene).positions.iter().zip(expected) {
        assert!(found.abs_diff_eq(expected, 1e-6), "{found} {expected}");
    }
}

#[test]
fn a_matrix_is_column_by_column() {
    let mut file = File::triangle();
    file.node()["matrix"] = json!([2, 0, 0, 0, 0, 3, 0, 0, 0, 0, 1, 0, 7, 8, 9, 1]);
    let expected = [Vec3::new(7.0, 8.0, 9.0), Vec3::new(9.0, 8.0, 9.0), Vec3::new(7.0, 11.0, 9.0)];
    assert_eq!(only(&file.scene()).positions, expected);
}

#[test]
fn mirroring_keeps_the_front_in_front() {
    let mut file = File::triangle();
    let normals = file.floats("VEC3", &[0.0, 0.0, 1.0].repeat(3));
    file.primitive()["attributes"]["NORMAL"] = json!(normals);
    file.node()["scale"] = json!([-2, 1, 1]);
    let scene = file.scene();
    assert_eq!(only(&scene).positions[0], Vec3::ZERO);
    assert_eq!(geometric_normal(only(&scene)), Vec3::Z);
    assert_eq!(only(&scene).normals, Some([Vec3::Z; 3]));

    // Mirrored through its own plane, what was seen from +Z is seen from -Z.
    let mut file = File::triangle();
    let normals = file.floats("VEC3", &[0.0, 0.0, 1.0].repeat(3));
    file.primitive()["attributes"]["NORMAL"] = json!(normals);
    file.node()["scale"] = json!([1, 1, -1]);
    let scene = file.scene();
    assert_eq!(geometric_normal(only(&scene)), Vec3::NEG_Z);
    assert_eq!(only(&scene).normals, Some([Vec3::NEG_Z; 3]));
}

#[test]
fn normals_stay_perpendicular_under_uneven_scale() {
    let mut file = File::empty();
    let positions = file.floats("VEC3", &[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 0.0, -1.0]);
    let normals = file.floats("VEC3", &[1.0, 1.0, 0.0].repeat(3));
    file.json["scenes"][0]["nodes"] = json!([0]);
    file.json["nodes"] = json!([{"mesh": 0, "scale": [4, 1, 1]}]);
    let attributes = json!({"POSITION": positions, "NORMAL": normals});
    file.json["meshes"] = json!([{"primitives": [{"attributes": attributes}]}]);
    let scene = file.scene();
    let expected = geometric_normal(only(&scene));
    for normal in only(&scene).normals.unwrap() {
        assert!(normal.dot(expected).abs() > 0.999_999, "{normal} {expected}");
        assert!((normal.length() - 1.0).abs() < 1e-6);
    }
}

#[test]
fn strips_and_fans_face_one_way() {
    let grid = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 1.0, 1.0, 0.0, 0.0, 2.0, 0.0];
    let fan = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1.0, 0.0, 0.0, 1.0, 0.0, -1.0, 1.0, 0.0];
    for (mode, corners) in [(5, grid), (6, fan)] {
        for indexed in [false, true] {
            let mut file = File::triangle();
            let positions = file.floats("VEC3", &corners);
            file.primitive()["attributes"]["POSITION"] = json!(positions);
            file.primitive()["mode"] = json!(mode);
            if indexed {
                let indices = file.shorts(&[0, 1, 2, 3, 4]);
                file.primitive()["indices"] = json!(indices);
            }
            let scene = file.scene();
            assert_eq!(scene.triangles.len(), 3);
            assert!(scene.triangles.iter().all(|t| geometric_normal(t) == Vec3::Z), "mode {mode}");
        }
    }
}

#[test]
fn indices_of_every_width_pick_the_corners() {
    for (component, bytes) in
        [(5121, vec![0, 2, 1]), (5123, vec![0, 0, 2, 0, 1, 0]), (5125, vec![0, 0, 0, 0, 2, 0, 0, 0, 1, 0, 0, 0])]
    {
        let mut file = File::triangle();
        let indices = file.accessor("SCALAR", component, 3, &bytes);
        file.primitive()["indices"] = json!(indices);
        assert_eq!(only(&file.scene()).positions, [Vec3::ZERO, Vec3::Y, Vec3::X]);
    }
}

#[test]
fn interleaved_and_quantized_attributes_are_read() {
    let mut file = File::triangle();
    // Position as three shorts, two bytes of padding, texture coordinates as two normalized bytes and padding.
    let mut bytes = Vec::new();
    for (p, uv) in [([0i16, 0, 0], [0u8, 255]), ([5, 0, 0], [255, 0]), ([0, 5, 0], [51, 51])] {
        bytes.extend(p.into_iter().flat_map(i16::to_le_bytes));
        bytes.extend([0, 0, uv[0], uv[1], 0, 0]);
    }
    let view = file.view(&bytes);
    file.json["bufferViews"][view]["byteStride"] = json!(12);
    file.json["extensionsRequired"] = json!(["KHR_mesh_quantization"]);
    file.json["accessors"] = json!([
        {"bufferView": view, "componentType": 5122, "count": 3, "type": "VEC3"},
        {"bufferView": view, "byteOffset": 8, "componentType": 5121, "count": 3, "type": "VEC2", "normalized": true},
    ]);
    file.primitive()["attributes"] = json!({"POSITION": 0, "TEXCOORD_0": 1});
    let scene = file.scene();
    assert_eq!(only(&scene).positions, [Vec3::ZERO, Vec3::X * 5.0, Vec3::Y * 5.0]);
    assert_eq!(only(&scene).uvs, [Vec2::Y, Vec2::X, Vec2::splat(0.2)]);
}

#[test]
fn degenerate_triangles_are_left_out_and_counted() {
    let mut file = File::triangle();
    let mut corners = CORNERS.to_vec();
    // Collinear, then a point.
    corners.extend([0.1, 0.1, 0.1, 0.2, 0.2, 0.2, 0.3, 0.3, 0.3]);
    corners.extend([1.0; 9]);
    let positions = file.floats("VEC3", &corners);
    file.primitive()["attributes"]["POSITION"] = json!(positions);
    let scene = file.scene();
    let left_out = 9 - 3 * scene.triangles.len();
    assert_eq!(left_out, 6);
    assert!(scene.warnings[0].ends_with("mesh \"shape\" primitive 0: 2 degenerate triangles left out"));
}

#[test]
fn a_bad_normal_shades_its_triangle_flat() {
    for bad in [0.0, f32::NAN, f32::INFINITY] {
        let mut file = File::triangle();
        let positions = file.floats("VEC3", &CORNERS.repeat(2));
        let mut normals = [0.0, 0.0, 1.0].repeat(6);
        normals[14] = bad;
        let normals = file.floats("VEC3", &normals);
        file.primitive()["attributes"] = json!({"POSITION": positions, "NORMAL": normals});
        let scene = file.scene();
        assert_eq!(scene.triangles[0].normals, Some([Vec3::Z; 3]));
        assert_eq!(scene.triangles[1].normals, None);
        assert!(scene.warnings[0].ends_with("1 triangles have a zero or NaN normal and are shaded flat"));
    }
}

#[test]
fn only_the_default_scene_is_shown() {
    let mut file = File::triangle();
    file.json["scenes"] = json!([{"nodes": [0]}, {"nodes": []}]);
    file.json["scene"] = json!(1);
    assert!(file.scene().triangles.is_empty());
    let mut file = File::triangle();
    file.json["scenes"] = json!([{"nodes": [0]}, {"nodes": []}]);
    file.json.as_object_mut().unwrap().remove("scene");
    assert_eq!(file.scene().triangles.len(), 1);
}

#[test]
fn a_mesh_can_be_shown_twice() {
    let mut file = File::triangle();
    super::push(&mut file.json["nodes"], json!({"mesh": 0, "translation": [0, 0, 1]}));
    file.json["scenes"][0]["nodes"] = json!([0, 1]);
    let scene = file.scene();
    assert_eq!(scene.triangles.len(), 2);
    assert_eq!(scene.triangles[1].positions[0], Vec3::Z);
    assert_eq!(scene.materials.len(), 1);
}

#[test]
fn hierarchies_can_be_deep() {
    let mut file = File::triangle();
    let deepest = 100_000;
    let mut nodes: Vec<_> = (1..=deepest).map(|child| json!({"children": [child]})).collect();
    nodes.push(json!({"mesh": 0}));
    file.json["nodes"] = json!(nodes);
    assert_eq!(file.scene().triangles.len(), 1);
}

#[test]
fn animations_extras_and_own_attributes_do_no_harm() {
    let mut file = File::triangle();
    file.json["animations"] = json!([{"channels": [{"sampler": 9, "target": {"path": "pointer"}}], "samplers": []}]);
    file.json["extensionsUsed"] = json!(["ACME_gloss"]);
    file.node()["extras"] = json!(5);
    file.primitive()["attributes"]["_HEAT"] = json!(0);
    let scene = file.scene();
    assert_eq!(scene.triangles.len(), 1);
    let warnings = scene.warnings.join("\n");
    assert!(warnings.contains("1 animations are ignored"), "{warnings}");
    assert!(warnings.contains("extensionsUsed: \"ACME_gloss\" is not supported and ignored"), "{warnings}");
}

#[test]
fn buffers_and_images_can_lie_beside_the_file_or_in_it() {
    let folder = tempfile::tempdir().unwrap();
    let bytes: Vec<u8> = CORNERS.iter().flat_map(|v| v.to_le_bytes()).collect();
    fs::write(folder.path().join("my data.bin"), &bytes).unwrap();
    fs::write(folder.path().join("dot.png"), super::png(1, 1, &[255, 0, 0, 255])).unwrap();
    // Two corners' worth of texture coordinates 0, base64.
    let zeros = format!("data:application/octet-stream;base64,{}", "A".repeat(32));
    let mut file = File::painted(json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}));
    file.json["buffers"] = json!([{"byteLength": 36, "uri": "my%20data.bin"}, {"byteLength": 24, "uri": zeros}]);
    file.json["images"] = json!([{"uri": "dot.png"}]);
    file.json["textures"] = json!([{"source": 0}]);
    super::push(&mut file.json["bufferViews"], json!({"buffer": 1, "byteLength": 24}));
    let uvs = json!({"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"});
    let uvs = super::push(&mut file.json["accessors"], uvs);
    file.primitive()["attributes"]["TEXCOORD_0"] = json!(uvs);
    let path = folder.path().join("scene.gltf");
    fs::write(&path, file.json.to_string()).unwrap();
    let scene = load(&path).unwrap();
    assert_eq!(only(&scene).positions[1], Vec3::X);
    assert_eq!(scene.textures[0].texels, [Vec3::X]);

    fs::remove_file(folder.path().join("my data.bin")).unwrap();
    let error = load(&path).unwrap_err().to_string();
    assert!(error.contains("scene.gltf: buffer 0: file \"my data.bin\" cannot be read"), "{error}");
}
