//! Who opens frames: `ambience render` without its processes.

use std::rc::Rc;
use std::time::Duration;

use cache_core::id::Digest;
use cache_core::{Record, RecordId, Tag};
use cache_proto::v1::frame_event::Event;
use cache_proto::{convert, v1};
use tonic::Status;
use worker::client;

use crate::events;
use crate::hosts::Farm;
use crate::job::{namespace, reference};
use crate::network::connect;

/// A picture somebody wants, and how far it is.
#[derive(Clone, Debug)]
pub struct Frame {
    /// Who.
    pub owner: usize,
    /// What.
    pub spec: v1::FrameSpec,
    /// Not to be asked for yet.
    pub held_back: bool,
    /// It was checked against the reference.
    pub done: bool,
    /// Records that somebody gathered for it, rather than find them.
    pub gathered: u64,
}

impl Frame {
    /// One to be rendered.
    pub fn new(owner: usize, spec: v1::FrameSpec) -> Self {
        Self { owner, spec, held_back: false, done: false, gathered: 0 }
    }
}

/// How an attempt ended.
enum End {
    Done(Vec<Vec<u8>>, v1::FrameDone),
    /// The server was lost.
    Broken,
    /// The server was away for too long: the program ends, somebody starts it again.
    GaveUp,
}

/// The base a frame was begun with.
struct Base {
    digest: Digest,
    /// Its frame found everything there.
    filled: bool,
    /// How often the disk had been lost when its frame was opened.
    losses: u32,
    /// `None`: it could not be found out.
    records: Option<Vec<(Tag, Record)>>,
}

/// Renders the frames of an owner one after another. When its machine crashes, the picture it was at is begun anew.
pub async fn owner(farm: Rc<Farm>, owner: usize) -> turmoil::Result {
    let wanted = |frame: &Frame| frame.owner == owner && !frame.done && !frame.held_back;
    loop {
        let next = farm.frames.borrow().iter().position(wanted);
        let Some(at) = next else {
            tokio::time::sleep(Duration::from_millis(500)).await;
            continue;
        };
        let spec = farm.frames.borrow()[at].spec.clone();
        let gathered = render(&farm, &spec).await;
        let frame = &mut farm.frames.borrow_mut()[at];
        (frame.done, frame.gathered) = (true, gathered);
    }
}

/// Renders a frame and checks the picture; says how many records were gathered.
async fn render(farm: &Rc<Farm>, spec: &v1::FrameSpec) -> u64 {
    let mut base = None;
    loop {
        match attempt(farm, spec, &mut base).await {
            End::Done(tiles, done) => {
                check(farm, spec, base, &tiles, &done);
                let count = |prefix: &str| -> f64 {
                    done.counts.iter().filter(|c| c.name.starts_with(prefix)).map(|c| c.value).sum()
                };
                return (count("records.") - count("reused")) as u64;
            }
            End::Broken => events::note("owner", "lost the server"),
            End::GaveUp => base = None,
        }
    }
}

fn check(farm: &Farm, spec: &v1::FrameSpec, base: Option<Base>, tiles: &[Vec<u8>], done: &v1::FrameDone) {
    events::note("owner", format_args!("done: {} records, {} leases lost", done.records, done.leases_lost));
    // Whoever opened it before the disk was lost and could not know the records cannot know the picture either.
    let Some(Base { records: Some(records), losses, filled, .. }) = base else {
        return events::note("owner", "picture not checked");
    };
    let expected = reference(spec, &records, filled);
    let all = (records.len() + expected.gathered.len()) as u64;
    if done.records != all {
        events::wrong(format_args!("a picture read {} records, expected {all}", done.records));
    }
    let disk = farm.disk.replica();
    let durable = |id: &&RecordId| disk.set(&namespace(spec.levels)).is_some_and(|set| set.get(**id).is_some());
    let published = expected.gathered.iter().filter(durable).count();
    // What was told before the disk was lost may be heard after.
    if published < expected.gathered.len() && losses == farm.disk.losses() {
        let all = expected.gathered.len();
        events::wrong(format_args!("a picture is done and {published} of its {all} records are published"));
    }
    if tiles != expected.tiles {
        events::wrong("a picture is not that of the reference");
    }
}

async fn attempt(farm: &Rc<Farm>, spec: &v1::FrameSpec, base: &mut Option<Base>) -> End {
    let frames = client::frames(connect());
    let asked = base.as_ref().map(|base| (convert::digest_bytes(base.digest), base.filled)).unwrap_or_default();
    let opening = client::retry(|| {
        let (spec, (base, filled)) = (Some(spec.clone()), asked.clone());
        let mut frames = frames.clone();
        async move { frames.open(v1::OpenRequest { spec, base, filled }).await }
    });
    let mut away = farm.away.subscribe();
    let mut events = match opening.await {
        Ok(events) => events,
        Err(status) => return give_up("opening a frame", &status),
    };
    let mut tiles = vec![Vec::new(); (spec.width / spec.tile_size) as usize];
    loop {
        let event = tokio::select! {
            biased;
            Ok(()) = away.changed() => {
                drop(events);
                let time = *away.borrow();
                events::note("owner", "goes away");
                tokio::time::sleep(time).await;
                return End::Broken;
            }
            event = events.message() => event,
        };
        match event {
            Ok(Some(v1::FrameEvent { event: Some(event) })) => match event {
                Event::Opened(opened) => opened_with(farm, spec, base, &opened),
                // Its scene is made up: nobody lacks it.
                Event::SceneWanted(_) => {}
                Event::Tile(tile) => {
                    let place = &mut tiles[tile.tile as usize];
                    if !place.is_empty() {
                        events::wrong(format_args!("tile {} came twice", tile.tile));
                    }
                    *place = tile.pixels.to_vec();
                }
                Event::Done(done) => {
                    if tiles.iter().any(Vec::is_empty) {
                        events::wrong("a picture ended with tiles missing");
                    }
                    return End::Done(tiles, done);
                }
                Event::Declined(declined) => {
                    events::wrong(format_args!("{} declined: {}", declined.worker, declined.reason));
                }
                Event::Progress(progress) => {
                    let step = progress.step.unwrap_or_default();
                    events::note("owner", format_args!("step {}, {} tiles done", step.index, progress.tiles_done));
                }
            },
            Ok(_) => return End::Broken,
            Err(status) if client::is_passing(&status) => return End::Broken,
            Err(status) => return give_up("a frame", &status),
        }
    }
}

fn give_up(what: &str, status: &Status) -> End {
    if !client::is_passing(status) {
        events::wrong(format_args!("{what} ended: {status}"));
    }
    events::note("owner", "gives up and is started again");
    End::GaveUp
}

fn opened_with(farm: &Rc<Farm>, spec: &v1::FrameSpec, base: &mut Option<Base>, opened: &v1::FrameOpened) {
    let digest = convert::digest(&opened.base).expect("the server's own");
    events::note("owner", format_args!("frame {} reads {} records", opened.frame, opened.base_records));
    if let Some(before) = base.as_ref().filter(|before| before.digest != digest) {
        let namespace = namespace(spec.levels);
        let held = |records: &Vec<(Tag, Record)>| records.iter().all(|(_, r)| farm.is_held(&namespace, r.id()));
        if before.records.as_ref().is_some_and(held) {
            events::wrong("a frame begun again has another base, though its records are held");
        }
        events::note("owner", "the base is lost");
    }
    let losses = farm.disk.losses();
    match base {
        Some(base) if base.digest == digest => base.losses = losses,
        _ => {
            let records = farm.disk.prefix(&namespace(spec.levels), digest);
            *base = Some(Base { digest, filled: opened.filled, losses, records });
        }
    }
}
