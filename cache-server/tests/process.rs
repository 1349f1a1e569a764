//! `cache-server` as users start it: what it prints, how it stops, how it fails.

use std::io::{BufRead as _, BufReader};
use std::process::{Command, Output, Stdio};

fn cache_server() -> Command {
    Command::new(env!("CARGO_BIN_EXE_cache-server"))
}

fn fails(args: &[&str]) -> Output {
    let output = cache_server().args(args).output().expect("started");
    assert!(output.stdout.is_empty());
    output
}

fn message(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

#[test]
fn it_says_where_it_listens_and_a_signal_ends_it() {
    let folder = tempfile::tempdir().expect("a folder");
    let socket = folder.path().join("cache.sock");
    for signal in ["-TERM", "-INT"] {
        let mut server = cache_server()
            .args(["--listen", "127.0.0.1:0", "--listen", &format!("unix:{}", socket.display())])
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("started");
        let mut lines = BufReader::new(server.stdout.take().expect("piped")).lines().map(|line| line.expect("text"));
        let tcp = lines.next().expect("a line");
        let port = tcp.strip_prefix("listening on 127.0.0.1:").expect("the address");
        assert_ne!(port.parse::<u16>().expect("a port"), 0);
        assert_eq!(lines.next(), Some(format!("listening on unix:{}", socket.display())));
        let taken = fails(&["--listen", &format!("127.0.0.1:{port}")]);
        assert_eq!(taken.status.code(), Some(1));
        assert!(message(&taken).contains(port), "{}", message(&taken));

        let sent = Command::new("kill").args([signal, &server.id().to_string()]).status().expect("kill runs");
        assert!(sent.success());
        assert_eq!(server.wait().expect("ended").code(), Some(0));
        assert!(!socket.exists());
    }
}

#[test]
fn wrong_usage_is_one_line_and_exit_code_2() {
    let open = fails(&["--listen", "0.0.0.0:0"]);
    assert_eq!((open.status.code(), message(&open).lines().count()), (Some(2), 1), "{}", message(&open));
    assert!(message(&open).contains("0.0.0.0:0") && message(&open).contains("--insecure"));
    let bad = fails(&["--listen", "nonsense"]);
    assert_eq!(bad.status.code(), Some(2));
    assert!(message(&bad).contains("nonsense"));
    let nowhere = fails(&["--listen", "unix:/no/such/folder/cache.sock"]);
    assert_eq!((nowhere.status.code(), message(&nowhere).lines().count()), (Some(2), 1));
}
