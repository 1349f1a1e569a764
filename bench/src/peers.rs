//! What others use, on the same scenes in the same run on the same machine: Radiance's rpict with an ambient file, Mitsuba 3's
//! path tracer, and that path tracer followed by Open Image Denoise, next to `ambience render --error`.
//!
//! CPU seconds are those of all cores and processes. Ambience's count from the start of the program to its end, the peers'
//! without loading and compiling. Every picture is averaged down to 128 x 128 and judged by the same measure.

use std::error::Error;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::{Path, PathBuf};
use std::process::{ChildStdin, Command, Stdio};
use std::time::Instant;

use clap::ValueEnum;
use glam::Vec3;
use serde::Deserialize;
use worker::scene;

use crate::host::children;
use crate::judge::{self, Reference, SIZE, judge, reduce, reference};
use crate::own;
use crate::results::{Point, Results};

/// Errors that Ambience is asked for, cheapest first.
const ERRORS: [f32; 7] = [0.1, 0.05, 0.03, 0.02, 0.015, 0.01, 0.005];

/// How far aside the view is that fills a cache for the second, over the diagonal of the scene's box.
const STEP: f32 = 0.05;

/// Arguments of the benchmark.
#[derive(Clone, Debug, clap::Args)]
pub struct PeersArgs {
    /// Scenes, all bounces
    #[arg(default_values = ["cornell", "stairs", "leak", "glossy-floor", "arcade"])]
    scenes: Vec<String>,
    /// Edge of the pictures, a multiple of 128
    #[arg(long, default_value_t = 512)]
    edge: u32,
    /// Only these
    #[arg(long, value_enum, value_delimiter = ',', default_values_t = Renderer::value_variants().iter().copied())]
    only: Vec<Renderer>,
    /// Only so many settings of each, the cheapest first
    #[arg(long, default_value_t = 99)]
    rungs: usize,
    /// A Python that has the packages of bench/peers/requirements.txt
    #[arg(long, default_value = "python3")]
    python: PathBuf,
}

/// What renders.
#[derive(Clone, Copy, PartialEq, Eq, Debug, ValueEnum)]
enum Renderer {
    /// `ambience render --error`
    Ambience,
    /// The same with the cache a view from a step aside has filled
    SecondView,
    /// Radiance, with an ambient file
    Rpict,
    /// Mitsuba 3's path tracer
    Path,
    /// The same, then Open Image Denoise
    Denoised,
}

/// What the script tells, a line at a time.
#[derive(Deserialize)]
#[serde(untagged)]
enum Told {
    Versions { versions: std::collections::BTreeMap<String, String> },
    Missing { missing: String },
    Picture { setting: String, cpu: f64, wall: f64, file: PathBuf },
}

/// Renders, judges, prints and keeps everything, in bench/results/peers.json, .md and .svg.
///
/// # Errors
/// No program `ambience` beside this one, results of another machine, or a peer that fails.
pub fn run(args: &PeersArgs) -> Result<(), Box<dyn Error>> {
    if args.edge == 0 || !(args.edge as usize).is_multiple_of(SIZE) {
        return Err(format!("--edge {}: expected a multiple of {SIZE}", args.edge).into());
    }
    let mut results = Results::open("peers")?;
    for scene in &args.scenes {
        let files = Files::of(scene)?;
        for &renderer in &args.only {
            let name = renderer.to_possible_value().map_or(String::new(), |v| v.get_name().into());
            let mut keep = |setting: &str, cpu: f64, wall: f64, image: &[[f64; 3]]| {
                let verdict = judge(&reduce(image), files.truth(renderer));
                let (scene, renderer, setting) = (scene.clone(), name.clone(), setting.into());
                results.put(Point::new(scene, args.edge, renderer, setting, [cpu, wall], &verdict));
            };
            let versions = match renderer {
                Renderer::Ambience => ours(&files, args, None, &mut keep)?,
                Renderer::SecondView => ours(&files, args, Some(&files.aside()?), &mut keep)?,
                _ => theirs(&name, &files.radiance, args, &mut keep)?,
            };
            results.versions.extend(versions);
            results.save()?;
        }
    }
    Ok(())
}

/// A scene's files and its references.
struct Files {
    radiance: PathBuf,
    ambience: PathBuf,
    truth: Reference,
    /// Of Radiance's material, where that is another.
    ward: Option<Reference>,
}

impl Files {
    fn of(scene: &str) -> Result<Self, Box<dyn Error>> {
        if let Some(radiance) = own::file(scene)? {
            return Ok(Self { ambience: radiance.clone(), radiance, truth: own::load(scene)?.2, ward: None });
        }
        let [radiance, ambience] = ["rad", "glb"].map(|ending| judge::file("scenes").join(format!("{scene}.{ending}")));
        if !ambience.exists() {
            return Err(format!("{scene}: neither a scene of tests/scenes nor one of {}", own::NAMES.join(", ")).into());
        }
        let ward = (scene == "glossy-floor").then(|| reference("glossy-floor-ward.full"));
        Ok(Self { radiance, ambience, truth: reference(&format!("{scene}.full")), ward })
    }

    /// The view of the scene's .vf from a step to the right, as text of a .vf.
    fn aside(&self) -> Result<String, Box<dyn Error>> {
        let path = self.radiance.with_extension("vf");
        let (view, camera) = (std::fs::read_to_string(&path)?, scene::load_view(&path)?);
        let positions = scene::load(&self.radiance)?.triangles.into_iter().flat_map(|t| t.positions);
        let (low, high) = positions.fold((Vec3::INFINITY, Vec3::NEG_INFINITY), |(low, high), position| {
            (low.min(position), high.max(position))
        });
        let eye = camera.eye + camera.right.normalize() * STEP * (high - low).length();
        let words: Vec<_> = view.split_whitespace().collect();
        let at = words.iter().position(|word| *word == "-vp").ok_or("a .vf without -vp")?;
        let moved = eye.to_array().map(|x| x.to_string());
        Ok([&words[..=at], &moved.each_ref().map(String::as_str), &words[at + 4..]].concat().join(" "))
    }

    fn truth(&self, renderer: Renderer) -> &Reference {
        let ward = if renderer == Renderer::Rpict { self.ward.as_ref() } else { None };
        ward.unwrap_or(&self.truth)
    }
}

/// Takes a setting, CPU and wall seconds, and the picture.
type Keep<'a> = &'a mut dyn FnMut(&str, f64, f64, &[[f64; 3]]);

/// The program users run.
pub(crate) fn program() -> Result<PathBuf, Box<dyn Error>> {
    let program = std::env::current_exe()?.with_file_name("ambience");
    let made = program.exists().then_some(&program);
    made.cloned().ok_or_else(|| format!("{}: not there; cargo build --release makes it", program.display()).into())
}

/// Runs a command to its end: wall seconds, and CPU seconds of its processes.
///
/// # Errors
/// One that cannot be run, or fails.
pub(crate) fn timed(command: &mut Command) -> Result<[f64; 2], Box<dyn Error>> {
    let (before, start) = (children()?, Instant::now());
    let status = command.status()?;
    let seconds = [start.elapsed().as_secs_f64(), children()? - before];
    if status.success() { Ok(seconds) } else { Err(format!("{command:?}: {status}").into()) }
}

/// The program as users run it; after another `view` has filled its cache, if there is one.
fn ours(
    files: &Files,
    args: &PeersArgs,
    view: Option<&str>,
    keep: Keep,
) -> Result<Vec<(String, String)>, Box<dyn Error>> {
    let program = program()?;
    for error in ERRORS.into_iter().take(args.rungs) {
        let folder = tempfile::tempdir()?;
        let [picture, cache, aside] = ["picture.exr", "cache", "aside.vf"].map(|name| folder.path().join(name));
        let command = || {
            let mut command = Command::new(&program);
            command.arg("render").arg(&files.ambience).arg("-o").arg(&picture).arg("--quiet");
            command.args(["--error", &error.to_string(), "--size", &format!("{0}x{0}", args.edge)]);
            if view.is_some() {
                command.arg("--cache").arg(&cache);
            }
            command
        };
        if let Some(view) = view {
            std::fs::write(&aside, view)?;
            timed(command().arg("--camera").arg(&aside))?;
        }
        let [wall, cpu] = timed(&mut command())?;
        let image: Vec<_> = worker::film::read(&picture)?.rgb.into_iter().map(|p| p.map(f64::from)).collect();
        keep(&format!("--error {error}"), cpu, wall, &image);
    }
    let out = Command::new(&program).arg("--version").output()?;
    Ok(vec![("Ambience".into(), String::from_utf8_lossy(&out.stdout).trim().into())])
}

/// What the script renders.
fn theirs(name: &str, scene: &Path, args: &PeersArgs, keep: Keep) -> Result<Vec<(String, String)>, Box<dyn Error>> {
    let folder = tempfile::tempdir()?;
    let mut script = Command::new(&args.python);
    script.arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("peers/peers.py")).arg(name).arg(scene);
    script.arg(args.edge.to_string()).arg(folder.path()).arg(args.rungs.to_string());
    let mut child = script.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
    let mut go_on: ChildStdin = child.stdin.take().ok_or("no stdin")?;
    let mut versions = Vec::new();
    for line in BufReader::new(child.stdout.take().ok_or("no stdout")?).lines() {
        match serde_json::from_str(&line?)? {
            Told::Versions { versions: told } => versions.extend(told),
            Told::Missing { missing } => {
                println!("{name} is missing: {missing}; bench/peers/requirements.txt names what it needs");
                versions.push((name.into(), format!("missing: {missing}")));
            }
            Told::Picture { setting, cpu, wall, file } => {
                keep(&setting, cpu, wall, &read(&file, args.edge)?);
                writeln!(go_on)?;
            }
        }
    }
    let status = child.wait()?;
    if status.success() { Ok(versions) } else { Err(format!("{script:?}: {status}").into()) }
}

/// A picture the script wrote.
fn read(path: &Path, edge: u32) -> Result<Vec<[f64; 3]>, Box<dyn Error>> {
    let bytes = std::fs::read(path)?;
    let floats: Vec<f64> = bytes.as_chunks().0.iter().map(|&b| f32::from_le_bytes(b).into()).collect();
    if floats.len() != 3 * (edge as usize).pow(2) || floats.iter().any(|v| !v.is_finite()) {
        return Err(format!("{}: not {edge} x {edge} finite pixels", path.display()).into());
    }
    Ok(floats.as_chunks().0.to_vec())
}
