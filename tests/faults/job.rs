//! A job that makes records up. They have the real size and go through the real caches; each depends on all that was
//! sealed when it was made, so that whoever reads one record too many, or too few, makes others from then on.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::Duration;

use cache_core::details::Details;
use cache_core::id::{Digest, Origin, Random};
use cache_core::rounds::{Plan, Step, refines};
use cache_core::{Irradiance, Namespace, Query, Record, RecordId, Shrink, Tag};
use cache_proto::{convert, v1};
use glam::{Vec2, Vec3};
use worker::job::{Job, Known, Work};
use worker::levels::{Level, Levels};
use worker::scenes::Scenes;
use worker::task::Done;

use crate::events;

/// Allowed error; with the records' radius, no record answers for the site of another.
const A: f32 = 0.5;
const RADIUS: f32 = 0.2;

/// Slowest gather of one record, ms.
const GATHER_MAX: u128 = 30;

/// Bytes of a pixel.
const PIXEL: usize = 16;

/// Edge of a tile in pixels.
const EDGE: u32 = 2;

/// A frame of made-up records.
pub struct MadeUp {
    spec: v1::FrameSpec,
    namespace: Namespace,
}

/// A view of the one scene: what the wire says of it. Any two views have about half of their sites in common.
pub fn view(number: u32, tiles: u32, levels: u32) -> v1::FrameSpec {
    let vector = |x: f32| Some(v1::Vector { x, y: 0.0, z: 0.0 });
    let eye = vector(number as f32);
    v1::FrameSpec {
        scene: "scene".into(),
        scene_hash: vec![1; 32].into(),
        namespace: namespace(levels).0.to_vec().into(),
        camera: Some(v1::CameraSpec {
            eye,
            forward: vector(1.0),
            right: vector(1.0),
            up: vector(1.0),
            parallel: false,
        }),
        width: tiles * EDGE,
        height: EDGE,
        tile_size: EDGE,
        spp: 1,
        method: "irradiance".into(),
        a: A,
        rays: 64,
        bounces: levels,
        seed: 0,
        levels,
        adaptive: number % 2 == 1,
        splat: false,
        effort: None,
    }
}

/// The namespace of the scene.
pub fn namespace(levels: u32) -> Namespace {
    Namespace([0x50 + levels as u8; 32])
}

/// A sound record with nothing in it but its site and its id.
pub fn record(id: RecordId, position: Vec3) -> Irradiance {
    Irradiance {
        id,
        position,
        normal: Vec3::Z,
        radius: RADIUS,
        radius_min: RADIUS / 2.0,
        radius_max: RADIUS,
        irradiance: Vec3::splat((id.0 % 1000) as f32),
        gradient_t: [Vec2::ZERO; 3],
        gradient_r: [Vec2::ZERO; 3],
        ellipse: [0.0; 3],
        noise: 0.0,
    }
}

impl MadeUp {
    /// The frame a specification describes.
    pub fn new(spec: v1::FrameSpec) -> Result<Self, String> {
        let namespace = convert::namespace(&spec.namespace).map_err(|e| e.to_string())?;
        Ok(Self { spec, namespace })
    }

    fn tiles(&self) -> u32 {
        self.spec.width / EDGE
    }

    /// Candidates of a tile in a round: fewer in later passes, none in the last, so that every plan ends.
    fn sites(&self, level: u32, pass: u32, rank: u32, tile: u32) -> Vec<Vec3> {
        let numbers = [level, pass, rank, tile].map(u64::from);
        let mut random = Random::named("sites", &numbers);
        let mut one_in = |n: f32| random.uniform() * n < 1.0;
        let count = match pass {
            0 => u32::from(one_in(1.5)) + u32::from(one_in(3.0)),
            1..4 => u32::from(one_in(8.0)),
            4..8 => u32::from(one_in(64.0)),
            _ => 0,
        };
        let eye = self.spec.camera.and_then(|camera| camera.eye).map_or(0.0, |eye| eye.x + 1.0);
        let seen_by_all = one_in(2.0);
        let place = if seen_by_all { 0.0 } else { eye } * 1000.0 + (level * 100 + pass) as f32;
        (0..count).map(|k| Vec3::new(rank as f32 + 0.25 * k as f32, tile as f32, place)).collect()
    }

    /// What a tile proposes in a round that refines: of what is sealed at its sites, by all that is.
    fn proposals(&self, step: &Step, tile: u32, levels: &Levels) -> Vec<Record> {
        let Step::Fill { level, pass, ranks } = step else { return Vec::new() };
        if !self.spec.adaptive || !refines(*level, *pass) || *pass >= 8 {
            return Vec::new();
        }
        let sites = (0..4).flat_map(|pass| self.sites(*level, pass, ranks.start, tile));
        let at = |position| levels[*level as usize - 1].irradiance.contributions(&Query::new(position, Vec3::Z));
        let a = A * (0.5 + 0.4 * Random::named("a", &[digest(levels).0 as u64, tile.into()]).uniform());
        let shrinks: BTreeSet<_> = sites.flat_map(at).map(|near| near.record.id).collect();
        shrinks.into_iter().map(|of| Shrink::new(of, a).into()).collect()
    }

    /// What a tile gathers in a round, found or made, and how many were found.
    fn fill(&self, step: &Step, tile: u32, levels: &Levels, known: &Known) -> (Vec<Record>, u64) {
        let Step::Fill { level, pass, ranks } = step else { return Default::default() };
        let (sealed, read) = (&levels[*level as usize - 1], digest(levels));
        let (mut records, mut found) = (Vec::new(), 0);
        for position in self.sites(*level, *pass, ranks.start, tile) {
            if sealed.irradiance.covers(&Query::new(position, Vec3::Z)) {
                continue;
            }
            let site = position.to_array();
            let origin = Origin { namespace: &self.namespace, kind: 1, level: *level, site: &site, seed: 0, read };
            let id = origin.id();
            found += u64::from(known(id).is_some());
            records.push(known(id).unwrap_or_else(|| record(id, position).into()));
        }
        (records, found)
    }

    fn pixels(&self, tile: u32, levels: &Levels) -> Vec<u8> {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&digest(levels).0.to_le_bytes()).update(&tile.to_le_bytes());
        let mut pixels = vec![0; (EDGE * EDGE) as usize * PIXEL];
        hasher.finalize_xof().fill(&mut pixels);
        pixels
    }
}

fn digest(levels: &Levels) -> Digest {
    levels.iter().fold(Digest::default(), |sum, sealed| sum.and(sealed.digest()))
}

impl Job for MadeUp {
    async fn prepare(_: u64, described: &v1::DescribeResponse, _: &Scenes) -> Result<Self, String> {
        Self::new(described.spec.clone().ok_or("nothing is described")?)
    }

    fn levels(&self) -> u32 {
        self.spec.levels
    }

    fn a(&self) -> f32 {
        self.spec.a
    }

    async fn run(self: Arc<Self>, work: Work) -> Result<Option<Done>, String> {
        let mut done = Done::default();
        let step = convert::plan_step(&work.step);
        for tile in work.tiles.start..work.tiles.end.min(self.tiles()) {
            if let Step::Fill { level, .. } = step {
                let (records, found) = self.fill(&step, tile, &work.levels, &work.known);
                let anew = records.len() as u64 - found;
                let wait: u128 = records.iter().take(anew as usize).map(|r| r.id().0 % GATHER_MAX).sum();
                tokio::time::sleep(Duration::from_millis(wait as u64)).await;
                let proposals = self.proposals(&step, tile, &work.levels);
                let tag = Tag { level, step: work.step.index };
                done.counts.reused += found;
                done.records.extend(records.into_iter().chain(proposals).map(|record| (tag, record)));
            } else {
                let pixels = self.pixels(tile, &work.levels).into();
                done.tiles.push(v1::FrameTile { tile, pixels });
            }
            if (work.dropped)() {
                events::note("job", format_args!("step {} of tile {tile} is dropped", work.step.index));
                return Ok(None);
            }
        }
        Ok(Some(done))
    }
}

/// What a frame must come to.
#[derive(Clone, Debug)]
pub struct Reference {
    /// Its picture: tiles in order.
    pub tiles: Vec<Vec<u8>>,
    /// What it gathers.
    pub gathered: Vec<RecordId>,
}

/// Renders a frame from a base, which may be `filled` already, with nobody in between.
pub fn reference(spec: &v1::FrameSpec, base: &[(Tag, Record)], filled: bool) -> Reference {
    let frame = MadeUp::new(spec.clone()).expect("our own");
    let mut levels: Levels = (0..spec.levels).map(|_| Level::new(spec.a, Details::default())).collect();
    for (tag, record) in base {
        levels[tag.level as usize - 1].unite([record]);
    }
    let nothing: Known = Arc::new(|_| None);
    let size = u64::from(spec.width) * u64::from(spec.height);
    let (mut plan, mut gathered, mut last) =
        (Plan::new(if filled { 0 } else { spec.levels }, spec.adaptive, size), Vec::new(), 0);
    while let Some(step @ Step::Fill { level, .. }) = plan.next(last) {
        let tiles = 0..frame.tiles();
        let one = |tile| [frame.fill(&step, tile, &levels, &nothing).0, frame.proposals(&step, tile, &levels)].concat();
        let new: Vec<_> = tiles.flat_map(one).collect();
        last = new.len() as u64;
        // Two tiles may propose the same.
        let new: BTreeMap<_, _> = new.into_iter().map(|record| (record.id(), record)).collect();
        gathered.extend(new.keys());
        levels[level as usize - 1].unite(new.values());
    }
    Reference { tiles: (0..frame.tiles()).map(|tile| frame.pixels(tile, &levels)).collect(), gathered }
}
