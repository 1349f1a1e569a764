//! A server in this process, as other machines would see it, and records to send it.
#![allow(dead_code, reason = "each test uses what it needs")]

use std::time::Duration;

use cache_core::{Irradiance, Namespace, RecordId, Tag};
use cache_proto::v1::cache_client::CacheClient;
use cache_proto::{convert, v1};
use cache_server::{Bound, Config, Listen, ServeError, bind, serve};
use glam::{Vec2, Vec3};
use tokio::sync::oneshot;
use tokio::task::JoinHandle;
use tonic::service::Interceptor;
use tonic::service::interceptor::InterceptedService;
use tonic::transport::{Channel, Endpoint};
use tonic::{Request, Status};

/// No step of these tests takes near as long; what does has hung.
pub const PATIENCE: Duration = Duration::from_secs(60);

pub async fn soon<T>(future: impl Future<Output = T>) -> T {
    tokio::time::timeout(PATIENCE, future).await.expect("in time")
}

pub struct Server {
    pub port: u16,
    stop: oneshot::Sender<()>,
    running: JoinHandle<Result<(), ServeError>>,
}

impl Server {
    pub fn start(config: Config) -> Self {
        let bound = bind(&"127.0.0.1:0".parse().expect("an address"), false).expect("bound");
        Self::start_on(bound, config)
    }

    pub fn start_on(bound: Bound, config: Config) -> Self {
        let Listen::Tcp(address) = bound.address() else { unreachable!("TCP") };
        let port = address.port();
        let (stop, stopped) = oneshot::channel();
        let shutdown = async {
            let _ = stopped.await;
        };
        Self { port, stop, running: tokio::spawn(serve(vec![bound], config, shutdown)) }
    }

    pub fn endpoint(&self) -> Endpoint {
        Endpoint::from_shared(format!("http://127.0.0.1:{}", self.port)).expect("a URI")
    }

    /// A connection of its own.
    pub fn cache(&self) -> CacheClient<Channel> {
        CacheClient::new(self.endpoint().connect_lazy())
    }

    pub async fn stop(self) {
        let _ = self.stop.send(());
        soon(self.running).await.expect("no panic").expect("served");
    }
}

/// Adds a token.
#[derive(Clone)]
pub struct Bearer(pub Option<String>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: Request<()>) -> Result<Request<()>, Status> {
        if let Some(token) = &self.0 {
            request.metadata_mut().insert("authorization", format!("Bearer {token}").parse().expect("ASCII"));
        }
        Ok(request)
    }
}

/// A client that says a token.
pub fn with_token(channel: Channel, token: Option<&str>) -> CacheClient<InterceptedService<Channel, Bearer>> {
    CacheClient::with_interceptor(channel, Bearer(token.map(Into::into)))
}

pub fn record(id: u32) -> Irradiance {
    let x = (id % 100) as f32 * 0.1;
    Irradiance {
        id: RecordId(u128::from(id) << 64 | 1),
        position: Vec3::new(x, (id / 100) as f32 * 0.1, 0.0),
        normal: Vec3::Z,
        radius: 0.5 + x,
        radius_min: 0.1,
        radius_max: 10.0,
        irradiance: Vec3::new(1.0 + x, 2.0, 3.0),
        gradient_t: [Vec2::new(0.1, 0.2); 3],
        gradient_r: [Vec2::new(0.3, -0.4); 3],
        ellipse: [0.0; 3],
        noise: 0.0,
    }
}

/// A stream of one batch of records.
pub fn insert(namespace: Namespace, ids: std::ops::Range<u32>) -> impl tokio_stream::Stream<Item = v1::InsertRequest> {
    let records: Vec<_> = ids.map(record).collect();
    tokio_stream::once(v1::InsertRequest { batch: Some(convert::pack(&namespace, Tag::level(1), &records)) })
}

pub fn subscribe(namespace: Namespace) -> v1::SubscribeRequest {
    v1::SubscribeRequest { namespace: namespace.0.to_vec().into(), position: 0, digest: Default::default() }
}
