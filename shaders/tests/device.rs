//! What a device makes of records, against the octree and the twins in Rust.
//!
//! Without an adapter each test counts as ignored, and says so.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use cache_core::Query;
use cache_core::id::Random;
use cache_proto::v1;
use glam::Vec3;
use libtest_mimic::{Arguments, Failed, Trial};
use shaders::device::Gpu;
use shaders::layout::{Answer, IRRADIANCE, Point, Site, Splats, View};
use shaders::node::Node;
use shaders::splatter::Splatter;
use shaders::twin;
use worker::frame::{Counts, Frame};
use worker::job::Work;
use worker::levels::{Level, Reflected};
use worker::lobes::Served;
use worker::settings::{Method, Settings};
use worker::solo::{self, Order};
use worker::splat::{Look, Splat};

type Test = (&'static str, fn(&Arc<Gpu>));

const TESTS: [Test; 8] = [
    ("pictures_are_those_of_the_octree", pictures_are_those_of_the_octree),
    ("shaders_do_what_their_twins_do", shaders_do_what_their_twins_do),
    ("order_changes_nothing_but_roundings", order_changes_nothing_but_roundings),
    ("small_buffers_change_nothing", small_buffers_change_nothing),
    ("finished_pixels_are_those_of_the_octree", finished_pixels_are_those_of_the_octree),
    ("a_normal_with_minus_zero_turns_as_on_the_processor", a_normal_with_minus_zero_turns_as_on_the_processor),
    ("more_than_a_million_records_are_split", more_than_a_million_records_are_split),
    ("a_lost_device_leaves_the_pixels_to_the_octree", a_lost_device_leaves_the_pixels_to_the_octree),
];

fn main() {
    let arguments = Arguments::from_args();
    let trials = [true, false].into_iter().flat_map(|blend| {
        let gpu = Gpu::new(blend).map(Arc::new);
        TESTS.map(|(name, test)| {
            let name = format!("{name}_{}", if blend { "blending" } else { "computing" });
            match &gpu {
                Ok(gpu) if gpu.blends == blend => {
                    let gpu = gpu.clone();
                    Trial::test(name, move || {
                        let run = std::panic::AssertUnwindSafe(|| test(&gpu));
                        std::panic::catch_unwind(run).map_err(|panic| {
                            let said = panic.downcast_ref::<String>().cloned();
                            Failed::from(said.unwrap_or_else(|| "it panicked".into()))
                        })
                    })
                }
                Ok(gpu) => skipped(name, &format!("{} cannot add floats to a picture", gpu.name)),
                Err(lost) => skipped(name, &lost.to_string()),
            }
        })
    });
    libtest_mimic::run(&arguments, trials.collect()).exit();
}

fn skipped(name: String, why: &str) -> Trial {
    eprintln!("shaders/tests/device: {name} is skipped: {why}");
    Trial::test(name, || Ok(())).with_ignored_flag(true)
}

/// A small frame of a scene.
fn frame(scene: &str, method: Method, size: u32) -> Frame {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/scenes").join(scene);
    let scene = worker::scene::load(&path).expect("a scene");
    let camera = scene.cameras.first().cloned();
    let camera = camera.unwrap_or_else(|| worker::scene::load_view(&path.with_extension("vf")).expect("a view"));
    let settings = Settings { rays: 64, spp: 2, bounces: 1, method, ..Settings::new(camera, size, size) };
    Frame::new(scene, settings)
}

/// Every scene there is, and glossy ones by records of radiance.
const SCENES: [(&str, Method); 8] = [
    ("cornell.glb", Method::Auto),
    ("stairs.rad", Method::Auto),
    ("leak.rad", Method::Auto),
    ("sphere-plane.rad", Method::Auto),
    ("white-furnace.glb", Method::Auto),
    ("glossy-floor.glb", Method::Radiance),
    ("glossy-floor.rad", Method::Radiance),
    ("glossy-floor.rad", Method::Auto),
];

/// Where the pixels of a frame ask.
fn looks(frame: &Frame) -> Vec<(Look<'_>, Query)> {
    let (settings, mut counts) = (frame.settings(), Counts::default());
    let pixels = (0..settings.height).flat_map(|y| (0..settings.width).map(move |x| [x, y]));
    pixels
        .filter_map(|[x, y]| {
            // Anywhere within the pixel.
            let mut random = Random::named("look", &[x.into(), y.into()]);
            let ray = settings.ray(x as f32 + random.uniform(), y as f32 + random.uniform());
            let (query, served) = frame.look(ray, &mut counts)?;
            Some((Look { pixel: [x, y], query, served }, query))
        })
        .collect()
}

fn filled(frame: &Frame) -> Level {
    solo::fill(frame, Order::Rounds).remove(0)
}

fn answers(splatter: &mut Splatter, looks: &[(Look, Query)]) -> Vec<Option<Reflected>> {
    splatter.answers(&mut looks.iter().map(|(look, _)| look)).expect("a device")
}

/// Relative difference of two answers; 1 where only one has records.
fn difference(a: &Option<Reflected>, b: &Option<Reflected>) -> f32 {
    match (a, b) {
        (Some(a), Some(b)) => {
            let scale = a.radiance.max(b.radiance).max_element().max(1e-6);
            let noise = (a.noise - b.noise).abs() / a.noise.max(b.noise).max(1e-6);
            ((a.radiance - b.radiance).abs().max_element() / scale).max(noise)
        }
        (None, None) => 0.0,
        _ => 1.0,
    }
}

/// Holds that all but one in a thousand differ by no more than one in ten thousand.
fn same(what: &str, pairs: impl Iterator<Item = f32>) {
    let mut all: Vec<f32> = pairs.collect();
    all.sort_unstable_by(f32::total_cmp);
    assert!(!all.is_empty(), "{what}: nothing to compare");
    let off = all.iter().filter(|d| **d > 1e-4).count();
    let at = |share: f64| all[((all.len() - 1) as f64 * share) as usize];
    println!(
        "{what}: {} answers, {off} off; median {:.1e}, 99.9 % {:.1e}, most {:.1e}",
        all.len(),
        at(0.5),
        at(0.999),
        at(1.0)
    );
    assert!(off * 1000 <= all.len(), "{what}: {off} of {} differ by more than 1e-4", all.len());
}

fn pictures_are_those_of_the_octree(gpu: &Arc<Gpu>) {
    for (scene, method) in SCENES {
        let frame = frame(scene, method, 160);
        let (level, looks) = (filled(&frame), looks(&frame));
        let mut splatter = Splatter::new(gpu.clone(), frame.settings());
        splatter.load(&level);
        let told = answers(&mut splatter, &looks);
        let asked = looks.iter().map(|(look, query)| level.ask(query, &look.served));
        let what = format!("{scene} {} records {} of radiance", level.len(), level.len() - level.irradiance.len());
        same(&what, told.iter().zip(asked).map(|(a, b)| difference(a, &b)));
    }
}

/// Points and lobes of a whole picture.
fn points(frame: &Frame) -> (Vec<Point>, BTreeMap<u32, Vec<f32>>) {
    let settings = frame.settings();
    let mut points = vec![bytemuck::Zeroable::zeroed(); settings.size() as usize];
    let mut lobes = BTreeMap::<u32, Vec<f32>>::new();
    for (look, query) in looks(frame) {
        let at = (look.pixel[1] * settings.width + look.pixel[0]) as usize;
        points[at] = match &look.served {
            Served::Diffuse(_) => Point::new(&query, IRRADIANCE, 0),
            Served::Gloss(order, reflection) => {
                let own = lobes.entry(*order as u32).or_default();
                let number = own.len() / (3 * order * order);
                cache_core::of_order!(*order, N => own.extend(reflection.coefficients::<N>().as_flattened()));
                Point::new(&query, *order as u32, number as u32)
            }
        };
    }
    (points, lobes)
}

fn close(a: &Answer, b: &Answer) -> f32 {
    let floats = |a: &Answer| [a.irradiance, a.radiance].concat();
    let scale = floats(a).iter().chain(&floats(b)).fold(1e-6, |most: f32, v| most.max(v.abs()));
    let values = floats(a).iter().zip(floats(b)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max) / scale;
    if (a.records == 0.0) == (b.records == 0.0) { values } else { 1.0 }
}

fn shaders_do_what_their_twins_do(gpu: &Arc<Gpu>) {
    for (scene, method) in [("stairs.rad", Method::Auto), ("glossy-floor.glb", Method::Radiance)] {
        let frame = frame(scene, method, 96);
        let (level, (points, lobes)) = (filled(&frame), points(&frame));
        let region = [0, frame.settings().width, 0, frame.settings().height];
        let mut splatter = Splatter::new(gpu.clone(), frame.settings());
        splatter.load(&level);
        let drawn = splatter.draw(region, &points, &lobes).expect("a device");
        let mut expected = vec![Answer::default(); points.len()];
        for splats in Splats::of(&level) {
            let lobes = lobes.get(&splats.kind).map_or(&[][..], Vec::as_slice);
            twin::splat(&View::new(frame.settings(), region), &splats, &points, lobes, &mut expected);
        }
        same(&format!("{scene}, twin"), drawn.iter().zip(&expected).map(|(a, b)| close(a, b)));
    }
}

fn order_changes_nothing_but_roundings(gpu: &Arc<Gpu>) {
    let frame = frame("stairs.rad", Method::Auto, 96);
    let (level, (points, lobes)) = (filled(&frame), points(&frame));
    let region = [0, frame.settings().width, 0, frame.settings().height];
    let mut splatter = Splatter::new(gpu.clone(), frame.settings());
    let mut draw = |splats| {
        splatter.take(splats);
        splatter.draw(region, &points, &lobes).expect("a device")
    };
    let by_id = draw(Splats::of(&level));
    // To the bit, as often as one likes.
    assert!(by_id == draw(Splats::of(&level)));
    let mut shuffled = Splats::of(&level);
    for splats in &mut shuffled {
        let (stride, mut random) = (splats.stride(), Random::named("shuffle", &[]));
        for i in (1..splats.sites.len()).rev() {
            let j = (random.uniform() * (i + 1) as f32) as usize;
            splats.sites.swap(i, j);
            (0..stride).for_each(|k| splats.values.swap(i * stride + k, j * stride + k));
        }
    }
    let others = draw(shuffled);
    assert!(by_id != others, "another order rounds otherwise somewhere");
    let most = by_id.iter().zip(&others).map(|(a, b)| close(a, b)).fold(0.0, f32::max);
    assert!(most < 1e-5, "{most}");
}

fn small_buffers_change_nothing(gpu: &Arc<Gpu>) {
    for (scene, method) in [("stairs.rad", Method::Auto), ("glossy-floor.glb", Method::Radiance)] {
        let frame = frame(scene, method, 96);
        let (level, looks) = (filled(&frame), looks(&frame));
        let draw = |mut splatter: Splatter| {
            splatter.load(&level);
            answers(&mut splatter, &looks)
        };
        let whole = draw(Splatter::new(gpu.clone(), frame.settings()));
        // A few records and rows each.
        let parts = draw(Splatter::new(gpu.clone(), frame.settings()).with_buffers_of(40_000));
        let bits = |told: &[Option<Reflected>]| -> Vec<Option<[u32; 3]>> {
            told.iter().map(|t| t.map(|t| t.radiance.to_array().map(f32::to_bits))).collect()
        };
        assert!(bits(&whole) == bits(&parts), "{scene}");
        assert!(whole.iter().flatten().any(|t| t.radiance != Vec3::ZERO));
    }
}

/// A plane seen from straight above, 96 pixels for 1 m, and records on it.
struct Plane {
    settings: Settings,
    normal: Vec3,
    points: Vec<Point>,
}

impl Plane {
    const EDGE: u32 = 96;

    fn new(normal: Vec3) -> Self {
        let across = if normal.x.abs() > 0.5 { Vec3::Y } else { Vec3::X };
        let camera = worker::scene::Camera::look(normal, -normal, across, 1.0, 1.0, true).expect("a view");
        let settings = Settings::new(camera, Self::EDGE, Self::EDGE);
        let at = |x: u32, y: u32| {
            let (eye, direction) = settings.ray(x as f32 + 0.5, y as f32 + 0.5);
            Point::new(&Query::new(eye + direction, normal), IRRADIANCE, 0)
        };
        let points =
            (0..Self::EDGE).flat_map(|y| (0..Self::EDGE).map(move |x| (x, y))).map(|(x, y)| at(x, y)).collect();
        Self { settings, normal, points }
    }

    /// `count` records that reach `reach` metres; each its own value and gradient.
    fn records(&self, count: u32, reach: f32) -> Splats {
        let mut random = Random::named("records", &[]);
        let site = |random: &mut Random| {
            let (eye, direction) =
                self.settings.ray(random.uniform() * Self::EDGE as f32, random.uniform() * Self::EDGE as f32);
            let (position, normal) = ((eye + direction).to_array(), self.normal.to_array());
            Site { position, radius: 2.0 * reach, normal, a: 0.5, limit: 1.0, ..bytemuck::Zeroable::zeroed() }
        };
        let sites: Vec<_> = (0..count).map(|_| site(&mut random)).collect();
        let values = sites.iter().flat_map(|_| std::array::from_fn::<f32, 15, _>(|_| 1.0 + random.uniform()));
        Splats { kind: IRRADIANCE, values: values.collect(), sites }
    }

    /// Holds that the device draws records as the twin does.
    fn compare(&self, gpu: &Arc<Gpu>, splats: Splats, buffers: u64) {
        let region = [0, Self::EDGE, 0, Self::EDGE];
        let mut expected = vec![Answer::default(); self.points.len()];
        twin::splat(&View::new(&self.settings, region), &splats, &self.points, &[], &mut expected);
        let mut splatter = Splatter::new(gpu.clone(), &self.settings).with_buffers_of(buffers);
        splatter.take(vec![splats]);
        let drawn = splatter.draw(region, &self.points, &BTreeMap::new()).expect("a device");
        assert!(expected.iter().filter(|answer| answer.records > 1.0).count() > self.points.len() / 2);
        same("plane", drawn.iter().zip(&expected).map(|(a, b)| close(a, b)));
    }
}

fn a_normal_with_minus_zero_turns_as_on_the_processor(gpu: &Arc<Gpu>) {
    for zero in [0.0, -0.0] {
        let plane = Plane::new(Vec3::new(1.0, 0.0, zero));
        plane.compare(gpu, plane.records(300, 0.2), u64::MAX);
    }
}

fn more_than_a_million_records_are_split(gpu: &Arc<Gpu>) {
    let plane = Plane::new(Vec3::Z);
    plane.compare(gpu, plane.records((1 << 20) + 5000, 0.004), (1 << 20) * size_of::<Site>() as u64);
}

fn a_lost_device_leaves_the_pixels_to_the_octree(gpu: &Arc<Gpu>) {
    let new = || frame("cornell.glb", Method::Auto, 64);
    let levels = solo::fill(&new(), Order::Rounds);
    let whole = new();
    // A device of its own, since it is lost.
    let own = Arc::new(Gpu::new(gpu.blends).expect("a device"));
    let node = Node::new(new(), own.clone());
    let lease = |tiles| {
        let (levels, known, dropped) = (levels.clone(), Arc::new(|_| None) as _, Arc::new(|| false) as _);
        node.run(&Work { step: v1::Step::default(), tiles, levels, known, dropped }).expect("somebody waits")
    };
    let done = lease(0..8);
    assert!(done.counts.splatted > 0 && done.counts.splatted == done.counts.samples, "{:?}", done.counts);
    own.device.destroy();
    let done = [lease(8..12), lease(12..16)];
    assert_eq!(done.each_ref().map(|done| (done.counts.splatted, done.counts.devices_lost)), [(0, 1), (0, 0)]);
    for tile in done.iter().flat_map(|done| &done.tiles) {
        let asked: Vec<u8> = whole.pixels(tile.tile, &levels).0.iter().flat_map(|v| v.to_le_bytes()).collect();
        assert!(tile.pixels[..] == asked[..], "tile {}", tile.tile);
    }
}

fn finished_pixels_are_those_of_the_octree(gpu: &Arc<Gpu>) {
    for (scene, method) in [("cornell.glb", Method::Auto), ("glossy-floor.glb", Method::Radiance)] {
        let frame = frame(scene, method, 96);
        let levels = solo::fill(&frame, Order::Rounds);
        let mut splatter = Splatter::new(gpu.clone(), frame.settings());
        splatter.load(&levels[0]);
        let tiles = 0..frame.settings().tiles();
        let (splatted, _) = frame.splatted(tiles.clone(), &levels, &mut splatter).expect("a device");
        let asked = tiles.map(|tile| frame.pixels(tile, &levels).0);
        let beauty = |tile: &[f32]| tile.chunks(worker::frame::CHANNELS).map(Vec3::from_slice).collect::<Vec<_>>();
        let pairs = splatted.iter().zip(asked).flat_map(|(a, b)| beauty(a).into_iter().zip(beauty(&b)));
        let scale = |a: Vec3, b: Vec3| a.max(b).max_element().max(1e-6);
        same(&format!("{scene}, finished"), pairs.map(|(a, b)| (a - b).abs().max_element() / scale(a, b)));
    }
}
