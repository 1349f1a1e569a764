//! Materials and their textures, each read when first used: what no triangle shows is not an error.

use std::collections::HashMap;

use ::gltf::json::Index;
use ::gltf::json::extensions::material::Material as Extensions;
use ::gltf::json::material::{AlphaMode, Material as Source, NormalTexture, PbrMetallicRoughness};
use ::gltf::json::texture::{Info, MagFilter, Sampler, Texture as TextureSource, WrappingMode};
use ::gltf::json::validation::Checked;

use super::container::{Document, beyond};
use super::picture::Meaning;
use super::{Fault, name, picture};
use crate::scene::{Bumps, Material, Rgb, Surface, Texture, Wrap};

/// The materials read so far.
pub(super) struct Materials<'a> {
    document: &'a Document,
    /// As `Scene::materials`.
    pub(super) materials: Vec<Material>,
    /// As `Scene::textures`.
    pub(super) textures: Vec<Texture>,
    /// As `Scene::warnings`.
    pub(super) warnings: Vec<String>,
    /// By index in the file; `None` is the default material.
    read: HashMap<Option<usize>, MaterialUse>,
    /// By image, wrap modes and what it means.
    pictures: HashMap<(usize, [u8; 2], Meaning), PictureUse>,
}

/// What a primitive must know about its material.
#[derive(Clone, Copy)]
pub(super) struct MaterialUse {
    /// Index into `Scene::materials`.
    pub(super) index: u32,
    /// The set of texture coordinates that its texture uses.
    pub(super) uv_set: Option<u32>,
}

#[derive(Clone, Copy)]
struct PictureUse {
    index: u32,
    has_alpha: bool,
}

impl<'a> Materials<'a> {
    /// None read yet.
    pub(super) fn new(document: &'a Document) -> Self {
        Self {
            document,
            materials: Vec::new(),
            textures: Vec::new(),
            warnings: Vec::new(),
            read: HashMap::new(),
            pictures: HashMap::new(),
        }
    }

    /// The material with this index in the file, the default material for `None`.
    pub(super) fn get(&mut self, index: Option<Index<Source>>) -> Result<MaterialUse, Fault> {
        let key = index.map(|i| i.value());
        if let Some(&known) = self.read.get(&key) {
            return Ok(known);
        }
        let root = &self.document.root;
        let default = Source::default();
        let (source, title) = match index {
            None => (&default, "default material".into()),
            Some(i) => {
                let source = root.get(i).ok_or_else(|| format!("material {i} {}", beyond(root.materials.len())))?;
                (source, name("material", source.name.as_deref(), i.value()))
            }
        };
        let uv_set = self.add(source, &title).map_err(|fault| format!("{title}: {fault}"))?;
        let known = MaterialUse { index: count(self.materials.len() - 1), uv_set };
        self.read.insert(key, known);
        Ok(known)
    }

    fn add(&mut self, source: &Source, title: &str) -> Result<Option<u32>, Fault> {
        let none = Extensions::default();
        let extensions = source.extensions.as_ref().unwrap_or(&none);
        let pbr = &source.pbr_metallic_roughness;
        check_supported(source, extensions)?;
        if source.occlusion_texture.is_some() {
            self.warnings.push(format!("{title}: occlusionTexture is ignored; shadows are computed"));
        }
        let [r, g, b, _] = pbr.base_color_factor.0;
        let color = rgb("baseColorFactor", [r, g, b], 1.0)?;
        let surface = surface(pbr, extensions)?;
        let emission = emission(source, extensions)?;
        let texture = pbr.base_color_texture.as_ref();
        let used = texture.map(|info| Used::of("baseColorTexture", info, Meaning::Colors));
        let picture = used.map(|used| self.texture(&used, title)).transpose()?;
        let normal = source.normal_texture.as_ref().map(|info| (Used::of_normals(info), info.scale));
        let bumps = normal.map(|(used, scale)| self.bumps(&used, scale, title)).transpose()?;
        let sets = [texture.map(|t| t.tex_coord), source.normal_texture.as_ref().map(|t| t.tex_coord)];
        if let [Some(color), Some(normal)] = sets
            && color != normal
        {
            return Err(format!(
                "baseColorTexture uses TEXCOORD_{color}, normalTexture TEXCOORD_{normal}; expected one set for both"
            ));
        }
        check_opaque(source, picture.is_some_and(|p| p.has_alpha))?;
        self.materials.push(Material {
            name: source.name.clone().unwrap_or_else(|| title.into()),
            color,
            texture: picture.map(|p| p.index),
            surface,
            emission,
            double_sided: source.double_sided,
            bumps,
            cached: cached(source)?,
        });
        Ok(sets[0].or(sets[1]))
    }

    fn bumps(&mut self, used: &Used, scale: f32, title: &str) -> Result<Bumps, Fault> {
        if !scale.is_finite() {
            return Err(format!("normalTexture: scale is {scale}; expected a finite number"));
        }
        Ok(Bumps { texture: self.texture(used, title)?.index, scale })
    }

    fn texture(&mut self, used: &Used, title: &str) -> Result<PictureUse, Fault> {
        self.picture(used, title).map_err(|fault| format!("{}: {fault}", used.field))
    }

    fn picture(&mut self, used: &Used, title: &str) -> Result<PictureUse, Fault> {
        if let Some(extension) = &used.extension {
            return Err(format!("extension {extension} is not supported"));
        }
        let root = &self.document.root;
        let texture: &TextureSource =
            root.get(used.index).ok_or_else(|| format!("texture {} {}", used.index, beyond(root.textures.len())))?;
        let sampler = match texture.sampler {
            None => Sampler::default(),
            Some(i) => root.get(i).cloned().ok_or_else(|| format!("sampler {i} {}", beyond(root.samplers.len())))?,
        };
        let wrap = [wrap("wrapS", sampler.wrap_s)?, wrap("wrapT", sampler.wrap_t)?];
        if matches!(sampler.mag_filter, Some(Checked::Valid(MagFilter::Nearest))) {
            self.warnings.push(format!("{title}: {} is filtered bilinearly in place of NEAREST", used.field));
        }
        let key = (texture.source.value(), wrap.map(|w| w as u8), used.meaning);
        if let Some(&known) = self.pictures.get(&key) {
            return Ok(known);
        }
        let image = root.get(texture.source).ok_or_else(|| match texture.source.value() as u32 {
            // What the crate reads where the field is missing.
            u32::MAX => format!("texture {} has no source; expected a PNG or JPEG image", used.index),
            _ => format!("image {} {}", texture.source, beyond(root.images.len())),
        })?;
        let picture = picture::read(self.document, image, used.meaning);
        let picture = picture.map_err(|fault| format!("image {}: {fault}", texture.source))?;
        let known = PictureUse { index: count(self.textures.len()), has_alpha: picture.has_alpha };
        let picture::Picture { width, height, texels, .. } = picture;
        self.textures.push(Texture { width, height, texels, wrap });
        self.pictures.insert(key, known);
        Ok(known)
    }
}

/// A texture as a material uses it.
struct Used {
    field: &'static str,
    index: Index<TextureSource>,
    meaning: Meaning,
    /// One that is not known here.
    extension: Option<String>,
}

impl Used {
    fn of(field: &'static str, info: &Info, meaning: Meaning) -> Self {
        let extension = info.extensions.iter().flat_map(|e| e.others.keys()).next().cloned();
        Self { field, index: info.index, meaning, extension }
    }

    fn of_normals(info: &NormalTexture) -> Self {
        let extension = info.extensions.iter().flat_map(|e| e.others.keys()).next().cloned();
        Self { field: "normalTexture", index: info.index, meaning: Meaning::Numbers, extension }
    }
}

/// What extras say of records there: `{"ambience_cached": false}` follows paths in their place.
fn cached(source: &Source) -> Result<bool, Fault> {
    let Some(extras) = &source.extras else { return Ok(true) };
    let extras: serde_json::Value = serde_json::from_str(extras.get()).map_err(|e| format!("extras: {e}"))?;
    match extras.get("ambience_cached") {
        None => Ok(true),
        Some(serde_json::Value::Bool(cached)) => Ok(*cached),
        Some(other) => Err(format!("extras.ambience_cached is {other}; expected true or false")),
    }
}

/// A list of so many things does not fit in memory, and each stands for bytes of the file.
fn count(length: usize) -> u32 {
    u32::try_from(length).unwrap_or(u32::MAX)
}

fn check_supported(source: &Source, extensions: &Extensions) -> Result<(), Fault> {
    if let Some(extension) = extensions.others.keys().next() {
        return Err(format!("extension {extension} is not supported"));
    }
    let specular = extensions.specular.as_ref();
    let textures = [
        ("metallicRoughnessTexture", source.pbr_metallic_roughness.metallic_roughness_texture.is_some()),
        ("emissiveTexture", source.emissive_texture.is_some()),
        ("specularTexture", specular.is_some_and(|s| s.specular_texture.is_some())),
        ("specularColorTexture", specular.is_some_and(|s| s.specular_color_texture.is_some())),
    ];
    match textures.into_iter().find(|(_, used)| *used) {
        Some((field, _)) => Err(format!("{field} is not supported; only baseColorTexture and normalTexture are")),
        None => Ok(()),
    }
}

fn surface(pbr: &PbrMetallicRoughness, extensions: &Extensions) -> Result<Surface, Fault> {
    let metallic = factor("metallicFactor", pbr.metallic_factor.0, 1.0)?;
    let roughness = factor("roughnessFactor", pbr.roughness_factor.0, 1.0)?;
    let (strength, color) =
        extensions.specular.as_ref().map_or((1.0, [1.0; 3]), |s| (s.specular_factor.0, s.specular_color_factor.0));
    let specular = factor("specularFactor", strength, 1.0)?;
    let specular_color = rgb("specularColorFactor", color, f32::MAX)?;
    let ior = extensions.ior.as_ref().map_or(1.5, |ior| ior.ior.0);
    if !(ior >= 1.0 && ior.is_finite()) {
        return Err(format!("ior is {ior}; expected at least 1"));
    }
    // Without coat and metal, roughness changes nothing: appendix B leaves exactly the Lambert part.
    if metallic == 0.0 && specular == 0.0 {
        return Ok(Surface::Diffuse);
    }
    Ok(Surface::Gltf { metallic, roughness, specular, specular_color, ior })
}

fn emission(source: &Source, extensions: &Extensions) -> Result<Rgb, Fault> {
    let strength = extensions.emissive_strength.as_ref().map_or(1.0, |e| e.emissive_strength.0);
    let strength = factor("emissiveStrength", strength, f32::MAX)?;
    let emission = rgb("emissiveFactor", source.emissive_factor.0, f32::MAX)? * strength;
    if !emission.is_finite() {
        return Err(format!("emissiveFactor times emissiveStrength is {emission}; expected finite numbers"));
    }
    Ok(emission)
}

/// Accepts alpha modes that leave the surface opaque everywhere.
fn check_opaque(source: &Source, texture_has_alpha: bool) -> Result<(), Fault> {
    let alpha = source.pbr_metallic_roughness.base_color_factor.0[3];
    let cutoff = source.alpha_cutoff.map_or(0.5, |c| c.0);
    let opaque = alpha == 1.0 && !texture_has_alpha;
    match source.alpha_mode {
        Checked::Valid(AlphaMode::Opaque) => Ok(()),
        Checked::Valid(AlphaMode::Mask) if opaque && cutoff <= 1.0 => Ok(()),
        Checked::Valid(AlphaMode::Blend) if opaque => Ok(()),
        Checked::Valid(mode) => Err(format!("alphaMode {mode:?} is not supported; expected OPAQUE or an alpha of 1")),
        Checked::Invalid => Err("unknown alphaMode; expected OPAQUE".into()),
    }
}

fn factor(field: &str, value: f32, largest: f32) -> Result<f32, Fault> {
    match value {
        value if (0.0..=largest).contains(&value) => Ok(value),
        value if largest == f32::MAX => Err(format!("{field} is {value}; expected at least 0")),
        value => Err(format!("{field} is {value}; expected 0 to {largest}")),
    }
}

fn rgb(field: &str, values: [f32; 3], largest: f32) -> Result<Rgb, Fault> {
    for value in values {
        factor(field, value, largest)?;
    }
    Ok(values.into())
}

fn wrap(field: &str, mode: Checked<WrappingMode>) -> Result<Wrap, Fault> {
    match mode {
        Checked::Valid(WrappingMode::Repeat) => Ok(Wrap::Repeat),
        Checked::Valid(WrappingMode::MirroredRepeat) => Ok(Wrap::Mirror),
        Checked::Valid(WrappingMode::ClampToEdge) => Ok(Wrap::Clamp),
        Checked::Invalid => Err(format!("sampler: unknown {field}; expected 10497, 33648 or 33071")),
    }
}
