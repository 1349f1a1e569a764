//! The tests, one after the other on the same farm.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use ambience_bench::judge::file;
use libtest_mimic::{Failed, Trial};
use rcgen::{CertificateParams, KeyPair};
use serde_json::Value;
use tempfile::TempDir;

use crate::network::{Network, SERVER, WORKERS};
use crate::processes::{Run, collect, wait_for};

/// Bytes of nothing in the scene's file: what a worker that is sent it must receive at least.
const BALLAST: usize = 3 << 20;

/// A link is cut for so long.
const CUT: Duration = Duration::from_secs(10);

/// A server and two workers on machines of their own; the picture's owner is on the server's.
struct Farm {
    server: Child,
    workers: Vec<Child>,
    network: Network,
    folder: TempDir,
}

/// What can be tested here, or why nothing can.
pub fn tests() -> Result<Vec<Trial>, String> {
    let farm = Arc::new(Mutex::new(Farm::start(Network::build()?)));
    let test = |name: &str, run: fn(&mut Farm)| {
        let farm = farm.clone();
        let run = move || {
            let mut farm = farm.lock().unwrap_or_else(PoisonError::into_inner);
            let ran = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| run(&mut farm)));
            ran.map_err(|panic| {
                let said = panic.downcast_ref::<String>().cloned();
                Failed::from(said.unwrap_or_else(|| "it panicked".into()))
            })
        };
        Trial::test(name, run)
    };
    Ok(vec![
        test("1_the_picture_is_that_of_one_machine_and_a_scene_is_sent_to_who_lacks_it", quiet),
        test("2_fifty_milliseconds_of_delay_and_five_percent_of_loss_change_nothing", slow),
        test("3_the_link_to_the_server_cut_for_ten_seconds_changes_nothing", cut),
        test("4_a_machine_gone_for_good_changes_nothing", gone),
    ])
}

fn quiet(farm: &mut Farm) {
    let began = farm.render(&["--seed", "1"]);
    let first = farm.finish(began);
    let received = |run: &Run, host: &str| run.host(host)["bytes_received"].as_u64().unwrap_or(0) as usize;
    let (has, lacks) = (received(&first, "w1"), received(&first, "w2"));
    assert!(has > 10_000 && has < BALLAST / 2, "w1 has the scene and received {has} bytes");
    assert!(lacks > BALLAST, "w2 lacks the scene and received {lacks} bytes");
    let began = farm.render(&[]);
    let second = farm.finish(began);
    let again = received(&second, "w2");
    assert!(again > 10_000 && again < BALLAST / 2, "w2 has been sent the scene and received {again} bytes");
    assert!(second.host("w2")["bytes_sent"].as_u64() > Some(10_000), "{}", second.stats["hosts"]);
    farm.same(&second, &[]);
}

fn slow(farm: &mut Farm) {
    // Both ways together.
    farm.network.wire.set(Duration::from_millis(25), 5);
    let before = farm.network.wire.dropped();
    let began = farm.render(&["--seed", "3"]);
    let run = farm.finish(began);
    farm.network.wire.set(Duration::ZERO, 0);
    assert!(farm.network.wire.dropped() > before + 20);
    for (host, _) in WORKERS {
        let ms = run.host(host)["round_trip_ms"].as_f64().unwrap_or(0.0);
        assert!((50.0..5000.0).contains(&ms), "{host}: {ms} ms");
    }
    farm.same(&run, &["--seed", "3"]);
}

fn cut(farm: &mut Farm) {
    let mut began = farm.render(&["--rays", "2048"]);
    farm.busy(&mut began, 0);
    farm.network.wire.set(Duration::ZERO, 100);
    std::thread::sleep(CUT);
    assert!(began.0.try_wait().expect("wait").is_none(), "the picture was done without workers");
    farm.network.wire.set(Duration::ZERO, 0);
    let run = farm.finish(began);
    assert!(run.stats["leases_lost"].as_u64() >= Some(1), "{}", run.stats);
    farm.same(&run, &["--rays", "2048"]);
}

fn gone(farm: &mut Farm) {
    let mut began = farm.render(&["--rays", "4096"]);
    farm.busy(&mut began, 1);
    // First the network: nobody hears that its processes end.
    farm.network.cut("w2");
    farm.workers[1].kill().expect("kill");
    let run = farm.finish(began);
    assert!(run.host("w1")["bytes_sent"].as_u64() > Some(1000), "{}", run.stats["hosts"]);
    farm.same(&run, &["--rays", "4096"]);
}

impl Farm {
    fn start(network: Network) -> Self {
        let folder = tempfile::tempdir().expect("a folder");
        let at = |name: &str| folder.path().join(name);
        let scenes = at("scenes");
        std::fs::create_dir(&scenes).expect("a folder");
        std::fs::write(scenes.join("cornell.glb"), heavy(&file("scenes").join("cornell.glb"))).expect("written");
        let key = KeyPair::generate().expect("a key");
        let certificate = CertificateParams::new([SERVER.into()]).expect("a host").self_signed(&key).expect("signed");
        std::fs::write(at("server.pem"), certificate.pem()).expect("written");
        std::fs::write(at("server.key"), key.serialize_pem()).expect("written");
        std::fs::write(at("tokens"), "light 0123456789abcdef0123\n").expect("written");
        std::fs::write(at("token"), "0123456789abcdef0123\n").expect("written");
        std::fs::set_permissions(at("tokens"), std::os::unix::fs::PermissionsExt::from_mode(0o600)).expect("set");

        let mut server = network.command("serve", None, env!("CARGO_BIN_EXE_ambience"));
        server.env("RUST_LOG", "warn").args(["serve", "--listen", &address(), "--token-file"]).arg(at("tokens"));
        server.arg("--tls-cert").arg(at("server.pem")).arg("--tls-key").arg(at("server.key"));
        let mut farm = Self { server: spawn(&mut server), workers: Vec::new(), network, folder };
        for (host, _) in WORKERS {
            let hidden = (host == "w2").then(|| farm.folder.path().join("scenes"));
            let mut worker = farm.network.command(host, hidden.as_deref(), env!("CARGO_BIN_EXE_ambience"));
            worker.args(["worker", "--threads", "1"]).args(farm.calling());
            farm.workers.push(spawn(&mut worker));
        }
        farm
    }

    /// How the server is called.
    fn calling(&self) -> Vec<String> {
        let at = |name: &str| self.folder.path().join(name).display().to_string();
        ["--server".into(), address(), "--tls-ca".into(), at("server.pem"), "--token-file".into(), at("token")].into()
    }

    fn settings(&self, command: &mut Command, more: &[&str]) -> PathBuf {
        let out = self.folder.path().join("out");
        std::fs::create_dir_all(&out).expect("a folder");
        command.arg("render").arg(self.folder.path().join("scenes/cornell.glb"));
        command.arg("-o").arg(out.join("out.exr")).arg("--stats").arg(out.join("stats.json"));
        command.args(["--quiet", "--size", "64x48", "--rays", "256", "--spp", "4", "--bounces", "1"]).args(more);
        out
    }

    fn render(&self, more: &[&str]) -> (Child, PathBuf) {
        let mut command = self.network.command("serve", None, env!("CARGO_BIN_EXE_ambience"));
        let out = self.settings(&mut command, more);
        (spawn(command.args(self.calling())), out)
    }

    fn finish(&self, (mut render, out): (Child, PathBuf)) -> Run {
        let status = wait_for("the picture", || render.try_wait().expect("wait"));
        assert!(status.success(), "{status}");
        collect(&out)
    }

    /// Waits until a worker is in the middle of its work.
    fn busy(&self, (render, _): &mut (Child, PathBuf), worker: usize) {
        let pid = self.workers[worker].id();
        let before = crate::processes::cpu_ticks(pid);
        wait_for("a busy worker", || {
            assert!(render.try_wait().expect("wait").is_none(), "the picture was done before the worker was busy");
            (crate::processes::cpu_ticks(pid) > before + 20).then_some(())
        });
    }

    /// The picture is that of one machine.
    fn same(&self, run: &Run, more: &[&str]) {
        let mut command = Command::new(env!("CARGO_BIN_EXE_ambience"));
        let out = self.settings(&mut command, more);
        assert!(command.args(["--workers", "2"]).status().expect("ambience starts").success());
        let alone = collect(&out);
        assert_eq!(run.stats["digest"], alone.stats["digest"]);
        assert!(run.exr == alone.exr, "another picture");
    }
}

impl Drop for Farm {
    fn drop(&mut self) {
        for process in self.workers.iter_mut().chain([&mut self.server]) {
            // It may have ended.
            drop(process.kill());
            drop(process.wait());
        }
    }
}

impl Run {
    fn host(&self, name: &str) -> &Value {
        &self.stats["hosts"][name]
    }
}

fn address() -> String {
    format!("{SERVER}:4670")
}

fn spawn(command: &mut Command) -> Child {
    command.stdin(Stdio::null()).stdout(Stdio::null()).spawn().expect("it starts")
}

/// A .glb with a chunk that nobody reads, which its format allows.
fn heavy(scene: &Path) -> Vec<u8> {
    let mut bytes = std::fs::read(scene).expect("the scene");
    bytes.extend((BALLAST as u32).to_le_bytes());
    bytes.extend(*b"NULL");
    bytes.resize(bytes.len() + BALLAST, 0);
    let length = bytes.len() as u32;
    bytes[8..12].copy_from_slice(&length.to_le_bytes());
    bytes
}
