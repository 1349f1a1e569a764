//! Rays a second against Embree: the same triangles and rays, one thread, in one run.
//!
//! Embree is a small C program beside this crate, built when there is a compiler and Embree 3 (Debian: libembree-dev).
//! All take turns for several rounds, and what counts is the median of the ratios and rates by CPU time of the thread, so
//! that what else the machine does falls on all of them.

use std::error::Error;
use std::io::{BufRead as _, BufReader, Write as _};
use std::path::Path;
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::time::Duration;

use glam::Vec2;
use nix::time::{ClockId, clock_gettime};
use obvhs::BvhBuildParams;
use obvhs::bvh2::Bvh2;
use obvhs::bvh2::builder::build_bvh2_from_tris;
use obvhs::ray::RayHit;
use obvhs::rt_triangle::RtTriangle;
use worker::bvh::Bvh;
use worker::scene::Triangle;

use crate::model::Corners;
use crate::report::{Report, bars, quantile};
use crate::soups::{self, Ray};

/// Arguments of the benchmark.
#[derive(Clone, Debug, clap::Args)]
pub struct RaysArgs {
    /// Rounds; the median counts
    #[arg(long, default_value_t = 9)]
    rounds: usize,
    /// Rays of a round
    #[arg(long, default_value_t = 500_000)]
    rays: usize,
    /// Keep table and chart in bench/results
    #[arg(long)]
    save: bool,
}

/// What a round of rays gave.
#[derive(Clone, Copy, Default)]
struct Round {
    /// CPU seconds of the thread.
    seconds: f64,
    hits: u64,
    /// Sum of distances.
    sum: f64,
}

/// One that traces rays.
enum Tracer {
    Ours(Bvh),
    Obvhs(Bvh2, Vec<RtTriangle>),
    Embree(Embree),
}

/// Measures and prints everything.
///
/// # Errors
/// When Embree is there but does not run.
pub fn run(args: &RaysArgs) -> Result<(), Box<dyn Error>> {
    let mut report = Report::begin("cargo run --release -p ambience-bench -- rays");
    report.line(&format!("{} rays, {} rounds, Mray/s by CPU time of the thread", args.rays, args.rounds));
    let folder = tempfile::tempdir()?;
    let program = folder.path().join("rays");
    let built = Command::new("cc")
        .args(["-O3", "-o"])
        .arg(&program)
        .arg(Path::new(env!("CARGO_MANIFEST_DIR")).join("embree/rays.c"))
        .args(["-lembree3", "-lm"])
        .stderr(Stdio::null())
        .status()
        .is_ok_and(|status| status.success());
    if !built {
        report.line("Embree 3 is not here (Debian: apt-get install gcc libembree-dev): no ratios to it");
    }
    let mut chart = Vec::new();
    for detail in [1.0, 3.5] {
        scene(&mut report, &mut chart, args, detail, built.then_some(&program), folder.path())?;
    }
    if args.save {
        report.save("rays")?;
        bars("rays", "rays a second / those of Embree, one thread", &chart, 1.0)?;
    }
    Ok(())
}

fn scene(
    report: &mut Report,
    chart: &mut Vec<(String, f64)>,
    args: &RaysArgs,
    detail: f32,
    embree: Option<&std::path::PathBuf>,
    folder: &Path,
) -> Result<(), Box<dyn Error>> {
    let soup = soups::room(detail);
    let rays = soups::rays(&soup, args.rays);
    report.line("");
    report.line(&format!("{} triangles", soup.len()));
    report.line(&format!(
        "{:22} {:>8} {:>10} {:>9} {:>9} {:>9} {:>9}",
        "", "build s", "bytes/tri", "closest", "/ Embree", "any", "/ Embree"
    ));
    let mut tracers = Vec::new();
    if let Some(program) = embree {
        let file = folder.join("scene");
        write(&file, &soup, &rays)?;
        let (version, build, bytes, embree) = Embree::start(program, &file)?;
        tracers.push((format!("Embree {version}"), build, bytes, Tracer::Embree(embree)));
    }
    let triangle = |&positions: &Corners| Triangle { positions, normals: None, uvs: [Vec2::ZERO; 3], material: 0 };
    let triangles: Vec<_> = soup.iter().map(triangle).collect();
    let start = cpu();
    let ours = Bvh::new(&triangles);
    let (build, bytes) = (cpu() - start, ours.bytes());
    tracers.push(("ours".into(), build, bytes, Tracer::Ours(ours)));
    let portable = Bvh::new(&triangles).portable();
    tracers.push(("ours, portable".into(), build, bytes, Tracer::Ours(portable)));
    let plain: Vec<_> = soup
        .iter()
        .map(|t| {
            let [v0, v1, v2] = t.map(Into::into);
            obvhs::triangle::Triangle { v0, v1, v2 }
        })
        .collect();
    let start = cpu();
    let tree = build_bvh2_from_tris(&plain, BvhBuildParams::medium_build(), &mut Duration::default());
    let corners: Vec<RtTriangle> = tree.primitive_indices.iter().map(|&i| (&plain[i as usize]).into()).collect();
    let (build, bytes) = (cpu() - start, size_of_val(&tree.nodes[..]) + size_of_val(&corners[..]));
    tracers.push(("obvhs BVH2".into(), build, bytes, Tracer::Obvhs(tree, corners)));

    let mut rounds = vec![[const { Vec::new() }; 2]; tracers.len()];
    for _ in 0..args.rounds {
        for ((_, _, _, tracer), rounds) in tracers.iter_mut().zip(&mut rounds) {
            for (any, rounds) in [false, true].into_iter().zip(rounds) {
                rounds.push(tracer.trace(&rays, any)?);
            }
        }
    }
    let median = |values: &dyn Fn(usize) -> f64| quantile(&mut (0..args.rounds).map(values).collect::<Vec<_>>(), 0.5);
    for (at, (name, build, bytes, _)) in tracers.iter().enumerate() {
        let rate = |any: usize| median(&|r| args.rays as f64 * 1e-6 / rounds[at][any][r].seconds);
        let ratio = |any: usize| median(&|r| rounds[0][any][r].seconds / rounds[at][any][r].seconds);
        let shown = |ratio: f64| if embree.is_some() { format!("{ratio:.2}") } else { "-".into() };
        report.line(&format!(
            "{name:22} {build:8.3} {:10.1} {:9.2} {:>9} {:9.2} {:>9}",
            *bytes as f64 / soup.len() as f64,
            rate(0),
            shown(ratio(0)),
            rate(1),
            shown(ratio(1)),
        ));
        if embree.is_some() && at > 0 {
            chart.push((format!("{name}, {}k triangles, closest", soup.len() / 1000), ratio(0)));
            chart.push((format!("{name}, {}k triangles, any", soup.len() / 1000), ratio(1)));
        }
    }
    for any in 0..2 {
        let [first, others @ ..] = &rounds[..] else { continue };
        let far = others
            .iter()
            .map(|r| &r[any][0])
            .filter(|r| r.hits != first[any][0].hits || (r.sum - first[any][0].sum).abs() > 1e-6 * first[any][0].sum);
        report.line(&format!(
            "{}: {} of {} rays hit; {} of the others disagree",
            ["closest", "any"][any],
            first[any][0].hits,
            args.rays,
            far.count()
        ));
    }
    if let Some(Tracer::Ours(bvh)) = tracers.iter().map(|t| &t.3).find(|t| matches!(t, Tracer::Ours(_))) {
        threads(report, bvh, &rays, args.rounds);
    }
    Ok(())
}

/// What two threads trace at once, against what one does: memory and caches are shared, processors are not.
fn threads(report: &mut Report, bvh: &Bvh, rays: &[Ray], rounds: usize) {
    let rate = |rays: &[Ray]| rays.len() as f64 / ours(bvh, rays, false).seconds;
    let mut scaling = Vec::new();
    for _ in 0..rounds {
        let one = rate(rays);
        let (left, right) = rays.split_at(rays.len() / 2);
        let two = std::thread::scope(|scope| {
            let other = scope.spawn(|| rate(left));
            rate(right) + other.join().unwrap_or(0.0)
        });
        scaling.push(two / one);
    }
    let scaling = quantile(&mut scaling, 0.5);
    report.line(&format!("ours, closest, 2 threads: {scaling:.2} x one thread, by CPU time of each"));
}

fn ours(bvh: &Bvh, rays: &[Ray], any: bool) -> Round {
    let start = cpu();
    let mut round = Round::default();
    for ray in rays {
        if any {
            round.hits += u64::from(bvh.occluded(ray.origin, ray.direction, ray.t_max));
        } else if let Some(hit) = bvh.closest(ray.origin, ray.direction, f32::INFINITY) {
            round.hits += 1;
            round.sum += f64::from(hit.t);
        }
    }
    Round { seconds: cpu() - start, ..round }
}

impl Tracer {
    fn trace(&mut self, rays: &[Ray], any: bool) -> Result<Round, Box<dyn Error>> {
        Ok(match self {
            Self::Ours(bvh) => ours(bvh, rays, any),
            Self::Obvhs(tree, corners) => {
                let start = cpu();
                let mut round = Round::default();
                for ray in rays {
                    let end = if any { ray.t_max } else { f32::INFINITY };
                    let ray = obvhs::ray::Ray::new(ray.origin.into(), ray.direction.into(), 0.0, end);
                    let mut hit = RayHit::none();
                    if any {
                        round.hits += u64::from(!tree.ray_traverse_miss(ray, |ray, i| corners[i].intersect(ray)));
                    } else if tree.ray_traverse(ray, &mut hit, |ray, i| corners[i].intersect(ray)) {
                        round.hits += 1;
                        round.sum += f64::from(hit.t);
                    }
                }
                Round { seconds: cpu() - start, ..round }
            }
            Self::Embree(embree) => embree.trace(any)?,
        })
    }
}

/// CPU seconds of this thread.
fn cpu() -> f64 {
    clock_gettime(ClockId::CLOCK_THREAD_CPUTIME_ID).map_or(f64::NAN, |time| Duration::from(time).as_secs_f64())
}

/// The file the C program reads.
fn write(path: &Path, soup: &[Corners], rays: &[Ray]) -> std::io::Result<()> {
    let lengths = [soup.len() as u32, rays.len() as u32].map(u32::to_le_bytes);
    let corners = soup.iter().flatten().flat_map(|c| c.to_array());
    let rays =
        rays.iter().flat_map(|r| [r.origin.to_array(), r.direction.to_array()].concat().into_iter().chain([r.t_max]));
    let floats = corners.chain(rays).flat_map(f32::to_le_bytes);
    std::fs::write(path, lengths.into_iter().flatten().chain(floats).collect::<Vec<_>>())
}

/// The C program, running. It ends when its input does.
struct Embree {
    child: Child,
    ask: Option<ChildStdin>,
    answers: BufReader<ChildStdout>,
}

impl Embree {
    /// Its version, CPU seconds and bytes of its tree.
    fn start(program: &Path, scene: &Path) -> Result<(String, f64, usize, Self), Box<dyn Error>> {
        let mut child = Command::new(program).arg(scene).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        let answers = BufReader::new(child.stdout.take().ok_or("no output")?);
        let mut embree = Self { ask: child.stdin.take(), child, answers };
        let line = embree.line()?;
        let [version, build, bytes] = line.split_whitespace().collect::<Vec<_>>()[..] else {
            return Err(format!("Embree says {line:?}").into());
        };
        Ok((version.into(), build.parse()?, bytes.parse()?, embree))
    }

    fn line(&mut self) -> std::io::Result<String> {
        let mut line = String::new();
        self.answers.read_line(&mut line)?;
        Ok(line)
    }

    fn trace(&mut self, any: bool) -> Result<Round, Box<dyn Error>> {
        let ask = self.ask.as_mut().ok_or("no input")?;
        writeln!(ask, "{}", if any { "any" } else { "closest" })?;
        let line = self.line()?;
        let [seconds, hits, sum] = line.split_whitespace().collect::<Vec<_>>()[..] else {
            return Err(format!("Embree says {line:?}").into());
        };
        Ok(Round { seconds: seconds.parse()?, hits: hits.parse()?, sum: sum.parse()? })
    }
}

impl Drop for Embree {
    fn drop(&mut self) {
        drop(self.ask.take());
        // It ends by itself; nothing is lost if not.
        let _ = self.child.wait();
    }
}
