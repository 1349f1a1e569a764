//! Scenes of a few lines, against what the manual says they are.

use std::f64::consts::PI;
use std::path::Path;

use glam::{DVec3, Vec3};
use proptest::prelude::*;
use tempfile::TempDir;

use crate::scene::{Scene, Surface, Triangle, load};

const GREY: &str = "void plastic grey\n0\n0\n5 .5 .5 .5 0 0\n";

/// Loads `main.rad` from a directory with these files.
fn load_files(files: &[(&str, &str)]) -> Result<Scene, String> {
    let room = TempDir::new().unwrap();
    for (name, text) in files {
        let path = room.path().join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, text).unwrap();
    }
    let place = format!("{}/", room.path().display());
    load(&room.path().join("main.rad")).map_err(|e| e.to_string().replace(&place, ""))
}

fn read(text: &str) -> Scene {
    load_files(&[("main.rad", text)]).unwrap()
}

fn error(text: &str) -> String {
    let message = load_files(&[("main.rad", text)]).unwrap_err();
    assert!(!message.contains('\n'), "{message}");
    message
}

/// One surface of grey.
fn grey(kind: &str, reals: &str) -> Scene {
    read(&surface(kind, reals))
}

fn surface(kind: &str, reals: &str) -> String {
    format!("{GREY}grey {kind} it\n0\n0\n{} {reals}\n", reals.split_whitespace().count())
}

fn cross(t: &Triangle) -> DVec3 {
    let [a, b, c] = t.positions.map(|p| p.as_dvec3());
    (b - a).cross(c - a)
}

fn area(scene: &Scene) -> f64 {
    scene.triangles.iter().map(|t| cross(t).length() / 2.0).sum()
}

fn close(a: f64, b: f64) {
    assert!((a - b).abs() <= 1e-5 * b.abs().max(1e-3), "{a} is not {b}");
}

/// The points of a polygon that is a triangle.
fn corners(scene: &Scene) -> Vec<Vec3> {
    scene.triangles.iter().flat_map(|t| t.positions).collect()
}

#[test]
fn comments_and_layout_do_not_matter() {
    let text = "# head\nvoid plastic 'a b' # none\n0\n0 5#five\n .5 .25 5e-1 # grey\n 0 0\n\
                \"a b\"\npolygon\r\n  p\n0 0 9 0 0 0 +1 0. 0 0 1 0";
    let scene = read(text);
    assert_eq!(corners(&scene), [Vec3::ZERO, Vec3::X, Vec3::Y]);
    assert_eq!(scene.materials[0].color, Vec3::new(0.5, 0.25, 0.5));
    assert_eq!(scene.materials[0].name, "a b");
}

#[test]
fn materials_are_what_they_say() {
    let scene = read(
        "void plastic p 0 0 5 .1 .2 .3 0 0\nvoid plastic s 0 0 5 .1 .2 .3 .04 .1\nvoid metal m 0 0 5 .8 .8 .8 1 .2\n\
         void light l 0 0 3 1 2 3\nvoid glow g 0 0 4 1 2 3 0\nvoid glow n 0 0 4 1 2 3 5\n\
         p polygon a 0 0 9 0 0 0 1 0 0 0 1 0\ns polygon a 0 0 9 0 0 0 1 0 0 0 1 0\n\
         m polygon a 0 0 9 0 0 0 1 0 0 0 1 0\nl polygon a 0 0 9 0 0 0 1 0 0 0 1 0\n\
         g polygon a 0 0 9 0 0 0 1 0 0 0 1 0\nn polygon a 0 0 9 0 0 0 1 0 0 0 1 0\n",
    );
    let m = &scene.materials;
    assert_eq!(m.len(), 6);
    assert_eq!((m[0].surface, m[0].color, m[0].double_sided), (Surface::Diffuse, Vec3::new(0.1, 0.2, 0.3), true));
    assert_eq!(m[1].surface, Surface::Plastic { specular: 0.04, roughness: 0.1 });
    assert_eq!(m[2].surface, Surface::Metal { specular: 1.0, roughness: 0.2 });
    for light in &m[3..6] {
        assert_eq!((light.emission, light.color), (Vec3::new(1.0, 2.0, 3.0), Vec3::ZERO));
        assert!(!light.double_sided);
    }
}

#[test]
fn mixtures_mix_emission_and_reflection() {
    let mixed = |a: &str, b: &str, c: &str| {
        let text = format!("void {a}\nvoid {b}\nvoid mixfunc m 4 a b {c} . 0 0\nm sphere s 0 0 4 0 0 0 1\n");
        load_files(&[("main.rad", &text)]).map(|mut s| s.materials.remove(0))
    };
    let m = mixed("glow a 0 0 4 2 2 2 0", "plastic b 0 0 5 1 1 1 0 0", "0.25").unwrap();
    assert_eq!((m.emission, m.color, m.surface), (Vec3::splat(0.5), Vec3::splat(0.75), Surface::Diffuse));
    assert!(m.double_sided);
    let m = mixed("plastic a 0 0 5 .5 .5 .5 .1 .2", "plastic b 0 0 5 .3 .3 .3 0 0", "0.5").unwrap();
    assert_eq!(m.surface, Surface::Plastic { specular: 0.05, roughness: 0.2 });
    // Diffuse albedo: half of .45 and half of .3.
    close(f64::from(m.color.x) * 0.95, 0.375);
    let m = mixed("light a 0 0 3 1 1 1", "metal b 0 0 5 .8 .6 .4 .5 .2", "0.5").unwrap();
    assert_eq!(m.surface, Surface::Metal { specular: 0.5, roughness: 0.2 });
    close(f64::from(m.color.y), 0.3);
    let m = mixed("metal a 0 0 5 .8 .6 .4 .5 .2", "plastic b 0 0 5 1 0 0 0 0", "1").unwrap();
    assert_eq!(m.color, Vec3::new(0.8, 0.6, 0.4));
    assert!(mixed("metal a 0 0 5 .8 .6 .4 1 .2", "plastic b 0 0 5 1 0 0 0 0", "0.5").unwrap_err().contains("neither"));
    assert!(mixed("metal a 0 0 5 1 1 1 1 .2", "metal b 0 0 5 1 1 1 1 .1", "0.5").unwrap_err().contains("roughness"));
    assert!(mixed("glow a 0 0 4 2 2 2 0", "plastic b 0 0 5 1 1 1 0 0", "noise").unwrap_err().contains("constant"));
}

#[test]
fn the_latest_definition_counts_and_aliases_keep_theirs() {
    let scene = read(
        "void plastic a 0 0 5 .1 .1 .1 0 0\nvoid alias b a\ninherit alias c b\n\
         a polygon p 0 0 9 0 0 0 1 0 0 0 1 0\nvoid plastic a 0 0 5 .2 .2 .2 0 0\n\
         a polygon p 0 0 9 0 0 0 1 0 0 0 1 0\nc polygon p 0 0 9 0 0 0 1 0 0 0 1 0\n",
    );
    let colors: Vec<f32> = scene.triangles.iter().map(|t| scene.materials[t.material as usize].color.x).collect();
    assert_eq!(colors, [0.1, 0.2, 0.1]);
}

#[test]
fn polygons_keep_area_and_front() {
    // A horseshoe, area 7; the same from behind; and leaning.
    let horseshoe = [(0, 0), (3, 0), (3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3)];
    for (reverse, axis) in [(false, 0), (true, 0), (false, 1), (true, 2)] {
        let mut points: Vec<[f64; 3]> = horseshoe.iter().map(|&(x, y)| [f64::from(x), f64::from(y), 0.25]).collect();
        points.iter_mut().for_each(|p| p.rotate_right(axis));
        if reverse {
            points.reverse();
        }
        let reals: Vec<String> = points.iter().flatten().map(f64::to_string).collect();
        let scene = grey("polygon", &reals.join(" "));
        close(area(&scene), 7.0);
        let mut front = DVec3::ZERO;
        front[(axis + 2) % 3] = if reverse { -1.0 } else { 1.0 };
        assert!(scene.triangles.iter().all(|t| cross(t).normalize().abs_diff_eq(front, 1e-9)));
    }
}

#[test]
fn seams_cut_holes() {
    let hole = |x: f64| format!("{x} 1 0 {x} 3 0 {} 3 0 {} 1 0 {x} 1 0", x + 1.0, x + 1.0);
    // Round the outside, along the seam to the hole, round it the other way, and back.
    let one = grey("polygon", &format!("0 0 0 8 0 0 8 4 0 0 4 0 0 0 0 {}", hole(1.0)));
    close(area(&one), 30.0);
    assert!(one.triangles.iter().all(|t| cross(t).z > 0.0));
    // Two holes at the end of one seam of several points.
    let two =
        grey("polygon", &format!("0 0 0 8 0 0 8 4 0 0 4 0 0 0 0 .5 .5 0 {} {} 1 1 0 .5 .5 0", hole(1.0), hole(4.0)));
    close(area(&two), 28.0);
    // The hole must be empty.
    let inside = |t: &&Triangle| {
        let p = DVec3::new(1.5, 2.0, 0.0);
        let [a, b, c] = t.positions.map(|q| q.as_dvec3() - p);
        a.cross(b).z > 0.0 && b.cross(c).z > 0.0 && c.cross(a).z > 0.0
    };
    assert!(one.triangles.iter().find(inside).is_none());
}

#[test]
fn degenerate_polygons_are_left_out_with_a_warning() {
    let line = "grey polygon line 0 0 9 0 0 0 1 1 1 2 2 2\ngrey polygon dot 0 0 12 1 1 1 1 1 1 2 2 2 2 2 2\n";
    let scene = read(&format!("{GREY}{line}grey sphere s 0 0 4 0 0 0 1\n"));
    assert_eq!(scene.warnings.len(), 2);
    assert!(scene.warnings[0].contains("main.rad:5: polygon line: is left out"), "{:?}", scene.warnings);
    let crossed = error(&surface("polygon", "0 0 0 4 0 0 0 3 0 4 4 0 2 -1 0"));
    assert!(crossed.contains("main.rad:5: polygon it: crosses itself"), "{crossed}");
}

#[test]
fn curved_surfaces_have_the_exact_area_and_face_the_right_way() {
    let slant = (9.0f64 + 1.0).sqrt();
    for (kind, reals, exact, outward) in [
        ("sphere", "1 2 3 0.5", PI, 1.0),
        ("bubble", "1 2 3 0.5", PI, -1.0),
        ("cylinder", "1 2 3 1 2 6 0.5", 3.0 * PI, 1.0),
        ("tube", "1 2 3 1 2 6 0.5", 3.0 * PI, -1.0),
        ("cone", "1 2 3 1 2 6 1.5 0.5", 2.0 * PI * slant, 1.0),
        ("cup", "1 2 3 1 2 6 1.5 0.5", 2.0 * PI * slant, -1.0),
        ("cone", "1 2 3 1 2 6 1 0", PI * slant, 1.0),
        ("cup", "1 2 3 1 2 6 0 1", PI * slant, -1.0),
    ] {
        let scene = grey(kind, reals);
        close(area(&scene), exact);
        for t in &scene.triangles {
            let middle = (t.positions[0] + t.positions[1] + t.positions[2]).as_dvec3() / 3.0;
            let mut away = middle - DVec3::new(1.0, 2.0, 3.0);
            if !matches!(kind, "sphere" | "bubble") {
                away.z = 0.0;
            }
            assert!(cross(t).dot(away) * outward > 0.0, "{kind} {reals}");
            for n in t.normals.unwrap() {
                assert!((n.length() - 1.0).abs() < 1e-6);
                assert!(n.as_dvec3().dot(cross(t).normalize()) > 0.99, "{kind} {reals}");
            }
        }
    }
}

#[test]
fn rings_are_flat_and_face_their_normal() {
    for (reals, exact) in [("0 0 1 0 0 2 0 1", PI), ("0 0 1 0 0 -1 2 1", 3.0 * PI)] {
        let scene = grey("ring", reals);
        close(area(&scene), exact);
        let up = if reals.contains("-1") { -1.0 } else { 1.0 };
        assert!(scene.triangles.iter().all(|t| cross(t).z * up > 0.0 && t.normals.is_none()));
    }
}

#[test]
fn spheres_are_closed() {
    let scene = grey("sphere", "0.1 0.2 0.3 0.7");
    let key = |p: Vec3| p.to_array().map(f32::to_bits);
    let mut edges = std::collections::HashSet::new();
    for t in &scene.triangles {
        for i in 0..3 {
            assert!(edges.insert((key(t.positions[i]), key(t.positions[(i + 1) % 3]))));
        }
    }
    assert!(edges.iter().all(|&(a, b)| edges.contains(&(b, a))));
}

#[test]
fn sources_light_exactly() {
    let scene = |angle: &str| {
        let text = format!("void light l 0 0 3 3 2 1\nvoid glow g 0 0 4 3 2 1 0\nl source s 0 0 4 0 0 2 {angle}\n");
        read(&format!("{text}g source s 0 0 4 0 2 0 {angle}\n"))
    };
    for (angle, cosine) in [("360", -1.0), ("180", 0.0), ("120", 0.5)] {
        let d = &scene(angle).distant;
        assert!((d[0].cos_half_angle - cosine).abs() < 1e-7, "{angle}");
        assert_eq!((d[0].strength, d[0].to_light), (Vec3::new(3.0, 2.0, 1.0), Vec3::Z));
        assert_eq!(d[1].to_light, Vec3::Y);
    }
    assert_eq!(scene("180").distant[0].cos_half_angle, 0.0);
    let beam = scene("0.1").distant[0];
    assert!(beam.is_beam());
    close(f64::from(beam.strength.x), 3.0 * 2.392_459_47e-6);
    let sun = scene("0.533").distant[0];
    assert!(!sun.is_beam());
    let exact = 2.0 * PI * (1.0 - 0.2665f64.to_radians().cos());
    close(f64::from(sun.strength.x) * 2.0 * PI * (1.0 - f64::from(sun.cos_half_angle)), 3.0 * exact);
}

/// What xform makes of the triangle (1 0 0) (0 2 0) (0 0 3).
fn transformed(args: &str) -> Vec<Vec3> {
    let part = "grey polygon p 0 0 9 1 0 0 0 2 0 0 0 3\n";
    let main = format!("{GREY}!xform {args} part.rad\n");
    corners(&load_files(&[("main.rad", &main), ("part.rad", part)]).unwrap())
}

fn expect(args: &str, points: &[[f32; 3]]) {
    let found = transformed(args);
    let same =
        found.len() == points.len() && found.iter().zip(points).all(|(f, p)| f.abs_diff_eq(Vec3::from_array(*p), 1e-6));
    assert!(same, "{args}: {found:?}");
}

#[test]
fn xform_arguments_apply_from_left_to_right() {
    expect("", &[[1., 0., 0.], [0., 2., 0.], [0., 0., 3.]]);
    expect("-t 1 2 3", &[[2., 2., 3.], [1., 4., 3.], [1., 2., 6.]]);
    expect("-rx 90", &[[1., 0., 0.], [0., 0., 2.], [0., -3., 0.]]);
    expect("-ry 90", &[[0., 0., -1.], [0., 2., 0.], [3., 0., 0.]]);
    expect("-rz 90", &[[0., 1., 0.], [-2., 0., 0.], [0., 0., 3.]]);
    expect("-s 2", &[[2., 0., 0.], [0., 4., 0.], [0., 0., 6.]]);
    expect("-t 1 0 0 -rz 90", &[[0., 2., 0.], [-2., 1., 0.], [0., 1., 3.]]);
    expect("-rz 90 -t 1 0 0", &[[1., 1., 0.], [-1., 0., 0.], [1., 0., 3.]]);
    // Mirrors turn the outline round so that the front stays in front.
    expect("-mx", &[[0., 0., 3.], [0., 2., 0.], [-1., 0., 0.]]);
    expect("-mx -my", &[[-1., 0., 0.], [0., -2., 0.], [0., 0., 3.]]);
    expect("-s -1", &[[0., 0., -3.], [0., -2., 0.], [-1., 0., 0.]]);
    expect("-i 3 -t 1 0 0 -i 1 -s 2", &[[8., 0., 0.], [6., 4., 0.], [6., 0., 6.]]);
    expect("-e -c -n name -i 0 -t 9 9 9", &[[1., 0., 0.], [0., 2., 0.], [0., 0., 3.]]);
    let flipped = transformed("-I");
    assert!((flipped[1] - flipped[0]).cross(flipped[2] - flipped[0]).x < 0.0);
}

#[test]
fn arrays_nest() {
    let firsts: Vec<Vec3> = transformed("-a 2 -t 10 0 0 -a 3 -t 0 1 0").into_iter().step_by(3).collect();
    let expected = [(1, 0), (1, 1), (1, 2), (11, 0), (11, 1), (11, 2)];
    assert_eq!(firsts, expected.map(|(x, y)| Vec3::new(x as f32, y as f32, 0.0)));
    let list = "# two lines\n-t 1 0 0\n!xform -s 2\n";
    let part = "grey polygon p 0 0 9 1 0 0 0 2 0 0 0 3\n";
    let main = format!("{GREY}!xform -f list -t 0 0 1 \\\n part.rad\n");
    let scene = load_files(&[("main.rad", &main), ("list", list), ("part.rad", part)]).unwrap();
    assert_eq!(scene.triangles[0].positions[0], Vec3::new(2.0, 0.0, 1.0));
    assert_eq!(scene.triangles[1].positions[0], Vec3::new(2.0, 0.0, 1.0));
}

#[test]
fn includes_nest_and_carry_options() {
    let scene = load_files(&[
        ("main.rad", "void plastic red 0 0 5 1 0 0 0 0\n!xform -m red -t 1 0 0 sub/a.rad\n"),
        ("sub/a.rad", "void plastic blue 0 0 5 0 0 1 0 0\n!xform -s 2 -I 'b b.rad'\n"),
        ("sub/b b.rad", "blue sphere s 0 0 4 1 0 0 1\n"),
    ])
    .unwrap();
    close(area(&scene), 16.0 * PI);
    assert_eq!((scene.materials.len(), scene.materials[0].color), (1, Vec3::X));
    let centre = DVec3::new(3.0, 0.0, 0.0);
    assert!(scene.triangles.iter().all(|t| cross(t).dot(t.positions[0].as_dvec3() - centre) < 0.0));
}

#[test]
fn errors_name_file_line_and_object() {
    for (text, wanted) in [
        ("", "main.rad: nothing to render"),
        ("void plastic p 0 0 5 1 1", "main.rad:1: the file ends where argument 3 of 5 of plastic p"),
        ("\n\nvoid glass g 0 0 3 1 1 1\n", "main.rad:3: glass g: this material is not supported"),
        ("void brightfunc b 2 a b 0 0\n", "main.rad:1: brightfunc b: patterns are not supported"),
        ("void instance i 1 a.oct 0 0\n", "main.rad:1: instance i: compiled geometry"),
        ("void wobble w 0 0 0\n", "main.rad:1: wobble w: unknown type"),
        ("void sphere s 0 0 4 0 0 0 1\n", "main.rad:1: sphere s: has no material (void)"),
        ("\nred sphere s 0 0 4 0 0 0 1\n", "main.rad:2: sphere s: modifier `red` is not defined"),
        ("void plastic p 0 0 5 -1 0 0 0 0\n", "colour is -1 0 0"),
        ("void plastic p 0 0 5 1 0 0 1.5 0\n", "specularity is 1.5; expected 0 to 1"),
        ("void metal p 0 0 5 1 0 0 0 -1\n", "roughness is -1"),
        ("void plastic p 0 0 4 1 0 0 0\n", "has 0 strings and 4 numbers; expected 0 and 5"),
        ("void plastic p 0 0 5 1 0\n nan 0 0\n", "main.rad:2: argument 3 of 5 of plastic p is `nan`"),
        ("void plastic p 0 0 5 1 0 1e999 0 0\n", "is `1e999`; expected a finite number"),
        ("void plastic p 0 0 1000000000 1 0\n", "the file ends"),
        ("void plastic p 99999999999999999999 1 0\n", "is not the number of strings"),
        ("void plastic p -1 0 0\n", "`-1` is not the number of strings"),
        ("void alias a b\n", "main.rad:1: alias a: modifier `b` is not defined"),
        ("\n!genbox a b 1 1 1\n", "main.rad:2: command `genbox a b 1 1 1`: only xform is supported"),
        ("!xform a.rad | xform -t 1 1 1\n", "needs a shell"),
        ("!xform -q a.rad\n", "xform option `-q` is not supported"),
        ("!xform -t 1 x 1 a.rad\n", "xform argument `x`: expected a finite number"),
        ("!xform -t 1\n", "-t"),
        ("!xform -t 1 1 1\n", "no file to read"),
        ("!xform -a 1000000000 main.rad\n", "too many copies"),
        ("!xform nowhere.rad\n", "main.rad:1: command `xform nowhere.rad`: file `nowhere.rad` is not found"),
        ("!xform no\u{5}where.rad\n", "file `no\u{fffd}where.rad` is not found"),
        ("!xform main.rad\n", "includes itself"),
    ] {
        let message = error(text);
        assert!(message.starts_with("main.rad") && message.contains(wanted), "{text:?} gives {message:?}");
        assert!(!message.contains(char::is_control), "{text:?} gives {message:?}");
    }
    for (kind, reals, wanted) in [
        ("sphere", "0 0 0 -1", "main.rad:5: sphere it: radius is -1"),
        ("sphere", "0 0 0 0", "radius is 0"),
        ("sphere", "0 0 0", "has 0 strings and 3 numbers"),
        ("ring", "0 0 0 0 0 0 0 1", "normal is zero"),
        ("cylinder", "0 0 0 0 0 0 1", "same point"),
        ("polygon", "0 0 0 1 0 0 0 1", "8 numbers"),
        ("polygon", "0 0 0 1e30 0 0 0 1 0", "expected coordinates within"),
        ("source", "0 0 1 5", "has a material that reflects"),
        ("source", "0 0 1 0", "angle is 0 degrees"),
    ] {
        let message = error(&surface(kind, reals));
        assert!(message.contains(wanted), "{kind} {reals} gives {message:?}");
    }
    assert!(load(Path::new("/nowhere/at all.rad")).unwrap_err().to_string().contains("cannot be read"));
}

#[test]
fn a_deep_chain_of_files_is_refused() {
    let names: Vec<String> = (0..40).map(|i| if i == 0 { "main.rad".into() } else { format!("{i}.rad") }).collect();
    let texts: Vec<String> = (1..=40).map(|i| format!("!xform {i}.rad\n")).collect();
    let files: Vec<(&str, &str)> = names.iter().zip(&texts).map(|(n, t)| (n.as_str(), t.as_str())).collect();
    assert!(load_files(&files).unwrap_err().contains("nested deeper than 32"));
}

/// A scene with a bit of everything.
const EVERYTHING: &str = "void plastic p 0 0 5 .5 .5 .5 0 0\nvoid light l 0 0 3 1 1 1\nvoid metal m 0 0 5 .5 .5 .5 1 .1\n\
    void mixfunc x 4 l p .5 . 0 0\ninherit alias a p\n!xform -n n -a 3 -t 1 0 0 -rz 30 -s 2 part.rad\n\
    p polygon q 0 0 30 0 0 0 8 0 0 8 4 0 0 4 0 0 0 0 1 1 0 1 3 0 2 3 0 2 1 0 1 1 0\nx sphere s 0 0 4 1 2 3 1\n\
    a ring r 0 0 8 0 0 0 0 0 1 1 2\nm cone c 0 0 8 0 0 0 0 0 1 1 0\nl source u 0 0 4 0 0 1 .5\n";

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    #[test]
    fn no_bytes_make_it_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
        let room = TempDir::new().unwrap();
        let path = room.path().join("main.rad");
        std::fs::write(&path, bytes).unwrap();
        let _ = load(&path);
    }

    #[test]
    fn no_damage_makes_it_panic(
        edits in proptest::collection::vec((any::<prop::sample::Index>(), "[-0-9.e a!#\"\n]{0,4}", 0usize..5), 1..6)
    ) {
        let mut bytes = EVERYTHING.as_bytes().to_vec();
        for (at, text, skip) in edits {
            let at = at.index(bytes.len() + 1);
            let end = (at + skip).min(bytes.len());
            bytes.splice(at..end, text.into_bytes());
        }
        let room = TempDir::new().unwrap();
        let path = room.path().join("main.rad");
        std::fs::write(&path, bytes).unwrap();
        std::fs::write(room.path().join("part.rad"), "p cylinder c 0 0 7 0 0 0 0 0 1 1\n").unwrap();
        let _ = load(&path);
    }

    #[test]
    fn outlines_on_a_grid_have_their_area_or_are_refused(
        points in proptest::collection::vec((0i8..4, 0i8..4), 3..14)
    ) {
        let points: Vec<DVec3> = points.iter().map(|&(x, y)| DVec3::new(x.into(), y.into(), 0.0)).collect();
        let doubled: DVec3 = points.iter().zip(points.iter().cycle().skip(1)).map(|(a, b)| a.cross(*b)).sum();
        if let Ok(triangles) = super::polygon::triangulate(&points) {
            let found: f64 = triangles.corners.iter().map(|c| {
                let [a, b, c] = c.map(|i| points[i]);
                (b - a).cross(c - a).z * doubled.z.signum()
            }).sum();
            prop_assert!((found - doubled.z.abs()).abs() < 1e-5);
        }
    }
}
