//! Radiance view files: lines that begin with `VIEW=` or with the name of a program that takes views.

use std::path::Path;

use glam::{DVec3, Vec3};

use super::rad::show;
use super::{Camera, SceneError};

/// What a line with a view begins with, after any path.
const STARTS: [&str; 6] = ["VIEW=", "rpict", "rview", "rvu", "rpiece", "pinterp"];

/// The options, with Radiance's defaults. Sizes are degrees, in a parallel view lengths.
struct View {
    parallel: bool,
    point: DVec3,
    direction: DVec3,
    up: DVec3,
    horizontal: f64,
    vertical: f64,
}

impl Default for View {
    fn default() -> Self {
        Self {
            parallel: false,
            point: DVec3::ZERO,
            direction: DVec3::Y,
            up: DVec3::Z,
            horizontal: 45.0,
            vertical: 45.0,
        }
    }
}

/// Reads a .vf file. As in Radiance, lines add up: the last one decides, and keeps what it does not mention.
///
/// # Errors
/// A missing file, no view in it, or an option that makes no view we can take; with file and line.
pub(super) fn load(path: &Path) -> Result<Camera, SceneError> {
    let shown = path.display();
    let error = |message: String| SceneError(format!("{shown}{message}"));
    if path.metadata().is_ok_and(|about| !about.is_file()) {
        return Err(error(": not a file; expected a Radiance view file".into()));
    }
    let bytes = std::fs::read(path).map_err(|e| error(format!(": cannot be read: {e}")))?;
    let mut view = View::default();
    let mut found = None;
    for (i, line) in String::from_utf8_lossy(&bytes).lines().enumerate() {
        let Some(options) = options(line) else { continue };
        let seen = view.read(options).map_err(|wrong| error(format!(":{}: {wrong}", i + 1)))?;
        found = if seen { Some(i + 1) } else { found };
    }
    let line = found.ok_or_else(|| error(": no view in it; expected a line `rvu -vtv -vp ...`".into()))?;
    view.camera().map_err(|wrong| error(format!(":{line}: {wrong}")))
}

/// What follows the beginning of a line with a view; `None` for other lines.
fn options(line: &str) -> Option<&str> {
    let line = line.trim_start();
    let first = line.split_whitespace().next()?;
    let program = first.rsplit(['/', '\\']).next()?;
    let start = STARTS.iter().find(|start| program.starts_with(**start))?;
    let skip = if *start == "VIEW=" { first.len() - program.len() + start.len() } else { first.len() };
    Some(&line[skip..])
}

impl View {
    /// Takes in a line's options; whether any of them was a view's.
    fn read(&mut self, options: &str) -> Result<bool, String> {
        let mut words = options.split_whitespace();
        let mut seen = false;
        while let Some(word) = words.next() {
            // Lines of rpict hold all of its options; only the view's concern us.
            if !word.starts_with("-v") || word == "-v" {
                continue;
            }
            seen = true;
            let mut number = || -> Result<f64, String> {
                let text = words.next().ok_or_else(|| format!("{word} ends the line; expected its numbers"))?;
                let value = text.parse().ok().filter(|v: &f64| v.is_finite());
                value.ok_or_else(|| format!("{word} has `{}`; expected a finite number", show(text.as_bytes())))
            };
            match word {
                "-vtv" => self.parallel = false,
                "-vtl" => self.parallel = true,
                "-vp" => self.point = DVec3::new(number()?, number()?, number()?),
                "-vd" => self.direction = DVec3::new(number()?, number()?, number()?),
                "-vu" => self.up = DVec3::new(number()?, number()?, number()?),
                "-vh" => self.horizontal = number()?,
                "-vv" => self.vertical = number()?,
                "-vo" | "-va" | "-vs" | "-vl" => {
                    let value = number()?;
                    if value != 0.0 {
                        return Err(format!("{word} {value} is not supported (clipping, shift, lift); expected 0"));
                    }
                }
                _ if word.starts_with("-vt") => {
                    return Err(format!("view type {} is not supported; expected -vtv or -vtl", show(word.as_bytes())));
                }
                _ => {
                    return Err(format!(
                        "view option {} is not supported; expected -vt -vp -vd -vu -vh -vv",
                        show(word.as_bytes())
                    ));
                }
            }
        }
        Ok(seen)
    }

    fn camera(&self) -> Result<Camera, String> {
        let size = |value: f64| (if self.parallel { value } else { value.to_radians() }) as f32;
        // Lengths of directions mean nothing; in 32 bits they could still be lost.
        let direction = |v: DVec3| v.try_normalize().unwrap_or(DVec3::ZERO).as_vec3();
        let point: Vec3 = self.point.as_vec3();
        Camera::look(
            point,
            direction(self.direction),
            direction(self.up),
            size(self.horizontal),
            size(self.vertical),
            self.parallel,
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(text: &str) -> Result<Camera, String> {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        load(file.path()).map_err(|e| e.to_string().replace(&file.path().display().to_string(), "FILE"))
    }

    #[test]
    fn views_have_radiance_defaults() {
        let camera = view("VIEW= -vtv\n").unwrap();
        assert_eq!((camera.eye, camera.forward, camera.parallel), (Vec3::ZERO, Vec3::Y, false));
        let half = libm::tanf(22.5f32.to_radians());
        assert!(camera.right.abs_diff_eq(Vec3::X * half, 1e-6) && camera.up.abs_diff_eq(Vec3::Z * half, 1e-6));
    }

    #[test]
    fn the_last_line_decides_and_keeps_the_rest() {
        let text = "#?RADIANCE\nrvu -vtv -vp 1 2 3 -vd 0 0 -2 -vu 0 1 0 -vh 90 -vv 60 -vo 0 -va 0 -vs 0 -vl 0\n\
                    nothing -vp 9 9 9\n/usr/bin/rpict -ab 2 -x 512 -vtl -vh 4 -vv 2 scene.oct\n";
        let camera = view(text).unwrap();
        assert_eq!((camera.eye, camera.forward, camera.parallel), (Vec3::new(1.0, 2.0, 3.0), Vec3::NEG_Z, true));
        assert_eq!((camera.right, camera.up), (Vec3::X * 2.0, Vec3::Y));
    }

    #[test]
    fn the_smallest_and_largest_views_take_any_aspect() {
        for (horizontal, vertical) in [("2e-12", "9e11"), ("9e11", "2e-12")] {
            let camera = view(&format!("rvu -vtl -vh {horizontal} -vv {vertical}\n")).unwrap();
            for aspect in [1.0 / 65536.0, 1.0, 65536.0] {
                let there = camera.clone().with_aspect(aspect).aspect();
                assert!((there / aspect - 1.0).abs() < 1e-5, "{there} for {aspect}");
            }
        }
    }

    #[test]
    fn what_is_no_view_is_an_error_with_its_line() {
        for (text, wanted) in [
            ("", "FILE: no view in it"),
            ("hello\n", "FILE: no view in it"),
            ("rvu\n", "FILE: no view in it"),
            ("\nrvu -vth\n", "FILE:2: view type -vth is not supported"),
            ("rvu -vtv -vs 0.5\n", "FILE:1: -vs 0.5 is not supported"),
            ("rvu -vf other.vf\n", "FILE:1: view option -vf is not supported"),
            ("rvu -vp 1 2\n", "FILE:1: -vp ends the line"),
            ("rvu -vp 1 2 nan\n", "FILE:1: -vp has `nan`"),
            ("rvu -vp 1 2 \u{17}3\n", "FILE:1: -vp has `\u{fffd}3`"),
            ("rvu -v\u{1b}[2J\n", "FILE:1: view option -v\u{fffd}[2J is not supported"),
            (
                "rvu -vh 180\n",
                "FILE:1: horizontal view size 180 is out of range; expected degrees between 1e-10 and 180",
            ),
            ("rvu -vh 1e-14\n", "FILE:1: horizontal view size 0.00000000000001 is out of range"),
            ("rvu -vd 0 0 1 -vu 0 0 1\n", "FILE:1: view up must not be"),
            ("rvu -vp 1e300 0 0\n", "FILE:1: view point"),
        ] {
            let message = view(text).unwrap_err();
            assert!(message.starts_with(wanted), "{text:?} gives {message:?}");
        }
        for size in ["-1", "0", "1e-30", "1e-45", "1e18", "6888888888888888888888888888888888880", "1e300"] {
            for (option, what) in [("-vh", "horizontal"), ("-vv", "vertical")] {
                let message = view(&format!("VIEW= -vtl\nrvu {option} {size}\n")).expect_err(size);
                assert!(message.starts_with(&format!("FILE:2: {what} view size ")), "{message}");
                assert!(message.ends_with(" is out of range; expected a length between 1e-12 and 1e12"), "{message}");
            }
        }
        assert!(load(Path::new("/nowhere/a.vf")).unwrap_err().to_string().contains("cannot be read"));
    }
}
