//! A server that does what its script says: it keeps real logs, hands out leases given to it, and loses everything,
//! changes its mind or has no room when told to. It listens in this process, on no socket.

use std::collections::{BTreeMap, VecDeque};
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use cache_core::id::Digest;
use cache_core::set::Inserted;
use cache_core::{Namespace, Record, RecordSet, Tag};
use cache_proto::{convert, v1};
use tokio::sync::{mpsc, watch};
use tokio_stream::wrappers::ReceiverStream;
use tokio_stream::{Stream, StreamExt as _};
use tonic::transport::Server;
use tonic::{Request, Response, Status, Streaming};
use worker::client::Line;

type Log = RecordSet;

#[derive(Default)]
pub struct State {
    pub logs: BTreeMap<Namespace, Log>,
    pub frames: BTreeMap<u64, v1::DescribeResponse>,
    /// Leases to be given out.
    pub leases: VecDeque<v1::Lease>,
    pub held: Vec<u64>,
    pub completed: Vec<v1::CompleteRequest>,
    pub declined: Vec<String>,
    /// Answers to the next inserts, instead of keeping them.
    pub refusals: VecDeque<Status>,
    /// Answer to subscriptions.
    pub closed: Option<Status>,
    /// How often a subscription was asked for.
    pub asked: u32,
    /// Size of every insert, records.
    pub inserts: Vec<usize>,
    /// Where each subscription started.
    pub starts: Vec<u64>,
}

/// A handle on the server.
#[derive(Clone)]
pub struct Script {
    state: Arc<Mutex<State>>,
    /// Changes: which life of the server, and how often anything happened in it.
    changed: Arc<watch::Sender<(u64, u64)>>,
}

impl Script {
    /// Starts it; the channel leads there.
    pub fn start() -> (Self, Line) {
        let script = Self { state: Arc::default(), changed: Arc::new(watch::channel((0, 0)).0) };
        let (connections, accepted) = mpsc::channel::<std::io::Result<_>>(8);
        let channel = worker::client::connect_with(move || {
            let connections = connections.clone();
            async move {
                let (near, far) = tokio::io::duplex(1 << 16);
                connections.send(Ok(far)).await.map_err(std::io::Error::other)?;
                Ok(near)
            }
        });
        let serving = Server::builder()
            .add_service(v1::cache_server::CacheServer::new(script.clone()))
            .add_service(v1::frames_server::FramesServer::new(script.clone()))
            .serve_with_incoming(ReceiverStream::new(accepted));
        tokio::spawn(serving);
        (script, channel)
    }

    /// Looks at or changes what there is.
    pub fn with<T>(&self, look: impl FnOnce(&mut State) -> T) -> T {
        let result = look(&mut self.lock());
        self.changed.send_modify(|(_, changes)| *changes += 1);
        result
    }

    /// Another server in its place, which begins with `state`: leases are gone, subscriptions end.
    pub fn replace(&self, state: State) {
        *self.lock() = state;
        self.changed.send_modify(|(life, _)| *life += 1);
    }

    /// Waits until something is so, ten minutes at most.
    pub async fn until<T>(&self, mut look: impl FnMut(&State) -> Option<T>) -> T {
        let mut changed = self.changed.subscribe();
        let waiting = async {
            loop {
                if let Some(found) = look(&self.lock()) {
                    return found;
                }
                changed.changed().await.expect("the script lives");
            }
        };
        tokio::time::timeout(Duration::from_secs(600), waiting).await.expect("it comes to be so")
    }

    /// Inserts as some other worker does.
    pub fn insert(&self, namespace: Namespace, records: &[(Tag, Record)]) {
        self.with(|state| {
            let log = state.logs.entry(namespace).or_default();
            records.iter().for_each(|(tag, record)| _ = log.insert(*tag, record.clone()));
        });
    }

    /// The ids of a log, in its order.
    pub fn ids(&self, namespace: Namespace) -> Vec<u128> {
        self.lock().logs.get(&namespace).map_or(Vec::new(), |log| log.since(0).iter().map(|(_, r)| r.id().0).collect())
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().expect("no test panics while it looks")
    }
}

/// Digest of the records below a position.
fn prefix(log: &Log, position: usize) -> Digest {
    let mut set = Log::default();
    log.since(0).iter().take(position).for_each(|(tag, record)| _ = set.insert(*tag, record.clone()));
    set.digest()
}

type Events<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send>>;

#[tonic::async_trait]
impl v1::cache_server::Cache for Script {
    async fn insert(
        &self,
        request: Request<Streaming<v1::InsertRequest>>,
    ) -> Result<Response<v1::InsertResponse>, Status> {
        let mut stream = request.into_inner();
        let mut batches = Vec::new();
        while let Some(request) = stream.message().await? {
            batches.push(convert::unpack(&request.batch.expect("a batch")).expect("sound"));
        }
        self.with(|state| {
            if let Some(refusal) = state.refusals.pop_front() {
                return Err(refusal);
            }
            state.inserts.push(batches.iter().map(|(_, _, records)| records.len()).sum());
            let (mut added, mut position) = (0, 0);
            for (namespace, tag, records) in batches {
                let log = state.logs.entry(namespace).or_default();
                added +=
                    records.into_iter().filter(|r| log.insert(tag, Record::clone(r)) == Inserted::Added).count() as u64;
                position = log.position() as u64;
            }
            Ok(Response::new(v1::InsertResponse { added, position }))
        })
    }

    type SubscribeStream = Events<v1::SubscribeResponse>;

    async fn subscribe(
        &self,
        request: Request<v1::SubscribeRequest>,
    ) -> Result<Response<Self::SubscribeStream>, Status> {
        let request = request.into_inner();
        let namespace = convert::namespace(&request.namespace).expect("a namespace");
        let digest = convert::digest(&request.digest).expect("a digest");
        let (script, mut changed) = (self.clone(), self.changed.subscribe());
        let life = changed.borrow().0;
        let (end, mut position) = self.with(|state| {
            state.asked += 1;
            if let Some(status) = &state.closed {
                return Err(status.clone());
            }
            let log = state.logs.entry(namespace).or_default();
            let asked = request.position as usize;
            let proven = asked <= log.position() && prefix(log, asked) == digest;
            let end = log.position();
            let start = if proven { asked } else { 0 };
            state.starts.push(start as u64);
            Ok((end as u64, start))
        })?;
        let (sender, stream) = mpsc::channel(1);
        tokio::spawn(async move {
            let first = v1::SubscribeResponse { batch: None, position: position as u64, end };
            let mut alive = sender.send(Ok(first)).await.is_ok();
            while alive {
                let next = script.lock().logs.get(&namespace).and_then(|log| log.since(position).first().cloned());
                alive = if changed.borrow_and_update().0 != life {
                    drop(sender.send(Err(Status::unavailable("gone"))).await);
                    false
                } else if let Some((tag, record)) = next {
                    let batch = Some(convert::pack(&namespace, tag, [&record]));
                    position += 1;
                    let response = v1::SubscribeResponse { batch, position: position as u64 - 1, end: 0 };
                    sender.send(Ok(response)).await.is_ok()
                } else {
                    tokio::select! {
                        changed = changed.changed() => changed.is_ok(),
                        () = sender.closed() => false,
                    }
                };
            }
        });
        Ok(Response::new(Box::pin(ReceiverStream::new(stream))))
    }

    async fn query(&self, _: Request<v1::QueryRequest>) -> Result<Response<v1::QueryResponse>, Status> {
        Err(Status::unimplemented("not in the script"))
    }

    async fn info(&self, _: Request<v1::InfoRequest>) -> Result<Response<v1::InfoResponse>, Status> {
        Err(Status::unimplemented("not in the script"))
    }
}

#[tonic::async_trait]
impl v1::frames_server::Frames for Script {
    type OpenStream = Events<v1::FrameEvent>;

    async fn open(&self, _: Request<v1::OpenRequest>) -> Result<Response<Self::OpenStream>, Status> {
        Ok(Response::new(Box::pin(tokio_stream::empty().map(Ok))))
    }

    async fn describe(&self, request: Request<v1::DescribeRequest>) -> Result<Response<v1::DescribeResponse>, Status> {
        let frame = request.into_inner().frame;
        let described = self.lock().frames.get(&frame).cloned();
        described.map(Response::new).ok_or_else(|| Status::not_found(format!("no frame {frame}")))
    }

    async fn lease(&self, _: Request<v1::LeaseRequest>) -> Result<Response<v1::LeaseResponse>, Status> {
        let waiting = tokio::time::timeout(Duration::from_secs(10), async {
            self.until(|state| (!state.leases.is_empty()).then_some(())).await;
        });
        drop(waiting.await);
        let lease = self.with(|state| {
            let lease = state.leases.pop_front();
            state.held.extend(lease.iter().map(|lease| lease.id));
            lease
        });
        Ok(Response::new(v1::LeaseResponse { lease }))
    }

    async fn renew(&self, _: Request<v1::RenewRequest>) -> Result<Response<v1::RenewResponse>, Status> {
        Ok(Response::new(v1::RenewResponse { leases: self.lock().held.clone() }))
    }

    async fn complete(&self, request: Request<v1::CompleteRequest>) -> Result<Response<v1::CompleteResponse>, Status> {
        let request = request.into_inner();
        let accepted = self.with(|state| {
            let held = state.held.len();
            state.held.retain(|lease| *lease != request.lease);
            let accepted = state.held.len() < held;
            state.completed.extend(accepted.then_some(request));
            accepted
        });
        Ok(Response::new(v1::CompleteResponse { accepted }))
    }

    async fn decline(&self, request: Request<v1::DeclineRequest>) -> Result<Response<v1::DeclineResponse>, Status> {
        self.with(|state| state.declined.push(request.into_inner().reason));
        Ok(Response::new(v1::DeclineResponse {}))
    }

    type SceneStream = Events<v1::ScenePart>;

    async fn scene(&self, _: Request<v1::SceneRequest>) -> Result<Response<Self::SceneStream>, Status> {
        Ok(Response::new(Box::pin(tokio_stream::empty().map(Ok))))
    }

    async fn offer(&self, _: Request<Streaming<v1::OfferRequest>>) -> Result<Response<v1::OfferResponse>, Status> {
        Ok(Response::new(v1::OfferResponse {}))
    }

    async fn leave(&self, _: Request<v1::LeaveRequest>) -> Result<Response<v1::LeaveResponse>, Status> {
        Ok(Response::new(v1::LeaveResponse {}))
    }
}
