//! Addresses and the sockets bound to them.

use std::fmt;
use std::fs;
use std::io;
use std::net::{SocketAddr, ToSocketAddrs as _};
use std::os::unix::fs::{FileTypeExt as _, MetadataExt as _, PermissionsExt as _};
use std::path::{Path, PathBuf};
use std::str::FromStr;

use tokio::net::{TcpListener, UnixListener};

/// Longest path of a Unix socket, bytes; the kernel's own bound.
const SOCKET_PATH_MAX: usize = 107;

/// Why the server cannot run, in one line.
#[derive(Debug, thiserror::Error)]
pub enum ServeError {
    /// Wrong usage: exit code 2.
    #[error("{0}")]
    Usage(String),
    /// Everything else: exit code 1.
    #[error("{0}")]
    Failed(String),
}

impl ServeError {
    /// The exit code of a command that ends with this.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Usage(_) => 2,
            Self::Failed(_) => 1,
        }
    }
}

/// Where to listen: `HOST:PORT` (port 0: any free one) or `unix:/path`.
#[derive(Clone, PartialEq, Eq, Debug)]
pub enum Listen {
    /// TCP.
    Tcp(SocketAddr),
    /// A Unix socket; its file belongs to the user alone.
    Unix(PathBuf),
}

impl Listen {
    /// Whether only this machine can connect.
    pub fn is_local(&self) -> bool {
        match self {
            Self::Tcp(address) => address.ip().is_loopback(),
            Self::Unix(_) => true,
        }
    }
}

impl FromStr for Listen {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if let Some(path) = text.strip_prefix("unix:") {
            return match path.len() {
                1..=SOCKET_PATH_MAX => Ok(Self::Unix(path.into())),
                length => Err(format!("path has {length} bytes, expected 1 to {SOCKET_PATH_MAX}")),
            };
        }
        let mut found = text.to_socket_addrs().map_err(|error| format!("not HOST:PORT or unix:/path ({error})"))?;
        found.next().map(Self::Tcp).ok_or_else(|| "the host has no address".into())
    }
}

impl fmt::Display for Listen {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Tcp(address) => write!(f, "{address}"),
            Self::Unix(path) => write!(f, "unix:{}", path.display()),
        }
    }
}

/// A socket that is bound: clients can connect from now on, and are answered once it is served.
#[derive(Debug)]
pub struct Bound {
    pub(crate) socket: Socket,
    address: Listen,
}

#[derive(Debug)]
pub(crate) enum Socket {
    Tcp(TcpListener),
    /// For calls of health alone.
    Health(TcpListener),
    Unix(UnixListener, SocketFile),
}

impl Bound {
    /// The address clients connect to; its port is the real one.
    pub fn address(&self) -> &Listen {
        &self.address
    }
}

/// Binds a socket. Unless those that connect are asked who they are, or that is not wanted, it must be `open` to nobody
/// else.
///
/// Must be called within a tokio runtime.
///
/// # Errors
/// [`ServeError::Usage`] for an address that is not allowed or not there; [`ServeError::Failed`] for one that is taken.
pub fn bind(listen: &Listen, open: bool) -> Result<Bound, ServeError> {
    if !listen.is_local() && !open {
        return Err(ServeError::Usage(format!(
            "{listen} can be reached by others, who could read and change everything: give --tls-cert, --tls-key and \
             --token-file, use a loopback address or a Unix socket, or say --insecure"
        )));
    }
    match listen {
        Listen::Tcp(address) => bind_tcp(*address, Socket::Tcp),
        Listen::Unix(path) => bind_unix(path),
    }
    .map_err(|error| cannot(listen, &error))
}

/// Binds a socket that answers calls of health alone, unencrypted: whoever connects learns only whether the server is
/// ready, and changes nothing.
///
/// Must be called within a tokio runtime.
///
/// # Errors
/// As [`bind`].
pub fn bind_health(address: SocketAddr) -> Result<Bound, ServeError> {
    bind_tcp(address, Socket::Health).map_err(|error| cannot(&Listen::Tcp(address), &error))
}

fn cannot(listen: &Listen, error: &io::Error) -> ServeError {
    let said = format!("cannot listen on {listen}: {error}");
    match error.kind() {
        io::ErrorKind::AddrInUse | io::ErrorKind::PermissionDenied => ServeError::Failed(said),
        _ => ServeError::Usage(said),
    }
}

fn bind_tcp(address: SocketAddr, of: fn(TcpListener) -> Socket) -> io::Result<Bound> {
    let listener = std::net::TcpListener::bind(address)?;
    listener.set_nonblocking(true)?;
    let listener = TcpListener::from_std(listener)?;
    let address = Listen::Tcp(listener.local_addr()?);
    Ok(Bound { socket: of(listener), address })
}

fn bind_unix(path: &Path) -> io::Result<Bound> {
    remove_stale(path)?;
    let listener = UnixListener::bind(path)?;
    let file = SocketFile::new(path)?;
    // Until here the umask applies; the usual ones let nobody else connect either.
    fs::set_permissions(path, fs::Permissions::from_mode(0o600))?;
    Ok(Bound { socket: Socket::Unix(listener, file), address: Listen::Unix(path.into()) })
}

/// Removes the socket file of a server that is gone. One that answers, or a file of another kind, is an error.
fn remove_stale(path: &Path) -> io::Result<()> {
    let in_use = |what| Err(io::Error::new(io::ErrorKind::AddrInUse, what));
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(error),
        Ok(metadata) if !metadata.file_type().is_socket() => return in_use("a file that is no socket is there"),
        Ok(_) => (),
    }
    match std::os::unix::net::UnixStream::connect(path) {
        Ok(_) => in_use("another server listens there"),
        Err(error) if error.kind() == io::ErrorKind::ConnectionRefused => fs::remove_file(path),
        Err(error) => Err(error),
    }
}

/// Removes the socket's file when dropped, unless another has taken its place.
#[derive(Debug)]
pub(crate) struct SocketFile {
    path: PathBuf,
    identity: (u64, u64),
}

impl SocketFile {
    fn new(path: &Path) -> io::Result<Self> {
        Ok(Self { path: path.into(), identity: identity(path)? })
    }
}

impl Drop for SocketFile {
    fn drop(&mut self) {
        if identity(&self.path).is_ok_and(|now| now == self.identity) {
            // Nobody can be told, and the next server replaces a file that stays.
            let _ = fs::remove_file(&self.path);
        }
    }
}

fn identity(path: &Path) -> io::Result<(u64, u64)> {
    fs::symlink_metadata(path).map(|metadata| (metadata.dev(), metadata.ino()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Listen, String> {
        text.parse()
    }

    #[test]
    fn addresses_are_read_and_shown_alike() {
        for text in ["127.0.0.1:4670", "[::1]:0", "unix:/run/ambience.sock"] {
            assert_eq!(parse(text).map(|listen| listen.to_string()), Ok(text.into()));
        }
        for text in ["", "4670", "127.0.0.1", "127.0.0.1:70000", "unix:"] {
            assert!(parse(text).is_err(), "{text}");
        }
        assert!(parse(&format!("unix:/{}", "x".repeat(107))).is_err());
    }

    #[tokio::test]
    async fn what_others_can_reach_needs_insecure() {
        let open = parse("0.0.0.0:0").expect("an address");
        let error = bind(&open, false).expect_err("refused");
        assert_eq!(error.exit_code(), 2);
        assert!(error.to_string().contains("0.0.0.0:0") && error.to_string().contains("--insecure"));
        assert!(bind(&open, true).is_ok());
    }

    #[tokio::test]
    async fn a_port_in_use_is_named() {
        let first = bind(&parse("127.0.0.1:0").expect("an address"), false).expect("bound");
        let error = bind(first.address(), false).expect_err("in use");
        assert_eq!(error.exit_code(), 1);
        assert!(error.to_string().contains(&first.address().to_string()), "{error}");
    }

    #[tokio::test]
    async fn a_stale_socket_is_replaced_a_live_one_or_a_file_is_not() {
        let folder = tempfile::tempdir().expect("a folder");
        let listen = Listen::Unix(folder.path().join("a.sock"));
        let Listen::Unix(path) = &listen else { unreachable!() };

        drop(std::os::unix::net::UnixListener::bind(path).expect("bound"));
        let bound = bind(&listen, false).expect("the stale one is replaced");
        assert_eq!(fs::metadata(path).expect("there").permissions().mode() & 0o777, 0o600);
        assert_eq!(bind(&listen, false).expect_err("live").exit_code(), 1);
        drop(bound);
        assert!(!path.exists());

        fs::write(path, "precious").expect("written");
        assert!(bind(&listen, false).expect_err("a file").to_string().contains("no socket"));
        assert!(path.exists());

        let nowhere = Listen::Unix(folder.path().join("no/such/folder"));
        assert_eq!(bind(&nowhere, false).expect_err("no folder").exit_code(), 2);
    }
}
