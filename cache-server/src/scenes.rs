//! Scenes on their way from owners of frames to workers that lack them. Kept in memory, as they came, for as long as their
//! frame is open; what is in them is the workers' business, who compare the hash.

use std::collections::BTreeMap;
use std::pin::Pin;
use std::sync::{Arc, Mutex};
use std::task::{Context, Poll, ready};

use cache_proto::{SCENE_BYTES_MAX, v1};
use tokio_stream::Stream;
use tonic::Status;

use crate::bell::{Bell, Listener};
use crate::refusal::Refusal;
use crate::spec;
use crate::store::lock;

/// Most bytes of all scenes together.
const BYTES_MAX: usize = 2 * SCENE_BYTES_MAX;

/// Most parts of one scene, so that empty ones do not add up.
const PARTS_MAX: usize = 1 << 16;

/// Bytes of one part: the wire's bounds.
const PART_MAX: usize = 1 << 20;
const PATH_MAX: usize = 4096;

/// The scenes that workers asked for.
#[derive(Default)]
pub struct Scenes {
    copies: Mutex<BTreeMap<u64, Arc<Mutex<Copy>>>>,
    grown: Bell,
}

#[derive(Default)]
struct Copy {
    parts: Vec<v1::ScenePart>,
    bytes: usize,
    end: Option<End>,
}

enum End {
    Whole,
    /// The owner has none to send, and why.
    Refused(String),
    /// The owner was cut off, or began anew.
    Cut,
}

impl Scenes {
    /// A worker asks for the scene of an open frame, which must be forgotten when it is closed.
    pub fn want(&self, frame: u64) {
        lock(&self.copies).entry(frame).or_default();
    }

    /// A frame was closed.
    pub fn forget(&self, frame: u64) {
        lock(&self.copies).remove(&frame);
        self.grown.ring();
    }

    /// Sends all readers away.
    pub fn close(&self) {
        self.grown.close();
    }

    /// The owner sends a scene. What came before is forgotten.
    ///
    /// # Errors
    /// [`Refusal::NoFrame`] when nobody asked for it.
    pub fn begin(self: &Arc<Self>, frame: u64) -> Result<Sending, Refusal> {
        let mut copies = lock(&self.copies);
        let copy = copies.get_mut(&frame).ok_or(Refusal::NoFrame(frame))?;
        let before = std::mem::take(copy);
        lock(&before).end.get_or_insert(End::Cut);
        Ok(Sending { scenes: self.clone(), copy: copy.clone() })
    }

    /// The parts of a scene, as they come.
    pub fn read(self: &Arc<Self>, frame: u64) -> Reading {
        Reading { grown: self.grown.listen(), scenes: self.clone(), frame, copy: None, next: 0, ended: false }
    }

    fn bytes(&self) -> usize {
        lock(&self.copies).values().map(|copy| lock(copy).bytes).sum()
    }
}

/// A scene that is being sent. Dropping it before its end cuts it off.
pub struct Sending {
    scenes: Arc<Scenes>,
    copy: Arc<Mutex<Copy>>,
}

impl Sending {
    /// Takes what the owner says next.
    ///
    /// # Errors
    /// What is unsound about it, or [`Refusal::Full`].
    pub fn take(&self, said: v1::OfferRequest) -> Result<(), Refusal> {
        if !said.refusal.is_empty() {
            spec::size("refusal", said.refusal.len(), 1..=PATH_MAX)?;
            self.end(End::Refused(said.refusal));
            return Ok(());
        }
        let Some(part) = said.part else { return Ok(()) };
        spec::size("part.path", part.path.len(), 1..=PATH_MAX)?;
        spec::size("part.content", part.content.len(), 0..=PART_MAX)?;
        let (bytes, all) = (part.path.len() + part.content.len(), self.scenes.bytes());
        if all + bytes > BYTES_MAX {
            self.end(End::Refused("the server has no room for it now".into()));
            return Err(Refusal::Busy { what: "bytes of scenes", most: BYTES_MAX });
        }
        let mut copy = lock(&self.copy);
        if copy.bytes + bytes > SCENE_BYTES_MAX || copy.parts.len() >= PARTS_MAX {
            drop(copy);
            self.end(End::Refused("it is too large to be sent".into()));
            return Err(Refusal::Full { what: "bytes of a scene", most: SCENE_BYTES_MAX });
        }
        copy.bytes += bytes;
        copy.parts.push(part);
        drop(copy);
        self.scenes.grown.ring();
        Ok(())
    }

    /// That was all.
    pub fn whole(&self) {
        self.end(End::Whole);
    }

    fn end(&self, end: End) {
        lock(&self.copy).end.get_or_insert(end);
        self.scenes.grown.ring();
    }
}

impl Drop for Sending {
    fn drop(&mut self) {
        self.end(End::Cut);
    }
}

/// A worker's side. It has no queue: a slow worker holds nobody back.
pub struct Reading {
    scenes: Arc<Scenes>,
    grown: Listener,
    frame: u64,
    /// The one it began with.
    copy: Option<Arc<Mutex<Copy>>>,
    next: usize,
    ended: bool,
}

impl Reading {
    /// The next part, `None` at the end; or nothing yet.
    fn look(&mut self) -> Option<Result<Option<v1::ScenePart>, Status>> {
        if self.scenes.grown.is_closed() {
            return Some(Err(Refusal::Closing.into()));
        }
        let now = lock(&self.scenes.copies).get(&self.frame).cloned();
        let Some(now) = now else { return Some(Err(Refusal::NoFrame(self.frame).into())) };
        if self.next == 0 {
            self.copy = Some(now);
        }
        let copy = lock(self.copy.as_ref()?);
        if let Some(part) = copy.parts.get(self.next) {
            self.next += 1;
            return Some(Ok(Some(part.clone())));
        }
        Some(match copy.end.as_ref()? {
            End::Whole => Ok(None),
            End::Refused(why) => Err(Status::failed_precondition(why.as_str())),
            End::Cut => Err(Status::unavailable("the owner was cut off while it sent the scene")),
        })
    }
}

impl Stream for Reading {
    type Item = Result<v1::ScenePart, Status>;

    fn poll_next(mut self: Pin<&mut Self>, context: &mut Context<'_>) -> Poll<Option<Self::Item>> {
        while !self.ended {
            match self.look() {
                Some(Ok(Some(part))) => return Poll::Ready(Some(Ok(part))),
                Some(Ok(None)) => self.ended = true,
                Some(Err(status)) => {
                    self.ended = true;
                    return Poll::Ready(Some(Err(status)));
                }
                None => self.ended = ready!(Pin::new(&mut self.grown).poll_next(context)).is_none(),
            }
        }
        Poll::Ready(None)
    }
}

#[cfg(test)]
mod tests {
    use tokio_stream::StreamExt as _;

    use super::*;

    fn part(bytes: usize) -> v1::OfferRequest {
        let part = v1::ScenePart { path: "a".into(), content: vec![7; bytes].into() };
        v1::OfferRequest { frame: 1, part: Some(part), refusal: String::new() }
    }

    #[tokio::test]
    async fn every_reader_gets_every_part_whenever_it_comes() {
        let scenes = Arc::new(Scenes::default());
        assert!(scenes.begin(1).is_err(), "nobody asked");
        scenes.want(1);
        let early = tokio::spawn(scenes.read(1).collect::<Vec<_>>());
        tokio::task::yield_now().await;
        let sending = scenes.begin(1).expect("wanted");
        (0..3).for_each(|size| sending.take(part(size)).expect("sound"));
        sending.whole();
        drop(sending);
        for parts in [early.await.expect("runs"), scenes.read(1).collect().await] {
            let sizes: Vec<_> = parts.into_iter().map(|part| part.expect("a part").content.len()).collect();
            assert_eq!(sizes, [0, 1, 2]);
        }
        scenes.forget(1);
        assert!(matches!(scenes.read(1).next().await, Some(Err(status)) if status.code() == tonic::Code::NotFound));
    }

    #[tokio::test]
    async fn what_is_cut_off_or_too_much_is_told() {
        let scenes = Arc::new(Scenes::default());
        let code = async || scenes.read(1).collect::<Vec<_>>().await.pop().and_then(Result::err).map(|s| s.code());
        scenes.want(1);
        let first = scenes.begin(1).expect("wanted");
        first.take(part(3)).expect("sound");
        let mut reader = scenes.read(1);
        assert!(reader.next().await.is_some_and(|part| part.is_ok()));
        let second = scenes.begin(1).expect("anew");
        assert!(reader.next().await.is_some_and(|part| part.is_err()), "parts of two attempts are not mixed");
        drop(second);
        assert_eq!(code().await, Some(tonic::Code::Unavailable));
        let third = scenes.begin(1).expect("anew");
        assert!(third.take(part(PART_MAX + 1)).is_err());
        // Bytes are shared: only the count is large.
        let large = part(PART_MAX);
        let taken = (0..).take_while(|_| third.take(large.clone()).is_ok()).count();
        assert_eq!(taken, SCENE_BYTES_MAX / (PART_MAX + 1));
        assert_eq!(code().await, Some(tonic::Code::FailedPrecondition));
    }
}
