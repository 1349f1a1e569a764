//! The `Frames` service: work is leased, its results come back, owners are told.

use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use cache_core::Namespace;
use cache_core::id::Digest;
use cache_proto::convert::{self, Malformed};
use cache_proto::v1;
use cache_proto::v1::frames_server::Frames as FramesTrait;
use prost::Message as _;
use tokio_stream::Stream;
use tonic::{Request, Response, Status, Streaming};

use crate::access::{Tenant, tenant};
use crate::bell::{Bell, Listener};
use crate::clock::Clock;
use crate::frame::{News, Origin};
use crate::frames::{Changes, Filled, Frames};
use crate::limits::Limits;
use crate::refusal::Refusal;
use crate::replica::Mark;
use crate::scenes::{Reading, Scenes};
use crate::spec::{self, Job};
use crate::store::{Store, lock};

/// How long a worker waits for a lease before it is told to ask again.
const LEASE_WAIT: Duration = Duration::from_secs(10);

/// How long a frame that is opened again waits for the records it was begun with, when the server lost its own: workers
/// bring them back.
const REFILL_WAIT: Duration = Duration::from_secs(10);

/// Pause before a journal that failed is asked again to keep a publication.
const PUBLISH_AGAIN: Duration = Duration::from_millis(500);

/// The frames shared between tasks, with the bells that tell of work and news.
///
/// The lock is held for one transition and never across an await. Order where both are taken: frames, replica.
pub struct Board {
    frames: Mutex<Frames>,
    store: Arc<Store>,
    scenes: Arc<Scenes>,
    clock: Clock,
    work: Bell,
    news: Bell,
}

impl Board {
    /// A board without frames; see [`Frames::new`] for `first`.
    pub fn new(store: Arc<Store>, clock: Clock, limits: Limits, first: u64) -> Self {
        Self {
            frames: Mutex::new(Frames::new(limits, first)),
            store,
            scenes: Arc::default(),
            clock,
            work: Bell::default(),
            news: Bell::default(),
        }
    }

    /// Takes back leases whose deadline has come. To be called a few times a second.
    pub fn tick(&self) {
        self.change(|frames, now| frames.tick(now));
    }

    /// Wakes all who wait, and sends them away.
    pub fn close(&self) {
        self.work.close();
        self.news.close();
        self.scenes.close();
    }

    /// How many frames are open, and how many workers were heard of lately.
    pub fn census(&self) -> (u64, u64) {
        let frames = lock(&self.frames);
        (frames.frames() as u64, frames.workers() as u64)
    }

    /// How many leases are held, and how old the oldest is.
    pub fn leases(&self) -> (u64, Duration) {
        let (held, since) = lock(&self.frames).leases();
        (held as u64, since.map_or(Duration::ZERO, |since| self.clock.now().saturating_sub(since)))
    }

    /// One transition; then wakes whom it concerns.
    fn change<T>(&self, transition: impl FnOnce(&mut Frames, Duration) -> T) -> T {
        self.change_and(transition).0
    }

    fn change_and<T>(&self, transition: impl FnOnce(&mut Frames, Duration) -> T) -> (T, Changes) {
        let (result, changes) = {
            let mut frames = lock(&self.frames);
            let result = transition(&mut frames, self.clock.now());
            (result, frames.take_changes())
        };
        if changes.work {
            self.work.ring();
        }
        if changes.news {
            self.news.ring();
        }
        (result, changes)
    }

    fn mark(&self, draft: &Namespace, step: u32) -> Mark {
        self.store.replica().mark_before(draft, step)
    }

    /// Opens a frame of a tenant: finds its base, begins its draft. Returns its number.
    async fn open(&self, tenant: &Tenant, request: v1::OpenRequest) -> Result<(u64, Namespace), Refusal> {
        let v1::OpenRequest { spec, base: before, filled } = request;
        let job = Job::check(spec.ok_or(Refusal::Malformed(Malformed::Missing("spec")))?)?;
        let namespace = job.namespace;
        self.store.replica().belongs(&namespace, tenant.name())?;
        if self.store.replica().is_draft(&namespace) {
            return Err(Refusal::field(
                "namespace",
                "is the draft of a frame, expected that of a scene and its settings",
            ));
        }
        let before = if before.is_empty() { None } else { Some(convert::digest(&before)?) };
        let base = match before {
            None => self.store.mark(&namespace),
            Some(digest) => self.base(&namespace, digest).await,
        };
        let effort = job.spec.effort.map(|effort| v1::Effort { samples: 0.0, ..effort });
        let view = v1::FrameSpec { scene: String::new(), spp: 0, splat: false, effort, ..job.spec.clone() };
        let view = [view.encode_to_vec(), cache_proto::VERSION.into()].concat();
        let draft_after = |digest| namespace.draft(digest, &view);
        let draft = draft_after(base.sum.digest);
        let filled = match before {
            // Publications may be lost with a server: what the first attempt was told counts.
            Some(digest) if digest == base.sum.digest => filled,
            _ => self.store.replica().is_filled(&namespace, base.position, draft_after),
        };
        if job.spec.levels > 0 {
            self.store.label(label(&job, tenant.name(), namespace, None)).await?;
            if !filled {
                self.store.label(label(&job, tenant.name(), draft, Some(namespace))).await?;
            }
            self.store.hold(draft);
        }
        let origin = Origin { tenant: tenant.clone(), base, draft, filled };
        let opened = self.change(|frames, _| frames.open(job, origin, |draft, step| self.mark(draft, step)));
        if opened.is_err() {
            self.store.release(&draft);
        }
        Ok((opened?, draft))
    }

    /// The beginning of a namespace's log that has this digest. If it does not come up in time, the whole log.
    async fn base(&self, namespace: &Namespace, digest: Digest) -> Mark {
        let mut grown = self.store.grown().listen();
        let wait = tokio::time::sleep(REFILL_WAIT);
        tokio::pin!(wait);
        loop {
            // The whole log is by far the most likely, and looking for its beginnings takes time.
            let whole = self.store.mark(namespace);
            let found =
                if whole.sum.digest == digest { Some(whole) } else { self.store.replica().find(namespace, digest) };
            if let Some(mark) = found {
                return mark;
            }
            tokio::select! {
                biased;
                () = grown.changed(), if !self.store.grown().is_closed() => (),
                () = &mut wait => return self.store.mark(namespace),
            }
        }
    }

    /// Publishes what a frame gathered, as soon as the disk has room; then lets its owner hear that it is done.
    async fn publish(self: Arc<Self>, filled: Filled) {
        let Filled { frame, draft, namespace } = filled;
        while let Err(refusal) = self.store.publish(draft, namespace).await {
            tracing::warn!(frame, "the records of a filled frame stay a draft: {refusal}");
            // For any other reason it stays one: the picture does not need more, and a frame begun again finds it.
            if !matches!(refusal, Refusal::Journal(_)) || !lock(&self.frames).is_open(frame) {
                break;
            }
            tokio::time::sleep(PUBLISH_AGAIN).await;
        }
        self.change(|frames, _| frames.published(frame));
    }

    /// Waits for work; `None` when none came up in time.
    async fn lease(&self, tenant: &Tenant, worker: &str, threads: u32) -> Result<Option<v1::Lease>, Refusal> {
        let mut work = self.work.listen();
        let wait = tokio::time::sleep(LEASE_WAIT);
        tokio::pin!(wait);
        loop {
            if self.work.is_closed() {
                return Err(Refusal::Closing);
            }
            if let Some(lease) = self.change(|frames, now| frames.lease(tenant, worker, threads, now))? {
                return Ok(Some(lease));
            }
            tokio::select! {
                biased;
                () = work.changed() => (),
                () = &mut wait => return Ok(None),
            }
        }
    }
}

/// Implements `Frames` over a board.
pub struct FramesService(Arc<Board>);

impl FramesService {
    /// Serves `board`.
    pub fn new(board: Arc<Board>) -> Self {
        Self(board)
    }
}

#[tonic::async_trait]
impl FramesTrait for FramesService {
    type OpenStream = Owner;

    async fn open(&self, request: Request<v1::OpenRequest>) -> Result<Response<Owner>, Status> {
        let tenant = tenant(&request);
        let (frame, draft) = self.0.open(&tenant, request.into_inner()).await?;
        tracing::info!(frame, "frame opened");
        Ok(Response::new(Owner::new(self.0.clone(), frame, draft)))
    }

    async fn describe(&self, request: Request<v1::DescribeRequest>) -> Result<Response<v1::DescribeResponse>, Status> {
        let frames = lock(&self.0.frames);
        let frame = frames.frame(&tenant(&request), request.get_ref().frame)?;
        let origin = frame.origin();
        Ok(Response::new(v1::DescribeResponse {
            spec: Some(frame.job().spec.clone()),
            draft: origin.draft.0.to_vec().into(),
            base_position: origin.base.position,
            base_digest: convert::digest_bytes(origin.base.sum.digest),
        }))
    }

    async fn lease(&self, request: Request<v1::LeaseRequest>) -> Result<Response<v1::LeaseResponse>, Status> {
        let tenant = tenant(&request);
        let v1::LeaseRequest { worker, threads } = request.into_inner();
        let lease = self.0.lease(&tenant, &named(&tenant, &worker)?, threads).await?;
        Ok(Response::new(v1::LeaseResponse { lease }))
    }

    async fn renew(&self, request: Request<v1::RenewRequest>) -> Result<Response<v1::RenewResponse>, Status> {
        let worker = named(&tenant(&request), &request.get_ref().worker)?;
        let leases = request.into_inner().leases.into_iter().collect();
        let leases = self.0.change(|frames, now| frames.renew(&worker, &leases, now));
        Ok(Response::new(v1::RenewResponse { leases }))
    }

    async fn complete(&self, request: Request<v1::CompleteRequest>) -> Result<Response<v1::CompleteResponse>, Status> {
        let worker = named(&tenant(&request), &request.get_ref().worker)?;
        let request = v1::CompleteRequest { worker, ..request.into_inner() };
        let mark = |draft: &Namespace, step| self.0.mark(draft, step);
        let (accepted, changes) = self.0.change_and(|frames, now| frames.complete(request, now, mark));
        let accepted = accepted?;
        if let Some(filled) = changes.filled {
            // Whoever brought the last records may be gone before they are published.
            tokio::spawn(self.0.clone().publish(filled));
        }
        Ok(Response::new(v1::CompleteResponse { accepted }))
    }

    async fn decline(&self, request: Request<v1::DeclineRequest>) -> Result<Response<v1::DeclineResponse>, Status> {
        let tenant = tenant(&request);
        let mut request = request.into_inner();
        request.worker = named(&tenant, &request.worker)?;
        lock(&self.0.frames).frame(&tenant, request.frame)?;
        self.0.change(|frames, now| frames.decline(request, now))?;
        Ok(Response::new(v1::DeclineResponse {}))
    }

    type SceneStream = Reading;

    async fn scene(&self, request: Request<v1::SceneRequest>) -> Result<Response<Reading>, Status> {
        let (tenant, frame) = (tenant(&request), request.get_ref().frame);
        let board = &self.0;
        // Within the transition, so that whoever closes the frame forgets the scene after this.
        let wanted = board.change(|frames, _| {
            frames.frame(&tenant, frame)?;
            frames.want_scene(frame);
            board.scenes.want(frame);
            Ok::<_, Refusal>(())
        });
        wanted?;
        Ok(Response::new(board.scenes.read(frame)))
    }

    async fn offer(
        &self,
        request: Request<Streaming<v1::OfferRequest>>,
    ) -> Result<Response<v1::OfferResponse>, Status> {
        let tenant = tenant(&request);
        let mut said = request.into_inner();
        let first = said.message().await?.ok_or(Refusal::Malformed(Malformed::Missing("part")))?;
        lock(&self.0.frames).frame(&tenant, first.frame)?;
        let sending = self.0.scenes.begin(first.frame)?;
        let mut next = Some(first);
        while let Some(request) = next {
            sending.take(request)?;
            next = said.message().await?;
        }
        sending.whole();
        Ok(Response::new(v1::OfferResponse {}))
    }

    async fn leave(&self, request: Request<v1::LeaveRequest>) -> Result<Response<v1::LeaveResponse>, Status> {
        let worker = named(&tenant(&request), &request.get_ref().worker)?;
        self.0.change(|frames, _| frames.leave(&worker));
        Ok(Response::new(v1::LeaveResponse {}))
    }
}

/// What a frame's namespace or draft is, for people.
fn label(job: &Job, tenant: &str, namespace: Namespace, draft_of: Option<Namespace>) -> v1::Label {
    let spec = &job.spec;
    let name = std::path::Path::new(&spec.scene).file_name().and_then(|name| name.to_str()).unwrap_or(&spec.scene);
    v1::Label {
        namespace: namespace.0.to_vec().into(),
        scene: name.into(),
        scene_hash: spec.scene_hash.clone(),
        method: spec.method.clone(),
        a: spec.a,
        rays: spec.rays,
        rays_by_deviation: spec.effort.map_or(0.0, |effort| effort.rays),
        least_rays: spec.effort.map_or(0, |effort| effort.least_rays),
        bounces: spec.bounces,
        seed: spec.seed,
        owner: tenant.into(),
        draft_of: draft_of.map_or_else(Default::default, |namespace| namespace.0.to_vec().into()),
    }
}

/// A worker's name among those of all tenants.
fn named(tenant: &Tenant, worker: &str) -> Result<String, Refusal> {
    spec::worker_name(worker)?;
    Ok(if tenant.name().is_empty() { worker.into() } else { format!("{}/{worker}", tenant.name()) })
}

/// What the owner of a frame hears. Dropping it cancels the frame.
pub struct Owner {
    board: Arc<Board>,
    news: Listener,
    frame: u64,
    draft: Namespace,
    ended: bool,
}

impl Owner {
    fn new(board: Arc<Board>, frame: u64, draft: Namespace) -> Self {
        let news = board.news.listen();
        Self { board, news, frame, draft, ended: false }
    }

    fn look(&self) -> Result<News, Refusal> {
        if self.board.news.is_closed() {
            return Err(Refusal::Closing);
        }
        Ok(self.board.change(|frames, _| frames.news(self.frame, |draft, step| self.board.mark(draft, step))))
    }
}

impl Stream for Owner {
    type Item = Result<v1::FrameEvent, Status>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        while !self.ended {
            match self.look() {
                Ok(News::Tell(event)) => return Poll::Ready(Some(Ok(*event))),
                Ok(News::Wait) => self.ended = ready!(Pin::new(&mut self.news).poll_next(context)).is_none(),
                Ok(News::End) => self.ended = true,
                Err(refusal) => {
                    self.ended = true;
                    return Poll::Ready(Some(Err(refusal.into())));
                }
            }
        }
        Poll::Ready(None)
    }
}

impl Drop for Owner {
    fn drop(&mut self) {
        self.board.change(|frames, _| frames.close(self.frame));
        self.board.scenes.forget(self.frame);
        self.board.store.release(&self.draft);
        tracing::info!(frame = self.frame, "frame closed");
    }
}
