//! Bytes of messages that are on their way: a server takes only so many at a time, whoever sends them. A message may be
//! long and a connection may carry many calls, so that without this bound a few peers that send all but the last byte
//! would fill its memory.

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

/// Counts what has come of messages that are not whole yet, over all calls.
#[derive(Debug)]
pub struct Inflow {
    most: usize,
    held: AtomicUsize,
}

impl Inflow {
    /// At most so many bytes.
    pub fn new(most: usize) -> Self {
        Self { most, held: AtomicUsize::new(0) }
    }

    /// A call's request, counted.
    pub fn count(self: Arc<Self>, body: Body) -> Body {
        Body::new(Flow { inflow: self, body, held: 0, prefix: [0; PREFIX], prefix_held: 0, rest: 0 })
    }
}

/// The request of one call. Its reader asks for more only when it has taken every whole message.
struct Flow {
    inflow: Arc<Inflow>,
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
        let more = held.saturating_sub(self.held);
        let less = self.held.saturating_sub(held);
        self.held = held;
        self.inflow.held.fetch_sub(less, Ordering::Relaxed);
        if self.inflow.held.fetch_add(more, Ordering::Relaxed) + more > self.inflow.most && more > 0 {
            return Err(Refusal::Full { what: "bytes of messages under way", most: self.inflow.most });
        }
        Ok(())
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
        self.inflow.held.fetch_sub(self.held, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn flow(inflow: &Arc<Inflow>) -> Flow {
        let inflow = inflow.clone();
        Flow { inflow, body: Body::empty(), held: 0, prefix: [0; PREFIX], prefix_held: 0, rest: 0 }
    }

    #[test]
    fn what_is_not_whole_is_counted_however_it_is_cut() {
        let lengths = [0usize, 1, 300, 7, 0];
        let mut bytes = Vec::new();
        for length in lengths {
            bytes.push(0);
            bytes.extend((length as u32).to_be_bytes());
            bytes.extend(vec![9; length]);
        }
        let ends: Vec<_> =
            lengths.iter().scan(0, |end, length| Some(std::mem::replace(end, *end + 5 + length))).collect();
        for step in 1..=bytes.len() {
            let inflow = Arc::new(Inflow::new(1 << 20));
            let mut flow = flow(&inflow);
            for (at, piece) in bytes.chunks(step).enumerate() {
                flow.take(piece).expect("room");
                let come = at * step + piece.len();
                let whole = ends.iter().copied().chain([bytes.len()]).filter(|&end| end <= come).max().expect("0");
                assert_eq!(inflow.held.load(Ordering::Relaxed), come - whole, "step {step}, {come} bytes");
            }
        }
    }

    #[test]
    fn past_the_bound_a_call_is_refused_and_its_end_makes_room() {
        let inflow = Arc::new(Inflow::new(1000));
        let begun = [&[0u8, 0, 1, 0, 0][..], &[7; 600]].concat();
        let (mut first, mut second) = (flow(&inflow), flow(&inflow));
        first.take(&begun).expect("room");
        assert!(second.take(&begun).expect_err("full").to_string().contains("1000"));
        drop(second);
        assert!(flow(&inflow).take(&[0, 0, 0, 0, 9]).is_ok());
        drop(first);
        assert!(flow(&inflow).take(&begun).is_ok());
        assert_eq!(inflow.held.load(Ordering::Relaxed), 0);
    }
}
