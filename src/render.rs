//! `ambience render`: from a scene to a picture, with own processes or somebody's server.

use std::collections::HashSet;
use std::path::Path;
use std::time::Duration;

use cache_proto::v1::frame_event::Event as FrameEvent;
use cache_proto::{VERSION, v1};
use serde_json::{Map, Value, json};
use tonic::{Status, Streaming};
use worker::client::{self, Address, Frames};
use worker::credentials::Credentials;
use worker::film::{self, Film};
use worker::frame::Frame;
use worker::pilot::{self, Errors, Forecast};
use worker::scene::{self, Scene};
use worker::scenes;
use worker::settings::{ALL_BOUNCES, Effort, Settings};
use worker::spec;
use worker::task;
use worker::world::World;

use crate::args::RenderArgs;
use crate::children::{Children, Event, how};
use crate::failure::Failure;
use crate::familiar::{self, Found};
use crate::progress::{Progress, phase_name};
use crate::say;
use crate::stats::{Stats, hex};

/// Share of samples that gathered for themselves from which the closing line says so.
const TOLD_FROM: f64 = 0.02;

/// Own processes that died and are started again, all together.
const RESTARTS: u32 = 3;

/// How long the server may take to hear that a worker died; its leases run out a little later anyway.
const LEAVE: Duration = Duration::from_secs(2);

/// A server that answers later than this has to be waited for, and the user told.
const SLOW: Duration = Duration::from_secs(1);

/// Rays across and down with which a black picture is examined.
const PROBES: u32 = 24;

/// Renders until done, failed, or ended by a signal; leaves no process and no partial file behind.
///
/// # Errors
/// What went wrong, with the exit code it means.
pub async fn run(args: RenderArgs) -> Result<(), Failure> {
    args.check()?;
    let credentials = args.credentials()?;
    let mut children = Children::new()?;
    let ended = tokio::select! {
        biased;
        number = signalled() => Err(Failure::Signal(number)),
        ended = render(&args, credentials, &mut children) => ended,
    };
    children.stop().await;
    ended
}

/// Waits until the command is told to end: the signal's number.
#[cfg(unix)]
pub async fn signalled() -> u8 {
    use tokio::signal::unix::{SignalKind, signal};
    let wait = async |kind: SignalKind| {
        match signal(kind) {
            Ok(mut signal) => drop(signal.recv().await),
            Err(_) => std::future::pending().await,
        }
        kind.as_raw_value() as u8
    };
    tokio::select! {
        number = wait(SignalKind::interrupt()) => number,
        number = wait(SignalKind::terminate()) => number,
        number = wait(SignalKind::hangup()) => number,
    }
}

/// Waits until the command is told to end: the signal's number.
#[cfg(not(unix))]
pub async fn signalled() -> u8 {
    if tokio::signal::ctrl_c().await.is_err() {
        std::future::pending().await
    }
    2
}

async fn render(args: &RenderArgs, credentials: Credentials, children: &mut Children) -> Result<(), Failure> {
    let (mut stats, mut progress) = (Stats::default(), Progress::new(args.progress, args.quiet, args.workers() > 0));
    stats.phase("load");
    progress.phase("loading the scene");
    let frame = {
        let args = args.clone();
        off_runtime("loading the scene", move || load(&args)).await??
    };
    let (frame, forecast) = match args.error {
        Some(error) => {
            stats.phase("pilot");
            progress.phase("looking at a small part of the picture");
            let (frame, forecast) = off_runtime("the pilot", move || pilot::choose(frame, error)).await?;
            (frame, Some((error, forecast)))
        }
        None => (frame, None),
    };
    let mut job = job(args, &frame, forecast)?;
    drop(frame);
    for warning in &job.warnings {
        progress.note(&format!("warning: {warning}"));
    }
    let declined = HashSet::new();
    let mut render = Render { args, credentials, children, stats, progress, spare: RESTARTS, base: None, declined };
    let server = render.start(&mut job).await?;
    let (film, done) = render.picture(&job, server).await?;
    // Reaped first, so that their memory is in the statistics.
    render.children.stop().await;
    render.write(&job, film, &done).await
}

/// What is to be rendered.
struct Job {
    settings: Settings,
    spec: v1::FrameSpec,
    warnings: Vec<String>,
    /// The error asked for, and what the pilot made of it.
    forecast: Option<(f32, Forecast)>,
}

impl Job {
    /// Takes the settings of records there are, which reach the error asked for as well.
    fn adopt(&mut self, label: &v1::Label) {
        let Some(before) = self.settings.effort else { return };
        let effort = Effort { rays: label.rays_by_deviation, least_rays: label.least_rays, ..before };
        let settings = Settings { a: label.a, effort: Some(effort), ..self.settings.clone() };
        // Another build's may be something else.
        let hash: Option<[u8; 32]> = self.spec.scene_hash.as_ref().try_into().ok();
        if hash.is_none_or(|hash| settings.namespace(&hash).0 != *label.namespace) {
            return;
        }
        if let Some((_, forecast)) = &mut self.forecast {
            forecast.errors.noise *= f64::from(before.rays / effort.rays).sqrt();
            forecast.errors.interpolation *= f64::from(settings.a / self.settings.a).powi(2);
        }
        let Effort { rays, least_rays, samples } = effort;
        (self.spec.a, self.spec.effort) = (settings.a, Some(v1::Effort { rays, least_rays, samples }));
        (self.spec.namespace, self.settings) = (label.namespace.clone(), settings);
    }
}

/// Runs what takes long without holding up the runtime.
pub async fn off_runtime<T: Send + 'static>(
    what: &str,
    work: impl FnOnce() -> T + Send + 'static,
) -> Result<T, Failure> {
    tokio::task::spawn_blocking(work).await.map_err(|e| Failure::failed(format!("{what} failed: {e}")))
}

fn load(args: &RenderArgs) -> Result<Frame, Failure> {
    let scene = scene::load(&args.view.scene).map_err(Failure::usage)?;
    let settings = args.settings(&scene)?;
    Ok(Frame::new(scene, settings))
}

fn job(args: &RenderArgs, frame: &Frame, forecast: Option<(f32, Forecast)>) -> Result<Job, Failure> {
    let path = &args.view.scene;
    let (scene, shown) = (frame.scene(), path.display());
    let unreadable = |e: &dyn std::fmt::Display| Failure::usage(format!("{shown}: {e}"));
    let path = std::fs::canonicalize(path).map_err(|e| unreadable(&e))?;
    let path = path.to_str().ok_or_else(|| unreadable(&"the path is not UTF-8, workers could not be told"))?;
    let mut warnings = scene.warnings.clone();
    if !is_lit(scene) {
        warnings.push(format!("{shown} has no light: the picture will be black"));
    }
    // Only the renderer itself knows how many levels a scene needs.
    let spec = v1::FrameSpec { splat: args.splat, ..spec::message(frame, path, &scene.hash) };
    Ok(Job { settings: frame.settings().clone(), spec, warnings, forecast })
}

fn is_lit(scene: &Scene) -> bool {
    let emits = |t: &scene::Triangle| scene.materials[t.material as usize].emission.max_element() > 0.0;
    scene.points.iter().any(|p| p.intensity.max_element() > 0.0)
        || scene.distant.iter().any(|d| d.strength.max_element() > 0.0)
        || scene.triangles.iter().any(emits)
}

/// How the attempt to render a frame ended.
enum End {
    Done(v1::FrameDone),
    /// The connection broke; the frame was cancelled by that.
    Broken(Status),
    /// The own server died.
    ServerDied(String),
}

/// The records of its namespace a frame began with.
#[derive(Clone, PartialEq, Eq, Debug)]
struct Base {
    digest: Vec<u8>,
    records: u64,
    filled: bool,
}

struct Render<'a> {
    args: &'a RenderArgs,
    credentials: Credentials,
    children: &'a mut Children,
    stats: Stats,
    progress: Progress,
    /// Restarts left.
    spare: u32,
    /// Which records the first attempt began with.
    base: Option<Base>,
    /// Names of workers that cannot do the frame.
    declined: HashSet<String>,
}

impl Render<'_> {
    /// Renders the frame, from its beginning again whenever the server was lost: what depends on nothing but the scene,
    /// the settings and the records it began with comes out the same. What was gathered before comes back from the
    /// server's disk or from its workers.
    async fn picture(&mut self, job: &Job, mut server: Address) -> Result<(Film, v1::FrameDone), Failure> {
        loop {
            let mut film = Film::new(&job.settings);
            match self.attempt(job, &server, &mut film).await? {
                End::Done(done) if film.missing() == 0 => return Ok((film, done)),
                End::Done(_) => {
                    return Err(Failure::failed(format!("the server forgot {} tiles", film.missing())));
                }
                // If the own server died, we are about to hear it.
                End::Broken(_) if self.args.server.is_none() => {}
                End::Broken(status) => {
                    let why = status.message();
                    self.progress.note(&format!("warning: lost the server ({why}); starting the frame again"));
                }
                End::ServerDied(how) => {
                    self.stats.servers_lost += 1;
                    if self.spare == 0 {
                        return Err(Failure::failed(format!("the server ended, {how}, and that too often")));
                    }
                    self.spare -= 1;
                    self.progress.note(&format!("warning: the server ended, {how}; starting the frame again"));
                    self.stats.phase("start");
                    server = self.children.start_server(self.args.transport, self.args.cache.as_deref()).await?;
                }
            }
        }
    }

    /// Starts what is to be started: the server's address. What its cache has may change the job's settings.
    async fn start(&mut self, job: &mut Job) -> Result<Address, Failure> {
        self.stats.phase("start");
        self.progress.phase("starting");
        let server = match &self.args.server {
            Some(server) => server.clone(),
            None => self.children.start_server(self.args.transport, self.args.cache.as_deref()).await?,
        };
        if let Some(cache) = &self.args.cache {
            match familiar::look(&server, &self.credentials, &job.spec, cache).await? {
                Found::Nothing => {}
                Found::Near(label) => job.adopt(&label),
                Found::Foreign(note) => self.progress.note(&note),
            }
        }
        self.stats.workers = self.args.workers().into();
        for _ in 0..self.args.workers() {
            self.children.start_worker(&server, &self.credentials, self.args.threads, self.args.splat)?;
        }
        Ok(server)
    }

    async fn attempt(&mut self, job: &Job, server: &Address, film: &mut Film) -> Result<End, Failure> {
        let frames = client::frames(client::connect(server, &self.credentials).map_err(Failure::usage)?);
        let mut events = match self.open(job, server, &frames).await? {
            Ok(events) => events,
            Err(end) => return Ok(end),
        };
        let mut frame = 0;
        loop {
            let event = tokio::select! {
                event = events.message() => event,
                event = self.children.next() => match self.child(event, server, &frames).await? {
                    Some(end) => return Ok(end),
                    None => continue,
                },
            };
            let event = match event {
                Ok(Some(event)) => event.event,
                Ok(None) => return Ok(End::Broken(Status::unavailable("it ended the stream"))),
                Err(status) if client::is_passing(&status) => return Ok(End::Broken(status)),
                Err(status) => return Err(Failure::failed(format!("server {server}: {}", status.message()))),
            };
            match event {
                Some(FrameEvent::Progress(progress)) => {
                    self.stats.phase(&progress.step.as_ref().map_or("start".into(), phase_name));
                    self.progress.frame(&progress, job.settings.size(), job.spec.levels);
                }
                Some(FrameEvent::Tile(tile)) => {
                    self.stats.tile_bytes += tile.pixels.len() as u64;
                    film.add(tile.tile, &tile.pixels).map_err(Failure::failed)?;
                }
                Some(FrameEvent::Declined(declined)) => self.decline(declined)?,
                Some(FrameEvent::SceneWanted(_)) => {
                    let (frames, path) = (frames.clone(), job.spec.scene.clone());
                    // If it fails, the worker that asked says so.
                    tokio::spawn(async move { scenes::offer(&frames, frame, path.as_ref()).await });
                }
                Some(FrameEvent::Done(done)) => return Ok(End::Done(done)),
                Some(FrameEvent::Opened(opened)) => {
                    frame = opened.frame;
                    self.opened(opened);
                }
                None => {}
            }
        }
    }

    async fn open(
        &mut self,
        job: &Job,
        server: &Address,
        frames: &Frames,
    ) -> Result<Result<Streaming<v1::FrameEvent>, End>, Failure> {
        let (base, filled) =
            self.base.as_ref().map_or_else(Default::default, |base| (base.digest.clone(), base.filled));
        let opening = client::retry(|| {
            let (spec, base) = (Some(job.spec.clone()), base.clone().into());
            let mut frames = frames.clone();
            async move { frames.open(v1::OpenRequest { spec, base, filled }).await }
        });
        tokio::pin!(opening);
        let slow = tokio::time::sleep(SLOW);
        tokio::pin!(slow);
        loop {
            tokio::select! {
                opened = &mut opening => {
                    let away = |s: &Status| if client::is_passing(s) { "away for too long: " } else { "" };
                    let failed = |s: Status| Failure::failed(format!("server {server}: {}{}", away(&s), s.message()));
                    return opened.map(Ok).map_err(failed);
                }
                () = &mut slow, if !slow.is_elapsed() => self.progress.wait(&format!("waiting for server {server}")),
                event = self.children.next() => if let Some(end) = self.child(event, server, frames).await? {
                    return Ok(Err(end));
                },
            }
        }
    }

    /// Reacts to what a child did.
    async fn child(&mut self, event: Event, server: &Address, frames: &Frames) -> Result<Option<End>, Failure> {
        match event {
            Event::Line(title, line) => self.progress.note(&format!("{title}: {line}")),
            Event::ServerEnded(status) => return Ok(Some(End::ServerDied(how(status)))),
            Event::WorkerEnded { name, title, status } => {
                self.stats.workers_lost += 1;
                let request = v1::LeaveRequest { worker: name };
                drop(tokio::time::timeout(LEAVE, frames.clone().leave(request)).await);
                let again = self.spare > 0;
                if again {
                    self.spare -= 1;
                    self.children.start_worker(server, &self.credentials, self.args.threads, self.args.splat)?;
                }
                let what = if again { "starting another" } else { "going on without it" };
                self.progress.note(&format!("warning: {title} ended, {}; {what}", how(status)));
                self.check_workers("they ended")?;
            }
        }
        Ok(None)
    }

    fn opened(&mut self, opened: v1::FrameOpened) {
        let v1::FrameOpened { base: digest, base_records: records, filled, .. } = opened;
        let base = Base { digest: digest.to_vec(), records, filled };
        if let Some(before) = self.base.as_ref().filter(|before| before.digest != base.digest) {
            let (before, now) = (before.records, base.records);
            self.progress.note(&format!(
                "warning: the picture was begun with {before} records of the server, which it lost; now with {now}: \
                 within the same error, but not the same bits"
            ));
        }
        self.stats.base = base.records;
        self.base = Some(base);
    }

    fn decline(&mut self, declined: v1::FrameDeclined) -> Result<(), Failure> {
        let v1::FrameDeclined { worker, reason, for_all } = declined;
        if for_all {
            return Err(Failure::failed(reason));
        }
        self.progress.note(&format!("warning: worker {worker} cannot take part: {reason}"));
        self.declined.insert(worker);
        self.check_workers(&reason)
    }

    /// Fails when nobody is left who could render. With somebody's server, others may come.
    fn check_workers(&self, why: &str) -> Result<(), Failure> {
        let left = self.children.names().any(|name| !self.declined.contains(name));
        if left || self.args.server.is_some() {
            return Ok(());
        }
        Err(Failure::failed(format!("no worker is left to render: {why}")))
    }

    /// Puts picture and statistics on disk.
    async fn write(&mut self, job: &Job, film: Film, done: &v1::FrameDone) -> Result<(), Failure> {
        self.stats.phase("write");
        self.progress.phase("writing");
        let black = film.is_black();
        let attributes = attributes(job, done);
        let encoding = tokio::task::spawn_blocking(move || Ok((film.png()?, film.exr(&attributes)?)));
        let encoded = encoding.await.map_err(Failure::failed)?;
        let (png, exr) = encoded.map_err(|e: film::FilmError| Failure::failed(e))?;
        let mut files = Vec::new();
        // From here to the end nothing awaits, so no signal can come between the files.
        for (path, bytes) in [(&self.args.png(), &png), (&self.args.output, &exr)] {
            files.push(film::stage(path, bytes).map_err(Failure::failed)?);
        }
        self.progress.finish();
        let seconds = self.stats.seconds();
        if let Some(path) = &self.args.stats {
            let json = std::mem::take(&mut self.stats).json(told(job, done), done);
            let text = format!("{json:#}\n");
            files.push(film::stage(path, text.as_bytes()).map_err(Failure::failed)?);
        }
        for file in files {
            file.publish().map_err(Failure::failed)?;
        }
        if black {
            self.progress.note(&format!("warning: the picture is black: {}", why_black(job)));
        }
        self.progress.finish();
        if self.args.quiet {
            return Ok(());
        }
        say::result(format_args!(
            "{} and {}: {seconds:.1} s, {} records{}, {} rounds{}{}{}",
            self.args.output.display(),
            self.args.png().display(),
            done.records,
            of_radiance(done),
            done.rounds,
            job.forecast.map_or(String::new(), |(asked, forecast)| {
                let believed = 100.0 * believed(&forecast, done).total();
                format!("; error asked {} %, believed {believed:.2} %", 100.0 * asked)
            }),
            gathered_per_sample(done),
            splatted(job, done)
        ))
    }
}

/// How many of the records gathered are of radiance, if any.
fn of_radiance(done: &v1::FrameDone) -> String {
    let count = done.counts.iter().find(|count| count.name == "records.radiance");
    count.map_or(String::new(), |count| format!(" ({} of radiance)", count.value))
}

/// Where records did not pay, if that was more than here and there.
fn gathered_per_sample(done: &v1::FrameDone) -> String {
    let count = |name: &str| done.counts.iter().filter(|c| c.name == name).map(|c| c.value).sum::<f64>();
    let share = count("regathers") / count("samples").max(1.0);
    if share < TOLD_FROM {
        return String::new();
    }
    format!(
        "; {:.0} % of the samples gathered for themselves, where records would be as dense as pixels",
        100.0 * share
    )
}

/// How much of a picture that was to be splatted is, and whether devices were lost.
fn splatted(job: &Job, done: &v1::FrameDone) -> String {
    if !job.spec.splat {
        return String::new();
    }
    let count = |name: &str| done.counts.iter().filter(|c| c.name == name).map(|c| c.value).sum::<f64>();
    let lost = match count("devices_lost") {
        0.0 => String::new(),
        lost => format!(", {lost} devices lost"),
    };
    let share = 100.0 * count("samples.splatted") / count("samples").max(1.0);
    format!("; {share:.0} % of the samples splatted{lost}")
}

/// Why a picture may be black.
fn why_black(job: &Job) -> &'static str {
    let Ok(scene) = scene::load(Path::new(&job.spec.scene)) else { return "the scene is gone" };
    if !is_lit(&scene) {
        return "the scene has no light";
    }
    let world = World::new(scene);
    let (width, height) = (job.settings.width as f32, job.settings.height as f32);
    let place = |i: u32, size: f32| (i as f32 + 0.5) / PROBES as f32 * size;
    let sees = |i: u32| {
        let (origin, direction) = job.settings.ray(place(i % PROBES, width), place(i / PROBES, height));
        world.meet(origin, direction).is_some()
    };
    if (0..PROBES * PROBES).any(sees) { "no light reaches what the camera sees" } else { "the camera sees no surface" }
}

fn bounces(settings: &Settings) -> String {
    if settings.bounces == ALL_BOUNCES { "all".into() } else { settings.bounces.to_string() }
}

/// What the header of the EXR says. Nothing of it may depend on who rendered.
fn attributes(job: &Job, done: &v1::FrameDone) -> Vec<(&'static str, String)> {
    let s = &job.settings;
    let vector = |v: glam::Vec3| format!("{} {} {}", v.x, v.y, v.z);
    let mut attributes = vec![
        ("version", VERSION.into()),
        ("scene_hash", hex(&job.spec.scene_hash)),
        ("namespace", hex(&job.spec.namespace)),
        ("method", s.method.name().into()),
        ("spp", s.spp.to_string()),
        ("a", s.a.to_string()),
        ("rays", s.rays.to_string()),
        ("bounces", bounces(s)),
        ("seed", s.seed.to_string()),
        ("error", job.forecast.map_or("-".into(), |(error, _)| error.to_string())),
        ("effort", s.effort.map_or("-".into(), |e| format!("{} {} {}", e.rays, e.least_rays, e.samples))),
        ("records", done.records.to_string()),
        ("camera_eye", vector(s.camera.eye)),
        ("camera_forward", vector(s.camera.forward)),
        ("camera_right", vector(s.camera.right)),
        ("camera_up", vector(s.camera.up)),
        ("camera_parallel", s.camera.parallel.to_string()),
    ];
    // Its bits are those of a device.
    attributes.extend(job.spec.splat.then(|| ("splat", "true".into())));
    attributes
}

/// What the picture itself tells of its error: sampling and noise from all of its pixels, interpolation from the pilot.
fn believed(forecast: &Forecast, done: &v1::FrameDone) -> Errors {
    let count = |name: &str| done.counts.iter().filter(|c| c.name == name).map(|c| c.value).sum();
    pilot::reached(&task::sums(count), forecast)
}

/// What the statistics say about the error asked for and reached, relative to the picture's mean radiance.
fn error(asked: f32, forecast: &Forecast, done: &v1::FrameDone) -> Value {
    let parts = |e: &Errors| json!({ "total": e.total(), "sampling": e.sampling, "noise": e.noise, "interpolation": e.interpolation });
    json!({
        "asked": asked.to_string().parse::<f64>().unwrap_or(asked.into()),
        "forecast": parts(&forecast.errors),
        "believed": parts(&believed(forecast, done)),
        "why": "sampling: how much the samples of each finished pixel scatter; noise: how much the rays of the records each \
                finished pixel was made of scatter; interpolation: what records of the pilot were off by where it gathered \
                anew, times the square of a over the pilot's",
        "pilot_rays": forecast.counts.path_rays + forecast.counts.shadow_rays,
    })
}

/// What the statistics say about scene and settings.
fn told(job: &Job, done: &v1::FrameDone) -> Map<String, Value> {
    let s = &job.settings;
    let told = json!({
        "version": VERSION,
        "scene": job.spec.scene,
        "scene_hash": hex(&job.spec.scene_hash),
        "namespace": hex(&job.spec.namespace),
        "settings": {
            "width": s.width,
            "height": s.height,
            "spp": s.spp,
            "method": s.method.name(),
            // As the user wrote it, not as its nearest double.
            "a": s.a.to_string().parse::<f64>().unwrap_or(s.a.into()),
            "rays": s.rays,
            "bounces": bounces(s),
            "seed": s.seed,
            "levels": job.spec.levels,
            "rays_by_deviation": s.effort.map(|effort| effort.rays),
            "rays_at_least": s.effort.map(|effort| effort.least_rays),
            "samples_by_deviation": s.effort.map(|effort| effort.samples),
        },
        "error": job.forecast.map(|(asked, forecast)| error(asked, &forecast, done)),
    });
    match told {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}
