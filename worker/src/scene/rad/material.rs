//! Materials by name: plastic, metal, light, glow, and constant mixtures of them.

use std::collections::HashMap;

use glam::{DVec3, Vec3};

use super::Statement;
use super::lexer::{finite, show};
use crate::scene::{Material, Scene, SceneError, Surface};

/// The types of modifier that `Library::define` reads.
pub(super) const TYPES: [&[u8]; 5] = [b"plastic", b"metal", b"light", b"glow", b"mixfunc"];

/// Relative difference up to which two mixed lobes count as the same.
const SAME: f64 = 1e-6;

/// What a modifier says.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Matter {
    /// Radiance from the front, W/(sr m2).
    pub(super) emission: DVec3,
    /// `None`: nothing, as for all pure emitters.
    pub(super) reflection: Option<Reflection>,
}

/// The parameters of `plastic` and `metal`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Reflection {
    color: DVec3,
    specular: f64,
    roughness: f64,
    metal: bool,
}

/// A reflection as a sum, which is how mixtures add up: the diffuse albedo and the strength of the lobe.
struct Sum {
    diffuse: DVec3,
    lobe: DVec3,
    roughness: f64,
    metal: bool,
}

impl Reflection {
    fn weighted(&self, weight: f64) -> Sum {
        let lobe = if self.metal { self.color } else { DVec3::ONE };
        Sum {
            diffuse: self.color * ((1.0 - self.specular) * weight),
            lobe: lobe * (self.specular * weight),
            roughness: self.roughness,
            metal: self.metal && self.specular > 0.0,
        }
    }
}

impl Sum {
    fn plus(self, other: Sum) -> Result<Sum, String> {
        let (mine, its) = (self.lobe != DVec3::ZERO, other.lobe != DVec3::ZERO);
        if mine && its && self.roughness != other.roughness {
            return Err(format!(
                "mixes lobes of roughness {} and {}; expected the same roughness",
                self.roughness, other.roughness
            ));
        }
        Ok(Sum {
            diffuse: self.diffuse + other.diffuse,
            lobe: self.lobe + other.lobe,
            roughness: if mine { self.roughness } else { other.roughness },
            metal: self.metal || other.metal,
        })
    }

    /// The plastic or metal that reflects so.
    fn reflection(self) -> Result<Reflection, String> {
        let Sum { diffuse, lobe, roughness, metal } = self;
        if lobe == DVec3::ZERO {
            return Ok(Reflection { color: diffuse, specular: 0.0, roughness: 0.0, metal: false });
        }
        let color = diffuse + lobe;
        let strongest = color.max_position();
        let specular = lobe[strongest] / color[strongest];
        if metal && (lobe - color * specular).abs().max_element() <= SAME * color[strongest] {
            return Ok(Reflection { color, specular, roughness, metal: true });
        }
        let specular = lobe.max_element();
        if lobe.min_element() < specular * (1.0 - SAME) {
            return Err("is neither a plastic nor a metal; expected parts whose lobes have one colour".into());
        }
        let color = if specular < 1.0 { diffuse / (1.0 - specular) } else { DVec3::ZERO };
        Ok(Reflection { color, specular, roughness, metal: false })
    }
}

impl Matter {
    /// `share` of this and the rest of `other`: emission and reflection both mix.
    fn mix(&self, share: f64, other: &Matter) -> Result<Matter, String> {
        let parts = [(self, share), (other, 1.0 - share)];
        let mut sums = parts.iter().filter_map(|(m, weight)| Some(m.reflection?.weighted(*weight)));
        let reflection = match (sums.next(), sums.next()) {
            (Some(a), Some(b)) => Some(a.plus(b)?.reflection()?),
            (Some(a), None) => Some(a.reflection()?),
            _ => None,
        };
        Ok(Matter { emission: self.emission * share + other.emission * (1.0 - share), reflection })
    }

    fn material(&self, name: &[u8]) -> Material {
        let (color, surface) = match self.reflection {
            None => (DVec3::ZERO, Surface::Diffuse),
            Some(r) if r.specular == 0.0 => (r.color, Surface::Diffuse),
            Some(r) => {
                let (specular, roughness) = (r.specular as f32, r.roughness as f32);
                let surface = if r.metal {
                    Surface::Metal { specular, roughness }
                } else {
                    Surface::Plastic { specular, roughness }
                };
                (r.color, surface)
            }
        };
        Material {
            name: show(name),
            color: color.as_vec3(),
            texture: None,
            surface,
            emission: self.emission.as_vec3(),
            double_sided: self.reflection.is_some(),
            bumps: None,
            cached: true,
        }
    }
}

/// A modifier and where in the scene it is, if a triangle has it.
struct Entry {
    name: Vec<u8>,
    matter: Matter,
    in_scene: Option<u32>,
}

/// All modifiers read so far. A name stands for its latest definition.
#[derive(Default)]
pub(super) struct Library {
    entries: Vec<Entry>,
    by_name: HashMap<Vec<u8>, usize>,
}

impl Library {
    /// What `name` stands for now.
    ///
    /// # Errors
    /// What is wrong with it.
    pub(super) fn find(&self, name: &[u8]) -> Result<usize, String> {
        if name == b"void" {
            return Err("has no material (void); expected the name of one defined before".into());
        }
        self.by_name.get(name).copied().ok_or_else(|| {
            format!("modifier `{}` is not defined; expected the name of a material defined before", show(name))
        })
    }

    /// The modifier that `find` found.
    pub(super) fn matter(&self, index: usize) -> &Matter {
        &self.entries[index].matter
    }

    /// The scene's index for a modifier, which the scene then has.
    pub(super) fn in_scene(&mut self, index: usize, scene: &mut Scene) -> u32 {
        let entry = &mut self.entries[index];
        *entry.in_scene.get_or_insert_with(|| {
            scene.materials.push(entry.matter.material(&entry.name));
            scene.materials.len() as u32 - 1
        })
    }

    /// Reads a definition of one of `TYPES`.
    ///
    /// # Errors
    /// Wrong arguments, and a modifier other than void.
    pub(super) fn define(&mut self, statement: &Statement, warn: &mut dyn FnMut(String)) -> Result<(), SceneError> {
        if statement.modifier != b"void" {
            let modifier = show(statement.modifier);
            return Err(statement.error(format_args!("modifier `{modifier}` is not supported here; expected void")));
        }
        let matter = match statement.kind {
            b"plastic" | b"metal" => reflecting(statement, warn)?,
            b"light" | b"glow" => emitting(statement)?,
            _ => self.mixture(statement)?,
        };
        self.set(statement.name, matter);
        Ok(())
    }

    /// Reads `MODIFIER alias NAME TARGET`.
    ///
    /// # Errors
    /// An unknown target, and a modifier that would change it.
    pub(super) fn alias(&mut self, statement: &Statement, target: &[u8]) -> Result<(), SceneError> {
        if statement.modifier != b"void" && statement.modifier != b"inherit" {
            let modifier = show(statement.modifier);
            return Err(
                statement.error(format_args!("modifier `{modifier}` is not supported; expected void or inherit"))
            );
        }
        let index = self.find(target).map_err(|wrong| statement.error(wrong))?;
        self.set(statement.name, self.entries[index].matter.clone());
        Ok(())
    }

    fn set(&mut self, name: &[u8], matter: Matter) {
        // A file included a thousand times defines its materials a thousand times; the scene needs them once.
        if self.by_name.get(name).is_some_and(|&i| self.entries[i].matter == matter) {
            return;
        }
        self.by_name.insert(name.to_vec(), self.entries.len());
        self.entries.push(Entry { name: name.to_vec(), matter, in_scene: None });
    }

    fn mixture(&self, statement: &Statement) -> Result<Matter, SceneError> {
        statement.needs_reals(0, "none: only a constant can mix")?;
        let &[foreground, background, share, file] = statement.strings.as_slice() else {
            return Err(statement.error(format_args!(
                "has {} string arguments; expected 4: foreground background constant .",
                statement.strings.len()
            )));
        };
        let share = finite(share).filter(|_| file == b".").ok_or_else(|| {
            statement.error(format_args!(
                "mixes by `{} {}`; only a constant is supported: expected a number and .",
                show(share),
                show(file)
            ))
        })?;
        let share = share.clamp(0.0, 1.0);
        let part = |name| self.find(name).map(|i| self.matter(i)).map_err(|wrong| statement.error(wrong));
        if share == 1.0 {
            part(foreground).cloned()
        } else if share == 0.0 {
            part(background).cloned()
        } else {
            part(foreground)?.mix(share, part(background)?).map_err(|wrong| statement.error(wrong))
        }
    }
}

fn reflecting(statement: &Statement, warn: &mut dyn FnMut(String)) -> Result<Matter, SceneError> {
    statement.needs_reals(5, "red green blue specularity roughness")?;
    let color = rgb(statement)?;
    for (value, name) in [(statement.reals[3], "specularity"), (statement.reals[4], "roughness")] {
        if !(0.0..=1.0).contains(&value) {
            return Err(statement.error(format_args!("{name} is {value}; expected 0 to 1")));
        }
    }
    if color.max_element() > 1.0 {
        warn(statement.line(format_args!("colour {color} reflects more light than arrives; expected at most 1")));
    }
    let reflection = Reflection {
        color,
        specular: statement.reals[3],
        roughness: statement.reals[4],
        metal: statement.kind == b"metal",
    };
    Ok(Matter { emission: DVec3::ZERO, reflection: Some(reflection) })
}

fn emitting(statement: &Statement) -> Result<Matter, SceneError> {
    // The radius of a glow says how Radiance looks for its light, not how much there is.
    match statement.kind == b"light" {
        true => statement.needs_reals(3, "red green blue")?,
        false => statement.needs_reals(4, "red green blue radius")?,
    }
    Ok(Matter { emission: rgb(statement)?, reflection: None })
}

fn rgb(statement: &Statement) -> Result<DVec3, SceneError> {
    let color = DVec3::from_slice(&statement.reals[..3]);
    if color.min_element() < 0.0 || !color.as_vec3().is_finite() {
        let Vec3 { x, y, z } = color.as_vec3();
        return Err(statement.error(format_args!("colour is {x} {y} {z}; expected finite values >= 0")));
    }
    Ok(color)
}
