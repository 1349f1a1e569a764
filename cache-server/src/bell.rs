//! Wakes every task that waits for a change. It carries no message: who hears it looks for itself, so nothing can be
//! queued up for a slow listener.
//!
//! Listeners are woken in the order in which they began to wait, so that a simulation of a server replays.

use std::pin::Pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::task::{Context, Poll};

use tokio::sync::broadcast;
use tokio_stream::wrappers::BroadcastStream;
use tokio_stream::{Stream, StreamExt as _};

/// Rung after each change; closed once, when the server goes away.
#[derive(Debug)]
pub struct Bell {
    rings: broadcast::Sender<()>,
    closed: AtomicBool,
}

/// One who waits: yields after each ring, or once after several.
pub struct Listener(BroadcastStream<()>);

impl Default for Bell {
    fn default() -> Self {
        Self { rings: broadcast::Sender::new(1), closed: AtomicBool::new(false) }
    }
}

impl Bell {
    /// Wakes all who listen.
    pub fn ring(&self) {
        // Nobody listens: nobody misses it.
        drop(self.rings.send(()));
    }

    /// Wakes all who listen, and tells them to go away.
    pub fn close(&self) {
        self.closed.store(true, Ordering::Release);
        self.ring();
    }

    /// Whether it was closed.
    pub fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Acquire)
    }

    /// Hears every ring from now on: listen first, then look, then wait, and no change is missed.
    pub fn listen(&self) -> Listener {
        Listener(BroadcastStream::new(self.rings.subscribe()))
    }
}

impl Listener {
    /// Waits for the next ring.
    pub async fn changed(&mut self) {
        self.next().await;
    }
}

impl Stream for Listener {
    type Item = ();

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<()>> {
        // Rings that went by unheard count as one.
        Pin::new(&mut self.0).poll_next(context).map(|rung| rung.map(drop))
    }
}
