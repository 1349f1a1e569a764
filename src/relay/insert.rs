//! Inserts of many callers, sent up together while those before them become durable.

use std::collections::BTreeMap;
use std::collections::VecDeque;
use std::sync::Arc;

use cache_proto::v1;
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;
use tonic::{Response, Status, Streaming};
use worker::client;

use super::{Above, Caller};

/// Most batches that wait to be sent, and that are sent together; whoever brings more waits. One has half a megabyte at
/// most.
const QUEUE_MAX: usize = 64;

/// Most batches of one call that wait for an answer.
const UNDER_WAY_MAX: usize = 8;

/// One batch on its way up, and whom to tell.
struct Pending {
    caller: Caller,
    request: v1::InsertRequest,
    kept: oneshot::Sender<Result<v1::InsertResponse, Status>>,
}

/// The way up.
pub struct Inserts(mpsc::Sender<Pending>);

impl Inserts {
    /// Starts the task that sends.
    pub fn start(above: Arc<Above>) -> Self {
        let (queue, waiting) = mpsc::channel(QUEUE_MAX);
        tokio::spawn(send(above, waiting));
        Self(queue)
    }

    /// A call of one caller: answered when the server above keeps all of it. What is told as new is new of all that
    /// travelled together.
    pub async fn insert(
        &self,
        caller: &Caller,
        mut batches: Streaming<v1::InsertRequest>,
    ) -> Result<v1::InsertResponse, Status> {
        let (mut under_way, mut total) = (VecDeque::new(), v1::InsertResponse::default());
        loop {
            let request = batches.message().await?;
            let room = if request.is_some() { UNDER_WAY_MAX } else { 0 };
            while under_way.len() > room
                && let Some(keeping) = under_way.pop_front()
            {
                let keeping: oneshot::Receiver<Result<v1::InsertResponse, Status>> = keeping;
                let kept = keeping.await.unwrap_or_else(|_| Err(closing()))?;
                total = v1::InsertResponse { added: total.added + kept.added, position: kept.position };
            }
            let Some(request) = request else { return Ok(total) };
            let (kept, keeping) = oneshot::channel();
            let pending = Pending { caller: caller.clone(), request, kept };
            self.0.send(pending).await.map_err(|_| closing())?;
            under_way.push_back(keeping);
        }
    }
}

fn closing() -> Status {
    Status::unavailable("the relay is shutting down")
}

/// Sends what waits, one call for each caller and namespace, until nobody is left who could insert.
async fn send(above: Arc<Above>, mut waiting: mpsc::Receiver<Pending>) {
    let mut together = Vec::new();
    while waiting.recv_many(&mut together, QUEUE_MAX).await > 0 {
        let mut groups: BTreeMap<_, Vec<Pending>> = BTreeMap::new();
        for pending in together.drain(..) {
            let namespace = pending.request.batch.as_ref().map(|batch| batch.namespace.clone());
            groups.entry((pending.caller.clone(), namespace)).or_default().push(pending);
        }
        let mut calls = JoinSet::new();
        for ((caller, _), group) in groups {
            calls.spawn(call(above.clone(), caller, group));
        }
        while calls.join_next().await.is_some() {}
    }
}

async fn call(above: Arc<Above>, caller: Caller, group: Vec<Pending>) {
    let insert = async |requests: Vec<v1::InsertRequest>| {
        let mut cache = client::cache(above.line(&caller));
        cache.insert(tokio_stream::iter(requests)).await.map(Response::into_inner)
    };
    let kept = insert(group.iter().map(|pending| pending.request.clone()).collect()).await;
    // One that is refused must not spoil the others'.
    let by_itself = group.len() > 1 && kept.as_ref().is_err_and(|status| !client::is_passing(status));
    for pending in group {
        let kept = if by_itself { insert(vec![pending.request]).await } else { kept.clone() };
        // Who does not wait for the answer any more will ask again.
        drop(pending.kept.send(kept));
    }
}
