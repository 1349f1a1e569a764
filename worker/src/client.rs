//! The connection to a server: addresses, channels, and which calls are worth repeating.

use std::error::Error;
use std::future::Future;
use std::io;
use std::net::IpAddr;
use std::path::PathBuf;
use std::str::FromStr;
use std::sync::LazyLock;
use std::time::Duration;

use cache_proto::v1;
use hyper_util::rt::TokioIo;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::time::Instant;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, ClientTlsConfig, Endpoint, Uri};
use tonic::{Code, Response, Status};

use crate::credentials::{Bearer, Credentials};
use crate::traffic::Traffic;

/// How long a server may be away before its clients give up.
pub const PATIENCE: Duration = Duration::from_secs(30);

/// Longest message of the Frames service, bytes: the server leases at most 4 MiB of tiles at a time.
pub const FRAMES_MESSAGE_MAX: usize = 8 << 20;

/// Longest single attempt of a call. The longest the server takes its time for is `Lease`, 10 s.
const ATTEMPT: Duration = Duration::from_secs(20);
const CONNECT: Duration = Duration::from_secs(5);
const KEEP_ALIVE: Duration = Duration::from_secs(10);
const BACKOFF_FIRST: Duration = Duration::from_millis(50);
const BACKOFF_MAX: Duration = Duration::from_secs(1);
/// HTTP/2 windows, bytes; the default of 64 KiB would stop a batch of 448 KiB seven times.
const STREAM_WINDOW: u32 = 4 << 20;
const CONNECTION_WINDOW: u32 = 8 << 20;

/// Where a server listens.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Address {
    /// `HOST:PORT`.
    Tcp(String),
    /// `unix:PATH`.
    Unix(PathBuf),
}

impl Address {
    /// Whether what is sent there stays on this machine.
    pub fn is_local(&self) -> bool {
        let Self::Tcp(at) = self else { return true };
        let host = host(at);
        host == "localhost" || host.parse::<IpAddr>().is_ok_and(|ip| ip.is_loopback())
    }
}

/// The host of `HOST:PORT`, without the brackets of IPv6.
fn host(at: &str) -> &str {
    let host = at.rsplit_once(':').map_or(at, |(host, _)| host);
    host.strip_prefix('[').and_then(|host| host.strip_suffix(']')).unwrap_or(host)
}

impl FromStr for Address {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("{text:?} is no address; expected HOST:PORT or unix:PATH");
        if let Some(path) = text.strip_prefix("unix:") {
            return if path.is_empty() { Err(wrong()) } else { Ok(Self::Unix(path.into())) };
        }
        let (host, port) = text.rsplit_once(':').ok_or_else(wrong)?;
        let sound = !host.is_empty() && port.parse::<u16>().is_ok_and(|p| p > 0);
        let uri = format!("http://{text}").parse::<Uri>().is_ok_and(|u| u.path() == "/" && u.query().is_none());
        if sound && uri { Ok(Self::Tcp(text.into())) } else { Err(wrong()) }
    }
}

impl std::fmt::Display for Address {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Tcp(at) => f.write_str(at),
            Self::Unix(path) => write!(f, "unix:{}", path.display()),
        }
    }
}

/// A connection to a server: whatever is called over it carries the token.
pub type Line = InterceptedService<Channel, Bearer>;

/// A line to `address`. It connects with the first call and again whenever the connection was lost, so an absent server
/// shows as `Unavailable` there, not here.
///
/// # Errors
/// When the authority's certificate cannot be used.
pub fn connect(address: &Address, credentials: &Credentials) -> Result<Line, String> {
    connect_counted(address, credentials, &Traffic::default())
}

/// As [`connect`]; what goes through its sockets is counted.
///
/// # Errors
/// As [`connect`].
pub fn connect_counted(address: &Address, credentials: &Credentials, traffic: &Traffic) -> Result<Line, String> {
    Ok(over(dial(address, credentials, traffic)?, credentials.bearer()))
}

/// A line over a connection that others use too.
pub fn over(channel: Channel, bearer: Bearer) -> Line {
    InterceptedService::new(channel, bearer)
}

/// The connection alone, without the token.
///
/// # Errors
/// As [`connect`].
pub fn dial(address: &Address, credentials: &Credentials, traffic: &Traffic) -> Result<Channel, String> {
    let traffic = traffic.clone();
    Ok(match address.clone() {
        Address::Tcp(at) => {
            let endpoint = endpoint(&at, credentials)?;
            channel(&endpoint, move || {
                let (at, traffic) = (at.clone(), traffic.clone());
                async move {
                    let stream = tokio::net::TcpStream::connect(at).await?;
                    stream.set_nodelay(true)?;
                    Ok(traffic.count(stream))
                }
            })
        }
        #[cfg(unix)]
        Address::Unix(path) => channel(&NAMELESS, move || {
            let (path, traffic) = (path.clone(), traffic.clone());
            async move { Ok(traffic.count(tokio::net::UnixStream::connect(path).await?)) }
        }),
        #[cfg(not(unix))]
        Address::Unix(_) => channel(&NAMELESS, || async {
            Err::<tokio::net::TcpStream, _>(io::Error::new(io::ErrorKind::Unsupported, "no Unix sockets here"))
        }),
    })
}

/// Where it does not matter what the Host header says, because `open` knows where to go.
static NAMELESS: LazyLock<Endpoint> = LazyLock::new(|| Endpoint::from_static("http://ambience"));

/// The server at `HOST:PORT`; its certificate has to be for that host, if an authority is to vouch for it.
fn endpoint(at: &str, credentials: &Credentials) -> Result<Endpoint, String> {
    let Some(authority) = credentials.certificate() else { return Ok(NAMELESS.clone()) };
    let tls = ClientTlsConfig::new().ca_certificate(authority).domain_name(host(at)).timeout(CONNECT);
    let endpoint = Endpoint::from_shared(format!("https://{at}")).and_then(|endpoint| endpoint.tls_config(tls));
    endpoint.map_err(|error| format!("--tls-ca: {}", cause(&error)))
}

/// A line whose bytes travel over whatever `open` opens: a simulated socket, say. No token, no encryption.
pub fn connect_with<O, F, S>(open: O) -> Line
where
    O: Fn() -> F + Send + 'static,
    F: Future<Output = io::Result<S>> + Send + 'static,
    S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
{
    InterceptedService::new(channel(&NAMELESS, open), Bearer::default())
}

fn channel<O, F, S>(endpoint: &Endpoint, open: O) -> Channel
where
    O: Fn() -> F + Send + 'static,
    F: Future<Output = io::Result<S>> + Send + 'static,
    S: AsyncRead + AsyncWrite + Send + Unpin + 'static,
{
    let connector = tower::service_fn(move |_: Uri| {
        let opening = open();
        async move { opening.await.map(TokioIo::new) }
    });
    endpoint
        .clone()
        .connect_timeout(CONNECT)
        .http2_keep_alive_interval(KEEP_ALIVE)
        .keep_alive_timeout(KEEP_ALIVE)
        .keep_alive_while_idle(true)
        .initial_stream_window_size(STREAM_WINDOW)
        .initial_connection_window_size(CONNECTION_WINDOW)
        .connect_with_connector_lazy(connector)
}

/// Client of the Cache service.
pub type Cache = v1::cache_client::CacheClient<Line>;

/// Client of the Frames service.
pub type Frames = v1::frames_client::FramesClient<Line>;

/// Client of the Cache service over `line`.
pub fn cache(line: Line) -> Cache {
    Cache::new(line)
}

/// Client of the Frames service over `line`, with room for many tiles in one message.
pub fn frames(line: Line) -> Frames {
    Frames::new(line).max_decoding_message_size(FRAMES_MESSAGE_MAX).max_encoding_message_size(FRAMES_MESSAGE_MAX)
}

/// Whether an idempotent call that failed so may succeed when repeated. A cut stream comes as `Unknown`, a timeout of
/// the transport as `Cancelled`.
pub fn is_passing(status: &Status) -> bool {
    let by_transport = std::error::Error::source(status).is_some_and(|source| source.is::<tonic::transport::Error>());
    by_transport
        || matches!(status.code(), Code::Unavailable | Code::Unknown | Code::Cancelled | Code::DeadlineExceeded)
}

/// Why a server cannot be called as it was, if that is what a call failed for: repeating it would not mend that.
fn estranged(status: &Status) -> Option<Status> {
    let tls = chain(status)
        .filter_map(|error| error.downcast_ref::<io::Error>())
        .find(|error| error.kind() == io::ErrorKind::InvalidData);
    if let Some(error) = tls {
        return Some(Status::failed_precondition(format!("no trust in the encrypted connection: {error}")));
    }
    // What HTTP/2 reads in the answer of a server that encrypts.
    let garbled = chain(status).any(|error| error.to_string().ends_with("frame with invalid size"));
    garbled.then(|| Status::failed_precondition("does not answer in HTTP/2; if it encrypts, give --tls-ca"))
}

/// The innermost reason of an error; those around it say less.
fn cause(error: &(dyn Error + 'static)) -> String {
    chain(error).last().unwrap_or(error).to_string()
}

fn chain<'a>(error: &'a (dyn Error + 'static)) -> impl Iterator<Item = &'a (dyn Error + 'static)> {
    std::iter::successors(Some(error), |error| (*error).source())
}

/// Waiting times between attempts: doubling from 50 ms to 1 s.
#[derive(Debug)]
pub struct Backoff(Duration);

impl Default for Backoff {
    fn default() -> Self {
        Self(BACKOFF_FIRST)
    }
}

impl Backoff {
    /// Waits, and longer the next time.
    pub async fn wait(&mut self) {
        tokio::time::sleep(self.0).await;
        self.0 = (self.0 * 2).min(BACKOFF_MAX);
    }
}

/// Makes an idempotent call until it is answered, at most until [`PATIENCE`] has passed since it first failed.
///
/// # Errors
/// The last failure: one that repeating does not mend, or one that lasted too long ([`is_passing`] tells which).
pub async fn retry<T, F, R>(call: F) -> Result<T, Status>
where
    F: FnMut() -> R,
    R: Future<Output = Result<Response<T>, Status>>,
{
    retry_for(PATIENCE, call).await
}

/// As [`retry`], with another patience.
///
/// # Errors
/// As [`retry`].
pub async fn retry_for<T, F, R>(patience: Duration, mut call: F) -> Result<T, Status>
where
    F: FnMut() -> R,
    R: Future<Output = Result<Response<T>, Status>>,
{
    let (mut backoff, mut failing) = (Backoff::default(), None);
    loop {
        let answer = tokio::time::timeout(ATTEMPT, call()).await;
        let status = match answer {
            Ok(Ok(response)) => return Ok(response.into_inner()),
            Ok(Err(status)) => match estranged(&status) {
                Some(estranged) => return Err(estranged),
                None if !is_passing(&status) => return Err(status),
                None => status,
            },
            Err(_) => Status::deadline_exceeded(format!("no answer within {} s", ATTEMPT.as_secs())),
        };
        let since = *failing.get_or_insert_with(Instant::now);
        if since.elapsed() >= patience {
            return Err(status);
        }
        backoff.wait().await;
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    #[test]
    fn addresses_are_read_and_shown() {
        for sound in ["127.0.0.1:4670", "render-7.farm:80", "[::1]:4670", "unix:/a b", "unix:socket"] {
            assert_eq!(sound.parse::<Address>().expect(sound).to_string(), sound);
        }
        for wrong in ["", "host", "host:", ":80", "host:0", "host:70000", "unix:", "http://host:80", "a b:80"] {
            assert!(wrong.parse::<Address>().expect_err(wrong).contains("HOST:PORT or unix:PATH"));
        }
    }

    #[tokio::test(start_paused = true)]
    async fn what_passes_is_repeated_and_what_does_not_is_not() {
        let calls = Cell::new(0);
        let after = |failures: u32, status: Status| {
            calls.set(0);
            let calls = &calls;
            retry(move || {
                calls.set(calls.get() + 1);
                let answer = if calls.get() > failures { Ok(Response::new(calls.get())) } else { Err(status.clone()) };
                async move { answer }
            })
        };
        assert_eq!(after(4, Status::unavailable("away")).await.expect("mended"), 5);
        assert_eq!(after(4, Status::unknown("cut")).await.expect("mended"), 5);
        assert!(after(4, Status::invalid_argument("wrong")).await.is_err());
        assert_eq!(calls.get(), 1);
        let began = Instant::now();
        assert_eq!(after(u32::MAX, Status::unavailable("away")).await.expect_err("gone").message(), "away");
        assert!((30..33).contains(&began.elapsed().as_secs()));
    }
}
