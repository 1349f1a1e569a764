//! `ambience serve --upstream ADDR`: serves a rack for a server above it.
//!
//! Of each namespace that somebody below reads, one subscription leads up, and its log is given to all who subscribe here,
//! position by position as it is there ([`log`]). Records inserted here travel up together ([`insert`]). Everything else
//! passes through as it is ([`pass`]): the server above gives out leases, opens frames and decides who may do what, by the
//! tokens that callers show here. So a worker cannot tell a relay from the server, and may move from one to another.

mod insert;
mod log;
mod pass;

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use cache_proto::v1::cache_server::{Cache, CacheServer};
use cache_proto::{VERSION, v1};
use cache_server::access::Shown;
use cache_server::serve::CACHE_MESSAGE_MAX;
use tokio_stream::wrappers::ReceiverStream;
use tonic::codegen::http::{Extensions, HeaderMap};
use tonic::service::Routes;
use tonic::transport::Channel;
use tonic::{Code, Request, Response, Status, Streaming};
use worker::client::{self, Address, Line};
use worker::credentials::{Bearer, CredentialArgs, Credentials, RELAYS};
use worker::traffic::Traffic;

use crate::failure::Failure;

/// Connections up, taken in turns: one carries no more than 256 calls at once, and each thread of a worker that waits for
/// work is one.
const CONNECTIONS: usize = 8;

/// Most relays between a worker and the server.
const DEPTH_MAX: usize = 8;

/// Arguments that make a server a relay.
#[derive(Clone, Debug, clap::Args)]
pub struct RelayArgs {
    /// Serve a rack for the server at this address: HOST:PORT or unix:PATH. Nothing is kept here
    #[arg(long, value_name = "ADDR", conflicts_with = "data")]
    pub upstream: Option<Address>,
    /// Authority, PEM, that vouches for its certificate [default: $AMBIENCE_TLS_CA]
    #[arg(long, value_name = "FILE", requires = "upstream")]
    tls_ca: Option<std::path::PathBuf>,
}

/// Serves as a relay until told to stop.
///
/// # Errors
/// As [`cache_server::run`]; or the server above is of another version, or this very one.
pub async fn run(serve: cache_server::ServeArgs, args: RelayArgs, upstream: Address) -> Result<(), Failure> {
    let credentials = CredentialArgs { tls_ca: args.tls_ca, token_file: None, insecure: serve.insecure };
    let credentials = credentials.load(&upstream).map_err(Failure::usage)?;
    let above = Above::new(upstream, credentials).map_err(Failure::usage)?;
    let serving = cache_server::run_as(serve, Some(above.clone().routes()));
    tokio::select! {
        ended = serving => ended.map_err(crate::serve_failure),
        unfit = above.unfit() => Err(unfit),
    }
}

/// The server above, as callers below see it.
pub struct Above {
    address: Address,
    credentials: Credentials,
    channels: Vec<Channel>,
    turn: AtomicUsize,
    /// Names this relay in the calls that pass it.
    name: String,
}

/// On whose behalf a call goes up, and which relays it has passed.
#[derive(Clone, PartialEq, Eq, PartialOrd, Ord)]
pub struct Caller {
    authorization: Option<Vec<u8>>,
    relays: String,
}

impl Above {
    fn new(address: Address, credentials: Credentials) -> Result<Arc<Self>, String> {
        let channels = (0..CONNECTIONS)
            .map(|_| client::dial(&address, &credentials, &Traffic::default()))
            .collect::<Result<_, _>>()?;
        let name = worker::farm::unique_name();
        let name = name.rsplit('-').next().unwrap_or_default().to_string();
        Ok(Arc::new(Self { address, credentials, channels, turn: AtomicUsize::new(0), name }))
    }

    fn routes(self: Arc<Self>) -> Routes {
        let relay =
            Relay { logs: log::Logs::default(), inserts: insert::Inserts::start(self.clone()), above: self.clone() };
        Routes::new(CacheServer::new(relay).max_decoding_message_size(CACHE_MESSAGE_MAX)).add_service(pass::Pass(self))
    }

    fn channel(&self) -> Channel {
        self.channels[self.turn.fetch_add(1, Ordering::Relaxed) % CONNECTIONS].clone()
    }

    fn line(&self, caller: &Caller) -> Line {
        client::over(self.channel(), Bearer::relayed(caller.authorization.as_deref(), &caller.relays))
    }

    /// Who calls, if the call may go up: one that was here before would go round for ever.
    fn caller(&self, extensions: &Extensions, headers: &HeaderMap) -> Result<Caller, Status> {
        let passed = headers.get(RELAYS).and_then(|relays| relays.to_str().ok()).unwrap_or_default();
        if passed.split(' ').any(|relay| relay == self.name) {
            return Err(Status::failed_precondition("relays lead in a circle: one of them is its own --upstream"));
        }
        if passed.split(' ').count() >= DEPTH_MAX {
            return Err(Status::failed_precondition(format!("more than {DEPTH_MAX} relays one above the other")));
        }
        let authorization = extensions.get::<Shown>().and_then(|shown| shown.0.as_ref());
        let authorization = authorization.map(|header| header.as_bytes().to_vec());
        Ok(Caller { authorization, relays: format!("{passed} {}", self.name).trim().into() })
    }

    fn caller_of<T>(&self, request: &Request<T>) -> Result<Caller, Status> {
        self.caller(request.extensions(), &request.metadata().clone().into_headers())
    }

    /// Returns only when the server above cannot be served for: what is wrong with it.
    async fn unfit(&self) -> Failure {
        let info = || async {
            let line = client::over(self.channel(), self.credentials.bearer().passing(&self.name));
            client::cache(line).info(v1::InfoRequest {}).await
        };
        let wrong = match client::retry_for(Duration::MAX, info).await {
            Ok(info) if info.version != VERSION => {
                format!("is version {}, this is version {VERSION}; they must be the same", info.version)
            }
            // It is this relay itself, not to be trusted, or no server of ours.
            Err(status) if matches!(status.code(), Code::FailedPrecondition | Code::Unimplemented) => {
                status.message().into()
            }
            // It may answer only those who show a token.
            _ => std::future::pending().await,
        };
        Failure::usage(format!("--upstream {}: {wrong}", self.address))
    }
}

/// The `Cache` service of a relay.
struct Relay {
    above: Arc<Above>,
    logs: log::Logs,
    inserts: insert::Inserts,
}

#[tonic::async_trait]
impl Cache for Relay {
    async fn insert(
        &self,
        request: Request<Streaming<v1::InsertRequest>>,
    ) -> Result<Response<v1::InsertResponse>, Status> {
        let caller = self.above.caller_of(&request)?;
        self.inserts.insert(&caller, request.into_inner()).await.map(Response::new)
    }

    type SubscribeStream = ReceiverStream<Result<v1::SubscribeResponse, Status>>;

    async fn subscribe(
        &self,
        request: Request<v1::SubscribeRequest>,
    ) -> Result<Response<Self::SubscribeStream>, Status> {
        let caller = self.above.caller_of(&request)?;
        self.logs.subscribe(&self.above, &caller, request.into_inner()).await.map(Response::new)
    }

    async fn query(&self, request: Request<v1::QueryRequest>) -> Result<Response<v1::QueryResponse>, Status> {
        let line = self.above.line(&self.above.caller_of(&request)?);
        client::cache(line).query(request.into_inner()).await
    }

    async fn info(&self, request: Request<v1::InfoRequest>) -> Result<Response<v1::InfoResponse>, Status> {
        let line = self.above.line(&self.above.caller_of(&request)?);
        client::cache(line).info(request.into_inner()).await
    }
}
