//! The `Cache` service: records in, records out, answers.

use std::collections::VecDeque;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use cache_core::Namespace;
use cache_proto::convert::{self, Malformed};
use cache_proto::v1;
use cache_proto::v1::cache_server::Cache;
use tokio::time::Sleep;
use tokio_stream::Stream;
use tonic::{Request, Response, Status, Streaming};

use crate::access::{Tenant, tenant};
use crate::bell::Listener;
use crate::frames_service::Board;
use crate::query::Queries;
use crate::refusal::Refusal;
use crate::replica::Added;
use crate::store::{Counted, Keeping, Store};

/// Most batches of one insert that wait to become durable.
const UNDER_WAY_MAX: usize = 8;

/// A subscriber that has everything hears of more after this long for each subscription the server has, so that many of
/// them take half a core or less, and each message carries what came meanwhile.
const PACE: Duration = Duration::from_micros(20);

/// Shorter than this no timer waits.
const PACE_LEAST: Duration = Duration::from_millis(1);

/// Implements `Cache` over a store.
pub struct CacheService {
    store: Arc<Store>,
    queries: Arc<Queries>,
    board: Arc<Board>,
}

impl CacheService {
    /// Serves `store`; `board` only lends its numbers to `Info`.
    pub fn new(store: Arc<Store>, board: Arc<Board>) -> Self {
        Self { queries: Arc::new(Queries::new(store.clone())), store, board }
    }
}

#[tonic::async_trait]
impl Cache for CacheService {
    async fn insert(
        &self,
        request: Request<Streaming<v1::InsertRequest>>,
    ) -> Result<Response<v1::InsertResponse>, Status> {
        let tenant = tenant(&request);
        let mut batches = request.into_inner();
        let mut insert = Insert::default();
        while let Some(request) = batches.message().await? {
            let batch = request.batch.ok_or(Refusal::Malformed(Malformed::Missing("batch")));
            let queued = match batch {
                Ok(batch) => self.store.insert(tenant.name(), batch).await,
                Err(refusal) => Err(refusal),
            };
            insert.queued(queued).await?;
        }
        let total = insert.end().await?;
        Ok(Response::new(v1::InsertResponse { added: total.added, position: total.position }))
    }

    type SubscribeStream = Subscription;

    async fn subscribe(&self, request: Request<v1::SubscribeRequest>) -> Result<Response<Subscription>, Status> {
        let tenant = tenant(&request);
        let v1::SubscribeRequest { namespace, position, digest } = request.into_inner();
        let namespace = convert::namespace(&namespace).map_err(Refusal::from)?;
        let position = if digest.is_empty() {
            position
        } else {
            let digest = convert::digest(&digest).map_err(Refusal::from)?;
            self.store.replica().resume(&namespace, position, digest)
        };
        let subscription = Subscription::new(&self.store, tenant, namespace, position)?;
        // Told before the stream begins, so that the client learns it from the call itself.
        self.store.replica().belongs(&namespace, subscription.tenant.name())?;
        self.store.replica().since(&namespace, position)?;
        Ok(Response::new(subscription))
    }

    async fn query(&self, request: Request<v1::QueryRequest>) -> Result<Response<v1::QueryResponse>, Status> {
        let answers = self.queries.answer(tenant(&request).name(), request.get_ref()).await?;
        Ok(Response::new(v1::QueryResponse { answers: answers.into() }))
    }

    async fn info(&self, request: Request<v1::InfoRequest>) -> Result<Response<v1::InfoResponse>, Status> {
        let (frames, workers) = self.board.census();
        Ok(Response::new(v1::InfoResponse {
            version: cache_proto::VERSION.into(),
            namespaces: self.store.replica().info(tenant(&request).name()),
            subscribers: self.store.subscribers(),
            workers,
            frames,
        }))
    }
}

/// An insert under way: batches are checked and queued while those before them become durable.
#[derive(Default)]
struct Insert {
    index: u64,
    under_way: VecDeque<Keeping>,
    total: Added,
}

impl Insert {
    async fn queued(&mut self, queued: Result<Keeping, Refusal>) -> Result<(), Refusal> {
        match queued {
            Ok(keeping) => self.under_way.push_back(keeping),
            Err(reason) => {
                // Those before it are kept, as the refusal says.
                let index = self.index + self.under_way.len() as u64;
                self.settle(0).await?;
                return Err(Refusal::Batch { index, reason: Box::new(reason) });
            }
        }
        self.settle(UNDER_WAY_MAX).await
    }

    async fn settle(&mut self, most: usize) -> Result<(), Refusal> {
        while self.under_way.len() > most
            && let Some(keeping) = self.under_way.pop_front()
        {
            let index = self.index;
            let added = keeping.kept().await.map_err(|reason| Refusal::Batch { index, reason: Box::new(reason) })?;
            self.total = Added { added: self.total.added + added.added, position: added.position };
            self.index += 1;
        }
        Ok(())
    }

    async fn end(mut self) -> Result<Added, Refusal> {
        self.settle(0).await?;
        Ok(self.total)
    }
}

/// Reads the shared log by position, as fast as its client takes it. It has no queue: a slow client costs the buffer of
/// its own socket and holds nobody back.
pub struct Subscription {
    store: Counted,
    grown: Listener,
    /// It was told something and is told no more for a while.
    rest: Option<Pin<Box<Sleep>>>,
    tenant: Tenant,
    namespace: Namespace,
    position: u64,
    /// The client was told where it starts.
    started: bool,
    ended: bool,
}

impl Subscription {
    fn new(store: &Arc<Store>, tenant: Tenant, namespace: Namespace, position: u64) -> Result<Self, Refusal> {
        let grown = store.grown().listen();
        let store = store.count_subscriber()?;
        Ok(Self { store, grown, rest: None, tenant, namespace, position, started: false, ended: false })
    }

    fn read(&mut self) -> Result<Option<v1::SubscribeResponse>, Refusal> {
        let store = self.store.store();
        if store.grown().is_closed() {
            return Err(Refusal::Closing);
        }
        let (replica, position) = (store.replica(), self.position);
        // It may have come to be since the subscription began.
        replica.belongs(&self.namespace, self.tenant.name())?;
        if !std::mem::replace(&mut self.started, true) {
            let end = replica.mark(&self.namespace).position;
            return Ok(Some(v1::SubscribeResponse { batch: None, position, end }));
        }
        let Some((count, batch)) = replica.read(&self.namespace, position)? else { return Ok(None) };
        self.position += count;
        let pace = PACE * u32::try_from(store.subscribers()).unwrap_or(u32::MAX);
        if pace >= PACE_LEAST && replica.since(&self.namespace, self.position)?.is_empty() {
            self.rest = Some(Box::pin(tokio::time::sleep(pace)));
        }
        Ok(Some(v1::SubscribeResponse { batch: Some(batch), position, end: 0 }))
    }
}

impl Stream for Subscription {
    type Item = Result<v1::SubscribeResponse, Status>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        while !self.ended {
            if let Some(rest) = &mut self.rest {
                ready!(rest.as_mut().poll(context));
                self.rest = None;
            }
            match self.read() {
                Ok(Some(response)) => return Poll::Ready(Some(Ok(response))),
                Ok(None) => self.ended = ready!(Pin::new(&mut self.grown).poll_next(context)).is_none(),
                Err(refusal) => {
                    self.ended = true;
                    return Poll::Ready(Some(Err(refusal.into())));
                }
            }
        }
        Poll::Ready(None)
    }
}
