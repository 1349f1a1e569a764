//! What happened in a simulation, in order: enough to compare two runs, and to read one.

use std::cell::RefCell;
use std::fmt::Display;
use std::sync::Once;
use std::time::Duration;

/// What is told of one run.
#[derive(Clone, Debug, Default)]
pub struct Told {
    /// Digest of all events with their times.
    pub digest: String,
    /// The events, if they were to be kept.
    pub events: Vec<String>,
    /// What must not happen and did.
    pub wrong: Vec<String>,
}

#[derive(Default)]
struct Events {
    running: bool,
    now: Duration,
    digest: blake3::Hasher,
    keep: bool,
    told: Told,
}

thread_local! {
    /// A simulation runs on one thread; its parts tell what they do here.
    static EVENTS: RefCell<Events> = RefCell::default();
}

/// Begins a run. Panics on its thread are among what must not happen, also where a runtime swallows them.
pub fn begin(keep: bool) {
    static HOOK: Once = Once::new();
    HOOK.call_once(|| {
        let before = std::panic::take_hook();
        std::panic::set_hook(Box::new(move |panic| {
            if EVENTS.with_borrow(|events| events.running) { wrong(panic) } else { before(panic) }
        }));
    });
    EVENTS.set(Events { running: true, keep, ..Events::default() });
}

/// Simulated time goes on.
pub fn tick(now: Duration) {
    EVENTS.with_borrow_mut(|events| events.now = now);
}

/// Tells an event.
pub fn note(who: &str, what: impl Display) {
    EVENTS.with_borrow_mut(|events| {
        let line = format!("{:9.3} {who}: {what}", events.now.as_secs_f64());
        events.digest.update(line.as_bytes());
        if events.keep {
            events.told.events.push(line);
        }
    });
}

/// Tells what must not happen.
pub fn wrong(what: impl Display) {
    note("WRONG", &what);
    EVENTS.with_borrow_mut(|events| {
        let line = format!("at {:.3} s: {what}", events.now.as_secs_f64());
        events.told.wrong.push(line);
    });
}

/// Ends a run.
pub fn end() -> Told {
    let events = EVENTS.take();
    Told { digest: events.digest.finalize().to_string(), ..events.told }
}
