//! Work kept off the runtime's threads, and locks that outlive a panic.

use std::sync::{Mutex, MutexGuard, PoisonError};

use tokio::runtime::{Handle, RuntimeFlavor};

/// Does what takes CPU time where it holds up nobody: on a thread of its own, or in place on a runtime that has only
/// one, so that a simulation stays in order.
///
/// # Errors
/// It panicked.
pub async fn off_thread<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, String> {
    match Handle::current().runtime_flavor() {
        RuntimeFlavor::CurrentThread => Ok(work()),
        _ => tokio::task::spawn_blocking(work).await.map_err(|panic| format!("the worker failed: {panic}")),
    }
}

/// Locks, also after a panic: it has been reported by then, and what replicas and caches hold is checked by digest.
pub fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
