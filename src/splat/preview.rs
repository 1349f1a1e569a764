//! `ambience splat`: follows the records of a scene, and draws them again and again.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use cache_core::details::Details;
use cache_core::id::Digest;
use cache_core::{Namespace, Record, RecordId};
use cache_proto::{convert, v1};
use shaders::device::Gpu;
use shaders::splatter::Splatter;
use worker::client::{self, Cache};
use worker::farm::cores;
use worker::film::{self, Film};
use worker::follow::Follower;
use worker::frame::Frame;
use worker::levels::{Level, Reflected};
use worker::scene;
use worker::settings::{Method, Settings, TILE};
use worker::spec;
use worker::splat::{Look, Lost, Splat};

use super::SplatArgs;
use crate::failure::Failure;
use crate::render::{off_runtime, signalled};
use crate::say;

/// How much farther than in the picture records count where none answers: what is missing is sketched.
const REACHES: [f32; 3] = [1.0, 3.0, 9.0];

/// Rows of tiles that a thread traces at a time.
const BAND: u32 = 4;

/// Draws until told to stop.
///
/// # Errors
/// What is wrong with scene, picture or server; or that the device is lost.
pub async fn run(args: SplatArgs) -> Result<(), Failure> {
    tokio::select! {
        biased;
        number = signalled() => Err(Failure::Signal(number)),
        ended = watch(args) => ended,
    }
}

async fn watch(args: SplatArgs) -> Result<(), Failure> {
    film::check_writable(&args.output).map_err(|e| Failure::usage(format!("--output {e}")))?;
    let credentials = args.credentials.load(&args.server).map_err(Failure::usage)?;
    let cache = client::cache(client::connect(&args.server, &credentials).map_err(Failure::usage)?);
    let gpu = off_runtime("opening the device", || Gpu::new(true).map_err(Failure::failed)).await??;
    let view = args.view.clone();
    let scene = off_runtime("loading the scene", move || scene::load(&view.scene).map_err(Failure::usage)).await??;
    let (camera, [width, height]) = args.view.of(&scene)?;
    let settings = Settings { spp: 1, ..Settings::new(camera, width, height) };
    spec::check(&settings).map_err(|e| Failure::usage(format!("--{e}")))?;
    let (hash, gpu) = (scene.hash, Arc::new(gpu));
    drop(scene);
    let mut watched = Watched { args: &args, cache, gpu, hash, settings, logs: BTreeMap::new(), shown: None };
    let every = Duration::from_secs(args.every.into());
    let (mut waits, mut late) = (false, false);
    loop {
        let start = Instant::now();
        match watched.look().await? {
            Looked::Drew { records } if !args.quiet => {
                let (out, seconds) = (args.output.display(), start.elapsed().as_secs_f64());
                say::result(format_args!("{out}: {records} records, drawn in {seconds:.2} s"))?;
            }
            Looked::Nothing if !std::mem::replace(&mut waits, true) => {
                say::line(format_args!("waiting for records of {} at {}", args.view.scene.display(), args.server));
            }
            _ => {}
        }
        if start.elapsed() > every && !std::mem::replace(&mut late, true) {
            let every = args.every;
            say::line(format_args!("warning: pictures take longer than --every {every}: each comes when it is done"));
        }
        tokio::time::sleep(every.saturating_sub(start.elapsed())).await;
    }
}

/// What a look found.
enum Looked {
    /// No records of the scene.
    Nothing,
    /// None but those that were drawn already.
    Same,
    /// A picture was written.
    Drew { records: usize },
}

struct Watched<'a> {
    args: &'a SplatArgs,
    cache: Cache,
    gpu: Arc<Gpu>,
    hash: [u8; 32],
    /// Camera and size.
    settings: Settings,
    /// Logs of what is shown.
    logs: BTreeMap<Namespace, Follower>,
    shown: Option<Shown>,
}

/// What is shown.
struct Shown {
    label: v1::Label,
    frame: Arc<Frame>,
    /// Of the records that were drawn.
    digest: Digest,
}

impl Watched<'_> {
    async fn look(&mut self) -> Result<Looked, Failure> {
        let asked = client::retry(|| {
            let mut cache = self.cache.clone();
            async move { cache.info(v1::InfoRequest {}).await }
        });
        let failed = |status: tonic::Status| {
            let away = if client::is_passing(&status) { "away for too long: " } else { "" };
            Failure::failed(format!("server {}: {away}{}", self.args.server, status.message()))
        };
        let info = asked.await.map_err(failed)?;
        let Some((label, namespaces)) = newest(&info.namespaces, &self.hash) else { return Ok(Looked::Nothing) };
        self.logs.retain(|namespace, _| namespaces.contains(namespace));
        for namespace in namespaces {
            self.logs.entry(namespace).or_insert_with(|| Follower::start(self.cache.clone(), namespace));
        }
        self.show(label).await?;
        let Some(shown) = &mut self.shown else { return Ok(Looked::Nothing) };
        let records = records(&self.logs);
        let mut digest = Digest::default();
        records.keys().for_each(|id| digest.add(*id));
        if digest == shown.digest {
            return Ok(Looked::Same);
        }
        let (gpu, frame, output) = (self.gpu.clone(), shown.frame.clone(), self.args.output.clone());
        let draw = move || {
            let png = draw(&gpu, &frame, &records).map_err(Failure::failed)?.png().map_err(Failure::failed)?;
            film::stage(&output, &png).and_then(film::Staged::publish).map_err(Failure::failed)?;
            Ok::<_, Failure>(records.len())
        };
        let records = off_runtime("drawing", draw).await??;
        shown.digest = digest;
        Ok(Looked::Drew { records })
    }

    /// Prepares to show what a label says, unless that is what is shown.
    async fn show(&mut self, label: v1::Label) -> Result<(), Failure> {
        if self.shown.as_ref().is_some_and(|shown| shown.label == label) {
            return Ok(());
        }
        let method = Method::from_name(&label.method);
        let method = method.ok_or_else(|| Failure::failed(format!("method {:?} is unknown here", label.method)))?;
        let settings = Settings { method, a: label.a, bounces: label.bounces, ..self.settings.clone() };
        spec::check(&settings).map_err(|e| Failure::failed(format!("server {}: {e}", self.args.server)))?;
        let (path, hash) = (self.args.view.scene.clone(), self.hash);
        let load = move || {
            let scene = scene::load(&path).map_err(Failure::usage)?;
            if scene.hash == hash {
                return Ok(Frame::new(scene, settings));
            }
            Err(Failure::failed(format!("{} has changed", path.display())))
        };
        let frame = Arc::new(off_runtime("loading the scene", load).await??);
        self.shown = Some(Shown { label, frame, digest: Digest::default() });
        Ok(())
    }
}

/// Of the settings a scene has records of, those being worked on, or else those with most records: what they are, and where the
/// records are.
fn newest(known: &[v1::NamespaceInfo], scene: &[u8]) -> Option<(v1::Label, Vec<Namespace>)> {
    let mut all = BTreeMap::<Namespace, (bool, u64, v1::Label, Vec<Namespace>)>::new();
    for info in known {
        let Some(label) = info.label.as_ref().filter(|label| label.scene_hash == scene) else { continue };
        let Ok(own) = convert::namespace(&info.namespace) else { continue };
        let (base, draft) = match convert::namespace(&label.draft_of) {
            Ok(base) => (base, true),
            Err(_) => (own, false),
        };
        // The same for a namespace and its drafts.
        let label = v1::Label { namespace: base.0.to_vec().into(), draft_of: Default::default(), ..label.clone() };
        let of = all.entry(base).or_insert_with(|| (false, 0, label, Vec::new()));
        (of.0, of.1) = (of.0 || draft, of.1 + info.records);
        of.3.push(own);
    }
    let (_, _, label, namespaces) = all.into_values().max_by_key(|(draft, records, ..)| (*draft, *records))?;
    Some((label, namespaces))
}

/// Records of level 1 that have come.
fn records(logs: &BTreeMap<Namespace, Follower>) -> BTreeMap<RecordId, Record> {
    let held = logs.values().filter_map(|log| log.read(|replica| replica.prefix(replica.position())).ok());
    held.flat_map(|part| part.records).filter(|(tag, _)| tag.level == 1).map(|(_, r)| (r.id(), r)).collect()
}

/// Draws records, and where none answers, the same counting farther.
struct Sketch([Splatter; 3]);

impl Splat for Sketch {
    fn answers(&mut self, looks: &mut dyn Iterator<Item = &Look>) -> Result<Vec<Option<Reflected>>, Lost> {
        let looks: Vec<_> = looks.collect();
        let mut answers = vec![None; looks.len()];
        for splatter in &mut self.0 {
            let open: Vec<_> = (0..looks.len()).filter(|i| answers[*i].is_none()).collect();
            let told = splatter.answers(&mut open.iter().map(|i| looks[*i]))?;
            open.into_iter().zip(told).for_each(|(i, told)| answers[i] = told);
        }
        Ok(answers)
    }
}

/// A picture of what records say: its rows of tiles are shared between all cores, which have one device.
fn draw(gpu: &Arc<Gpu>, frame: &Frame, records: &BTreeMap<RecordId, Record>) -> Result<Film, Lost> {
    let settings = frame.settings();
    let loaded = |farther: f32| {
        let mut level = Level::new(farther * settings.a, Details::default());
        level.unite(records.values());
        let mut splatter = Splatter::new(gpu.clone(), settings);
        splatter.load(&level);
        splatter
    };
    let splatter = Mutex::new(Sketch(REACHES.map(loaded)));
    let (columns, rows) = (settings.width.div_ceil(TILE), settings.height.div_ceil(TILE));
    let next = AtomicU32::new(0);
    let trace = || {
        let mut done = Vec::new();
        loop {
            let from = next.fetch_add(BAND, Ordering::Relaxed);
            if from >= rows {
                return Ok(done);
            }
            let tiles = from * columns..rows.min(from + BAND) * columns;
            let mut splat = &splatter;
            done.extend(tiles.clone().zip(frame.preview(tiles, &mut splat)?));
        }
    };
    let mut film = Film::new(settings);
    let parts: Vec<Result<_, Lost>> = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..cores()).map(|_| scope.spawn(trace)).collect();
        threads
            .into_iter()
            .map(|thread| thread.join().unwrap_or_else(|_| Err(Lost("a thread failed".into()))))
            .collect()
    });
    for part in parts {
        for (tile, pixels) in part? {
            film.put(tile, pixels.into_iter());
        }
    }
    Ok(film)
}
