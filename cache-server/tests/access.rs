//! Who is let in: over real TLS on loopback, through the generated client.

mod support;

use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use cache_core::Namespace;
use cache_proto::v1;
use cache_proto::v1::frames_client::FramesClient;
use cache_server::access::Tokens;
use cache_server::tls::Tls;
use cache_server::{Config, bind_health, clock};
use rcgen::{BasicConstraints, CertificateParams, IsCa, Issuer, KeyPair, date_time_ymd};
use support::{Bearer, Server, insert, soon, subscribe, with_token};
use tonic::transport::{Certificate, Channel, ClientTlsConfig};
use tonic::{Code, Status};
use tonic_health::ServingStatus;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

const LIGHT: &str = "token-of-lighting-7f3a";
const COMP: &str = "token-of-compositing-91";
const NAMESPACE: Namespace = Namespace([0xab; 32]);

/// When the certificates that are expired were good, since 1970: the middle of 2020.
const THEN: Duration = Duration::from_secs(1_592_000_000);

/// An authority, and what it signed.
struct Authority {
    pem: String,
    issuer: Issuer<'static, KeyPair>,
    folder: tempfile::TempDir,
}

impl Authority {
    fn new() -> Self {
        let key = KeyPair::generate().expect("a key");
        let mut params = CertificateParams::new([]).expect("sound");
        params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
        params.distinguished_name.push(rcgen::DnType::CommonName, "the authority");
        let pem = params.self_signed(&key).expect("signed").pem();
        Self { pem, issuer: Issuer::new(params, key), folder: tempfile::tempdir().expect("a folder") }
    }

    /// Writes a certificate for a host and its key; returns their paths.
    fn sign(&self, host: &str, until: (i32, u8)) -> [std::path::PathBuf; 2] {
        let key = KeyPair::generate().expect("a key");
        let mut params = CertificateParams::new([host.into()]).expect("a host");
        (params.not_before, params.not_after) = (date_time_ymd(2020, 1, 1), date_time_ymd(until.0, until.1, 1));
        let certificate = params.signed_by(&key, &self.issuer).expect("signed");
        let paths = ["pem", "key"].map(|ending| self.folder.path().join(format!("{host}-{}.{ending}", until.0)));
        std::fs::write(&paths[0], certificate.pem()).expect("written");
        std::fs::write(&paths[1], key.serialize_pem()).expect("written");
        paths
    }

    /// A server at 127.0.0.1 with a certificate for `host`.
    fn serve(&self, host: &str, until: (i32, u8), now: Duration) -> Server {
        let [certificate, key] = self.sign(host, until);
        let tls = Tls::load(&certificate, &key, now).expect("sound");
        Server::start(Config { tls: Some(tls), tokens: tokens(self.folder.path()), ..Config::default() })
    }

    /// An address for health alone, of a server that wants TLS and tokens elsewhere.
    fn serve_health(&self) -> Server {
        let [certificate, key] = self.sign("127.0.0.1", (2100, 1));
        let tls = Tls::load(&certificate, &key, clock::date()).expect("sound");
        let config = Config { tls: Some(tls), tokens: tokens(self.folder.path()), ..Config::default() };
        Server::start_on(bind_health("127.0.0.1:0".parse().expect("an address")).expect("bound"), config)
    }

    async fn connect(&self, server: &Server) -> Result<Channel, tonic::transport::Error> {
        let tls = ClientTlsConfig::new().ca_certificate(Certificate::from_pem(&self.pem)).domain_name("127.0.0.1");
        let uri = format!("https://127.0.0.1:{}", server.port);
        let endpoint = Channel::from_shared(uri).expect("a URI").tls_config(tls).expect("sound");
        soon(endpoint.connect()).await
    }
}

fn tokens(folder: &Path) -> Tokens {
    use std::os::unix::fs::PermissionsExt as _;
    let path = folder.join("tokens");
    std::fs::write(&path, format!("light {LIGHT}\ncomp {COMP}\n")).expect("written");
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o600)).expect("mode");
    Tokens::load(&path).expect("sound")
}

async fn info(channel: &Channel, token: Option<&str>) -> Result<v1::InfoResponse, Status> {
    soon(with_token(channel.clone(), token).info(v1::InfoRequest {})).await.map(tonic::Response::into_inner)
}

fn reason(error: &dyn std::error::Error) -> String {
    let chain = std::iter::successors(Some(error), |error| (*error).source());
    chain.map(ToString::to_string).collect::<Vec<_>>().join(": ")
}

#[tokio::test]
async fn only_those_with_a_token_are_let_in() {
    let authority = Authority::new();
    let server = authority.serve("127.0.0.1", (2100, 1), clock::date());
    let channel = authority.connect(&server).await.expect("trusted");
    assert!(info(&channel, Some(LIGHT)).await.is_ok());
    for wrong in [None, Some(""), Some("token-of-lighting-7f3b"), Some("token-of-lighting-7f3"), Some("light")] {
        let status = info(&channel, wrong).await.expect_err("refused");
        assert_eq!(status.code(), Code::Unauthenticated, "{wrong:?}");
        assert!(!status.message().contains(LIGHT) && !status.message().contains("7f3b"), "{status}");
        let inserted = soon(with_token(channel.clone(), wrong).insert(insert(NAMESPACE, 0..9))).await;
        assert_eq!(inserted.expect_err("refused").code(), Code::Unauthenticated);
        let subscribed = soon(with_token(channel.clone(), wrong).subscribe(subscribe(NAMESPACE))).await;
        assert_eq!(subscribed.expect_err("refused").code(), Code::Unauthenticated);
    }
    assert!(info(&channel, Some(LIGHT)).await.expect("let in").namespaces.is_empty());

    // Probes have no token; who may not call may not look either.
    let probe = HealthCheckRequest { service: "ambience.v1.Cache".into() };
    soon(HealthClient::new(channel.clone()).check(probe)).await.expect("open");
    let mut reflection = tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient::new(channel);
    let asked = soon(reflection.server_reflection_info(tokio_stream::empty())).await;
    assert_eq!(asked.expect_err("refused").code(), Code::Unauthenticated);
    server.stop().await;
}

#[tokio::test]
async fn a_namespace_belongs_to_the_token_that_wrote_to_it_first() {
    let authority = Authority::new();
    let server = authority.serve("127.0.0.1", (2100, 1), clock::date());
    let channel = authority.connect(&server).await.expect("trusted");
    let (mut light, mut comp) = (with_token(channel.clone(), Some(LIGHT)), with_token(channel.clone(), Some(COMP)));
    assert_eq!(soon(light.insert(insert(NAMESPACE, 0..9))).await.expect("first").into_inner().added, 9);
    let query =
        v1::QueryRequest { namespace: NAMESPACE.0.to_vec().into(), level: 1, a: 1.0, points: Default::default() };
    let refused = [
        soon(comp.insert(insert(NAMESPACE, 9..12))).await.expect_err("another's"),
        soon(comp.subscribe(subscribe(NAMESPACE))).await.expect_err("another's"),
        soon(comp.query(query.clone())).await.expect_err("another's"),
    ];
    for status in refused {
        assert_eq!(status.code(), Code::PermissionDenied, "{status}");
        assert!(status.message().contains("abababab") && !status.message().contains("ababababab"), "{status}");
    }
    assert!(info(&channel, Some(COMP)).await.expect("let in").namespaces.is_empty());
    assert_eq!(info(&channel, Some(LIGHT)).await.expect("let in").namespaces[0].records, 9);
    assert_eq!(soon(light.insert(insert(NAMESPACE, 9..12))).await.expect("its own").into_inner().added, 3);
    assert!(soon(light.query(query)).await.is_ok());
    let own = Namespace([1; 32]);
    assert_eq!(soon(comp.insert(insert(own, 0..3))).await.expect("its own").into_inner().added, 3);
    server.stop().await;
}

#[tokio::test]
async fn a_client_trusts_no_other_certificate() {
    let authority = Authority::new();
    let expired = authority.serve("127.0.0.1", (2021, 1), THEN);
    let error = authority.connect(&expired).await.expect_err("expired");
    assert!(reason(&error).contains("expired"), "{}", reason(&error));
    let elsewhere = authority.serve("elsewhere.example", (2100, 1), clock::date());
    let error = authority.connect(&elsewhere).await.expect_err("another host");
    assert!(reason(&error).contains("not valid for name"), "{}", reason(&error));
    let stranger = Authority::new();
    let error = stranger.connect(&elsewhere).await.expect_err("another authority");
    assert!(reason(&error).contains("invalid peer certificate"), "{}", reason(&error));
    expired.stop().await;
    elsewhere.stop().await;
}

#[tokio::test]
async fn plain_text_to_a_tls_port_is_cut_and_costs_nobody_else_anything() {
    let authority = Authority::new();
    let server = authority.serve("127.0.0.1", (2100, 1), clock::date());
    let channel = authority.connect(&server).await.expect("trusted");
    for _ in 0..20 {
        let plain = server.endpoint().connect_lazy();
        assert!(info(&plain, Some(LIGHT)).await.is_err());
    }
    assert!(info(&channel, Some(LIGHT)).await.is_ok());
    server.stop().await;
}

#[tokio::test]
async fn an_address_for_health_needs_no_tls_and_no_token_and_answers_nothing_else() {
    let authority = Authority::new();
    let server = authority.serve_health();
    let plain = soon(server.endpoint().connect()).await.expect("no TLS");
    let mut health = HealthClient::new(plain.clone());
    let told = soon(health.check(HealthCheckRequest::default())).await.expect("told");
    assert_eq!(told.into_inner().status, ServingStatus::Serving as i32);
    for token in [None, Some(LIGHT)] {
        let refused = [
            info(&plain, token).await.expect_err("not here"),
            soon(with_token(plain.clone(), token).insert(insert(NAMESPACE, 0..9))).await.expect_err("not here"),
            soon(with_token(plain.clone(), token).subscribe(subscribe(NAMESPACE))).await.expect_err("not here"),
        ];
        for status in refused {
            assert!(matches!(status.code(), Code::Unauthenticated | Code::Unimplemented), "{status}");
        }
    }
    let mut frames = FramesClient::with_interceptor(plain.clone(), Bearer(Some(LIGHT.into())));
    let refused = soon(frames.lease(v1::LeaseRequest::default())).await.expect_err("not here");
    assert_eq!(refused.code(), Code::Unimplemented, "{refused}");
    let reflection = tonic_reflection::pb::v1::server_reflection_client::ServerReflectionClient::with_interceptor(
        plain.clone(),
        Bearer(Some(LIGHT.into())),
    );
    let refused = soon({ reflection }.server_reflection_info(tokio_stream::empty())).await.expect_err("not here");
    assert_eq!(refused.code(), Code::Unimplemented, "{refused}");
    // Nothing can be brought to it, in a message or in many connections.
    let large = HealthCheckRequest { service: "a".repeat(2000) };
    let refused = soon(health.check(large)).await.expect_err("too large");
    assert_eq!(refused.code(), Code::OutOfRange, "{refused}");
    server.stop().await;
}

#[tokio::test]
async fn connections_to_an_address_for_health_are_bounded() {
    let server = Authority::new().serve_health();
    let mut kept = Vec::new();
    for _ in 0..100 {
        // Further ones are closed at once.
        let Ok(channel) = soon(server.endpoint().connect()).await else { continue };
        let mut health = HealthClient::new(channel);
        if soon(health.check(HealthCheckRequest::default())).await.is_ok() {
            kept.push(health);
        }
    }
    // 16, and the 64 that are told of other calls that there are too many: health is told them.
    assert_eq!(kept.len(), 80);
    server.stop().await;
}

#[tokio::test]
async fn certificates_that_would_not_do_are_refused_at_the_start() {
    let authority = Authority::new();
    let [good, key] = authority.sign("127.0.0.1", (2100, 1));
    let [old, old_key] = authority.sign("127.0.0.1", (2021, 1));
    let nothing = authority.folder.path().join("nothing");
    std::fs::write(&nothing, "nothing").expect("written");
    let load = |certificate: &Path, key: &Path, now| match Tls::load(certificate, key, now) {
        Ok(_) => panic!("loaded"),
        Err(error) => error,
    };
    let wrong = [
        (load(&old, &old_key, clock::date()), &old, "expired"),
        (load(&good, &key, Duration::from_secs(1)), &good, "not valid yet"),
        (load(&good, &old_key, clock::date()), &good, "KeyMismatch"),
        (load(&nothing, &key, clock::date()), &nothing, "no PEM certificate"),
        (load(&good, &nothing, clock::date()), &nothing, "key"),
        (load(Path::new("/no/such"), &key, clock::date()), &"/no/such".into(), "No such file"),
    ];
    for (error, path, what) in wrong {
        assert!(
            error.contains(what) && error.contains(&path.display().to_string()) && !error.contains('\n'),
            "{error}"
        );
    }
}

/// Everything logged by this process's tests.
#[derive(Clone, Default)]
struct Log(Arc<Mutex<Vec<u8>>>);

impl std::io::Write for Log {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.0.lock().expect("no panic").write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

#[tokio::test]
async fn a_call_has_a_name_in_the_log_and_no_token_is_ever_there() {
    let log = Log::default();
    let writer = {
        let log = log.clone();
        move || log.clone()
    };
    let all =
        tracing_subscriber::fmt().with_max_level(tracing::Level::TRACE).with_ansi(false).with_writer(writer).finish();
    tracing::subscriber::set_global_default(all).expect("the first");
    let authority = Authority::new();
    let server = authority.serve("127.0.0.1", (2100, 1), clock::date());
    let channel = authority.connect(&server).await.expect("trusted");
    let call = async |token: &str, id: Option<&str>| {
        let mut request = tonic::Request::new(v1::InfoRequest {});
        if let Some(id) = id {
            request.metadata_mut().insert("x-request-id", id.parse().expect("ASCII"));
        }
        match soon(with_token(channel.clone(), Some(token)).info(request)).await {
            Ok(response) => response.metadata().clone(),
            Err(status) => status.metadata().clone(),
        }
    };
    for token in [LIGHT, "guess-at-a-token-5511"] {
        assert_eq!(call(token, Some("shot-12.7")).await.get("x-request-id").expect("named"), "shot-12.7");
        let long = "x".repeat(65);
        for strange in [None, Some("a b"), Some(""), Some(long.as_str())] {
            let named = call(token, strange).await;
            let named = named.get("x-request-id").expect("named").to_str().expect("ASCII");
            assert!(named.parse::<u64>().is_ok(), "{named}");
        }
    }
    server.stop().await;
    let log = String::from_utf8_lossy(&log.0.lock().expect("no panic")).into_owned();
    assert!(log.contains("shot-12.7") && log.contains("Cache/Info") && log.contains("tenant=\"light\""));
    for secret in [LIGHT, COMP, "guess-at-a-token-5511"] {
        assert!(!log.contains(secret), "{}", log.lines().find(|line| line.contains(secret)).expect("there"));
    }
}
