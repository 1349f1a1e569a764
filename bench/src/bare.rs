//! The cache service with nothing behind it: the same messages over the same transport, relayed and forgotten, or kept as they came.
//! What the real one is measured against.

use std::fs::File;
use std::io::Write as _;
use std::pin::Pin;
use std::sync::Mutex;

use cache_proto::v1::cache_server::Cache;
use cache_proto::v1::{
    InfoRequest, InfoResponse, InsertRequest, InsertResponse, QueryRequest, QueryResponse, RecordBatch,
    SubscribeRequest, SubscribeResponse,
};
use tokio::sync::broadcast;
use tokio_stream::wrappers::BroadcastStream;
use tokio_stream::{Stream, StreamExt as _};
use tonic::{Request, Response, Status, Streaming};

use crate::work::lock;

/// A subscription from here gets what is inserted from now on; one from 0 the batches that were prepared.
pub const LIVE: u64 = u64::MAX;

/// Batches relayed that a subscriber may lag behind.
const LAG: usize = 1024;

/// The service.
pub struct Bare {
    prepared: Vec<RecordBatch>,
    /// What came, if that is to be kept.
    kept: Option<Mutex<Vec<RecordBatch>>>,
    /// Where its bytes are written, one after another, if they are.
    file: Option<Mutex<File>>,
    live: broadcast::Sender<RecordBatch>,
}

impl Bare {
    /// A service with `prepared` batches to send, that keeps the messages it gets or forgets them, and writes them to
    /// a file if there is one.
    pub fn new(prepared: Vec<RecordBatch>, keeps: bool, file: Option<File>) -> Self {
        let (kept, file) = (keeps.then(Mutex::default), file.map(Mutex::new));
        Self { prepared, kept, file, live: broadcast::Sender::new(LAG) }
    }
}

fn response(batch: RecordBatch) -> Result<SubscribeResponse, Status> {
    Ok(SubscribeResponse { batch: Some(batch), position: 0, end: 0 })
}

#[tonic::async_trait]
impl Cache for Bare {
    async fn insert(&self, request: Request<Streaming<InsertRequest>>) -> Result<Response<InsertResponse>, Status> {
        let mut batches = request.into_inner();
        let mut position = 0;
        while let Some(request) = batches.message().await? {
            let batch = request.batch.ok_or_else(|| Status::invalid_argument("no batch"))?;
            position += 1;
            if let Some(file) = &self.file {
                lock(file).write_all(&batch.records)?;
            }
            if let Some(kept) = &self.kept {
                lock(kept).push(batch.clone());
            }
            // Nobody may listen.
            let _ = self.live.send(batch);
        }
        Ok(Response::new(InsertResponse { added: 0, position }))
    }

    type SubscribeStream = Pin<Box<dyn Stream<Item = Result<SubscribeResponse, Status>> + Send>>;

    async fn subscribe(&self, request: Request<SubscribeRequest>) -> Result<Response<Self::SubscribeStream>, Status> {
        let SubscribeRequest { namespace, position, .. } = request.into_inner();
        let start = tokio_stream::once(Ok(SubscribeResponse { batch: None, position, end: 0 }));
        if position != LIVE {
            let prepared = tokio_stream::iter(self.prepared.clone()).map(response);
            return Ok(Response::new(Box::pin(start.chain(prepared))));
        }
        let live = BroadcastStream::new(self.live.subscribe());
        let wanted = live.filter_map(move |batch| batch.ok().filter(|batch| batch.namespace == namespace));
        Ok(Response::new(Box::pin(start.chain(wanted.map(response)))))
    }

    async fn query(&self, _: Request<QueryRequest>) -> Result<Response<QueryResponse>, Status> {
        Err(Status::unimplemented("a bare stream answers nothing"))
    }

    async fn info(&self, _: Request<InfoRequest>) -> Result<Response<InfoResponse>, Status> {
        Err(Status::unimplemented("a bare stream knows nothing"))
    }
}
