//! Sealed levels kept ready to answer clients that hold no replica.

use std::sync::{Arc, Mutex};

use cache_core::cached::Query;
use cache_core::{Irradiance, Namespace, Sealed};
use cache_proto::convert;
use cache_proto::v1::QueryRequest;
use glam::Vec3;
use tokio::sync::Semaphore;

use crate::refusal::Refusal;
use crate::store::{Store, lock};

/// Most points in one request.
pub const POINTS_MAX: usize = 65536;

/// Bytes of one packed point: position and normal, float32.
pub const POINT_BYTES: usize = 24;

/// Bytes of one packed answer: irradiance, float32, and the number of records that answered.
pub const ANSWER_BYTES: usize = 16;

/// Sealed levels kept; building one anew takes longer than anything else a query does.
const KEPT_MAX: usize = 4;

/// Queries worked on at once; others wait their turn.
const AT_ONCE: usize = 2;

/// What a sealed level was made of.
#[derive(Clone, Copy, PartialEq, Debug)]
struct Key {
    namespace: Namespace,
    level: u32,
    a: f32,
}

struct Kept {
    key: Key,
    /// Length of the namespace's log when it was sealed.
    position: u64,
    sealed: Arc<Sealed<Irradiance>>,
}

/// Answers queries from the store.
pub struct Queries {
    store: Arc<Store>,
    /// Least recently used first.
    kept: Mutex<Vec<Kept>>,
    turns: Semaphore,
}

impl Queries {
    /// Answers from `store`.
    pub fn new(store: Arc<Store>) -> Self {
        Self { store, kept: Mutex::default(), turns: Semaphore::new(AT_ONCE) }
    }

    /// Interpolates at every point of a tenant's request: [`ANSWER_BYTES`] each. The work is done off the async threads.
    ///
    /// # Errors
    /// What is unsound about the request, or [`Refusal::Foreign`].
    pub async fn answer(self: &Arc<Self>, tenant: &str, request: &QueryRequest) -> Result<Vec<u8>, Refusal> {
        let (key, points) = parse(request)?;
        self.store.replica().belongs(&key.namespace, tenant)?;
        let _turn = self.turns.acquire().await.map_err(|_| Refusal::Closing)?;
        let queries = self.clone();
        let work = tokio::task::spawn_blocking(move || pack(&queries.sealed(key), &points));
        work.await.map_err(|error| Refusal::Internal(error.to_string()))
    }

    /// The level as it is now, sealed anew only if the log grew.
    fn sealed(&self, key: Key) -> Arc<Sealed<Irradiance>> {
        let (position, records) = {
            let replica = self.store.replica();
            let position = replica.mark(&key.namespace).position;
            if let Some(sealed) = self.recall(key, position) {
                return sealed;
            }
            (position, replica.level(&key.namespace, key.level))
        };
        let mut sealed = Sealed::new(key.a);
        sealed.unite(&records);
        let sealed = Arc::new(sealed);
        let mut kept = lock(&self.kept);
        kept.retain(|k| k.key != key);
        if kept.len() == KEPT_MAX {
            kept.remove(0);
        }
        kept.push(Kept { key, position, sealed: sealed.clone() });
        sealed
    }

    fn recall(&self, key: Key, position: u64) -> Option<Arc<Sealed<Irradiance>>> {
        let mut kept = lock(&self.kept);
        let found = kept.iter().position(|k| k.key == key && k.position == position)?;
        let found = kept.remove(found);
        let sealed = found.sealed.clone();
        kept.push(found);
        Some(sealed)
    }
}

fn parse(request: &QueryRequest) -> Result<(Key, Vec<Query>), Refusal> {
    let namespace = convert::namespace(&request.namespace)?;
    if !(1..=64).contains(&request.level) {
        return Err(Refusal::field("level", format!("is {}, expected 1 to 64", request.level)));
    }
    if !(request.a > 0.0 && request.a <= 10.0) {
        return Err(Refusal::field("a", format!("is {}, expected more than 0 and at most 10", request.a)));
    }
    let bytes = request.points.len();
    if !bytes.is_multiple_of(POINT_BYTES) || bytes > POINTS_MAX * POINT_BYTES {
        let reason = format!("{bytes} bytes, expected {POINT_BYTES} for each of at most {POINTS_MAX} points");
        return Err(Refusal::field("points", reason));
    }
    let points = request.points.chunks_exact(POINT_BYTES).enumerate().map(|(i, bytes)| point(i, bytes));
    Ok((Key { namespace, level: request.level, a: request.a }, points.collect::<Result<_, _>>()?))
}

fn point(index: usize, bytes: &[u8]) -> Result<Query, Refusal> {
    let mut floats = [0f32; 6];
    for (value, four) in floats.iter_mut().zip(bytes.chunks_exact(4)) {
        *value = f32::from_le_bytes([four[0], four[1], four[2], four[3]]);
    }
    let [px, py, pz, nx, ny, nz] = floats;
    let query = Query::new(Vec3::new(px, py, pz), Vec3::new(nx, ny, nz));
    if !query.position.is_finite() || !query.normal.is_finite() {
        return Err(Refusal::field("points", format!("point {index} is not finite")));
    }
    let length = query.normal.length();
    if (length - 1.0).abs() > 1e-3 {
        return Err(Refusal::field("points", format!("point {index} has a normal of length {length}, expected 1")));
    }
    Ok(query)
}

fn pack(sealed: &Sealed<Irradiance>, points: &[Query]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(points.len() * ANSWER_BYTES);
    for query in points {
        let answer = sealed.ask(query).unwrap_or_default();
        for value in answer.irradiance.to_array() {
            bytes.extend_from_slice(&value.to_le_bytes());
        }
        bytes.extend_from_slice(&answer.records.to_le_bytes());
    }
    bytes
}
