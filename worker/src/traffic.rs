//! What this machine uses of the network, as its sockets see it.

use std::future::Future;
use std::io;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll};
use std::time::Duration;

use cache_proto::v1;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Instant;

use crate::threads::lock;

/// Longest host name that is told, bytes.
const HOST_MAX: usize = 64;

/// Bytes and round trips since they were last taken. Cheap to clone; all clones count together.
#[derive(Clone, Default)]
pub struct Traffic(Arc<Counted>);

#[derive(Default)]
struct Counted {
    sent: AtomicU64,
    received: AtomicU64,
    /// How many, and how long together.
    trips: Mutex<(u64, Duration)>,
}

impl Traffic {
    /// Makes a call that carries next to nothing, and counts how long its answer takes.
    ///
    /// # Errors
    /// The call's; then nothing is counted.
    pub async fn time<T, E>(&self, call: impl Future<Output = Result<T, E>>) -> Result<T, E> {
        let began = Instant::now();
        let answer = call.await?;
        let mut trips = lock(&self.0.trips);
        *trips = (trips.0 + 1, trips.1 + began.elapsed());
        Ok(answer)
    }

    /// A connection whose bytes are counted.
    pub fn count<S>(&self, stream: S) -> Counting<S> {
        Counting { stream, traffic: self.clone() }
    }

    /// What was counted since the last call, under this machine's name.
    pub fn take(&self) -> v1::HostUse {
        let (round_trips, time) = std::mem::take(&mut *lock(&self.0.trips));
        v1::HostUse {
            host: host(),
            sent_bytes: self.0.sent.swap(0, Relaxed),
            received_bytes: self.0.received.swap(0, Relaxed),
            round_trips,
            round_trip_seconds: time.as_secs_f64(),
        }
    }
}

#[cfg(unix)]
fn host() -> String {
    let name = nix::unistd::gethostname().unwrap_or_default();
    let mut name = name.to_string_lossy().into_owned();
    let end = (0..=HOST_MAX.min(name.len())).rev().find(|&at| name.is_char_boundary(at));
    name.truncate(end.unwrap_or(0));
    name
}

#[cfg(not(unix))]
fn host() -> String {
    String::new()
}

/// A stream of counted bytes.
pub struct Counting<S> {
    stream: S,
    traffic: Traffic,
}

impl<S: AsyncRead + Unpin> AsyncRead for Counting<S> {
    fn poll_read(mut self: Pin<&mut Self>, cx: &mut Context<'_>, buffer: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        let before = buffer.filled().len();
        let read = Pin::new(&mut self.stream).poll_read(cx, buffer);
        self.traffic.0.received.fetch_add((buffer.filled().len() - before) as u64, Relaxed);
        read
    }
}

impl<S: AsyncWrite + Unpin> Counting<S> {
    fn wrote(&self, wrote: Poll<io::Result<usize>>) -> Poll<io::Result<usize>> {
        if let Poll::Ready(Ok(bytes)) = wrote {
            self.traffic.0.sent.fetch_add(bytes as u64, Relaxed);
        }
        wrote
    }
}

impl<S: AsyncWrite + Unpin> AsyncWrite for Counting<S> {
    fn poll_write(mut self: Pin<&mut Self>, cx: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let wrote = Pin::new(&mut self.stream).poll_write(cx, bytes);
        self.wrote(wrote)
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let wrote = Pin::new(&mut self.stream).poll_write_vectored(cx, bytes);
        self.wrote(wrote)
    }

    fn is_write_vectored(&self) -> bool {
        self.stream.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_flush(cx)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.stream).poll_shutdown(cx)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};

    use super::*;

    #[tokio::test(start_paused = true)]
    async fn bytes_and_answers_are_counted_once() {
        let traffic = Traffic::default();
        let (near, mut far) = tokio::io::duplex(64);
        let mut near = traffic.count(near);
        near.write_all(b"12345").await.expect("room");
        far.write_all(b"123").await.expect("room");
        near.read_exact(&mut [0; 3]).await.expect("there");
        let slow = async |answer: Result<(), ()>| {
            tokio::time::sleep(Duration::from_millis(250)).await;
            answer
        };
        assert!(traffic.time(slow(Ok(()))).await.is_ok() && traffic.time(slow(Err(()))).await.is_err());
        let used = traffic.take();
        assert_eq!((used.sent_bytes, used.received_bytes), (5, 3));
        assert_eq!((used.round_trips, used.round_trip_seconds), (1, 0.25));
        assert_eq!(traffic.take(), v1::HostUse { host: used.host, ..Default::default() });
    }
}
