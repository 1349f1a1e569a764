//! JSON lines: one object a record, label or publication, with every field by name. Numbers are written with as many
//! digits as give the same bits again.

use std::io::{self, BufRead, Read as _, Write};

use cache_core::radiance::Plain;
use cache_core::{Irradiance, Record, RecordId, Shrink, Tag};
use cache_proto::convert::{self, Checked};
use cache_proto::v1::entry::Entry as Kind;
use cache_proto::v1::{Entry, Label, Publication};
use glam::{Vec2, Vec3};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// Most bytes of a line: a label with the longest names has less.
const LINE_MAX: usize = 64 << 10;

/// What an object is, and of a record its kind.
#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum Type {
    Record,
    Label,
    Publication,
}

/// Of what kind a record is.
#[derive(Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
enum RecordKind {
    Irradiance,
    Shrink,
    Radiance,
}

#[derive(Deserialize)]
struct Head {
    r#type: Type,
    /// Records have one.
    kind: Option<RecordKind>,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct IrradianceLine {
    r#type: Type,
    namespace: String,
    kind: RecordKind,
    level: u32,
    step: u32,
    id: String,
    position: [f32; 3],
    normal: [f32; 3],
    radius: f32,
    radius_min: f32,
    radius_max: f32,
    irradiance: [f32; 3],
    gradient_t: [[f32; 2]; 3],
    gradient_r: [[f32; 2]; 3],
    ellipse: [f32; 3],
    noise: f32,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ShrinkLine {
    r#type: Type,
    namespace: String,
    kind: RecordKind,
    level: u32,
    step: u32,
    id: String,
    of: String,
    a: f32,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct RadianceLine {
    r#type: Type,
    namespace: String,
    kind: RecordKind,
    level: u32,
    step: u32,
    id: String,
    position: [f32; 3],
    normal: [f32; 3],
    radius: f32,
    radius_min: f32,
    radius_max: f32,
    ellipse: [f32; 3],
    noise: f32,
    coefficients: [Vec<f32>; 3],
    gradient: [[Vec<f32>; 3]; 2],
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct LabelLine {
    r#type: Type,
    namespace: String,
    scene: String,
    scene_hash: String,
    method: String,
    a: f32,
    rays: u32,
    #[serde(default)]
    rays_by_deviation: f32,
    #[serde(default)]
    least_rays: u32,
    bounces: u32,
    seed: u64,
    owner: String,
    draft_of: String,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct PublicationLine {
    r#type: Type,
    draft: String,
    namespace: String,
}

/// Writes the lines of a sound entry.
///
/// # Errors
/// Those of writing.
pub fn write(out: &mut impl Write, entry: &Entry) -> io::Result<()> {
    let mut line = |object: serde_json::Result<Vec<u8>>| {
        let mut bytes = object?;
        bytes.push(b'\n');
        out.write_all(&bytes)
    };
    match convert::entry(entry).map_err(io::Error::other)? {
        Checked::Batch(namespace, tag, records) => {
            let namespace = hex::encode(namespace.0);
            records.iter().try_for_each(|record| {
                line(match record {
                    Record::Irradiance(r) => serde_json::to_vec(&irradiance_line(&namespace, tag, r)),
                    Record::Shrink(r) => serde_json::to_vec(&shrink_line(&namespace, tag, r)),
                    Record::Radiance(r) => serde_json::to_vec(&radiance_line(&namespace, tag, r.plain())),
                })
            })
        }
        Checked::Label(_, _, label) => line(serde_json::to_vec(&LabelLine {
            r#type: Type::Label,
            namespace: hex::encode(&label.namespace),
            scene: label.scene,
            scene_hash: hex::encode(&label.scene_hash),
            method: label.method,
            a: label.a,
            rays: label.rays,
            rays_by_deviation: label.rays_by_deviation,
            least_rays: label.least_rays,
            bounces: label.bounces,
            seed: label.seed,
            owner: label.owner,
            draft_of: hex::encode(&label.draft_of),
        })),
        Checked::Publication { draft, namespace } => line(serde_json::to_vec(&PublicationLine {
            r#type: Type::Publication,
            draft: hex::encode(draft.0),
            namespace: hex::encode(namespace.0),
        })),
    }
}

/// Reads all entries of a file. Errors say in which line, and of which field.
///
/// # Errors
/// What is unsound, that of reading, or the first of `each`.
pub fn read(mut file: impl BufRead, each: &mut dyn FnMut(Entry) -> Result<(), String>) -> Result<(), String> {
    let (mut bytes, mut number) = (Vec::new(), 0u64);
    loop {
        number += 1;
        let at = |reason: String| format!("line {number}: {reason}");
        bytes.clear();
        let size = file.by_ref().take(LINE_MAX as u64).read_until(b'\n', &mut bytes).map_err(|e| at(e.to_string()))?;
        if size == 0 {
            return Ok(());
        }
        if size == LINE_MAX {
            return Err(at(format!("longer than {LINE_MAX} bytes")));
        }
        if !bytes.trim_ascii().is_empty() {
            entry(&bytes).and_then(&mut *each).map_err(at)?;
        }
    }
}

fn entry(line: &[u8]) -> Result<Entry, String> {
    let head = parse::<Head>(line)?;
    let entry = match head.r#type {
        Type::Record => {
            let (namespace, tag, record) = match head.kind.ok_or("kind: missing")? {
                RecordKind::Irradiance => {
                    let line: IrradianceLine = parse(line)?;
                    let record = irradiance(&line)?;
                    (line.namespace, Tag { level: line.level, step: line.step }, Record::from(record))
                }
                RecordKind::Shrink => {
                    let line: ShrinkLine = parse(line)?;
                    let shrink = Shrink { id: id("id", &line.id)?, of: id("of", &line.of)?, a: line.a };
                    (line.namespace, Tag { level: line.level, step: line.step }, Record::from(shrink))
                }
                RecordKind::Radiance => {
                    let line: RadianceLine = parse(line)?;
                    let tag = Tag { level: line.level, step: line.step };
                    let (namespace, plain) = radiance(line)?;
                    (namespace, tag, Record::radiance(&plain).map_err(|invalid| invalid.to_string())?)
                }
            };
            record.check().map_err(|invalid| invalid.to_string())?;
            let namespace = convert::namespace(&bytes("namespace", &namespace)?).map_err(|e| e.to_string())?;
            Kind::Batch(convert::pack(&namespace, tag, [&record]))
        }
        Type::Label => {
            let line: LabelLine = parse(line)?;
            Kind::Label(Label {
                namespace: bytes("namespace", &line.namespace)?.into(),
                scene: line.scene,
                scene_hash: bytes("scene_hash", &line.scene_hash)?.into(),
                method: line.method,
                a: line.a,
                rays: line.rays,
                rays_by_deviation: line.rays_by_deviation,
                least_rays: line.least_rays,
                bounces: line.bounces,
                seed: line.seed,
                owner: line.owner,
                draft_of: bytes("draft_of", &line.draft_of)?.into(),
            })
        }
        Type::Publication => {
            let line: PublicationLine = parse(line)?;
            let (draft, namespace) = (bytes("draft", &line.draft)?.into(), bytes("namespace", &line.namespace)?.into());
            Kind::Publication(Publication { draft, namespace })
        }
    };
    Ok(Entry { entry: Some(entry) })
}

fn parse<T: DeserializeOwned>(line: &[u8]) -> Result<T, String> {
    let mut deserializer = serde_json::Deserializer::from_slice(line);
    let parsed =
        serde_path_to_error::deserialize(&mut deserializer).map_err(|error| match error.path().to_string() {
            whole if whole == "." => without_place(error.inner()),
            field => format!("{field}: {}", without_place(error.inner())),
        })?;
    deserializer.end().map(|()| parsed).map_err(|error| without_place(&error))
}

/// What is wrong without where: every object is on line 1 for its parser.
fn without_place(error: &serde_json::Error) -> String {
    let text = error.to_string();
    text.split(" at line ").next().unwrap_or(&text).into()
}

fn bytes(field: &str, text: &str) -> Result<Vec<u8>, String> {
    hex::decode(text).map_err(|error| format!("{field}: expected hexadecimal digits: {error}"))
}

fn shrink_line(namespace: &str, tag: Tag, shrink: &Shrink) -> ShrinkLine {
    ShrinkLine {
        r#type: Type::Record,
        namespace: namespace.into(),
        kind: RecordKind::Shrink,
        level: tag.level,
        step: tag.step,
        id: digits(shrink.id),
        of: digits(shrink.of),
        a: shrink.a,
    }
}

/// An id's 32 digits, most significant first.
fn digits(RecordId(id): RecordId) -> String {
    format!("{id:032x}")
}

fn id(field: &str, text: &str) -> Result<RecordId, String> {
    let id = <[u8; 16]>::try_from(bytes(field, text)?);
    id.map(|id| RecordId(u128::from_be_bytes(id))).map_err(|_| format!("{field}: expected 32 hexadecimal digits"))
}

fn irradiance_line(namespace: &str, tag: Tag, r: &Irradiance) -> IrradianceLine {
    IrradianceLine {
        r#type: Type::Record,
        namespace: namespace.into(),
        kind: RecordKind::Irradiance,
        level: tag.level,
        step: tag.step,
        id: digits(r.id),
        position: r.position.into(),
        normal: r.normal.into(),
        radius: r.radius,
        radius_min: r.radius_min,
        radius_max: r.radius_max,
        irradiance: r.irradiance.into(),
        gradient_t: r.gradient_t.map(Into::into),
        gradient_r: r.gradient_r.map(Into::into),
        ellipse: r.ellipse,
        noise: r.noise,
    }
}

fn irradiance(line: &IrradianceLine) -> Result<Irradiance, String> {
    Ok(Irradiance {
        id: id("id", &line.id)?,
        position: Vec3::from(line.position),
        normal: Vec3::from(line.normal),
        radius: line.radius,
        radius_min: line.radius_min,
        radius_max: line.radius_max,
        irradiance: Vec3::from(line.irradiance),
        gradient_t: line.gradient_t.map(Vec2::from),
        gradient_r: line.gradient_r.map(Vec2::from),
        ellipse: line.ellipse,
        noise: line.noise,
    })
}

fn radiance_line(namespace: &str, tag: Tag, r: Plain) -> RadianceLine {
    RadianceLine {
        r#type: Type::Record,
        namespace: namespace.into(),
        kind: RecordKind::Radiance,
        level: tag.level,
        step: tag.step,
        id: digits(r.id),
        position: r.position.into(),
        normal: r.normal.into(),
        radius: r.radius,
        radius_min: r.radius_bounds.0,
        radius_max: r.radius_bounds.1,
        ellipse: r.ellipse,
        noise: r.noise,
        coefficients: r.coefficients,
        gradient: r.gradient,
    }
}

/// The namespace a line names, and its record.
fn radiance(line: RadianceLine) -> Result<(String, Plain), String> {
    let plain = Plain {
        id: id("id", &line.id)?,
        position: Vec3::from(line.position),
        normal: Vec3::from(line.normal),
        radius: line.radius,
        radius_bounds: (line.radius_min, line.radius_max),
        ellipse: line.ellipse,
        noise: line.noise,
        coefficients: line.coefficients,
        gradient: line.gradient,
    };
    Ok((line.namespace, plain))
}
