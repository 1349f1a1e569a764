//! The machines of a simulation, besides the owners of frames: the server, its workers, and clients that only share.

use std::cell::{Cell, RefCell};
use std::collections::{BTreeMap, BTreeSet};
use std::rc::Rc;
use std::sync::Arc;
use std::time::Duration;

use cache_core::id::Random;
use cache_core::{Namespace, RecordId, Tag};
use cache_proto::v1;
use cache_proto::v1::cache_client::CacheClient;
use cache_server::{Config, Node, serve_on};
use glam::Vec3;
use tokio::sync::watch;
use worker::client;
use worker::farm::Worker;
use worker::follow::{self, Follower};
use worker::traffic::Traffic;

use crate::disk::Disk;
use crate::job::{MadeUp, record};
use crate::network::{connect, connect_narrow, listen};
use crate::owner::Frame;
use crate::{events, network};

/// Namespace of those who only share.
pub const SHARED: Namespace = Namespace([0x53; 32]);

/// Most records the sharer inserts at once; some of its inserts fill more than one segment of the network.
const SHARED_MAX: f32 = 300.0;

/// What the machines of one simulation have in common with whoever watches them. They all run on its thread.
pub struct Farm {
    /// Decides all that is up to chance, but the network.
    pub seed: u64,
    /// Under the server.
    pub disk: Disk,
    /// How far the server's clock was moved on.
    pub clock: watch::Sender<Duration>,
    /// How long the owners go away for.
    pub away: watch::Sender<Duration>,
    /// The sharer inserts nothing more.
    pub quiet: Cell<bool>,
    /// Records the sharer sent.
    pub sent: RefCell<BTreeSet<RecordId>>,
    /// Records the sharer was told are kept.
    pub acknowledged: RefCell<BTreeSet<RecordId>>,
    /// Records that a lost disk may have taken along, until they are seen on the new one.
    pub owed: RefCell<BTreeSet<RecordId>>,
    /// What each witness follows now, if it runs.
    pub replicas: RefCell<BTreeMap<&'static str, Vec<(Namespace, Follower)>>>,
    /// The frames of each owner.
    pub frames: RefCell<Vec<Frame>>,
    started: Cell<u64>,
}

impl Farm {
    /// A farm whose owners render these frames.
    pub fn new(seed: u64, frames: Vec<Frame>) -> Rc<Self> {
        Rc::new(Self {
            seed,
            disk: Disk::new(seed),
            clock: watch::Sender::default(),
            away: watch::Sender::default(),
            quiet: Cell::default(),
            sent: RefCell::default(),
            acknowledged: RefCell::default(),
            owed: RefCell::default(),
            replicas: RefCell::default(),
            frames: RefCell::new(frames),
            started: Cell::default(),
        })
    }

    /// A number nothing else that ever started has.
    fn start(&self) -> u64 {
        self.started.set(self.started.get() + 1);
        self.started.get()
    }

    /// Whether the server showed a record that only shares to some witness.
    pub fn is_shown(&self, id: RecordId) -> bool {
        let replicas = self.replicas.borrow();
        let mut of_namespace = replicas.values().flatten().filter(|(followed, _)| *followed == SHARED);
        of_namespace.any(|(_, follower)| follower.read(|replica| replica.get(id).is_some()))
    }

    /// Whether some witness holds a record.
    pub fn is_held(&self, namespace: &Namespace, id: RecordId) -> bool {
        let replicas = self.replicas.borrow();
        let mut of_namespace = replicas.values().flatten().filter(|(followed, _)| followed == namespace);
        of_namespace.any(|(_, follower)| follower.known(id).is_some())
    }
}

/// The server on its disk.
pub async fn server(farm: Rc<Farm>) -> turmoil::Result {
    let first_number = farm.start() << 20;
    events::note(network::SERVER, "starts");
    let config = Config { journal: Box::new(farm.disk.clone()), first_number, ..Config::default() };
    let node = Node::new(config)?;
    let mut clock = farm.clock.subscribe();
    let jumps = async {
        while clock.changed().await.is_ok() {
            let by = *clock.borrow_and_update();
            tokio::time::advance(by).await;
        }
    };
    tokio::select! {
        biased;
        served = serve_on(node.clone(), listen().await?, std::future::pending()) => served.map_err(|error| error.to_string().into()),
        never = node.tick() => match never {},
        () = jumps => Ok(()),
    }
}

/// A worker, started again by whoever looks after it when it gave up on its server.
pub async fn worker(farm: Rc<Farm>, name: &'static str, threads: usize) -> turmoil::Result {
    loop {
        let worker = Arc::new(Worker::<MadeUp>::new(format!("{name}.{}", farm.start()), connect(), Traffic::default()));
        events::note(name, "starts");
        let lost = worker.work(threads).await;
        events::note(name, format_args!("ends: {:?}", lost.code()));
        if !client::is_passing(&lost) {
            events::wrong(format_args!("{name} ended: {lost}"));
        }
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
}

/// Inserts records of its own now and then, each until it is acknowledged.
pub async fn sharer(farm: Rc<Farm>) -> turmoil::Result {
    let incarnation = farm.start();
    let mut random = Random::named("sharer", &[farm.seed, incarnation]);
    let cache = client::cache(connect());
    for number in 0u64.. {
        tokio::time::sleep(Duration::from_millis(100 + (random.uniform() * 900.0) as u64)).await;
        if farm.quiet.get() {
            break;
        }
        let count = (random.uniform().powi(4) * SHARED_MAX) as u64 + 1;
        let ids =
            (0..count).map(|k| RecordId(u128::from(incarnation) << 96 | u128::from(number) << 32 | u128::from(k)));
        let ids: Vec<_> = ids.collect();
        farm.sent.borrow_mut().extend(&ids);
        let records: Vec<_> = ids.iter().map(|id| (Tag::level(1), record(*id, Vec3::X).into())).collect();
        let inserted = client::retry_for(Duration::MAX, || {
            let (mut cache, records) = (cache.clone(), &records);
            async move { follow::insert(&mut cache, &SHARED, records).await.map(tonic::Response::new) }
        });
        match inserted.await {
            Ok(kept) => events::note("sharer", format_args!("{count} records kept, log at {}", kept.position)),
            Err(status) => events::wrong(format_args!("an insert ended: {status}")),
        }
        farm.acknowledged.borrow_mut().extend(ids);
    }
    Ok(())
}

/// Follows what is shared, and the namespace of the frames, for as long as it runs.
pub async fn witness(farm: Rc<Farm>, name: &'static str, frames: Namespace) -> turmoil::Result {
    let line = connect();
    let follow = |namespace| (namespace, Follower::start(client::cache(line.clone()), namespace));
    farm.replicas.borrow_mut().insert(name, [SHARED, frames].map(follow).into());
    std::future::pending().await
}

/// Subscribes and never reads.
pub async fn sleeper() -> turmoil::Result {
    loop {
        let mut cache = CacheClient::new(connect_narrow());
        let request = v1::SubscribeRequest { namespace: SHARED.0.to_vec().into(), ..Default::default() };
        if let Ok(stream) = cache.subscribe(request).await {
            tokio::time::sleep(Duration::from_secs(3600)).await;
            drop(stream);
        }
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
}
