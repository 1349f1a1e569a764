//! The image: built as its file says, by a builder that needs no daemon; then what compose and Kubernetes would start of it,
//! each in namespaces of its own: another user, nothing but the image's files, and those read-only.

use std::fs;
use std::path::Path;
use std::process::Command;

use rcgen::{CertificateParams, KeyPair};
use serde_json::Value;

use crate::{SMALL, Test, compose, deploy, kubernetes, needs, run};

/// Who runs it, and the group.
pub const USER: &str = "65532:65532";

const TOKEN: &str = "0123456789abcdef0123";

/// What runs of the image: the same, whoever describes it.
pub struct Container {
    /// What follows the image's entry point.
    pub arguments: Vec<String>,
    pub mounts: Vec<Mount>,
    /// Variables that hold the token.
    pub environment: Vec<String>,
    /// Where it starts.
    pub folder: Option<String>,
}

impl Container {
    /// Holds that what the arguments name by its path is mounted.
    pub fn sees_its_files(&self) {
        for argument in &self.arguments {
            let Some((_, path)) = argument.split_once("=/") else { continue };
            let mounted = |mount: &Mount| Path::new("/").join(path).starts_with(&mount.target);
            assert!(self.mounts.iter().any(mounted), "{argument}: nothing is mounted there");
        }
    }
}

/// A file or folder of the test's, by its name in the description, and where the container sees it.
pub struct Mount {
    pub source: String,
    pub target: String,
    pub writable: bool,
}

pub fn test() -> Test {
    // `sh` and `tar` are everywhere.
    let tools = ["cargo", "buildah", "bwrap"].into_iter().try_for_each(needs).and_then(|()| may());
    ("image_runs_shut_in_and_makes_the_same_picture", tools.map(|()| Box::new(image) as _))
}

/// Whether this machine lets builder and namespaces work at all: within some containers it does not.
fn may() -> Result<(), String> {
    let folder = tempfile::tempdir().expect("a folder");
    let [graph, runs] = ["graph", "runs"].map(|name| folder.path().join(name));
    let (mut builder, mut namespaces) = (Command::new("buildah"), Command::new("bwrap"));
    builder.args(["--storage-driver", "vfs", "--root"]).arg(graph).arg("--runroot").arg(runs).args(["from", "scratch"]);
    namespaces.args(NETWORK).arg("true");
    for command in [&mut builder, &mut namespaces] {
        let output = command.output().map_err(|e| e.to_string())?;
        if !output.status.success() {
            return Err(format!("{command:?}: {}", String::from_utf8_lossy(&output.stderr).trim()));
        }
    }
    Ok(())
}

/// A network of their own for processes that see all files.
const NETWORK: [&str; 6] = ["--unshare-user", "--unshare-net", "--dev-bind", "/", "/", "--die-with-parent"];

fn image() {
    let folder = tempfile::tempdir().expect("a folder");
    let root = build(folder.path());
    secrets(folder.path());
    let scene = ambience_bench::judge::file("scenes").join("cornell.glb");
    let out = folder.path().join("alone.exr");
    let mut command = Command::new(env!("CARGO_BIN_EXE_ambience"));
    run(command.arg("render").arg(&scene).arg("-o").arg(&out).arg("--quiet").args(SMALL.split(' ')));
    let alone = fs::read(out).expect("a picture");
    for (described, containers, work) in
        [("compose", compose::containers(), "work"), ("kubernetes", kubernetes::containers(), "ambience-work")]
    {
        let work = folder.path().join(work);
        fs::create_dir(&work).expect("a folder");
        fs::copy(&scene, work.join("scene.glb")).expect("copied");
        farm(folder.path(), &root, containers);
        assert!(fs::read(work.join("out.exr")).expect("a picture") == alone, "{described}: another picture");
    }
}

/// Makes the image and unpacks it: its root.
fn build(folder: &Path) -> std::path::PathBuf {
    let storage = folder.join("storage.conf");
    let [graph, runs] = ["graph", "runs"].map(|name| folder.join(name));
    let text = format!("[storage]\ndriver = \"vfs\"\ngraphroot = {graph:?}\nrunroot = {runs:?}\n");
    fs::write(&storage, text).expect("written");
    let with = |program: &str, arguments: &[&str]| {
        let mut command = Command::new(program);
        run(command.args(arguments).env("CONTAINERS_STORAGE_CONF", &storage).env("BUILDER", "buildah"));
    };
    with(deploy("container/build").to_str().expect("UTF-8"), &["ambience:test"]);
    let oci = folder.join("oci");
    with("buildah", &["push", "--quiet", "localhost/ambience:test", &format!("oci:{}", oci.display())]);

    let blob = |of: &Value| oci.join("blobs").join(of["digest"].as_str().expect("a digest").replace(':', "/"));
    let json = |path: &Path| -> Value { serde_json::from_slice(&fs::read(path).expect("a blob")).expect("JSON") };
    let manifest = json(&blob(&json(&oci.join("index.json"))["manifests"][0]));
    let config = json(&blob(&manifest["config"]));
    let told = ["User", "Entrypoint", "ExposedPorts"].map(|key| config["config"][key].to_string());
    assert_eq!(told, [&format!("\"{USER}\""), "[\"/ambience\"]", "{\"4670/tcp\":{}}"]);

    let root = folder.join("root");
    fs::create_dir(&root).expect("a folder");
    let mut held = Vec::new();
    for layer in manifest["layers"].as_array().expect("layers") {
        let list = run(Command::new("tar").args(["--numeric-owner", "-tvf"]).arg(blob(layer)));
        held.extend(list.lines().map(|line| {
            let words: Vec<_> = line.split_whitespace().collect();
            format!("{} {} {}", words[0], words[1], words[words.len() - 1])
        }));
        run(Command::new("tar").args(["--no-same-owner", "-xf"]).arg(blob(layer)).arg("-C").arg(&root));
    }
    held.sort();
    held.dedup();
    // One program and an empty folder. As nothing else is there, it starts only if it is linked statically.
    assert_eq!(held, ["-rwxr-xr-x 0/0 ambience", "drwxr-xr-x 65532/65532 data/"]);
    root
}

/// The server, the worker and the render of a farm, on a network of their own.
fn farm(folder: &Path, root: &Path, [server, worker, render]: [Container; 3]) {
    let quick = SMALL.split(' ').map(String::from);
    let render = Container { arguments: render.arguments.into_iter().chain(quick).collect(), ..render };
    let [server, worker, render] = [server, worker, render].map(|container| start(folder, root, &container));
    // A worker and a server that are told to end do so with 0.
    let script = format!(
        "{server} & server=$!
         {worker} & worker=$!
         {render} || exit 9
         kill $worker; wait $worker || exit 8
         kill $server; wait $server || exit 7"
    );
    run(Command::new("bwrap").args(NETWORK).args(["sh", "-c", &script]));
}

/// The command that starts a container.
fn start(folder: &Path, root: &Path, container: &Container) -> String {
    let hosts = folder.join("hosts");
    fs::write(&hosts, "127.0.0.1 localhost server ambience\n").expect("written");
    let mut line: Vec<String> =
        ["bwrap", "--die-with-parent", "--clearenv", "--cap-drop", "ALL"].map(String::from).into();
    line.extend(["user", "ipc", "uts", "cgroup-try"].map(|of| format!("--unshare-{of}")));
    let (user, group) = USER.split_once(':').expect("both");
    line.extend(["--uid", user, "--gid", group, "--bind"].map(String::from));
    line.extend([root.display().to_string(), "/".into()]);
    line.extend(["--proc", "/proc", "--dev", "/dev", "--ro-bind"].map(String::from));
    line.extend([hosts.display().to_string(), "/etc/hosts".into()]);
    for mount in &container.mounts {
        let source = folder.join(&mount.source);
        if mount.writable {
            fs::create_dir_all(&source).expect("a folder");
        }
        let bind = if mount.writable { "--bind" } else { "--ro-bind" };
        line.extend([bind.into(), source.display().to_string(), mount.target.clone()]);
    }
    // After the places for all these were made in it.
    line.extend(["--remount-ro", "/"].map(String::from));
    line.extend(container.environment.iter().flat_map(|name| ["--setenv", name, TOKEN].map(String::from)));
    line.extend(container.folder.iter().flat_map(|folder| ["--chdir", folder].map(String::from)));
    line.push("/ambience".into());
    line.extend(container.arguments.iter().cloned());
    // `exec`: signals are for the program itself.
    format!("exec '{}'", line.join("' '"))
}

/// What both descriptions ask for, under the names they give it.
fn secrets(folder: &Path) {
    use std::os::unix::fs::PermissionsExt as _;
    let key = KeyPair::generate().expect("a key");
    let hosts = CertificateParams::new(["server", "ambience"].map(String::from)).expect("hosts");
    let (pem, key) = (hosts.self_signed(&key).expect("signed").pem(), key.serialize_pem());
    for (name, text) in [
        ("secrets/ca.pem", &pem),
        ("secrets/server.pem", &pem),
        ("secrets/server.key", &key),
        ("secrets/tokens", &format!("light {TOKEN}\n")),
        ("secrets/token", &TOKEN.to_string()),
        ("ambience-tls/tls.crt", &pem),
        ("ambience-tls/tls.key", &key),
        ("ambience-ca/ca.pem", &pem),
    ] {
        let path = folder.join(name);
        fs::create_dir_all(path.parent().expect("a folder")).expect("a folder");
        fs::write(&path, text).expect("written");
        fs::set_permissions(&path, fs::Permissions::from_mode(0o400)).expect("set");
    }
}
