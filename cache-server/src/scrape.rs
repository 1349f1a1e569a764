//! The page Prometheus reads, and its bounds: few read at a time, each for a short time.

use std::convert::Infallible;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use http_body_util::Full;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper::{Response, body::Bytes};
use hyper_util::rt::TokioIo;
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;

/// Most connections at a time; more wait to be accepted.
pub const READERS: usize = 8;

/// Longest time of a connection; each reads one page.
pub const READING: Duration = Duration::from_secs(5);

/// Longest request, bytes.
const REQUEST_MAX: usize = 16 << 10;

/// How often what histograms gathered is put together.
const UPKEEP: Duration = Duration::from_secs(5);

/// Pause after a connection could not be accepted.
const PAUSE: Duration = Duration::from_millis(100);

/// Lets the page be read at an address from now on.
///
/// # Errors
/// When the address cannot be bound.
pub fn publish(address: SocketAddr, page: PrometheusHandle) -> std::io::Result<()> {
    let listener = std::net::TcpListener::bind(address)?;
    listener.set_nonblocking(true)?;
    let listener = TcpListener::from_std(listener)?;
    let kept = page.clone();
    tokio::spawn(async move {
        loop {
            tokio::time::sleep(UPKEEP).await;
            kept.run_upkeep();
        }
    });
    tokio::spawn(serve(listener, page));
    Ok(())
}

async fn serve(listener: TcpListener, page: PrometheusHandle) {
    let room = Arc::new(Semaphore::new(READERS));
    // Never closed.
    while let Ok(seat) = room.clone().acquire_owned().await {
        let Ok((stream, _)) = listener.accept().await else {
            tokio::time::sleep(PAUSE).await;
            continue;
        };
        let page = page.clone();
        tokio::spawn(async move {
            let answer = service_fn(|_| {
                let response = Response::new(Full::new(Bytes::from(page.render())));
                async { Ok::<_, Infallible>(response) }
            });
            let mut http = http1::Builder::new();
            let reading = http.keep_alive(false).max_buf_size(REQUEST_MAX);
            // Who stalls or says what is no HTTP is cut.
            drop(tokio::time::timeout(READING, reading.serve_connection(TokioIo::new(stream), answer)).await);
            drop(seat);
        });
    }
}
