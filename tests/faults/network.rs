//! The simulated network under the real services.

use std::cell::RefCell;
use std::collections::BTreeMap;
use std::io;
use std::net::IpAddr;
use std::pin::Pin;
use std::sync::{Arc, Mutex, Weak};
use std::task::{Context, Poll, Waker};

use hyper_util::rt::TokioIo;
use tokio::io::{AsyncRead, AsyncWrite, ReadBuf};
use tokio_stream::Stream;
use tonic::transport::server::Connected;
use tonic::transport::{Channel, Endpoint};
use turmoil::net::{TcpListener, TcpStream};
use worker::client::{self, Line};

/// Name of the one server.
pub const SERVER: &str = "server";

const PORT: u16 = 4670;

/// The sockets of a host, oldest first; `None` when it is about to crash.
type Sockets = Option<Vec<Weak<Mutex<Inner>>>>;

thread_local! {
    static SOCKETS: RefCell<BTreeMap<IpAddr, Sockets>> = RefCell::default();
}

/// A simulated connection as tonic wants it.
pub struct Socket(Arc<Mutex<Inner>>);

struct Inner {
    /// `None`: closed by [`cut`].
    stream: Option<TcpStream>,
    reader: Option<Waker>,
    cut: bool,
}

/// Forgets the hosts of an earlier simulation.
pub fn begin() {
    SOCKETS.take();
}

/// Closes every socket of a host that is about to crash, in the order they were opened. A runtime that is dropped closes
/// them in an order that depends on what else the process did.
pub fn cut(host: IpAddr) {
    let sockets = SOCKETS.with_borrow_mut(|all| all.insert(host, None));
    for socket in sockets.flatten().into_iter().flatten().filter_map(|socket| socket.upgrade()) {
        let mut inner = socket.lock().expect("nothing panics under it");
        inner.cut = true;
        if let Some(reader) = inner.reader.take() {
            reader.wake();
        }
    }
}

/// A host that crashed comes back.
pub fn mend(host: IpAddr) {
    SOCKETS.with_borrow_mut(|all| all.remove(&host));
}

impl Socket {
    fn new(stream: TcpStream) -> io::Result<Self> {
        let host = stream.local_addr()?.ip();
        let socket = Arc::new(Mutex::new(Inner { stream: Some(stream), reader: None, cut: false }));
        SOCKETS.with_borrow_mut(|all| match all.entry(host).or_insert_with(|| Some(Vec::new())) {
            Some(sockets) => {
                sockets.retain(|socket| socket.strong_count() > 0);
                sockets.push(Arc::downgrade(&socket));
            }
            None => socket.lock().expect("nothing panics under it").cut = true,
        });
        Ok(Self(socket))
    }

    fn poll<T>(
        &self,
        cx: &mut Context<'_>,
        reads: bool,
        act: impl FnOnce(Pin<&mut TcpStream>, &mut Context<'_>) -> Poll<io::Result<T>>,
    ) -> Poll<io::Result<T>> {
        let mut inner = self.0.lock().expect("nothing panics under it");
        if inner.cut {
            inner.stream = None;
        }
        if reads {
            inner.reader = Some(cx.waker().clone());
        }
        match &mut inner.stream {
            Some(stream) => act(Pin::new(stream), cx),
            None => Poll::Ready(Err(io::ErrorKind::ConnectionReset.into())),
        }
    }
}

impl Connected for Socket {
    type ConnectInfo = ();

    fn connect_info(&self) {}
}

impl AsyncRead for Socket {
    fn poll_read(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &mut ReadBuf<'_>) -> Poll<io::Result<()>> {
        self.poll(cx, true, |stream, cx| stream.poll_read(cx, buf))
    }
}

impl AsyncWrite for Socket {
    fn poll_write(self: Pin<&mut Self>, cx: &mut Context<'_>, buf: &[u8]) -> Poll<io::Result<usize>> {
        self.poll(cx, false, |stream, cx| stream.poll_write(cx, buf))
    }

    fn poll_flush(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.poll(cx, false, |stream, cx| stream.poll_flush(cx))
    }

    fn poll_shutdown(self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.poll(cx, false, |stream, cx| stream.poll_shutdown(cx))
    }
}

/// The connections that come to this host.
pub async fn listen() -> io::Result<impl Stream<Item = io::Result<Socket>>> {
    let listener = TcpListener::bind(("0.0.0.0", PORT)).await?;
    let (sender, receiver) = tokio::sync::mpsc::channel(1);
    tokio::spawn(async move {
        loop {
            let accepted = listener.accept().await.and_then(|(stream, _)| Socket::new(stream));
            if sender.send(accepted).await.is_err() {
                return;
            }
        }
    });
    Ok(tokio_stream::wrappers::ReceiverStream::new(receiver))
}

async fn open() -> io::Result<Socket> {
    Socket::new(TcpStream::connect((SERVER, PORT)).await?)
}

/// A line to the server, as clients open it.
pub fn connect() -> Line {
    client::connect_with(open)
}

/// A channel to the server that takes in little at a time: 64 KiB, HTTP/2's default.
pub fn connect_narrow() -> Channel {
    let connector = tower::service_fn(|_| async { open().await.map(TokioIo::new) });
    Endpoint::from_static("http://narrow").connect_with_connector_lazy(connector)
}
