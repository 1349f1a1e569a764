//! Wakes every task that waits for a change. It carries no message: who hears it looks for itself, so nothing can be
//! queued up for a slow listener.

use tokio::sync::watch;

/// Rung after each change; closed once, when the server goes away.
#[derive(Debug)]
pub struct Bell(watch::Sender<bool>);

/// One who waits. Its value is whether the bell was closed; `changed` returns after the next ring.
pub type Listener = watch::Receiver<bool>;

impl Default for Bell {
    fn default() -> Self {
        Self(watch::Sender::new(false))
    }
}

impl Bell {
    /// Wakes all who listen.
    pub fn ring(&self) {
        self.0.send_modify(|_| ());
    }

    /// Wakes all who listen, and tells them to go away.
    pub fn close(&self) {
        self.0.send_replace(true);
    }

    /// Whether it was closed.
    pub fn is_closed(&self) -> bool {
        *self.0.borrow()
    }

    /// Hears every ring from now on: listen first, then look, then wait, and no change is missed.
    pub fn listen(&self) -> Listener {
        self.0.subscribe()
    }
}
