//! The logs of the server above, given to many.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError, Weak};
use std::time::Duration;

use cache_core::Namespace;
use cache_core::id::Digest;
use cache_proto::{convert, v1};
use tokio::sync::mpsc;
use tokio::time::{Instant, timeout_at};
use tokio_stream::wrappers::ReceiverStream;
use tonic::Status;
use worker::client;
use worker::follow::{Follower, State};

use super::{Above, Caller};

/// How long a subscriber that holds more than has come down here waits for the rest. One that moved here from another
/// relay may be some milliseconds ahead.
const CATCH_UP: Duration = Duration::from_secs(2);

/// How long a subscriber waits for the server above to say something about its namespace.
const BEGIN: Duration = Duration::from_secs(5);

type Answer = Result<v1::SubscribeResponse, Status>;

/// The logs that somebody reads, by whose token they are followed with.
#[derive(Default)]
pub struct Logs(Mutex<BTreeMap<(Caller, Namespace), Weak<Follower>>>);

impl Logs {
    /// The log of a namespace, from where the caller is.
    pub async fn subscribe(
        &self,
        above: &Above,
        caller: &Caller,
        request: v1::SubscribeRequest,
    ) -> Result<ReceiverStream<Answer>, Status> {
        let malformed = |e: convert::Malformed| Status::invalid_argument(e.to_string());
        let namespace = convert::namespace(&request.namespace).map_err(malformed)?;
        let digest = &request.digest;
        let digest = (!digest.is_empty()).then(|| convert::digest(digest).map_err(malformed)).transpose()?;
        let log = self.follow(above, caller, namespace);
        let (start, state) = start(&log, request.position, digest).await?;
        // One message: whoever is slow waits for itself.
        let (told, answers) = mpsc::channel(1);
        tokio::spawn(async move {
            let begin = v1::SubscribeResponse { batch: None, position: start, end: state.end.max(state.position) };
            if told.send(Ok(begin)).await.is_ok() {
                let ended = tell(&log, state.epoch, start, &told).await;
                // Nobody may be there to hear it.
                drop(told.send(Err(ended)).await);
            }
        });
        Ok(ReceiverStream::new(answers))
    }

    fn follow(&self, above: &Above, caller: &Caller, namespace: Namespace) -> Arc<Follower> {
        let mut logs = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        logs.retain(|_, log| log.strong_count() > 0);
        // Whatever way the callers came, one subscription serves all of them.
        let caller = Caller { relays: above.name.clone(), ..caller.clone() };
        let key = (caller.clone(), namespace);
        if let Some(log) = logs.get(&key).and_then(Weak::upgrade) {
            return log;
        }
        let log = Arc::new(Follower::start(client::cache(above.line(&caller)), namespace));
        logs.insert(key, Arc::downgrade(&log));
        log
    }
}

/// Where the caller's stream starts: where it is, if its records are those that stand there before.
async fn start(log: &Follower, position: u64, digest: Option<Digest>) -> Result<(u64, State), Status> {
    let begin = Instant::now() + BEGIN;
    // What was said of a draft that is no more may not be true any more: a frame may fill it again.
    let before = log.state().attempts;
    log.ask();
    let until = |deadline: Instant, ready: fn(&State, u64, u64) -> bool| async move {
        loop {
            let changed = log.changed();
            let state = log.state();
            if ready(&state, before, position) {
                return Ok(state);
            }
            if timeout_at(deadline, changed).await.is_err() {
                return Err(log.state());
            }
        }
    };
    let said = |state: &State, before, _| state.open || state.ended.is_some() && state.attempts > before;
    let state = until(begin, said)
        .await
        .map_err(|state| state.ended.unwrap_or_else(|| Status::unavailable("the server above does not answer")))?;
    if let Some(status) = state.ended {
        return Err(status);
    }
    let here = until(Instant::now() + CATCH_UP, |state, _, position| state.position >= position).await;
    let state = here.unwrap_or_else(|state| state);
    let same = match digest {
        _ if position == 0 => true,
        None => true,
        Some(digest) => log.read(|log| log.epoch() == state.epoch && log.digest_at(position) == Some(digest)),
    };
    Ok((if same { position } else { 0 }, state))
}

/// Tells what comes, until the log ends: why.
async fn tell(log: &Follower, epoch: u64, mut position: u64, told: &mpsc::Sender<Answer>) -> Status {
    loop {
        let changed = log.changed();
        let read = log.read(|log| (log.epoch() == epoch).then(|| log.batch(position)));
        let Some(batch) = read else { return Status::unavailable("the server above has another log now") };
        if let Some((count, batch)) = batch {
            let answer = v1::SubscribeResponse { batch: Some(batch), position, end: 0 };
            if told.send(Ok(answer)).await.is_err() {
                return Status::cancelled("nobody listens");
            }
            position += count;
            continue;
        }
        // It may be away for a while: then nothing comes, and what is here stays true.
        if let Some(status) = log.state().ended.filter(|status| !client::is_passing(status)) {
            return status;
        }
        tokio::select! {
            () = changed => {}
            () = told.closed() => return Status::cancelled("nobody listens"),
        }
    }
}
