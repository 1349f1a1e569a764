//! Bytes of messages that are on their way: a message may be long and a connection may carry many calls, so that without
//! a bound a few peers that send all but the last byte would fill the memory. A connection has room for one message of its
//! own, whatever others do; beyond that all share what is left.

use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::task::{Context, Poll, ready};

use tonic::Status;
use tonic::body::Body;
use tonic::codegen::Bytes;

use crate::refusal::Refusal;

/// Length of what stands before each message of gRPC: a flag, and its length in four bytes.
const PREFIX: usize = 5;

/// What a connection may always hold, bytes: the longest message of an insert or a query.
const OWN: usize = 2 << 20;

/// Counts what has come of messages that are not whole yet, over all calls of all connections.
#[derive(Debug)]
pub struct Inflow {
    most: usize,
    /// What connections hold beyond their own room.
    shared: AtomicUsize,
}

/// What one connection holds, bytes.
pub type Holding = Arc<AtomicUsize>;

impl Inflow {
    /// At most so many bytes beyond what each connection may always hold.
    pub fn new(most: usize) -> Self {
        Self { most, shared: AtomicUsize::new(0) }
    }

    /// The request of a call of a connection, counted.
    pub fn count(self: Arc<Self>, holding: Holding, body: Body) -> Body {
        Body::new(Flow { inflow: self, holding, body, held: 0, prefix: [0; PREFIX], prefix_held: 0, rest: 0 })
    }

    fn grow(&self, holding: &Holding, bytes: usize) -> Result<(), Refusal> {
        let before = holding.fetch_add(bytes, Ordering::Relaxed);
        let beyond = beyond(before + bytes) - beyond(before);
        let shared = self.shared.fetch_add(beyond, Ordering::Relaxed) + beyond;
        if beyond > 0 && shared > self.most {
            return Err(Refusal::Busy { what: "bytes of messages under way", most: self.most });
        }
        Ok(())
    }

    fn shrink(&self, holding: &Holding, bytes: usize) {
        let before = holding.fetch_sub(bytes, Ordering::Relaxed);
        self.shared.fetch_sub(beyond(before) - beyond(before - bytes), Ordering::Relaxed);
    }
}

/// How much of what a connection holds is not in its own room.
fn beyond(held: usize) -> usize {
    held.saturating_sub(OWN)
}

/// The request of one call. Its reader asks for more only when it has taken every whole message.
struct Flow {
    inflow: Arc<Inflow>,
    holding: Holding,
    body: Body,
    /// Bytes counted for this call: what has come of a message that is not whole.
    held: usize,
    /// What has come of that message's prefix, and how many bytes of it.
    prefix: [u8; PREFIX],
    prefix_held: usize,
    /// Bytes still to come after the prefix.
    rest: usize,
}

impl Flow {
    /// Takes note of bytes that came, and counts what is not whole.
    fn take(&mut self, mut bytes: &[u8]) -> Result<(), Refusal> {
        let mut held = self.held;
        while !bytes.is_empty() {
            let taken = if self.prefix_held < PREFIX {
                let taken = bytes.len().min(PREFIX - self.prefix_held);
                self.prefix[self.prefix_held..][..taken].copy_from_slice(&bytes[..taken]);
                self.prefix_held += taken;
                let [_, length @ ..] = self.prefix;
                self.rest = u32::from_be_bytes(length) as usize;
                taken
            } else {
                let taken = bytes.len().min(self.rest);
                self.rest -= taken;
                taken
            };
            bytes = &bytes[taken..];
            held += taken;
            if self.prefix_held == PREFIX && self.rest == 0 {
                (self.prefix_held, held) = (0, 0);
            }
        }
        let before = std::mem::replace(&mut self.held, held);
        if held < before {
            self.inflow.shrink(&self.holding, before - held);
            return Ok(());
        }
        self.inflow.grow(&self.holding, held - before)
    }
}

impl http_body::Body for Flow {
    type Data = Bytes;
    type Error = Status;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<http_body::Frame<Bytes>, Status>>> {
        let frame = ready!(Pin::new(&mut self.body).poll_frame(context));
        if let Some(Ok(frame)) = &frame
            && let Some(bytes) = frame.data_ref()
            && let Err(refusal) = self.take(bytes)
        {
            return Poll::Ready(Some(Err(refusal.into())));
        }
        Poll::Ready(frame)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> http_body::SizeHint {
        self.body.size_hint()
    }
}

impl Drop for Flow {
    fn drop(&mut self) {
        self.inflow.shrink(&self.holding, self.held);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flow(inflow: &Arc<Inflow>, holding: &Holding) -> Flow {
        let (inflow, holding) = (inflow.clone(), holding.clone());
        Flow { inflow, holding, body: Body::empty(), held: 0, prefix: [0; PREFIX], prefix_held: 0, rest: 0 }
    }

    #[test]
    fn what_is_not_whole_is_counted_however_it_is_cut() {
        let lengths = [0usize, 1, 300, 7, 0];
        let (mut bytes, mut ends) = (Vec::new(), vec![0]);
        for length in lengths {
            bytes.push(0);
            bytes.extend((length as u32).to_be_bytes());
            bytes.extend(vec![9; length]);
            ends.push(bytes.len());
        }
        for step in 1..=bytes.len() {
            let holding = Holding::default();
            let mut flow = flow(&Arc::new(Inflow::new(1 << 20)), &holding);
            for (at, piece) in bytes.chunks(step).enumerate() {
                flow.take(piece).expect("room");
                let come = at * step + piece.len();
                let whole = ends.iter().copied().filter(|&end| end <= come).max().expect("0");
                assert_eq!(holding.load(Ordering::Relaxed), come - whole, "step {step}, {come} bytes");
            }
        }
    }

    #[test]
    fn past_the_bound_the_greedy_are_refused_and_the_modest_are_not() {
        let inflow = Arc::new(Inflow::new(1000));
        let (greedy, modest) = (Holding::default(), Holding::default());
        let begun = |bytes: usize| [&[0u8, 0xff, 0, 0, 0][..], &vec![7; bytes - PREFIX]].concat();
        let (mut first, mut second) = (flow(&inflow, &greedy), flow(&inflow, &greedy));
        first.take(&begun(OWN)).expect("its own");
        second.take(&begun(1000)).expect("shared");
        assert!(second.take(&[7]).expect_err("full").to_string().contains("1000"));
        flow(&inflow, &modest).take(&begun(OWN)).expect("its own");
        assert_eq!(modest.load(Ordering::Relaxed), 0, "a call that ends makes room");
        drop(second);
        flow(&inflow, &greedy).take(&begun(1000)).expect("shared");
        drop(first);
        assert_eq!((greedy.load(Ordering::Relaxed), inflow.shared.load(Ordering::Relaxed)), (0, 0));
    }
}
