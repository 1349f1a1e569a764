//! The `Cache` service: records in, records out, answers.

use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll, ready};

use cache_core::Namespace;
use cache_proto::convert::{self, Malformed};
use cache_proto::v1;
use cache_proto::v1::cache_server::Cache;
use tokio_stream::Stream;
use tokio_stream::wrappers::WatchStream;
use tonic::{Request, Response, Status, Streaming};

use crate::frames_service::Board;
use crate::query::Queries;
use crate::refusal::Refusal;
use crate::replica::Added;
use crate::store::{Counted, Store};

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
        let mut batches = request.into_inner();
        let (mut total, mut index) = (Added::default(), 0);
        while let Some(request) = batches.message().await? {
            let batch = request.batch.ok_or(Refusal::Malformed(Malformed::Missing("batch")));
            let added = batch.and_then(|batch| self.store.insert(&batch));
            let added = added.map_err(|reason| Refusal::Batch { index, reason: Box::new(reason) })?;
            total = Added { added: total.added + added.added, position: added.position };
            index += 1;
        }
        Ok(Response::new(v1::InsertResponse { added: total.added, position: total.position }))
    }

    type SubscribeStream = Subscription;

    async fn subscribe(&self, request: Request<v1::SubscribeRequest>) -> Result<Response<Subscription>, Status> {
        let v1::SubscribeRequest { namespace, position, digest: _ } = request.into_inner();
        let namespace = convert::namespace(&namespace).map_err(Refusal::from)?;
        let subscription = Subscription::new(&self.store, namespace, position);
        // Told before the stream begins, so that the client learns it from the call itself.
        self.store.replica().since(&namespace, position)?;
        Ok(Response::new(subscription))
    }

    async fn query(&self, request: Request<v1::QueryRequest>) -> Result<Response<v1::QueryResponse>, Status> {
        let answers = self.queries.answer(request.get_ref()).await?;
        Ok(Response::new(v1::QueryResponse { answers: answers.into() }))
    }

    async fn info(&self, _: Request<v1::InfoRequest>) -> Result<Response<v1::InfoResponse>, Status> {
        let (frames, workers) = self.board.census();
        Ok(Response::new(v1::InfoResponse {
            version: cache_proto::VERSION.into(),
            namespaces: self.store.replica().info(),
            subscribers: self.store.subscribers(),
            workers,
            frames,
        }))
    }
}

/// Reads the shared log by position, as fast as its client takes it. It has no queue: a slow client costs the buffer of
/// its own socket and holds nobody back.
pub struct Subscription {
    store: Counted,
    grown: WatchStream<bool>,
    namespace: Namespace,
    position: u64,
    ended: bool,
}

impl Subscription {
    fn new(store: &Arc<Store>, namespace: Namespace, position: u64) -> Self {
        let grown = WatchStream::from_changes(store.grown().listen());
        Self { store: store.count_subscriber(), grown, namespace, position, ended: false }
    }

    fn read(&mut self) -> Result<Option<v1::SubscribeResponse>, Refusal> {
        let store = self.store.store();
        if store.grown().is_closed() {
            return Err(Refusal::Closing);
        }
        let Some((count, batch)) = store.replica().read(&self.namespace, self.position)? else { return Ok(None) };
        let position = self.position;
        self.position += count;
        Ok(Some(v1::SubscribeResponse { batch: Some(batch), position, end: 0 }))
    }
}

impl Stream for Subscription {
    type Item = Result<v1::SubscribeResponse, Status>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        while !self.ended {
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
