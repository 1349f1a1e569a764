//! The door: how many connections there may be, and how long one may stay without a call.

use std::io;
use std::pin::Pin;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::task::{Context, Poll, ready};
use std::time::Duration;

use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio::time::Sleep;
use tokio_stream::Stream;
use tonic::transport::server::Connected;

use crate::inflow::Holding;
use crate::metrics;

/// A connection that brings no call it may make within this time is cut, whatever it does instead: nothing, half a
/// handshake, guesses at tokens.
pub const GREETING: Duration = Duration::from_secs(10);

/// Connections past the bound that are still told so, on each call, until their time is over; more are closed at once.
const TOLD: usize = 64;

/// Pause after a connection could not be accepted, which is most often for want of file descriptors.
const PAUSE: Duration = Duration::from_millis(100);

/// Counts the connections of all sockets of one server.
#[derive(Debug)]
pub struct Door {
    most: usize,
    open: AtomicUsize,
}

impl Door {
    /// A door for `most` connections.
    pub fn new(most: usize) -> Self {
        Self { most, open: AtomicUsize::new(0) }
    }

    /// How many connections are open.
    pub fn open(&self) -> usize {
        self.open.load(Ordering::Relaxed)
    }

    /// What comes in through this door. A connection that cannot be accepted is not the end of it.
    pub fn guests<I>(self: &Arc<Self>, incoming: I) -> Guests<I> {
        Guests { door: self.clone(), incoming: Box::pin(incoming), pause: None }
    }

    fn enter<IO>(self: &Arc<Self>, io: IO) -> Option<Guest<IO>> {
        let before = self.open.fetch_add(1, Ordering::Relaxed);
        let count = Counted(self.clone());
        let full = (before >= self.most).then_some(self.most);
        if before >= self.most + TOLD {
            return None;
        }
        let pass = Pass { full, called: Arc::default(), holding: Arc::default() };
        let greeting = Some(Box::pin(tokio::time::sleep(GREETING)));
        Some(Guest { io, pass, greeting, _count: count })
    }
}

/// One open connection.
#[derive(Debug)]
struct Counted(Arc<Door>);

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.open.fetch_sub(1, Ordering::Relaxed);
    }
}

/// The connections that come in through a door.
pub struct Guests<I> {
    door: Arc<Door>,
    incoming: Pin<Box<I>>,
    pause: Option<Pin<Box<Sleep>>>,
}

impl<I, IO> Stream for Guests<I>
where
    I: Stream<Item = io::Result<IO>>,
{
    type Item = io::Result<Guest<IO>>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        loop {
            if let Some(pause) = &mut self.pause {
                ready!(pause.as_mut().poll(context));
                self.pause = None;
            }
            match ready!(self.incoming.as_mut().poll_next(context)) {
                Some(Ok(io)) => match self.door.enter(io) {
                    Some(guest) => return Poll::Ready(Some(Ok(guest))),
                    None => {
                        tracing::debug!(most = self.door.most, "a connection past the bound was closed");
                        metrics::connection_refused();
                    }
                },
                Some(Err(error)) => {
                    tracing::warn!(%error, "a connection could not be accepted");
                    self.pause = Some(Box::pin(tokio::time::sleep(PAUSE)));
                }
                None => return Poll::Ready(None),
            }
        }
    }
}

/// What every call of one connection carries.
#[derive(Clone, Debug)]
pub struct Pass {
    full: Option<usize>,
    called: Arc<AtomicBool>,
    holding: Holding,
}

impl Pass {
    /// What this connection holds of messages that are not whole.
    pub fn holding(&self) -> &Holding {
        &self.holding
    }

    /// The bound of connections, if this one is past it.
    pub fn full(&self) -> Option<usize> {
        self.full
    }

    /// This connection made a call that it may make: it may stay.
    pub fn stay(&self) {
        self.called.store(true, Ordering::Relaxed);
    }
}

/// A connection: fails with `TimedOut` when its [`GREETING`] is over and no call was made.
pub struct Guest<IO> {
    io: IO,
    pass: Pass,
    greeting: Option<Pin<Box<Sleep>>>,
    _count: Counted,
}

impl<IO> Connected for Guest<IO> {
    type ConnectInfo = Pass;

    fn connect_info(&self) -> Pass {
        self.pass.clone()
    }
}

impl<IO: AsyncRead + Unpin> AsyncRead for Guest<IO> {
    fn poll_read(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        buffer: &mut ReadBuf<'_>,
    ) -> Poll<io::Result<()>> {
        if self.pass.called.load(Ordering::Relaxed) {
            self.greeting = None;
        }
        if self.greeting.as_mut().is_some_and(|greeting| greeting.as_mut().poll(context).is_ready()) {
            tracing::debug!("a connection without a call was cut");
            metrics::connection_refused();
            return Poll::Ready(Err(io::ErrorKind::TimedOut.into()));
        }
        let before = buffer.filled().len();
        ready!(Pin::new(&mut self.io).poll_read(context, buffer))?;
        metrics::received(buffer.filled().len() - before);
        Poll::Ready(Ok(()))
    }
}

impl<IO: AsyncWrite + Unpin> AsyncWrite for Guest<IO> {
    fn poll_write(mut self: Pin<&mut Self>, context: &mut Context<'_>, bytes: &[u8]) -> Poll<io::Result<usize>> {
        let written = ready!(Pin::new(&mut self.io).poll_write(context, bytes))?;
        metrics::sent(written);
        Poll::Ready(Ok(written))
    }

    fn poll_write_vectored(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
        bytes: &[io::IoSlice<'_>],
    ) -> Poll<io::Result<usize>> {
        let written = ready!(Pin::new(&mut self.io).poll_write_vectored(context, bytes))?;
        metrics::sent(written);
        Poll::Ready(Ok(written))
    }

    fn is_write_vectored(&self) -> bool {
        self.io.is_write_vectored()
    }

    fn poll_flush(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.io).poll_flush(context)
    }

    fn poll_shutdown(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<io::Result<()>> {
        Pin::new(&mut self.io).poll_shutdown(context)
    }
}

#[cfg(test)]
mod tests {
    use tokio::io::{AsyncReadExt as _, DuplexStream, duplex};
    use tokio_stream::StreamExt as _;

    use super::*;

    fn door(most: usize) -> Arc<Door> {
        Arc::new(Door::new(most))
    }

    fn enter(door: &Arc<Door>) -> (Option<Guest<DuplexStream>>, DuplexStream) {
        let (near, far) = duplex(64);
        (door.enter(near), far)
    }

    #[tokio::test(start_paused = true)]
    async fn a_connection_without_a_call_is_cut() {
        let door = door(2);
        let (silent, _far) = enter(&door);
        let (talking, _other) = enter(&door);
        let (mut silent, mut talking) = (silent.expect("room"), talking.expect("room"));
        talking.connect_info().stay();
        let mut byte = [0];
        assert!(tokio::time::timeout(GREETING / 2, silent.read(&mut byte)).await.is_err(), "not yet");
        let cut = silent.read(&mut byte).await.expect_err("cut");
        assert_eq!(cut.kind(), io::ErrorKind::TimedOut);
        assert!(tokio::time::timeout(GREETING * 100, talking.read(&mut byte)).await.is_err(), "stays");
    }

    #[tokio::test]
    async fn past_the_bound_connections_are_told_and_very_many_are_closed() {
        let door = door(3);
        let mut guests: Vec<_> = (0..3 + TOLD).map(|_| enter(&door).0.expect("let in")).collect();
        let full: Vec<_> = guests.iter().map(|guest| guest.connect_info().full()).collect();
        assert!(full[..3].iter().all(Option::is_none) && full[3..].iter().all(|full| *full == Some(3)));
        assert!(enter(&door).0.is_none());
        assert_eq!(door.open(), 3 + TOLD);
        guests.truncate(2);
        assert_eq!(enter(&door).0.expect("let in").connect_info().full(), None);
        assert_eq!(door.open(), 2);
    }

    #[tokio::test(start_paused = true)]
    async fn a_connection_that_cannot_be_accepted_is_not_the_end() {
        let (near, _far) = duplex(64);
        let incoming = tokio_stream::iter([Err(io::Error::other("too many open files")), Ok(near)]);
        let clock = crate::clock::Clock::start();
        let mut guests = door(1).guests(incoming);
        assert!(guests.next().await.expect("one").is_ok());
        assert!(clock.now() >= PAUSE, "it does not try again at once");
        assert!(guests.next().await.is_none());
    }
}
