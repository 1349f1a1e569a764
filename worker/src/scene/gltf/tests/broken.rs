//! Damaged, unsupported and hostile files: one clear line each, and never a panic.

use proptest::prelude::*;
use serde_json::json;

use super::{File, png, read_bytes, without_file};

fn changed(change: impl FnOnce(&mut File)) -> String {
    let mut file = File::triangle();
    change(&mut file);
    file.fault()
}

#[test]
fn broken_geometry_is_refused_with_its_place() {
    let in_shape = [
        (changed(|f| f.primitive()["attributes"]["COLOR_0"] = json!(0)), "COLOR_0: vertex colours are not supported"),
        (changed(|f| f.primitive()["attributes"] = json!({})), "POSITION: is missing"),
        (changed(|f| f.primitive()["attributes"]["POSITION"] = json!(9)), "POSITION: accessor 9: does not exist"),
        (changed(|f| f.primitive()["mode"] = json!(1)), "mode Lines is not supported; expected triangles"),
        (changed(|f| f.primitive()["mode"] = json!(0)), "mode Points is not supported"),
        (changed(|f| f.primitive()["mode"] = json!(17)), "unknown mode"),
        (changed(|f| f.primitive()["material"] = json!(2)), "material 2 does not exist; the file has none"),
        (changed(|f| f.json["accessors"][0]["count"] = json!(2)), "has 2 corners; expected a multiple of 3"),
        (changed(|f| f.json["accessors"][0]["count"] = json!(1u64 << 62)), "reach beyond bufferView 0"),
        (changed(|f| f.json["accessors"][0]["byteOffset"] = json!(u64::MAX)), "reach beyond bufferView 0"),
        (changed(|f| f.json["accessors"][0]["type"] = json!("VEC2")), "type is Vec2; expected Vec3"),
        (changed(|f| f.json["accessors"][0]["type"] = json!("VEC9")), "unknown type"),
        (changed(|f| f.json["accessors"][0]["componentType"] = json!(5125)), "componentType is unsigned int"),
        (changed(|f| f.json["accessors"][0]["componentType"] = json!(1)), "unknown componentType"),
        (
            changed(|f| f.json["accessors"][0]["bufferView"] = json!(5)),
            "bufferView 5: does not exist; the last one is 0",
        ),
        (changed(|f| f.json["bufferViews"][0]["byteLength"] = json!(1u64 << 40)), "reach beyond buffer 0"),
        (changed(|f| f.json["bufferViews"][0]["byteStride"] = json!(0)), "byteStride 0 is below the 12 bytes"),
        (changed(|f| f.json["bufferViews"][0]["buffer"] = json!(1)), "buffer 1: does not exist"),
        (
            changed(|f| {
                f.json["accessors"][0]["sparse"] = json!({
                    "count": 1,
                    "indices": {"bufferView": 0, "componentType": 5123},
                    "values": {"bufferView": 0},
                })
            }),
            "sparse accessors are not supported",
        ),
        (
            changed(|f| {
                let normals = f.floats("VEC3", &[1.0; 6]);
                f.primitive()["attributes"]["NORMAL"] = json!(normals);
            }),
            "NORMAL: has 2 elements; expected 3, as many as POSITION",
        ),
        (
            changed(|f| {
                let uvs = f.floats("VEC2", &[0.0, f32::NAN, 0.0, 0.0, 0.0, 0.0]);
                f.primitive()["attributes"]["TEXCOORD_0"] = json!(uvs);
            }),
            "TEXCOORD_0: vertex 0 is [0.0, NaN]; expected finite numbers",
        ),
        (
            changed(|f| {
                let indices = f.shorts(&[0, 1, 3]);
                f.primitive()["indices"] = json!(indices);
            }),
            "indices: number 2 is 3; expected less than 3",
        ),
    ];
    for (fault, part) in in_shape {
        assert!(fault.starts_with("mesh \"shape\" primitive 0: "), "{fault}");
        assert!(fault.contains(part), "{part}: {fault}");
    }
}

#[test]
fn vertices_that_are_no_place_are_refused() {
    for (bad, part) in [
        (f32::NAN, "vertex 2 is [0.0, NaN, 0.0]; expected finite numbers"),
        (f32::INFINITY, "vertex 2 is [0.0, inf, 0.0]"),
        (2e9, "expected coordinates of at most 1e9"),
    ] {
        let mut file = File::triangle();
        let positions = file.floats("VEC3", &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, bad, 0.0]);
        file.primitive()["attributes"]["POSITION"] = json!(positions);
        let fault = file.fault();
        assert!(fault.contains("mesh \"shape\" primitive 0: POSITION: ") && fault.contains(part), "{fault}");
    }
}

#[test]
fn what_would_move_vertices_is_refused() {
    assert!(changed(|f| f.node()["skin"] = json!(0)).starts_with("mesh \"shape\": is skinned"));
    let morphing = |weight: f32| {
        let mut file = File::triangle();
        file.primitive()["targets"] = json!([{"POSITION": 0}]);
        file.json["meshes"][0]["weights"] = json!([weight]);
        file
    };
    assert!(morphing(0.5).fault().contains("has morph target weights"));
    assert_eq!(morphing(0.0).scene().triangles.len(), 1);
}

#[test]
fn broken_nodes_are_refused() {
    for (fault, part) in [
        (changed(|f| f.node()["children"] = json!([0])), "node \"node\": is reached twice"),
        (changed(|f| f.node()["children"] = json!([4])), "node 4 does not exist; the last one is 0"),
        (changed(|f| f.node()["mesh"] = json!(4)), "mesh 4 does not exist"),
        (changed(|f| f.node()["rotation"] = json!([0, 0, 0, 0])), "is not a unit quaternion"),
        (changed(|f| f.node()["translation"] = json!([1e39, 0, 0])), "its transform is not finite"),
        (changed(|f| f.node()["matrix"] = json!(vec![1; 16])), "matrix: its last row is [1.0, 1.0, 1.0, 1.0]"),
        (
            changed(|f| f.node()["extensions"] = json!({"EXT_mesh_gpu_instancing": {}})),
            "node \"node\": extension EXT_mesh_gpu_instancing is not supported",
        ),
        (changed(|f| f.json["scene"] = json!(7)), "scene 7 does not exist"),
        (
            changed(|f| {
                f.json["scenes"] = json!([]);
                f.json.as_object_mut().unwrap().remove("scene");
            }),
            "scenes: is empty",
        ),
        (changed(|f| f.json["asset"]["version"] = json!("1.0")), "glTF version \"1.0\" is not supported"),
        (
            changed(|f| f.json["extensionsRequired"] = json!(["KHR_draco_mesh_compression"])),
            "extensionsRequired: \"KHR_draco_mesh_compression\" is not supported",
        ),
        (changed(|f| f.node()["mesh"] = json!("shape")), "not glTF 2.0: invalid type"),
    ] {
        assert!(fault.contains(part), "{part}: {fault}");
    }
}

#[test]
fn a_shared_child_cannot_grow_without_bounds() {
    let mut file = File::triangle();
    let mut nodes: Vec<_> = (1..60).map(|child| json!({"children": [child, child]})).collect();
    nodes.push(json!({"mesh": 0}));
    file.json["nodes"] = json!(nodes);
    assert!(file.fault().contains("is reached twice"));
}

#[test]
fn damaged_containers_are_refused() {
    let whole = File::triangle().glb();
    for length in 0..whole.len() {
        assert!(read_bytes(&whole[..length]).is_err(), "{length}");
    }
    let fault = |bytes: &[u8]| without_file(read_bytes(bytes).unwrap_err());
    assert!(fault(&whole[..100]).starts_with("truncated: its header says"));
    assert!(fault(b"glTF\x01\0\0\0\x0c\0\0\0").contains("version 1"));
    assert!(fault(b"glTF\x02\0\0\0\x0c\0\0\0").contains("has no JSON chunk"));
    assert!(fault(b"glTF\x02\0\0\0\x04\0\0\0").contains("has no JSON chunk"));
    assert!(fault(b"glTF\x02\0\0\0\x14\0\0\0\xff\xff\xff\xffJSON").contains("reaches beyond the file"));
    assert!(fault(b"").starts_with("not glTF 2.0: "));
    assert!(fault("[".repeat(100_000).as_bytes()).starts_with("not glTF 2.0: "));
    assert!(fault(b"{\"asset\": {\"version\": \"2.0\"},\n\"nodes\": 3}").contains("line 2"));
}

#[test]
fn buffers_must_be_there_in_full() {
    let with = |buffer: serde_json::Value| {
        let mut file = File::triangle();
        file.json["buffers"] = json!([buffer]);
        without_file(read_bytes(file.json.to_string().as_bytes()).unwrap_err())
    };
    assert_eq!(with(json!({"byteLength": 36})), "buffer 0: has neither a uri nor the binary chunk of a .glb");
    let short = json!({"byteLength": 1u64 << 60, "uri": "data:;base64,AAAA"});
    assert!(with(short).starts_with("buffer 0: byteLength is 1152921504606846976, but only "));
    assert!(with(json!({"byteLength": 36, "uri": "."})).contains("not a regular file"));
}

#[test]
fn names_cannot_break_the_line() {
    let mut file = File::triangle();
    file.json["meshes"][0]["name"] = json!("a\nb\u{7}");
    file.json["nodes"][0]["skin"] = json!(0);
    assert!(file.fault().starts_with("mesh \"a\\nb\\u{7}\""));
}

/// A file that has a bit of everything.
fn rich() -> Vec<u8> {
    let mut file = File::textured(&png(2, 1, &[255, 0, 0, 255, 0, 9, 0, 255]), [0.5; 2]);
    let normals = file.floats("VEC3", &[0.0, 0.0, 1.0].repeat(3));
    let indices = file.shorts(&[0, 1, 2]);
    file.primitive()["attributes"]["NORMAL"] = json!(normals);
    file.primitive()["indices"] = json!(indices);
    file.json["cameras"] = json!([{"type": "perspective", "perspective": {"yfov": 1, "znear": 1}}]);
    let spot = json!({"type": "spot", "spot": {"innerConeAngle": 0.5}});
    file.json["extensions"] = json!({"KHR_lights_punctual": {"lights": [spot]}});
    let child = json!({"camera": 0, "scale": [1, 2, 3], "extensions": {"KHR_lights_punctual": {"light": 0}}});
    super::push(&mut file.json["nodes"], child);
    file.node()["children"] = json!([1]);
    file.glb()
}

#[test]
fn the_rich_file_is_whole() {
    let scene = read_bytes(&rich()).unwrap();
    let counts = (scene.triangles.len(), scene.textures.len(), scene.points.len(), scene.cameras.len());
    assert_eq!(counts, (1, 1, 1, 1));
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(1000))]

    #[test]
    fn random_bytes_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200), glb in any::<bool>()) {
        let head: &[u8] = if glb { b"glTF\x02\0\0\0" } else { b"" };
        let _ = read_bytes(&[head, &bytes].concat());
    }

    #[test]
    fn mutated_files_never_panic(
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>(), any::<bool>()), 1..6),
    ) {
        let mut bytes = rich();
        for (place, value, digit) in changes {
            // Digits are where indices, counts and types are.
            let digits: Vec<usize> = (0..bytes.len()).filter(|&i| bytes[i].is_ascii_digit()).collect();
            if digit {
                bytes[digits[place.index(digits.len())]] = b'0' + value % 10;
            } else {
                let at = place.index(bytes.len());
                bytes[at] = value;
            }
        }
        if let Ok(scene) = read_bytes(&bytes) {
            prop_assert!(scene.triangles.iter().all(|t| t.positions.iter().all(|p| p.is_finite())));
            prop_assert!(scene.triangles.iter().all(|t| (t.material as usize) < scene.materials.len()));
        }
    }
}
