//! Materials and textures.

use glam::{Vec2, Vec3};
use serde_json::{Value, json};

use super::{File, encoded, png};
use crate::scene::{Material, Surface, Wrap};

fn material(source: Value) -> Material {
    let scene = File::painted(source).scene();
    assert_eq!(scene.materials.len(), 1);
    scene.materials[0].clone()
}

fn diffuse(mut extra: Value) -> Value {
    extra["pbrMetallicRoughness"]["metallicFactor"] = json!(0);
    extra["extensions"]["KHR_materials_specular"] = json!({"specularFactor": 0});
    extra
}

#[test]
fn without_coat_and_metal_a_material_is_lambert() {
    let paint = material(diffuse(json!({"pbrMetallicRoughness": {"baseColorFactor": [0.1, 0.2, 0.3, 1]}})));
    assert_eq!(paint.surface, Surface::Diffuse);
    assert_eq!(paint.color, Vec3::new(0.1, 0.2, 0.3));
    assert_eq!((paint.name.as_str(), paint.double_sided, paint.texture), ("paint", false, None));
    assert_eq!(paint.emission, Vec3::ZERO);
}

#[test]
fn everything_else_is_metallic_roughness() {
    let paint = material(json!({
        "doubleSided": true,
        "pbrMetallicRoughness": {"metallicFactor": 0.25, "roughnessFactor": 0.5},
        "extensions": {
            "KHR_materials_specular": {"specularFactor": 0.5, "specularColorFactor": [1, 0.5, 0]},
            "KHR_materials_ior": {"ior": 1.33},
        },
    }));
    let specular_color = Vec3::new(1.0, 0.5, 0.0);
    let expected = Surface::Gltf { metallic: 0.25, roughness: 0.5, specular: 0.5, specular_color, ior: 1.33 };
    assert_eq!(paint.surface, expected);
    assert!(paint.double_sided);
}

#[test]
fn a_primitive_without_material_has_the_default_one() {
    let scene = File::triangle().scene();
    let expected = Surface::Gltf { metallic: 1.0, roughness: 1.0, specular: 1.0, specular_color: Vec3::ONE, ior: 1.5 };
    assert_eq!((scene.materials[0].surface, scene.materials[0].color), (expected, Vec3::ONE));
}

#[test]
fn emitters_reflect_too() {
    let paint = material(diffuse(json!({
        "pbrMetallicRoughness": {"baseColorFactor": [0.5, 0.5, 0.5, 1]},
        "emissiveFactor": [1, 0.5, 0.25],
        "extensions": {"KHR_materials_emissive_strength": {"emissiveStrength": 8}},
    })));
    assert_eq!((paint.emission, paint.color), (Vec3::new(8.0, 4.0, 2.0), Vec3::splat(0.5)));
}

#[test]
fn a_material_used_twice_is_read_once() {
    let mut file = File::painted(diffuse(json!({})));
    let primitive = file.primitive().clone();
    super::push(&mut file.json["meshes"][0]["primitives"], primitive);
    let scene = file.scene();
    assert_eq!((scene.triangles.len(), scene.materials.len()), (2, 1));
}

#[test]
fn unused_materials_and_images_are_not_read() {
    let mut file = File::painted(diffuse(json!({})));
    super::push(&mut file.json["materials"], json!({"normalTexture": {"index": 99}}));
    file.json["images"] = json!([{"uri": "missing.png"}]);
    assert_eq!(file.scene().materials.len(), 1);
}

#[test]
fn unsupported_materials_are_refused_by_name() {
    let texture = json!({"index": 0});
    for (source, field) in [
        (json!({"pbrMetallicRoughness": {"metallicRoughnessTexture": texture}}), "metallicRoughnessTexture"),
        (json!({"normalTexture": {"index": 7}}), "normalTexture: texture 7 does not exist"),
        (json!({"extras": {"ambience_cached": 1}}), "extras.ambience_cached is 1; expected true or false"),
        (json!({"emissiveTexture": texture}), "emissiveTexture"),
        (json!({"extensions": {"KHR_materials_specular": {"specularTexture": texture}}}), "specularTexture"),
        (json!({"extensions": {"KHR_materials_specular": {"specularColorTexture": texture}}}), "specularColorTexture"),
        (json!({"extensions": {"KHR_materials_transmission": {}}}), "KHR_materials_transmission"),
        (json!({"extensions": {"KHR_materials_unlit": {}}}), "KHR_materials_unlit"),
        (json!({"extensions": {"KHR_materials_ior": {"ior": 0}}}), "ior is 0"),
        (json!({"alphaMode": "MASK", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.9]}}), "alphaMode Mask"),
        (json!({"alphaMode": "MASK", "alphaCutoff": 1.5}), "alphaMode Mask"),
        (json!({"alphaMode": "BLEND", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0]}}), "alphaMode Blend"),
        (json!({"alphaMode": "GLASS"}), "alphaMode"),
        (json!({"pbrMetallicRoughness": {"baseColorFactor": [1.5, 1, 1, 1]}}), "baseColorFactor is 1.5"),
        (json!({"pbrMetallicRoughness": {"metallicFactor": -1}}), "metallicFactor is -1; expected 0 to 1"),
        (json!({"pbrMetallicRoughness": {"roughnessFactor": 2}}), "roughnessFactor is 2"),
        (json!({"emissiveFactor": [-1, 0, 0]}), "emissiveFactor is -1"),
        (json!({"pbrMetallicRoughness": {"baseColorTexture": {"index": 7}}}), "texture 7 does not exist"),
    ] {
        let fault = File::painted(source).fault();
        assert!(fault.starts_with("mesh \"shape\" primitive 0: material \"paint\": "), "{fault}");
        assert!(fault.contains(field), "{field}: {fault}");
    }
}

#[test]
fn alpha_modes_without_effect_are_accepted() {
    material(json!({"alphaMode": "OPAQUE", "pbrMetallicRoughness": {"baseColorFactor": [1, 1, 1, 0.5]}}));
    material(json!({"alphaMode": "MASK"}));
    material(json!({"alphaMode": "BLEND"}));
    for (alpha, accepted) in [(255, true), (254, false)] {
        let mut file = File::textured(&png(1, 1, &[1, 2, 3, alpha]), [0.0; 2]);
        file.json["materials"][0]["alphaMode"] = json!("BLEND");
        assert_eq!(file.read().is_ok(), accepted);
    }
}

#[test]
fn baked_shadows_are_ignored_with_a_warning() {
    let scene = File::painted(json!({"occlusionTexture": {"index": 0}})).scene();
    assert!(scene.warnings[0].contains("material \"paint\": occlusionTexture is ignored"), "{:?}", scene.warnings);
}

#[test]
fn textures_are_linear_and_their_first_row_is_on_top() {
    let rgba = [255, 0, 188, 255, 0, 0, 0, 255, 10, 10, 10, 255, 255, 255, 255, 255];
    let scene = File::textured(&png(2, 2, &rgba), [0.25, 0.25]).scene();
    let texture = &scene.textures[0];
    assert_eq!((texture.width, texture.height, texture.wrap), (2, 2, [Wrap::Repeat; 2]));
    let color = texture.sample(scene.triangles[0].uvs[0]);
    assert!(color.abs_diff_eq(Vec3::new(1.0, 0.0, 0.502_886_5), 1e-6), "{color}");
    assert!((texture.sample(Vec2::new(0.25, 0.75)).x - 10.0 / 255.0 / 12.92).abs() < 1e-7);
    assert_eq!(scene.materials[0].texture, Some(0));
}

#[test]
fn jpeg_and_16_bit_png_are_read() {
    let flat = image::RgbImage::from_pixel(8, 8, image::Rgb([188; 3]));
    let jpeg = encoded(&flat.into(), image::ImageFormat::Jpeg);
    let deep = image::ImageBuffer::<image::Rgb<u16>, _>::from_pixel(1, 1, image::Rgb([48316u16; 3]));
    let deep = encoded(&deep.into(), image::ImageFormat::Png);
    for bytes in [jpeg, deep] {
        let scene = File::textured(&bytes, [0.5; 2]).scene();
        assert!((scene.textures[0].texels[0].x - 0.502_886_5).abs() < 5e-3, "{}", scene.textures[0].texels[0]);
    }
}

#[test]
fn samplers_say_what_is_outside() {
    let mut file = File::textured(&png(1, 1, &[255; 4]), [0.0; 2]);
    file.json["samplers"] = json!([{"wrapS": 33648, "wrapT": 33071, "magFilter": 9728}]);
    file.json["textures"][0]["sampler"] = json!(0);
    let scene = file.scene();
    assert_eq!(scene.textures[0].wrap, [Wrap::Mirror, Wrap::Clamp]);
    assert!(scene.warnings[0].contains("filtered bilinearly"));
}

#[test]
fn the_texture_chooses_its_coordinates() {
    let mut file = File::textured(&png(1, 1, &[255; 4]), [0.25; 2]);
    let uvs = file.floats("VEC2", &[0.75; 6]);
    file.primitive()["attributes"]["TEXCOORD_1"] = json!(uvs);
    file.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = json!(1);
    assert_eq!(file.scene().triangles[0].uvs, [Vec2::splat(0.75); 3]);
}

#[test]
fn broken_textures_are_refused() {
    let change = |change: fn(&mut File)| {
        let mut file = File::textured(&png(1, 1, &[255; 4]), [0.0; 2]);
        change(&mut file);
        file.fault()
    };
    for (fault, part) in [
        (change(|f| f.json["images"][0] = json!({"uri": "a.png"})), "image 0: file \"a.png\" cannot be read"),
        (change(|f| f.json["images"][0] = json!({"uri": "http://a/b.png"})), "is not supported; expected a relative"),
        (change(|f| f.json["images"][0] = json!({"uri": "%ff"})), "is not a percent-encoded UTF-8 name"),
        (change(|f| f.json["images"][0] = json!({"uri": "data:image/png;base64,????"})), "is not base64"),
        (change(|f| f.json["images"][0] = json!({"uri": "data:image/png;base64,AAAA"})), "neither a PNG nor a JPEG"),
        (change(|f| f.json["images"][0] = json!({})), "image 0: has neither a uri nor a bufferView"),
        (change(|f| f.json["images"] = json!([])), "image 0 does not exist; the file has none"),
        (change(|f| f.json["textures"][0] = json!({})), "texture 0 has no source"),
        (change(|f| f.json["textures"][0]["sampler"] = json!(3)), "sampler 3 does not exist"),
        (
            change(|f| {
                f.json["samplers"] = json!([{"wrapS": 1}]);
                f.json["textures"][0]["sampler"] = json!(0);
            }),
            "sampler: unknown wrapS",
        ),
        (
            change(|f| {
                f.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["extensions"] =
                    json!({"KHR_texture_transform": {"scale": [2, 2]}})
            }),
            "baseColorTexture: extension KHR_texture_transform is not supported",
        ),
        (
            change(|f| f.json["materials"][0]["pbrMetallicRoughness"]["baseColorTexture"]["texCoord"] = json!(4)),
            "TEXCOORD_4: is missing",
        ),
    ] {
        assert!(fault.contains(part), "{fault}");
    }
}

/// Numbers, not colours: half stays half.
#[test]
fn bumps_and_excluded_materials_are_read() {
    let mut file = File::textured(&png(1, 1, &[128, 128, 255, 255]), [0.0, 0.0]);
    file.json["materials"][0] = json!({
        "name": "paint", "normalTexture": {"index": 0, "scale": 0.5}, "extras": {"ambience_cached": false},
    });
    let scene = file.scene();
    let bumps = scene.materials[0].bumps.expect("bumps");
    assert_eq!((bumps.scale, scene.materials[0].texture, scene.materials[0].cached), (0.5, None, false));
    let texel: Vec3 = scene.textures[bumps.texture as usize].texels[0];
    assert!((texel - Vec3::new(128.0 / 255.0, 128.0 / 255.0, 1.0)).length() < 1e-6, "{texel}");
}
