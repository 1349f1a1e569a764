//! A splat node: a worker that fills as all do, and whose device interpolates the pixels of frames that ask for it.

use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use cache_proto::v1;
use worker::frame::Frame;
use worker::job::{Job, Work};
use worker::levels::Reflected;
use worker::scenes::Scenes;
use worker::splat::{Look, Lost, Splat};
use worker::task::{self, CpuClock, Done};
use worker::threads::{lock, off_thread};

use crate::device::Gpu;
use crate::splatter::Splatter;

/// A frame, and the device that interpolates it as long as there is one.
pub struct Node {
    frame: Frame,
    drawing: Mutex<Drawing>,
    /// Whether the loss of the device was told.
    told: AtomicBool,
}

/// What all leases of a frame share.
struct Drawing {
    /// The device; `None` when there is none, or none any more.
    splatter: Option<Splatter>,
    /// Digest of the records on it.
    sealed: Option<Vec<u8>>,
}

impl Node {
    /// A frame whose pixels a device interpolates.
    pub fn new(frame: Frame, gpu: Arc<Gpu>) -> Self {
        let splatter = Splatter::new(gpu, frame.settings());
        Self::with(frame, Some(splatter))
    }

    fn with(frame: Frame, splatter: Option<Splatter>) -> Self {
        Self { frame, drawing: Mutex::new(Drawing { splatter, sealed: None }), told: AtomicBool::new(false) }
    }

    /// What comes of a lease; `None` when nobody waits for it. A device that is lost says so, and from then on the processor does
    /// what it was to do.
    pub fn run(&self, work: &Work) -> Option<Done> {
        match self.splatted(work) {
            Ok(Some(done)) => Some(done),
            Ok(None) => task::run(&self.frame, work),
            Err(lost) => {
                let first = !self.told.swap(true, Ordering::Relaxed);
                if first {
                    tracing::warn!("splatting ends, the octree answers in its place: {lost}");
                }
                let mut done = task::run(&self.frame, work)?;
                done.counts.devices_lost += u64::from(first);
                Some(done)
            }
        }
    }

    /// The pixels of a lease; `None` where it is not of pixels, or there is no device.
    fn splatted(&self, work: &Work) -> Result<Option<Done>, Lost> {
        let Some(level) = work.levels.first().filter(|_| work.step.level == 0) else { return Ok(None) };
        let clock = CpuClock::start();
        let tiles = work.tiles.start..work.tiles.end.min(self.frame.settings().tiles());
        {
            let Drawing { splatter, sealed } = &mut *lock(&self.drawing);
            let Some(splatter) = splatter else { return Ok(None) };
            if sealed.as_ref().is_none_or(|sealed| work.step.sealed_digest != sealed[..]) {
                splatter.load(level);
                *sealed = Some(work.step.sealed_digest.to_vec());
            }
        }
        let (pixels, counts) = self.frame.splatted(tiles.clone(), &work.levels, &mut &self.drawing)?;
        let mut done = Done { counts, ..Done::default() };
        tiles.zip(pixels).for_each(|(tile, pixels)| done.finish(tile, &pixels));
        done.cpu_seconds = clock.seconds();
        Ok(Some(done))
    }
}

impl Job for Node {
    async fn prepare(frame: u64, described: &v1::DescribeResponse, scenes: &Scenes) -> Result<Self, String> {
        let prepared = Frame::prepare(frame, described, scenes).await?;
        if described.spec.as_ref().is_none_or(|spec| !spec.splat) {
            return Ok(Self::with(prepared, None));
        }
        off_thread(move || match Gpu::new(true) {
            Ok(gpu) => Self::new(prepared, Arc::new(gpu)),
            Err(lost) => {
                tracing::warn!("the octree answers in place of a device: {lost}");
                Self::with(prepared, None)
            }
        })
        .await
    }

    fn levels(&self) -> u32 {
        self.frame.levels()
    }

    fn a(&self) -> f32 {
        self.frame.settings().a
    }

    async fn run(self: Arc<Self>, work: Work) -> Result<Option<Done>, String> {
        off_thread(move || Node::run(&self, &work)).await
    }
}

impl Splat for Drawing {
    fn answers(&mut self, looks: &mut dyn Iterator<Item = &Look>) -> Result<Vec<Option<Reflected>>, Lost> {
        let Some(splatter) = &mut self.splatter else { return Err(Lost("another lease lost the device".into())) };
        let answers = splatter.answers(looks);
        if answers.is_err() {
            self.splatter = None;
        }
        answers
    }
}
