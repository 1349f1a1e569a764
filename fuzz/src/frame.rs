use std::collections::BTreeSet;
use std::sync::OnceLock;
use std::time::Duration;

use cache_core::Namespace;
use cache_proto::v1;
use cache_proto::v1::frame_event::Event;
use cache_server::access::Tenant;
use cache_server::frame::{News, Origin};
use cache_server::frames::Frames;
use cache_server::limits::Limits;
use cache_server::replica::Mark;
use cache_server::spec::Job;
use glam::{Vec2, Vec3};
use prost::Message as _;
use worker::levels::Level;
use worker::scene::{Material, Scene, Triangle};
use worker::settings::Settings;

use super::{byte, pieces};

const PIECES_MAX: usize = 128;

/// What owners and workers say is refused or done. No tile is told twice, none is missing in a frame that is done; a worker
/// makes pixels and sound records of whatever specification both sides take.
pub fn frame(data: &[u8]) {
    let mut board = Board::default();
    for (kind, bytes) in pieces(data).take(PIECES_MAX) {
        board.hear(kind, bytes);
    }
    for frame in board.open.clone() {
        board.listen(frame);
    }
}

struct Board {
    frames: Frames,
    now: Duration,
    leases: Vec<(String, v1::Lease)>,
    open: Vec<u64>,
    told: BTreeSet<(u64, u32)>,
}

impl Default for Board {
    fn default() -> Self {
        let (leases, open, told) = Default::default();
        let mut board = Self { frames: Frames::new(Limits::default(), 1), now: Duration::ZERO, leases, open, told };
        board.open(spec());
        board
    }
}

/// A sound frame of 3 x 2 tiles.
pub fn spec() -> v1::FrameSpec {
    let vector = |x: f32, y: f32, z: f32| Some(v1::Vector { x, y, z });
    v1::FrameSpec {
        scene: "scene.glb".into(),
        scene_hash: vec![1; 32].into(),
        namespace: vec![2; 32].into(),
        camera: Some(v1::CameraSpec {
            eye: vector(0.0, 0.0, 3.0),
            forward: vector(0.0, 0.0, -1.0),
            right: vector(0.5, 0.0, 0.0),
            up: vector(0.0, 0.4, 0.0),
            parallel: false,
        }),
        width: 40,
        height: 20,
        tile_size: 16,
        spp: 1,
        method: "irradiance".into(),
        a: 0.3,
        rays: 16,
        bounces: 1,
        seed: 0,
        levels: 1,
        adaptive: false,
        splat: false,
        effort: None,
    }
}

impl Board {
    fn hear(&mut self, kind: u8, bytes: &[u8]) {
        let worker = format!("w{}", byte(bytes, 0) % 4);
        match kind % 10 {
            0 => {
                if let Ok(v1::OpenRequest { spec: Some(spec), .. }) = v1::OpenRequest::decode(bytes) {
                    rendered(&spec);
                    self.open(spec);
                }
            }
            1 => {
                if let Ok(request) = v1::CompleteRequest::decode(bytes) {
                    self.complete(request);
                }
            }
            2 => self.lease(&worker, u32::from(byte(bytes, 1)).pow(4)),
            // A lease completed with what it should bring, and sometimes more or less.
            3 => self.finish(bytes),
            4 => drop(self.frames.renew(&worker, &self.leases.iter().map(|(_, lease)| lease.id).collect(), self.now)),
            5 => self.frames.leave(&worker),
            6 => {
                let reason = String::from_utf8_lossy(bytes).repeat(1 + usize::from(byte(bytes, 2)));
                let (frame, for_all) = (byte(bytes, 1).into(), byte(bytes, 3) % 2 == 1);
                let request = v1::DeclineRequest { worker, frame, reason, for_all };
                drop(self.frames.decline(request, self.now));
            }
            7 => {
                self.now += Duration::from_millis(100 * u64::from(byte(bytes, 0)));
                self.frames.tick(self.now);
            }
            8 => self.listen(byte(bytes, 0).into()),
            _ => {
                let frame = byte(bytes, 0).into();
                self.frames.close(frame);
                self.open.retain(|open| *open != frame);
            }
        }
        if let Some(filled) = self.frames.take_changes().filled {
            self.frames.published(filled.frame);
        }
    }

    fn open(&mut self, spec: v1::FrameSpec) {
        let Ok(job) = Job::check(spec) else { return };
        assert_eq!((0..job.tiles.min(64)).map(|t| job.pixels(t)).filter(|pixels| *pixels == 0).count(), 0);
        let origin =
            Origin { tenant: Tenant::default(), base: Mark::default(), draft: Namespace([3; 32]), filled: false };
        self.open.extend(self.frames.open(job, origin, |_, _| Mark::default()));
    }

    fn lease(&mut self, worker: &str, threads: u32) {
        if let Ok(Some(lease)) = self.frames.lease(&Tenant::default(), worker, threads, self.now) {
            assert!(lease.tile_from < lease.tile_to);
            self.leases.push((worker.into(), lease));
        }
    }

    fn complete(&mut self, request: v1::CompleteRequest) {
        drop(self.frames.complete(request, self.now, |_, _| Mark::default()));
    }

    fn finish(&mut self, bytes: &[u8]) {
        if self.leases.is_empty() {
            return;
        }
        let [at, gathered, size, more] = [0, 1, 2, 3].map(|at| byte(bytes, at));
        let (worker, lease) = self.leases.swap_remove(usize::from(at) % self.leases.len());
        let Ok(frame) = self.frames.frame(&Tenant::default(), lease.frame) else { return };
        let pixels = lease.step.as_ref().is_some_and(|step| step.level == 0);
        let last = if pixels { lease.tile_to + u32::from(more % 8 == 7) } else { lease.tile_from };
        let job = frame.job();
        let tile = |tile: u32| {
            let bytes = if tile < job.tiles { job.pixels(tile) * 4 * usize::from(size % 18).max(1) } else { 4 };
            v1::FrameTile { tile, pixels: vec![0; bytes].into() }
        };
        let tiles = (lease.tile_from..last).map(tile).collect();
        let counts = vec![v1::Count { name: format!("count {}", more >> 3), value: f64::MAX }];
        let (lease, frame, gathered) = (lease.id, lease.frame, gathered.into());
        self.complete(v1::CompleteRequest {
            worker,
            lease,
            frame,
            gathered,
            tiles,
            counts,
            worked_seconds: f64::from(byte(bytes, 4)) / 64.0,
            used: None,
        });
    }

    fn listen(&mut self, frame: u64) {
        while let News::Tell(event) = self.frames.news(frame, |_, _| Mark::default()) {
            match event.event {
                Some(Event::Tile(tile)) => assert!(self.told.insert((frame, tile.tile)), "tile {} twice", tile.tile),
                Some(Event::Done(_)) => {
                    let tiles = self.frames.frame(&Tenant::default(), frame).expect("open").job().tiles;
                    assert_eq!(self.told.range((frame, 0)..=(frame, u32::MAX)).count() as u64, u64::from(tiles));
                }
                Some(Event::Declined(declined)) => assert!(declined.reason.len() <= 1024),
                _ => (),
            }
        }
    }
}

/// A few pixels of what a worker takes, in as little work as it allows.
fn rendered(spec: &v1::FrameSpec) {
    let Ok(settings) = worker::spec::settings(spec) else { return };
    assert!(settings.tiles() > 0 && settings.tile(settings.tiles() - 1).iter().all(|edge| *edge <= 65536));
    let settings = Settings { spp: 1, rays: settings.rays.min(64), bounces: settings.bounces.min(2), ..settings };
    let few = settings.width.min(8) * settings.height.min(8);
    let frame = worker::frame::Frame::new(room(), Settings { width: few, height: few, ..settings });
    let mut levels: Vec<_> =
        (0..frame.levels()).map(|_| Level::new(frame.settings().a, frame.settings().details)).collect();
    for level in (1..=frame.levels()).rev() {
        // The fifth pass refines.
        for pass in [0, 4] {
            let (records, _) = frame.fill(level, pass, 0..64, 0, &levels, &|_| None);
            for record in &records {
                assert_eq!(record.check(), Ok(()));
            }
            levels[level as usize - 1].unite(&records);
        }
    }
    drop(frame.pixels(0, &levels));
}

/// A lit floor and a wall.
fn room() -> Scene {
    static ROOM: OnceLock<Scene> = OnceLock::new();
    let material = |color, emission| Material { emission, ..Material::diffuse(color) };
    let triangle = |positions, material| Triangle { positions, normals: None, uvs: [Vec2::ZERO; 3], material };
    let room = || Scene {
        triangles: vec![
            triangle([Vec3::new(-9.0, -1.0, 9.0), Vec3::new(9.0, -1.0, 9.0), Vec3::new(0.0, -1.0, -9.0)], 0),
            triangle([Vec3::new(-9.0, -9.0, -2.0), Vec3::new(9.0, -9.0, -2.0), Vec3::new(0.0, 9.0, -2.0)], 0),
            triangle([Vec3::new(-1.0, 2.0, 1.0), Vec3::new(0.0, 2.0, -1.0), Vec3::new(1.0, 2.0, 1.0)], 1),
        ],
        materials: vec![material(Vec3::splat(0.5), Vec3::ZERO), material(Vec3::ZERO, Vec3::splat(5.0))],
        hash: [1; 32],
        ..Scene::default()
    };
    ROOM.get_or_init(room).clone()
}
