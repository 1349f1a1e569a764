//! The renderer's job: what comes of a lease, and the numbers told about it.

use std::sync::Arc;

use cache_core::rounds::Step;
use cache_core::{Record, Tag};
use cache_proto::{convert, v1};

use crate::frame::{Counts, Frame, Sums};
use crate::job::{Job, Work};
use crate::scene::{Files, Scene};
use crate::scenes::Scenes;
use crate::settings::Settings;
use crate::threads::off_thread;
use crate::{scene, spec};

/// What came of a lease.
#[derive(Default)]
pub struct Done {
    /// Records of the candidates that none covered, gathered or found, and proposals that records shrink.
    pub records: Vec<(Tag, Record)>,
    /// Finished tiles.
    pub tiles: Vec<v1::FrameTile>,
    /// What was counted.
    pub counts: Counts,
    /// CPU time it took.
    pub cpu_seconds: f64,
}

impl Job for Frame {
    async fn prepare(frame: u64, described: &v1::DescribeResponse, scenes: &Scenes) -> Result<Self, String> {
        let spec = described.spec.clone().ok_or("the server described nothing")?;
        let settings = spec::settings(&spec)?;
        let load = async |files: Files| {
            let spec = spec.clone();
            off_thread(move || load(&spec, &files)).await?
        };
        let scene = match load(Files::default()).await {
            Ok(scene) => scene,
            Err(why) => match scenes.of(frame, &spec.scene_hash).await {
                Ok(files) => load(files).await?,
                Err(status) => return Err(format!("{why}; and nobody sent it: {}", status.message())),
            },
        };
        off_thread(move || ready(&spec, scene, settings)).await?.map_err(|e| format!("{e:#}"))
    }

    fn levels(&self) -> u32 {
        self.levels()
    }

    fn a(&self) -> f32 {
        self.settings().a
    }

    async fn run(self: Arc<Self>, work: Work) -> Result<Option<Done>, String> {
        off_thread(move || run(&self, &work)).await
    }
}

/// Loads the scene a message describes, and makes sure that it is what its owner meant.
fn load(described: &v1::FrameSpec, files: &Files) -> Result<Scene, String> {
    let scene = scene::load_from(described.scene.as_ref(), files);
    let scene = scene.map_err(|e| format!("cannot load the scene: {e}"))?;
    if scene.hash[..] != described.scene_hash[..] {
        return Err(format!("{} has other content here than where the frame was opened", described.scene));
    }
    Ok(scene)
}

/// Makes a frame, and makes sure that it is what its owner meant.
fn ready(described: &v1::FrameSpec, scene: Scene, settings: Settings) -> anyhow::Result<Frame> {
    let frame = Frame::new(scene, settings);
    anyhow::ensure!(
        frame.namespace().0[..] == described.namespace[..],
        "these settings lead to another namespace here: other builds of ambience at work"
    );
    let (here, there) = (frame.levels(), described.levels);
    anyhow::ensure!(here == there, "the frame has {there} levels, {here} here: other builds of ambience at work");
    Ok(frame)
}

/// What the processor makes of a lease; `None` when nobody waits for it.
pub fn run(frame: &Frame, work: &Work) -> Option<Done> {
    let clock = CpuClock::start();
    let mut done = Done::default();
    // The server counts tiles as we do; a range past the end would make tiles nobody can place.
    for tile in work.tiles.start..work.tiles.end.min(frame.settings().tiles()) {
        if (work.dropped)() {
            return None;
        }
        let counts = match convert::plan_step(&work.step) {
            Step::Fill { level, pass, ranks } => {
                let (records, counts) = frame.fill(level, pass, ranks, tile, &work.levels, &*work.known);
                let tag = Tag { level, step: work.step.index };
                done.records.extend(records.into_iter().map(|r| (tag, r)));
                counts
            }
            Step::Pixels => {
                let (pixels, counts) = frame.pixels(tile, &work.levels);
                done.finish(tile, &pixels);
                counts
            }
        };
        done.counts.add(&counts);
    }
    done.cpu_seconds = clock.seconds();
    Some(done)
}

impl Done {
    /// Adds a finished tile.
    pub fn finish(&mut self, tile: u32, pixels: &[f32]) {
        self.tiles.push(v1::FrameTile { tile, pixels: packed(pixels).into() });
    }

    /// The counts of `Complete`: `cpu_seconds.PHASE`, `records.PHASE`, `rays.path.PHASE`, `rays.shadow.PHASE` (PHASE is
    /// `level N` or `pixels`), `records.radiance` (of those of level 1), `cpu_seconds.tests` (of those of the levels, what was not spent on gathers), `proposals`,
    /// `queries`, `misses`, `regathers` (of the misses, samples of pixels that gathered for themselves), `dense` (candidates left
    /// alone where records would be as dense as pixels), `reused` (of the records, those found), `samples` of pixels, of these
    /// `samples.splatted`, `devices_lost` (that splatted), and of bytes on the wire `bytes.inserted` and
    /// `bytes.subscribed` (packed records), `bytes.tiles` (packed pixels).
    pub fn counts(&self, step: &v1::Step, inserted: u64, subscribed: u64) -> Vec<v1::Count> {
        let phase = match step.level {
            0 => "pixels".to_string(),
            level => format!("level {level}"),
        };
        let proposals = self.records.iter().filter(|(_, r)| matches!(r, Record::Shrink(_))).count();
        let glossy = self.records.iter().filter(|(_, r)| matches!(r, Record::Radiance(_))).count();
        let tiles: usize = self.tiles.iter().map(|t| t.pixels.len()).sum();
        let all = [
            (format!("cpu_seconds.{phase}"), self.cpu_seconds),
            ("cpu_seconds.tests".into(), self.counts.test_seconds),
            (format!("records.{phase}"), (self.records.len() - proposals) as f64),
            ("records.radiance".into(), glossy as f64),
            ("proposals".into(), proposals as f64),
            (format!("rays.path.{phase}"), self.counts.path_rays as f64),
            (format!("rays.shadow.{phase}"), self.counts.shadow_rays as f64),
            ("queries".into(), self.counts.queries as f64),
            ("misses".into(), self.counts.misses as f64),
            ("regathers".into(), self.counts.regathers as f64),
            ("dense".into(), self.counts.dense as f64),
            ("reused".into(), self.counts.reused as f64),
            ("samples".into(), self.counts.samples as f64),
            ("samples.splatted".into(), self.counts.splatted as f64),
            ("devices_lost".into(), self.counts.devices_lost as f64),
            ("bytes.inserted".into(), inserted as f64),
            ("bytes.subscribed".into(), subscribed as f64),
            ("bytes.tiles".into(), tiles as f64),
        ];
        let all = all.into_iter().chain(judged(&self.counts));
        all.filter(|(_, value)| *value != 0.0).map(|(name, value)| v1::Count { name, value }).collect()
    }
}

/// What finished pixels add up to, under names of their own.
fn judged(counts: &Counts) -> impl Iterator<Item = (String, f64)> {
    [("surfaces", counts.surfaces), ("lights", counts.lights)].into_iter().flat_map(|(of, sums)| {
        let Sums { pixels, radiance, sampling, noise_squared, .. } = sums;
        let named =
            [("pixels", pixels as f64), ("radiance", radiance), ("sampling", sampling), ("noise", noise_squared)];
        named.map(|(what, value)| (format!("{of}.{what}"), value))
    })
}

/// The sums that the counts of a whole frame hold.
pub fn sums(count: impl Fn(&str) -> f64) -> Counts {
    let of = |of: &str| {
        let value = |what: &str| count(&format!("{of}.{what}"));
        let (pixels, radiance) = (value("pixels") as u64, value("radiance"));
        Sums { pixels, radiance, sampling: value("sampling"), noise_squared: value("noise"), ..Sums::default() }
    };
    Counts { surfaces: of("surfaces"), lights: of("lights"), ..Counts::default() }
}

/// Little endian float32.
fn packed(values: &[f32]) -> Vec<u8> {
    values.iter().flat_map(|v| v.to_le_bytes()).collect()
}

/// CPU time of the thread it was started on.
pub struct CpuClock(f64);

impl CpuClock {
    /// Starts counting.
    pub fn start() -> Self {
        Self(thread_seconds())
    }

    /// CPU seconds since the start; ask on the same thread.
    pub fn seconds(&self) -> f64 {
        thread_seconds() - self.0
    }
}

#[cfg(any(target_os = "linux", target_os = "macos", target_os = "freebsd"))]
fn thread_seconds() -> f64 {
    let now = nix::time::clock_gettime(nix::time::ClockId::CLOCK_THREAD_CPUTIME_ID);
    now.map_or(0.0, |t| std::time::Duration::from(t).as_secs_f64())
}

/// Without such a clock the statistics show 0.
#[cfg(not(any(target_os = "linux", target_os = "macos", target_os = "freebsd")))]
fn thread_seconds() -> f64 {
    0.0
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use cache_core::RecordId;

    use super::*;

    #[test]
    fn known_records_are_not_gathered_again_and_change_nothing() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/scenes/cornell.glb");
        let scene = scene::load(path.as_ref()).expect("the box");
        let camera = scene.cameras[0].clone();
        let frame = Frame::new(scene, Settings { rays: 64, ..Settings::new(camera, 16, 16) });
        let step = v1::Step { index: 5, level: 1, rank_to: 4096, ..Default::default() };
        let lease = |known: BTreeMap<RecordId, Record>| {
            let known = Arc::new(move |id| known.get(&id).cloned());
            let (levels, dropped) = (Vec::new(), Arc::new(|| false));
            run(&frame, &Work { step: step.clone(), tiles: 0..1, levels, known, dropped }).expect("not dropped")
        };
        let first = lease(BTreeMap::new());
        assert!(first.records.len() > 100 && first.counts.reused == 0);
        assert!(first.records.iter().all(|(tag, _)| *tag == Tag { level: 1, step: 5 }));
        let again = lease(first.records.iter().map(|(_, r)| (r.id(), r.clone())).collect());
        assert_eq!((&again.records, again.counts.reused), (&first.records, first.records.len() as u64));
        assert!(again.counts.path_rays * 10 < first.counts.path_rays);
        let half = lease(first.records.iter().step_by(2).map(|(_, r)| (r.id(), r.clone())).collect());
        assert_eq!((half.records, half.counts.reused), (first.records, again.counts.reused.div_ceil(2)));
    }
}
