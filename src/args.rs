//! The arguments of `render`, their defaults, and what they mean for a given scene.

use std::path::{Path, PathBuf};

use cache_core::details::Details;
use worker::client::Address;
use worker::credentials::{CredentialArgs, Credentials};
use worker::scene::Scene;
use worker::settings::{ALL_BOUNCES, Method, Settings, defaults};
use worker::{film, pilot, spec};

use crate::children::Transport;
use crate::failure::Failure;
use crate::progress::Told;
use crate::splat;
use crate::view::ViewArgs;

/// Renders a picture.
#[derive(Clone, Debug, clap::Args)]
pub struct RenderArgs {
    #[command(flatten)]
    pub view: ViewArgs,
    /// Picture to write; a .png to look at is written beside it
    #[arg(short, long, value_name = "OUT.exr")]
    pub output: PathBuf,
    /// Samples a pixel
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=65536),
          default_value_t = defaults::SPP)]
    pub spp: u32,
    /// How indirect light is computed: auto has records of radiance for gloss where they are as good as sampling it
    #[arg(long, value_name = "M", value_parser = ["auto", "irradiance", "radiance", "path"], default_value = "auto")]
    pub method: String,
    /// Allowed interpolation error of a record (Ward 1988): smaller is slower and more accurate
    #[arg(long, value_name = "A", value_parser = allowed_error, default_value_t = defaults::A)]
    pub a: f32,
    /// Rays in one gather
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(4..=1 << 20),
          default_value_t = defaults::RAYS)]
    pub rays: u32,
    /// Indirect bounces: a number, or all
    #[arg(long, value_name = "N", value_parser = bounces, default_value = "all")]
    pub bounces: u32,
    /// Another number gives another, equally good, picture
    #[arg(long, value_name = "N", default_value_t = defaults::SEED)]
    pub seed: u64,
    /// Worker processes to start [default: one per core; with --server: none]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(0..=1024))]
    pub workers: Option<u16>,
    /// Threads of each worker started here
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=64),
          default_value_t = 1)]
    pub threads: u16,
    /// Use this server, and the workers connected to it: HOST:PORT or unix:PATH
    #[arg(long, value_name = "ADDR")]
    pub server: Option<Address>,
    /// How to call it.
    #[command(flatten)]
    pub credentials: CredentialArgs,
    /// Write statistics as one JSON object
    #[arg(long, value_name = "OUT.json")]
    pub stats: Option<PathBuf>,
    /// How progress is told
    #[arg(long, value_name = "HOW", value_enum, default_value_t)]
    pub progress: Told,
    /// No progress and no closing line; warnings and errors only
    #[arg(long)]
    pub quiet: bool,
    /// Keep records in this directory between renders, and use those it has of the same scene and settings
    #[arg(long, value_name = "DIR", conflicts_with = "server")]
    pub cache: Option<PathBuf>,
    /// Relative error of the finished picture to aim for, 0.001 to 0.5, in place of --a, --rays and --spp: a small part of
    /// the picture is looked at first, and what it shows decides
    #[arg(long, value_name = "E", value_parser = error, conflicts_with_all = ["a", "rays", "spp"])]
    pub error: Option<f32>,
    /// Let a GPU interpolate the pixels: that of the first worker started here, or of workers of --server that splat. The same
    /// picture within roundings, not the same bits
    #[arg(long)]
    pub splat: bool,
    /// How own workers reach their server.
    #[arg(long, hide = true, value_enum, default_value_t)]
    pub transport: Transport,
}

impl RenderArgs {
    /// Checks everything that can be checked without the scene, the files to be written included.
    ///
    /// # Errors
    /// [`Failure::Usage`].
    pub fn check(&self) -> Result<(), Failure> {
        if self.splat && self.workers() > 0 {
            splat::check("--splat")?;
        }
        if let Some(cache) = self.cache.as_ref().filter(|cache| cache.exists() && !cache.is_dir()) {
            return Err(Failure::usage(format!("--cache {}: expected a directory", cache.display())));
        }
        if self.server.is_none() && self.workers == Some(0) {
            return Err(Failure::usage("--workers 0 needs --server: nobody would render"));
        }
        let ending = self.output.extension().is_some_and(|e| e.eq_ignore_ascii_case("exr"));
        if !ending {
            return Err(Failure::usage(format!("--output {}: expected a name ending in .exr", self.output.display())));
        }
        let mut taken = vec![identity(&self.view.scene)];
        for (path, option) in
            [(Some(&self.output), "--output"), (Some(&self.png()), "--output"), (self.stats.as_ref(), "--stats")]
        {
            let Some(path) = path else { continue };
            film::check_writable(path).map_err(|e| Failure::usage(format!("{option} {e}")))?;
            if taken.contains(&identity(path)) {
                let path = path.display();
                return Err(Failure::usage(format!("{option} {path}: is the scene or another file to be written")));
            }
            taken.push(identity(path));
        }
        Ok(())
    }

    /// What the server is called with; a server of our own asks nothing.
    ///
    /// # Errors
    /// [`Failure::Usage`].
    pub fn credentials(&self) -> Result<Credentials, Failure> {
        let load = |server| self.credentials.load(server).map_err(Failure::usage);
        self.server.as_ref().map_or(Ok(Credentials::default()), load)
    }

    /// The PNG beside the EXR.
    pub fn png(&self) -> PathBuf {
        self.output.with_extension("png")
    }

    /// Worker processes to start.
    pub fn workers(&self) -> u16 {
        let default = || match self.server {
            Some(_) => 0,
            None => u16::try_from(worker::farm::cores()).unwrap_or(1024).min(1024),
        };
        self.workers.unwrap_or_else(default)
    }

    /// The settings for a scene.
    ///
    /// # Errors
    /// [`Failure::Usage`]: no such camera, or a value outside its range.
    pub fn settings(&self, scene: &Scene) -> Result<Settings, Failure> {
        let (camera, [width, height]) = self.view.of(scene)?;
        let settings = Settings {
            camera,
            width,
            height,
            spp: self.spp,
            method: Method::from_name(&self.method).unwrap_or(Method::Auto),
            a: self.a,
            rays: self.rays,
            bounces: self.bounces,
            seed: self.seed,
            // With --error a pilot decides.
            effort: None,
            details: Details::default(),
        };
        spec::check(&settings).map_err(|e| Failure::usage(format!("--{e}")))?;
        Ok(settings)
    }
}

/// The same for all names of one file, which need not be there yet.
fn identity(path: &Path) -> PathBuf {
    let whole = |path: &Path| std::fs::canonicalize(if path.as_os_str().is_empty() { Path::new(".") } else { path });
    whole(path).unwrap_or_else(|_| match (path.parent().map(whole), path.file_name()) {
        (Some(Ok(folder)), Some(name)) => folder.join(name),
        _ => path.to_path_buf(),
    })
}

fn allowed_error(text: &str) -> Result<f32, String> {
    let a = text.parse().ok().filter(|a| *a > 0.0 && *a <= 10.0);
    a.ok_or_else(|| "expected a number more than 0 and at most 10".into())
}

fn error(text: &str) -> Result<f32, String> {
    let (least, most) = pilot::ERROR_RANGE;
    let error = text.parse().ok().filter(|error| (least..=most).contains(error));
    error.ok_or_else(|| format!("expected a number from {least} to {most}, as 0.02 for 2 %"))
}

fn bounces(text: &str) -> Result<u32, String> {
    match text {
        "all" => Ok(ALL_BOUNCES),
        _ => text.parse().ok().filter(|n| *n < ALL_BOUNCES).ok_or_else(|| "expected a number or all".into()),
    }
}

#[cfg(test)]
mod tests {
    use clap::Parser;
    use glam::Vec3;

    use worker::scene::Camera;

    use super::*;

    #[derive(Parser)]
    struct Line {
        #[command(flatten)]
        render: RenderArgs,
    }

    fn args(rest: &[&str]) -> RenderArgs {
        let line = ["render", "scene.glb", "-o", "out.exr"].iter().chain(rest);
        Line::try_parse_from(line).unwrap_or_else(|e| panic!("{e}")).render
    }

    fn scene() -> Scene {
        let camera = |name: &str| Camera {
            name: name.into(),
            ..Camera::look(Vec3::ZERO, Vec3::Y, Vec3::Z, 1.0, 0.5, false).expect("view")
        };
        Scene { cameras: vec![camera("front"), camera("back")], ..Scene::default() }
    }

    fn usage(result: Result<impl std::fmt::Debug, Failure>) -> String {
        let failure = result.expect_err("refused");
        assert_eq!(failure.exit_code(), 2);
        failure.to_string()
    }

    #[test]
    fn defaults_are_those_of_the_help() {
        let settings = args(&[]).settings(&scene()).expect("sound");
        let expected = (libm::tanf(0.5) / libm::tanf(0.25) * 512.0).round() as u32;
        assert_eq!((settings.width, settings.height, settings.spp), (expected, defaults::HEIGHT, defaults::SPP));
        assert_eq!((settings.method, settings.rays, settings.bounces), (Method::Auto, defaults::RAYS, ALL_BOUNCES));
        assert_eq!(settings.camera.name, "front");
    }

    #[test]
    fn another_aspect_keeps_the_vertical_field_of_view() {
        let settings = args(&["--size", "100x200", "--bounces", "3"]).settings(&scene()).expect("sound");
        assert_eq!((settings.camera.up, settings.bounces), (scene().cameras[0].up, 3));
        assert!((settings.camera.aspect() - 0.5).abs() < 1e-6);
    }

    #[test]
    fn wrong_usage_says_what_and_where() {
        let settings = |rest: &[&str]| usage(args(rest).settings(&scene()));
        assert_eq!(settings(&["--camera", "top"]), "--camera top: scene.glb has the cameras \"front\", \"back\"");
        let none = usage(args(&[]).settings(&Scene::default()));
        assert_eq!(none, "scene.glb has no camera: name a view file with --camera FILE.vf");

        let check = |rest: &[&str]| usage(args(rest).check());
        let refused = |rest: &[&str]| {
            let line = ["render", "scene.glb", "-o", "out.exr"].iter().chain(rest);
            Line::try_parse_from(line).err().expect("refused").to_string()
        };
        assert!(refused(&["--error", "2"]).contains("expected a number from 0.001 to 0.5, as 0.02 for 2 %"));
        assert!(refused(&["--error", "0.02", "--rays", "64"]).contains("cannot be used with"));
        assert_eq!(check(&["--cache", "Cargo.toml"]), "--cache Cargo.toml: expected a directory");
        assert!(check(&["--workers", "0"]).starts_with("--workers 0 needs --server"));
        assert!(check(&["--stats", "/no/such/folder/s.json"]).starts_with("--stats /no/such/folder/s.json: cannot"));
        let mut other = args(&[]);
        other.output = "out.png".into();
        assert_eq!(usage(other.check()), "--output out.png: expected a name ending in .exr");
        for wrong in
            [["--spp", "0"], ["--a", "nan"], ["--a", "0"], ["--rays", "3"], ["--threads", "0"], ["--spp", "70000"]]
        {
            assert!(
                Line::try_parse_from(["render", "a.glb", "-o", "b.exr"].iter().chain(&wrong)).is_err(),
                "{wrong:?}"
            );
        }
        assert!(bounces("-1").is_err() && bounces("some").is_err());
    }
}
