//! The server itself: services, health, reflection, shutdown. The transport is a seam: [`serve`] feeds it sockets,
//! a simulator feeds [`serve_on`] whatever it likes.

use std::convert::Infallible;
use std::future::Future;
use std::hash::{BuildHasher as _, Hasher as _, RandomState};
use std::io;
use std::sync::Arc;
use std::time::Duration;

use cache_proto::v1::cache_server::CacheServer;
use cache_proto::v1::frames_server::FramesServer;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::sync::watch;
use tokio::task::JoinSet;
use tokio_stream::Stream;
use tokio_stream::wrappers::UnixListenerStream;
use tonic::service::Routes;
use tonic::transport::Server;
use tonic::transport::server::{Connected, TcpIncoming};

use crate::access::Tokens;
use crate::cache_service::CacheService;
use crate::clock::Clock;
use crate::door::Door;
use crate::frames_service::{Board, FramesService};
use crate::gate::Gate;
use crate::health::Health;
use crate::journal::{Journal, Nowhere};
use crate::limits::Limits;
use crate::listen::{Bound, ServeError, Socket};
use crate::metrics::{self, Census};
use crate::store::Store;
use crate::tls::Tls;

type BoxError = Box<dyn std::error::Error + Send + Sync>;

/// How often lost leases are looked for.
const TICK: Duration = Duration::from_millis(250);

/// A client that does not answer a ping, sent after this long without a word, for as long again, is gone.
const KEEPALIVE: Duration = Duration::from_secs(10);

/// How long calls may take to end once the server was told to shut down; those that wait are sent away at once.
const DRAIN: Duration = Duration::from_secs(5);

/// Largest message to the cache service, bytes: 65536 points of a query fit.
pub const CACHE_MESSAGE_MAX: usize = 2 << 20;

/// Largest message to the frames service, bytes: the tiles of a lease fit.
const FRAMES_MESSAGE_MAX: usize = 8 << 20;

/// HTTP/2 window, bytes: what a client may send ahead on one stream.
pub const STREAM_WINDOW: u32 = 1 << 20;

/// The same for one connection, and the most it can make the server hold.
pub const CONNECTION_WINDOW: u32 = 2 << 20;

/// Longest list of headers of one call, bytes.
const HEADERS_MAX: u32 = 16 << 10;

/// Calls that a client may take back before the server saw them, or spoil, at a time; one that does more is cut.
const RESETS_MAX: usize = 64;

/// Connections to an address for health alone, beside those past the bound: health answers them too.
const PROBES_MAX: usize = 16;

/// What a server is made of.
pub struct Config {
    /// Bounds of what it keeps.
    pub limits: Limits,
    /// Where inserts are made durable.
    pub journal: Box<dyn Journal>,
    /// Where numbers of frames and leases begin; see [`crate::frames::Frames::new`].
    pub first_number: u64,
    /// Who may call.
    pub tokens: Tokens,
    /// How TCP connections are encrypted, if they are.
    pub tls: Option<Tls>,
    /// Who answers in place of this server's own store and frames: a relay.
    pub instead: Option<Routes>,
}

impl Default for Config {
    /// Keeps records in memory only; numbers begin at random.
    fn default() -> Self {
        // Below 2^52, so that scripts may hold them in a double.
        let random = RandomState::new().build_hasher().finish() >> 32;
        Self {
            limits: Limits::default(),
            journal: Box::new(Nowhere),
            first_number: (random << 20) + 1,
            tokens: Tokens::default(),
            tls: None,
            instead: None,
        }
    }
}

/// The state behind all sockets of one server. Cheap to clone.
#[derive(Clone)]
pub struct Node {
    store: Arc<Store>,
    board: Arc<Board>,
    door: Arc<Door>,
    gate: Gate,
    health: Arc<Health>,
    tls: Option<Tls>,
    instead: Option<Routes>,
    calls: u32,
}

impl Node {
    /// Opens the store. Must be called within a tokio runtime, whose clock it uses from then on.
    ///
    /// # Errors
    /// When the journal cannot be read.
    pub fn new(config: Config) -> io::Result<Self> {
        let Config { limits, journal, first_number, tokens, tls, instead } = config;
        let (store, writer) = Store::open(limits, journal)?;
        tokio::spawn(writer.run());
        let store = Arc::new(store);
        let board = Arc::new(Board::new(store.clone(), Clock::start(), limits, first_number));
        let (door, gate) = (Arc::new(Door::new(limits.connections)), Gate::new(tokens, limits.inflow));
        // The range of the limit is far smaller than a u32.
        let calls = u32::try_from(limits.calls).unwrap_or(u32::MAX);
        Ok(Self { store, board, door, gate, health: Arc::default(), tls, instead, calls })
    }

    /// What clients call, beside health.
    fn services(&self) -> Result<Routes, BoxError> {
        let services = self.instead.clone().unwrap_or_else(|| {
            let cache = CacheServer::new(CacheService::new(self.store.clone(), self.board.clone()));
            let frames = FramesServer::new(FramesService::new(self.board.clone()));
            Routes::new(cache.max_decoding_message_size(CACHE_MESSAGE_MAX))
                .add_service(frames.max_decoding_message_size(FRAMES_MESSAGE_MAX))
        });
        let reflection = tonic_reflection::server::Builder::configure()
            .register_encoded_file_descriptor_set(cache_proto::DESCRIPTORS)
            .register_encoded_file_descriptor_set(tonic_health::pb::FILE_DESCRIPTOR_SET)
            .build_v1()?;
        Ok(services.add_service(reflection))
    }

    /// Takes back lost leases, and tells how things stand, for ever.
    pub async fn tick(&self) -> Infallible {
        let mut ticks = tokio::time::interval(TICK);
        loop {
            ticks.tick().await;
            self.board.tick();
            let ready = self.store.works();
            self.health.tell(ready).await;
            self.show(ready);
        }
    }

    fn show(&self, ready: bool) {
        let (records, namespaces) = self.store.replica().census();
        let ((frames, workers), (leases, oldest_lease)) = (self.board.census(), self.board.leases());
        let (connections, subscribers) = (self.door.open() as u64, self.store.subscribers());
        let census =
            Census { records, namespaces, connections, subscribers, frames, workers, leases, oldest_lease, ready };
        metrics::show(census);
    }

    /// Sends away all who wait: subscribers, owners of frames, workers without a lease.
    pub fn close(&self) {
        self.store.grown().close();
        self.board.close();
    }
}

/// Serves what `incoming` brings until `shutdown`, then lets calls end. [`Node::tick`] must run beside it, and somebody
/// must call [`Node::close`] at shutdown, or subscriptions hold it open.
///
/// # Errors
/// When the services cannot be built or the transport fails.
pub async fn serve_on<I, IO>(node: Node, incoming: I, shutdown: impl Future<Output = ()>) -> Result<(), BoxError>
where
    I: Stream<Item = io::Result<IO>>,
    IO: AsyncRead + AsyncWrite + Connected + Unpin + Send + 'static,
{
    let services = node.services()?;
    serve_routes(node, services, None, incoming, shutdown).await
}

async fn serve_routes<I, IO>(
    node: Node,
    services: Routes,
    tls: Option<Tls>,
    incoming: I,
    shutdown: impl Future<Output = ()>,
) -> Result<(), BoxError>
where
    I: Stream<Item = io::Result<IO>>,
    IO: AsyncRead + AsyncWrite + Connected + Unpin + Send + 'static,
{
    node.health.tell(node.store.works()).await;
    let mut server = Server::builder();
    if let Some(tls) = &tls {
        server = server.tls_config(tls.config().clone())?;
    }
    server
        .http2_keepalive_interval(Some(KEEPALIVE))
        .http2_keepalive_timeout(Some(KEEPALIVE))
        .initial_stream_window_size(STREAM_WINDOW)
        .initial_connection_window_size(CONNECTION_WINDOW)
        .max_concurrent_streams(node.calls)
        .http2_max_header_list_size(HEADERS_MAX)
        .http2_max_pending_accept_reset_streams(Some(RESETS_MAX))
        .http2_max_local_error_reset_streams(Some(RESETS_MAX))
        .layer(node.gate)
        .add_routes(services.add_service(node.health.service()))
        .serve_with_incoming_shutdown(node.door.guests(incoming), shutdown)
        .await?;
    Ok(())
}

/// Serves bound sockets until `shutdown`, then lets running calls end, for a few seconds at most. Files of Unix
/// sockets are removed.
///
/// # Errors
/// [`ServeError::Failed`] when the journal cannot be read or a transport fails.
pub async fn serve(sockets: Vec<Bound>, config: Config, shutdown: impl Future<Output = ()>) -> Result<(), ServeError> {
    let failed = |error: &dyn std::fmt::Display| ServeError::Failed(format!("cannot serve: {error}"));
    let node = Node::new(config).map_err(|error| failed(&error))?;
    let (stop, stopped) = watch::channel(false);
    let mut serving = JoinSet::new();
    for socket in sockets {
        serving.spawn(serve_socket(node.clone(), socket.socket, stopped.clone()));
    }
    let ended = async {
        while let Some(done) = serving.join_next().await {
            done.map_err(|error| failed(&error))?.map_err(|error| failed(&error))?;
        }
        Ok(())
    };
    tokio::pin!(ended);
    tokio::select! {
        result = &mut ended => return result,
        never = node.tick() => match never {},
        () = shutdown => (),
    }
    node.health.close().await;
    node.close();
    stop.send_replace(true);
    if let Ok(result) = tokio::time::timeout(DRAIN, ended).await {
        return result;
    }
    // Their tasks end with the runtime.
    tracing::warn!("calls are still running after {} s; not waiting for them", DRAIN.as_secs());
    Ok(())
}

async fn serve_socket(node: Node, socket: Socket, mut stopped: watch::Receiver<bool>) -> Result<(), BoxError> {
    let shutdown = async move {
        // An error means that `serve` itself was dropped.
        let _ = stopped.wait_for(|stopped| *stopped).await;
    };
    match socket {
        Socket::Tcp(listener) => {
            let (services, tls) = (node.services()?, node.tls.clone());
            let incoming = TcpIncoming::from(listener).with_nodelay(Some(true));
            serve_routes(node, services, tls, incoming, shutdown).await
        }
        Socket::Health(listener) => {
            // Probes must be answered also while clients have all connections, and cost them none.
            let node = Node { door: Arc::new(Door::new(PROBES_MAX)), ..node };
            serve_routes(node, Routes::default(), None, TcpIncoming::from(listener), shutdown).await
        }
        Socket::Unix(listener, _file) => serve_on(node, UnixListenerStream::new(listener), shutdown).await,
    }
}
