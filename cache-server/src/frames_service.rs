//! The `Frames` service: work is leased, its results come back, owners are told.

use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use cache_core::Namespace;
use cache_proto::convert::Malformed;
use cache_proto::v1;
use cache_proto::v1::frames_server::Frames as FramesTrait;
use tokio_stream::Stream;
use tokio_stream::wrappers::WatchStream;
use tonic::{Request, Response, Status};

use crate::bell::Bell;
use crate::clock::Clock;
use crate::frame::News;
use crate::frames::Frames;
use crate::refusal::{Refusal, same_version};
use crate::replica::Mark;
use crate::spec;
use crate::store::{Store, lock};

/// How long a worker waits for a lease before it is told to ask again.
const LEASE_WAIT: Duration = Duration::from_secs(10);

/// The frames shared between tasks, with the bells that tell of work and news.
///
/// The lock is held for one transition and never across an await. Order where both are taken: frames, replica.
pub struct Board {
    frames: Mutex<Frames>,
    store: Arc<Store>,
    clock: Clock,
    work: Bell,
    news: Bell,
}

impl Board {
    /// A board without frames; see [`Frames::new`] for `first`.
    pub fn new(store: Arc<Store>, clock: Clock, first: u64) -> Self {
        Self { frames: Mutex::new(Frames::new(first)), store, clock, work: Bell::default(), news: Bell::default() }
    }

    /// Takes back leases whose deadline has come. To be called a few times a second.
    pub fn tick(&self) {
        self.change(|frames, now| frames.tick(now));
    }

    /// Wakes all who wait, and sends them away.
    pub fn close(&self) {
        self.work.close();
        self.news.close();
    }

    /// How many frames are open, and how many workers were heard of lately.
    pub fn census(&self) -> (u64, u64) {
        let frames = lock(&self.frames);
        (frames.frames() as u64, frames.workers() as u64)
    }

    /// One transition; then wakes whom it concerns.
    fn change<T>(&self, transition: impl FnOnce(&mut Frames, Duration) -> T) -> T {
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
        result
    }

    fn mark(&self, namespace: &Namespace) -> Mark {
        self.store.mark(namespace)
    }

    /// Waits for work; `None` when none came up in time.
    async fn lease(&self, worker: &str) -> Result<Option<v1::Lease>, Refusal> {
        let mut work = self.work.listen();
        let wait = tokio::time::sleep(LEASE_WAIT);
        tokio::pin!(wait);
        loop {
            if self.work.is_closed() {
                return Err(Refusal::Closing);
            }
            if let Some(lease) = self.change(|frames, now| frames.lease(worker, now))? {
                return Ok(Some(lease));
            }
            tokio::select! {
                _ = work.changed() => (),
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
        let v1::OpenRequest { spec, version, base: _ } = request.into_inner();
        same_version(&version)?;
        let spec = spec.ok_or(Refusal::Malformed(Malformed::Missing("spec")))?;
        let frame = self.0.change(|frames, _| frames.open(spec, |namespace| self.0.mark(namespace)))?;
        tracing::info!(frame, "frame opened");
        Ok(Response::new(Owner::new(self.0.clone(), frame)))
    }

    async fn describe(&self, request: Request<v1::DescribeRequest>) -> Result<Response<v1::DescribeResponse>, Status> {
        let spec = lock(&self.0.frames).describe(request.get_ref().frame)?.clone();
        Ok(Response::new(v1::DescribeResponse { spec: Some(spec), ..Default::default() }))
    }

    async fn lease(&self, request: Request<v1::LeaseRequest>) -> Result<Response<v1::LeaseResponse>, Status> {
        let v1::LeaseRequest { worker, version } = request.into_inner();
        same_version(&version)?;
        let lease = self.0.lease(&worker).await?;
        Ok(Response::new(v1::LeaseResponse { lease }))
    }

    async fn renew(&self, request: Request<v1::RenewRequest>) -> Result<Response<v1::RenewResponse>, Status> {
        let worker = request.into_inner().worker;
        spec::worker_name(&worker)?;
        let leases = self.0.change(|frames, now| frames.renew(&worker, now));
        Ok(Response::new(v1::RenewResponse { leases }))
    }

    async fn complete(&self, request: Request<v1::CompleteRequest>) -> Result<Response<v1::CompleteResponse>, Status> {
        let request = request.into_inner();
        spec::worker_name(&request.worker)?;
        let mark = |namespace: &_| self.0.mark(namespace);
        let accepted = self.0.change(|frames, now| frames.complete(request, now, mark))?;
        Ok(Response::new(v1::CompleteResponse { accepted }))
    }

    async fn decline(&self, request: Request<v1::DeclineRequest>) -> Result<Response<v1::DeclineResponse>, Status> {
        let v1::DeclineRequest { worker, frame, reason } = request.into_inner();
        self.0.change(|frames, now| frames.decline(&worker, frame, reason, now))?;
        Ok(Response::new(v1::DeclineResponse {}))
    }

    async fn leave(&self, request: Request<v1::LeaveRequest>) -> Result<Response<v1::LeaveResponse>, Status> {
        let worker = request.into_inner().worker;
        spec::worker_name(&worker)?;
        self.0.change(|frames, _| frames.leave(&worker));
        Ok(Response::new(v1::LeaveResponse {}))
    }
}

/// What the owner of a frame hears. Dropping it cancels the frame.
pub struct Owner {
    board: Arc<Board>,
    news: WatchStream<bool>,
    frame: u64,
    ended: bool,
}

impl Owner {
    fn new(board: Arc<Board>, frame: u64) -> Self {
        let news = WatchStream::from_changes(board.news.listen());
        Self { board, news, frame, ended: false }
    }

    fn look(&self) -> Result<News, Refusal> {
        if self.board.news.is_closed() {
            return Err(Refusal::Closing);
        }
        Ok(self.board.change(|frames, _| frames.news(self.frame, |namespace| self.board.mark(namespace))))
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
        tracing::info!(frame = self.frame, "frame closed");
    }
}
