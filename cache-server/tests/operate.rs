//! The server as those who run it see it: what it checks, what it measures, how it goes.

mod support;

use std::io::{self, BufRead as _, BufReader, Read as _, Write as _};
use std::net::{TcpListener, TcpStream};
use std::os::unix::fs::PermissionsExt as _;
use std::process::{Child, Command, Output, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use cache_core::Namespace;
use cache_proto::v1;
use cache_proto::v1::cache_client::CacheClient;
use cache_server::Config;
use cache_server::journal::Journal;
use support::{insert, soon, subscribe};
use tonic::Code;
use tonic::transport::{Channel, Endpoint};
use tonic_health::ServingStatus;
use tonic_health::pb::HealthCheckRequest;
use tonic_health::pb::health_client::HealthClient;

fn cache_server(args: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cache-server"));
    command.args(args).env_remove("AMBIENCE_TOKEN");
    command
}

/// What a server that only checks says, and its exit code.
fn check(args: &[&str]) -> (Option<i32>, String) {
    said(&cache_server(args).arg("--check").output().expect("started"))
}

fn said(output: &Output) -> (Option<i32>, String) {
    let text = [&output.stdout[..], &output.stderr[..]].concat();
    (output.status.code(), String::from_utf8(text).expect("text"))
}

/// A server process, and the port it listens on.
fn start(args: &[&str]) -> (Child, u16) {
    start_with(&mut cache_server(args))
}

fn start_with(command: &mut Command) -> (Child, u16) {
    command.args(["--listen", "127.0.0.1:0"]).stdout(Stdio::piped()).stderr(Stdio::null());
    let mut server = command.spawn().expect("started");
    let mut line = String::new();
    BufReader::new(server.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
    let port = line.trim().rsplit(':').next().and_then(|port| port.parse().ok()).expect("a port");
    (server, port)
}

async fn connect(port: u16) -> Channel {
    soon(Endpoint::from_shared(format!("http://127.0.0.1:{port}")).expect("a URI").connect()).await.expect("connected")
}

#[test]
fn check_says_what_would_be_served() {
    let folder = tempfile::tempdir().expect("a folder");
    let (tokens, data) = (folder.path().join("tokens"), folder.path().join("cache"));
    std::fs::write(&tokens, "light 0123456789abcdef\ncomp 0123456789abcdeg\n").expect("written");
    std::fs::set_permissions(&tokens, std::fs::Permissions::from_mode(0o600)).expect("mode");
    let (tokens, data) = (tokens.display().to_string(), data.display().to_string());
    let (code, text) = check(&["--listen", "127.0.0.1:0", "--token-file", &tokens, "--data", &data]);
    assert_eq!(code, Some(0), "{text}");
    for expected in ["would listen on 127.0.0.1:", "not encrypted", "comp, light", &data] {
        assert!(text.contains(expected), "{expected}: {text}");
    }
    assert!(!folder.path().join("cache").exists(), "nothing is made");

    let holder = TcpListener::bind("127.0.0.1:0").expect("bound");
    let taken = holder.local_addr().expect("an address").to_string();
    let wrong: [(&[&str], &str); 8] = [
        (&["--listen", &taken], &taken),
        (&["--listen", "0.0.0.0:0"], "--token-file"),
        (&["--listen", "0.0.0.0:0", "--token-file", &tokens], "--tls-cert"),
        (&["--metrics", "0.0.0.0:0"], "--insecure"),
        (&["--token-file", "/no/such/file"], "/no/such/file"),
        (&["--tls-cert", &tokens, "--tls-key", &tokens], "no PEM certificate"),
        (&["--data", "/no/such/folder/cache"], "/no/such/folder"),
        (&["--limit", "records=0"], "records=0"),
    ];
    for (args, expected) in wrong {
        let listen = ["--listen", "127.0.0.1:0"];
        let args: Vec<&str> = if args[0] == "--listen" { args.into() } else { [&listen[..], args].concat() };
        let (code, text) = check(&args);
        assert_eq!(code, Some(2), "{args:?}: {text}");
        assert!(text.contains(expected), "{args:?}: {text}");
        assert!(args.contains(&"--limit") || text.lines().count() == 1, "{args:?}: {text}");
    }
    drop(holder);
}

#[tokio::test]
async fn a_token_in_the_environment_is_asked_for() {
    let (mut server, port) = start_with(cache_server(&[]).env("AMBIENCE_TOKEN", "token-of-the-house-1"));
    let channel = connect(port).await;
    let info = async |token| soon(support::with_token(channel.clone(), token).info(v1::InfoRequest {})).await;
    assert_eq!(info(None).await.expect_err("refused").code(), Code::Unauthenticated);
    assert!(info(Some("token-of-the-house-1")).await.is_ok());
    server.kill().expect("running");
    server.wait().expect("ended");
    let short = cache_server(&["--listen", "127.0.0.1:0"]).env("AMBIENCE_TOKEN", "short").output().expect("started");
    let (code, text) = said(&short);
    assert!(code == Some(2) && text.contains("AMBIENCE_TOKEN") && !text.contains("short"), "{text}");
}

#[tokio::test]
async fn metrics_tell_what_happened() {
    let free = TcpListener::bind("127.0.0.1:0").expect("bound").local_addr().expect("an address").to_string();
    let (mut server, port) = start(&["--metrics", &free, "--limit", "subscribers=1"]);
    let mut cache = CacheClient::new(connect(port).await);
    let namespace = Namespace([5; 32]);
    soon(cache.insert(insert(namespace, 0..700))).await.expect("sound");
    let _one = soon(cache.subscribe(subscribe(namespace))).await.expect("room");
    let full = soon(cache.subscribe(subscribe(namespace))).await.expect_err("full");
    assert_eq!(
        (full.code(), full.message()),
        (Code::ResourceExhausted, "no room for more subscribers: this server keeps at most 1")
    );
    let expected = [
        "ambience_records 700",
        "ambience_namespaces 1",
        "ambience_connections 1",
        "ambience_subscribers 1",
        "ambience_ready 1",
        "ambience_calls_total{method=\"Cache/Insert\"} 1",
        "ambience_calls_refused_total{method=\"Cache/Subscribe\",code=\"resource_exhausted\"} 1",
        "ambience_journal_append_seconds_count 1",
        "# HELP ambience_received_bytes_total Bytes received",
    ];
    // Some of them are looked at a few times a second.
    let shown = async {
        loop {
            let text = metrics(&free);
            if expected.iter().all(|line| text.contains(line)) {
                return;
            }
            tokio::task::yield_now().await;
        }
    };
    let shown = tokio::time::timeout(support::PATIENCE, shown).await;
    let text = metrics(&free);
    assert!(shown.is_ok(), "{text}");
    // Prometheus' own rules: base units, and `_total` for what only grows.
    let types: Vec<_> = text.lines().filter_map(|line| line.strip_prefix("# TYPE ")?.split_once(' ')).collect();
    assert!(types.len() > 10, "{text}");
    for (name, kind) in types {
        assert_eq!(name.ends_with("_total"), kind == "counter", "{name} is a {kind}");
        assert!(kind != "histogram" || name.ends_with("_seconds"), "{name} is a {kind}");
        let units = ["micros", "millis", "minutes", "kilo", "mega", "percent"];
        assert!(name.starts_with("ambience_") && !units.iter().any(|unit| name.contains(unit)), "{name}");
    }
    server.kill().expect("running");
    server.wait().expect("ended");
}

#[test]
fn who_stalls_where_metrics_are_read_is_cut_and_others_have_their_turn() {
    let free = TcpListener::bind("127.0.0.1:0").expect("a port").local_addr().expect("bound").to_string();
    let (mut server, _) = start(&["--metrics", &free]);
    // Half a request, on more connections than are read at a time.
    let stalled: Vec<_> = (0..20)
        .map(|_| {
            let mut stream = TcpStream::connect(&free).expect("connected");
            stream.write_all(b"GET /metrics HT").expect("sent");
            stream.set_read_timeout(Some(support::PATIENCE)).expect("a socket");
            stream
        })
        .collect();
    let page = std::thread::spawn(move || metrics(&free));
    for mut stream in stalled {
        let mut rest = Vec::new();
        // Cut, in whatever way.
        if let Err(error) = stream.read_to_end(&mut rest) {
            assert_eq!(error.kind(), io::ErrorKind::ConnectionReset, "{error}");
        }
    }
    assert!(page.join().expect("no panic").contains("ambience_ready"));
    server.kill().expect("running");
    server.wait().expect("ended");
}

fn metrics(address: &str) -> String {
    let mut stream = TcpStream::connect(address).expect("connected");
    stream.write_all(b"GET /metrics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n").expect("sent");
    let mut text = String::new();
    stream.read_to_string(&mut text).expect("read");
    text
}

/// A journal on a disk that is full for a while.
struct Full(Arc<AtomicBool>);

impl Journal for Full {
    fn append(&mut self, _: &[v1::Entry]) -> io::Result<()> {
        if self.0.load(Ordering::Relaxed) { Err(io::ErrorKind::StorageFull.into()) } else { Ok(()) }
    }

    fn replay(&mut self, _: &mut dyn FnMut(v1::Entry) -> io::Result<()>) -> io::Result<()> {
        Ok(())
    }

    fn waits(&self) -> bool {
        false
    }
}

#[tokio::test]
async fn health_is_told_by_the_journal() {
    let full = Arc::new(AtomicBool::new(false));
    let server = support::Server::start(Config { journal: Box::new(Full(full.clone())), ..Config::default() });
    let (mut cache, watch) = (server.cache(), HealthCheckRequest { service: "ambience.v1.Cache".into() });
    let mut asked = HealthClient::new(soon(server.endpoint().connect()).await.expect("connected"));
    let mut health = soon(asked.watch(watch)).await.expect("known").into_inner();
    let mut expect = async |status: ServingStatus| {
        let told = soon(health.message()).await.expect("no error").expect("no end");
        assert_eq!(told.status, status as i32);
    };
    expect(ServingStatus::Serving).await;
    full.store(true, Ordering::Relaxed);
    let refused = soon(cache.insert(insert(Namespace([5; 32]), 0..9))).await.expect_err("full");
    assert_eq!(refused.code(), Code::Unavailable, "{refused}");
    expect(ServingStatus::NotServing).await;
    // It is alive all the same.
    let alive = HealthCheckRequest { service: "grpc.health.v1.Health".into() };
    let told = soon(asked.check(alive)).await.expect("known").into_inner();
    assert_eq!(told.status, ServingStatus::Serving as i32);
    full.store(false, Ordering::Relaxed);
    soon(cache.insert(insert(Namespace([5; 32]), 0..9))).await.expect("room again");
    expect(ServingStatus::Serving).await;
    server.stop().await;
}

#[tokio::test]
async fn a_signal_ends_it_although_some_wait_for_ever() {
    let (mut server, port) = start(&[]);
    let channel = connect(port).await;
    let mut cache = CacheClient::new(channel.clone());
    let mut records = soon(cache.subscribe(subscribe(Namespace([5; 32])))).await.expect("accepted").into_inner();
    soon(records.message()).await.expect("no error").expect("where it starts");
    let watch = HealthCheckRequest { service: "ambience.v1.Frames".into() };
    let mut health = soon(HealthClient::new(channel.clone()).watch(watch)).await.expect("known").into_inner();
    let status = async |health: &mut tonic::Streaming<tonic_health::pb::HealthCheckResponse>| {
        soon(health.message()).await.expect("no error").map(|response| response.status)
    };
    assert_eq!(status(&mut health).await, Some(ServingStatus::Serving as i32));
    // An insert that never goes on.
    let (_hold, held) = tokio::sync::mpsc::channel(1);
    let mut stalled = cache.clone();
    let stalled = tokio::spawn(async move { stalled.insert(tokio_stream::wrappers::ReceiverStream::new(held)).await });

    let sent = Command::new("kill").args(["-TERM", &server.id().to_string()]).status().expect("kill runs");
    assert!(sent.success());
    assert_eq!(status(&mut health).await, Some(ServingStatus::NotServing as i32));
    assert_eq!(status(&mut health).await, None, "those who watch are sent away");
    assert_eq!(soon(records.message()).await.expect_err("told").code(), Code::Unavailable);
    let ended = tokio::task::spawn_blocking(move || server.wait().expect("ended"));
    assert_eq!(soon(ended).await.expect("no panic").code(), Some(0));
    assert!(soon(stalled).await.expect("no panic").is_err());
}
