//! Encrypted, and with tokens: a relay lets in whom it knows, and shows above what it was shown.

use std::io::{BufRead as _, BufReader};
use std::os::unix::fs::PermissionsExt as _;
use std::process::Stdio;
use std::time::Duration;

use ambience_bench::records;
use cache_core::Namespace;
use cache_proto::v1;
use rcgen::{CertificateParams, KeyPair};
use tonic::{Code, Status};
use worker::client::{self, Address, Cache};
use worker::credentials::CredentialArgs;

use crate::processes::{self, ambience, collect, signal, wait_for};
use crate::{Process, Tree};

/// Names and tokens. One is known only to the server, one only to its relays.
const TOKENS: [(&str, &str); 5] = [
    ("light", "token-of-lighting-7f3a"),
    ("comp", "token-of-compositing-91"),
    ("above", "token-known-above-0815"),
    ("below", "token-known-below-4711"),
    ("guess", "guess-at-a-token-5511"),
];

/// A server at 127.0.0.1 and a relay, encrypted and with tokens, and a relay that asks for none.
struct Farm {
    tree: Tree,
    root: String,
    relay: String,
    open: String,
    _processes: [Process; 3],
}

impl Farm {
    fn start() -> Self {
        let tree = Tree::new();
        for name in ["root", "relay"] {
            tree.certificate(name);
            let other = if name == "root" { "below" } else { "above" };
            let known = TOKENS[..4].iter().filter(|(name, _)| *name != other);
            let tokens: String = known.map(|(name, token)| format!("{name} {token}\n")).collect();
            tree.secret(&format!("{name}.tokens"), &tokens);
        }
        TOKENS.iter().for_each(|(name, token)| tree.secret(&format!("{name}.token"), token));
        let (root_process, root) = tree.guarded("root", &[]);
        let above = ["--upstream", &root, "--tls-ca", &tree.path("root.pem")];
        let (relay_process, relay) = tree.guarded("relay", &above);
        let open = tree.serve("open", &above);
        let at = tree.at("open");
        Self { tree, root, relay, open: at, _processes: [root_process, relay_process, open] }
    }

    /// How a server is called.
    fn calling(&self, at: &str, token: &str) -> Vec<String> {
        let ca = if at == self.relay { "relay.pem" } else { "root.pem" };
        let token = self.tree.path(&format!("{token}.token"));
        ["--server", at, "--tls-ca", &self.tree.path(ca), "--token-file", &token].map(String::from).into()
    }

    fn cache(&self, at: &str, token: &str) -> Cache {
        let calling = self.calling(at, token);
        let args = CredentialArgs {
            tls_ca: Some((&calling[3]).into()),
            token_file: Some((&calling[5]).into()),
            insecure: false,
        };
        let address: Address = at.parse().expect("an address");
        client::cache(client::connect(&address, &args.load(&address).expect("sound")).expect("a line"))
    }

    fn worker(&self, at: &str) -> Process {
        let calling = self.calling(at, "light");
        Process::start(self.tree.command(&["worker", "--threads", "1"]).args(calling))
    }
}

impl Tree {
    fn path(&self, name: &str) -> String {
        self.0.path().join(name).display().to_string()
    }

    fn secret(&self, name: &str, text: &str) {
        std::fs::write(self.path(name), text).expect("written");
        std::fs::set_permissions(self.path(name), std::fs::Permissions::from_mode(0o600)).expect("set");
    }

    /// Writes a certificate for 127.0.0.1, and its key.
    fn certificate(&self, name: &str) {
        let key = KeyPair::generate().expect("a key");
        let params = CertificateParams::new(["127.0.0.1".into()]).expect("a host");
        let certificate = params.self_signed(&key).expect("signed");
        self.secret(&format!("{name}.pem"), &certificate.pem());
        self.secret(&format!("{name}.key"), &key.serialize_pem());
    }

    /// Serves at a port of 127.0.0.1; says which.
    fn guarded(&self, name: &str, more: &[&str]) -> (Process, String) {
        let mut command = self.command(&["serve", "--listen", "127.0.0.1:0"]);
        for (option, ending) in [("--tls-cert", "pem"), ("--tls-key", "key"), ("--token-file", "tokens")] {
            command.arg(option).arg(self.path(&format!("{name}.{ending}")));
        }
        let command = command.args(more).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::null());
        let mut child = command.spawn().expect("it starts");
        let mut line = String::new();
        BufReader::new(child.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
        (Process(child), line.trim().trim_start_matches("listening on ").to_string())
    }
}

#[test]
fn workers_behind_a_guarded_relay_give_the_same_picture() {
    let farm = Farm::start();
    let _workers = [farm.worker(&farm.relay), farm.worker(&farm.relay), farm.worker(&farm.root)];
    let folder = tempfile::tempdir().expect("a folder");
    let render = |at: &str, token: &str| {
        let calling = farm.calling(at, token);
        let calling: Vec<_> = calling.iter().map(String::as_str).collect();
        let mut command = ambience(folder.path(), "cornell.glb", &[&["--workers", "0"], &calling[..]].concat());
        command.stderr(Stdio::piped()).output().expect("ambience starts")
    };
    let whole = render(&farm.relay, "light");
    assert!(whole.status.success(), "{}", String::from_utf8_lossy(&whole.stderr));
    let (run, alone) = (collect(folder.path()), processes::render("cornell.glb", &["--workers", "2"]));
    assert_eq!(run.records(), alone.records());
    assert!(run.exr == alone.exr, "another picture");
    // The scene belongs to that token's name, whichever way another comes.
    for at in [&farm.relay, &farm.root] {
        let refused = render(at, "comp");
        let said = String::from_utf8_lossy(&refused.stderr);
        assert_eq!(refused.status.code(), Some(1), "{said}");
        assert!(said.lines().count() == 1 && said.contains("belongs to another token"), "{said}");
    }
}

#[test]
fn a_token_means_at_a_relay_what_it_means_at_the_server() {
    let farm = Farm::start();
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let namespace = Namespace([0xab; 32]);
    let ask = |at: &str, token: &str| {
        let _within = runtime.enter();
        let mut cache = farm.cache(at, token);
        let asking = async move {
            let bytes = || namespace.0.to_vec().into();
            let inserted = cache.insert(tokio_stream::iter(inserts(namespace))).await.map(drop);
            let request = v1::SubscribeRequest { namespace: bytes(), ..Default::default() };
            let subscribed = cache.subscribe(request).await.map(drop);
            let request = v1::QueryRequest { namespace: bytes(), level: 1, a: 1.0, points: Default::default() };
            let queried = cache.query(request).await.map(drop);
            let seen = cache.info(v1::InfoRequest {}).await.map(|info| info.into_inner().namespaces.len());
            (vec![inserted, subscribed, queried].into_iter().map(said).collect::<Vec<_>>(), seen.map_err(|s| s.code()))
        };
        let timed = async move { tokio::time::timeout(Duration::from_secs(20), asking).await };
        runtime.block_on(timed).expect("an answer in time")
    };
    // The first writes to the namespace, and it is that token's.
    let own = ask(&farm.relay, "light");
    assert_eq!(own, (vec![(Code::Ok, String::new()); 3], Ok(1)));
    for at in [&farm.root, &farm.open] {
        assert_eq!(ask(at, "light"), own);
    }
    let foreign = ask(&farm.root, "comp");
    assert!(foreign.0.iter().all(|(code, _)| *code == Code::PermissionDenied), "{foreign:?}");
    assert_eq!(foreign.1, Ok(0));
    for at in [&farm.relay, &farm.open] {
        assert_eq!(ask(at, "comp"), foreign);
    }
    // Known to nobody; to the server alone, so that the relay refuses; to the relay alone, so that the server does.
    let unknown = ask(&farm.root, "guess");
    assert!(unknown.0.iter().all(|(code, _)| *code == Code::Unauthenticated), "{unknown:?}");
    assert_eq!(unknown.1, Err(Code::Unauthenticated));
    for (at, token) in [
        (&farm.relay, "guess"),
        (&farm.open, "guess"),
        (&farm.relay, "above"),
        (&farm.relay, "below"),
        (&farm.open, "below"),
    ] {
        assert_eq!(ask(at, token), unknown, "{at} {token}");
    }
    assert!(ask(&farm.open, "above").1.is_ok());
}

fn inserts(namespace: Namespace) -> Vec<v1::InsertRequest> {
    let batches = records::batches(&namespace, 9, 9);
    batches.into_iter().map(|batch| v1::InsertRequest { batch: Some(batch) }).collect()
}

fn said(answer: Result<(), Status>) -> (Code, String) {
    answer.map_or_else(|status| (status.code(), status.message().into()), |()| (Code::Ok, String::new()))
}

#[test]
fn a_server_above_that_cannot_be_trusted_or_called_so_is_refused_with_one_line() {
    let farm = Farm::start();
    farm.tree.certificate("stranger");
    let stranger = farm.tree.path("stranger.pem");
    let root = farm.tree.path("root.pem");
    let localhost = farm.root.replace("127.0.0.1", "localhost");
    for (at, authority, what) in [
        (&farm.root, Some(&stranger), "no trust in the encrypted connection"),
        (&localhost, Some(&root), "not valid for name"),
        (&farm.root, None, "give --tls-ca"),
    ] {
        let mut command = farm.tree.command(&["serve", "--listen", &farm.tree.at("lost"), "--upstream", at]);
        if let Some(authority) = authority {
            command.args(["--tls-ca", authority]);
        }
        let mut relay = Process::start(command.stderr(Stdio::piped()));
        let status = wait_for(&format!("a refusal: {what}"), || relay.0.try_wait().expect("wait"));
        let said = std::io::read_to_string(relay.0.stderr.take().expect("piped")).expect("text");
        assert_eq!(status.code(), Some(2), "{said}");
        assert!(said.starts_with(&format!("ambience: --upstream {at}: ")) && said.contains(what), "{said}");
        assert_eq!(said.lines().count(), 1, "{said}");
    }
}

/// Records of several callers travel up together; they wait here behind a server that was stopped.
#[test]
fn a_batch_that_is_refused_spoils_none_that_travels_with_it() {
    let tree = Tree::new();
    let root = tree.serve("root", &[]);
    let _relay = tree.relay("near", "root");
    let address: Address = tree.at("near").parse().expect("an address");
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let insert = |requests: Vec<v1::InsertRequest>| {
        let address = address.clone();
        runtime.spawn(async move {
            let mut cache = client::cache(client::connect(&address, &Default::default()).expect("a line"));
            cache.insert(tokio_stream::iter(requests)).await.map(|answer| answer.into_inner().added)
        })
    };
    let namespace = Namespace([7; 32]);
    let mut torn = inserts(namespace);
    let batch = torn[0].batch.as_mut().expect("a batch");
    batch.records = batch.records.slice(1..);
    signal(root.0.id(), "STOP");
    let pause = || std::thread::sleep(Duration::from_millis(300));
    let first = insert(inserts(Namespace([6; 32])));
    pause();
    let wrong = insert(torn);
    pause();
    let sound = insert(inserts(namespace));
    pause();
    signal(root.0.id(), "CONT");
    let [first, wrong, sound] = [first, wrong, sound].map(|insert| runtime.block_on(insert).expect("no panic"));
    assert_eq!(first.expect("kept"), 9);
    assert_eq!(wrong.expect_err("refused").code(), Code::InvalidArgument);
    assert_eq!(sound.expect("kept"), 9);
}
