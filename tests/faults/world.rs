//! One simulation: the farm is built, things go wrong, things are mended, and what is left is looked at.

use std::cell::RefCell;
use std::rc::Rc;
use std::time::Duration;

use cache_core::{Namespace, RecordId};
use cache_proto::{convert, v1};
use turmoil::Sim;
use worker::client;

use crate::events::{self, Told};
use crate::hosts::{self, Farm, SHARED};
use crate::job;
use crate::network::{self, SERVER, connect};
use crate::owner::{self, Frame};
use crate::schedule::{Fault, OWNERS, Planned, SHARER, SLEEPER, STEADY, Schedule, WITNESSES, WORKERS};

/// Step of simulated time.
const TICK: Duration = Duration::from_millis(10);

/// Longest time a message takes on a slow link.
const SLOW: Duration = Duration::from_secs(2);

/// Part of the messages that break a link that drops.
const DROPS: f64 = 0.03;

/// All pictures are done this long after the last fault has ended.
const PATIENCE: Duration = Duration::from_secs(180);

/// All replicas are equal this long after the last record came.
const CATCH_UP: Duration = Duration::from_secs(60);

/// The server has forgotten all that left, this long after.
const FORGET: Duration = Duration::from_secs(40);

/// Runs the simulation of a seed.
pub fn run(seed: u64, keep: bool) -> Told {
    events::begin(keep);
    network::begin();
    let mut world = World::new(seed);
    if let Err(error) = world.run() {
        events::wrong(error);
    }
    // Before their runtimes.
    world.farm.replicas.borrow_mut().clear();
    drop(world);
    events::end()
}

struct World {
    sim: Sim<'static>,
    farm: Rc<Farm>,
    schedule: Schedule,
    told: Rc<RefCell<Option<v1::InfoResponse>>>,
}

type Step = Result<(), String>;

impl World {
    fn new(seed: u64) -> Self {
        let schedule = Schedule::of(seed);
        events::note("schedule", format_args!("{schedule:#?}"));
        let mut builder = turmoil::Builder::new();
        builder.rng_seed(seed).tick_duration(TICK).simulation_duration(Duration::MAX).tcp_capacity(1 << 16);
        builder.max_message_latency(Duration::from_millis(schedule.latency)).fail_rate(0.0).repair_rate(0.1);
        let mut sim = builder.build();

        let view = |number| job::view(number, schedule.tiles, schedule.levels);
        let mut frames: Vec<_> = (0..schedule.owners).map(|owner| Frame::new(owner, view(owner as u32))).collect();
        frames.push(Frame::new(0, view(1)));
        let farm = Farm::new(seed, frames);
        let namespace = job::namespace(schedule.levels);

        let state = farm.clone();
        sim.host(SERVER, move || hosts::server(state.clone()));
        for (number, name) in OWNERS.into_iter().enumerate().take(schedule.owners) {
            let state = farm.clone();
            sim.host(name, move || owner::owner(state.clone(), number));
        }
        let threads = schedule.threads;
        for name in WORKERS.into_iter().take(schedule.workers) {
            let state = farm.clone();
            sim.host(name, move || hosts::worker(state.clone(), name, threads));
        }
        for name in WITNESSES {
            let state = farm.clone();
            sim.host(name, move || hosts::witness(state.clone(), name, namespace));
        }
        let state = farm.clone();
        sim.host(SHARER, move || hosts::sharer(state.clone()));
        sim.host(SLEEPER, hosts::sleeper);
        Self { sim, farm, schedule, told: Rc::default() }
    }

    fn run(&mut self) -> Step {
        self.suffer()?;
        let farm = self.farm.clone();
        self.until("all pictures are done", PATIENCE, |_| farm.frames.borrow().iter().all(|frame| frame.done))?;
        self.repeat()?;
        farm.quiet.set(true);
        self.inspect();
        self.until("all replicas are equal", CATCH_UP, |world| world.differences().is_empty())
            .map_err(|error| format!("{error}: {}", self.differences().join("; ")))?;
        self.check_acknowledged();
        self.check_namespaces();
        self.leave()
    }

    /// Lets everything go wrong that is planned, and mends it.
    fn suffer(&mut self) -> Step {
        let mut changes: Vec<(Duration, bool, Planned)> = Vec::new();
        for planned in &self.schedule.faults {
            changes.extend([(planned.from, true, *planned), (planned.to, false, *planned)]);
        }
        changes.sort_by_key(|(at, begins, _)| (*at, *begins));
        for (at, begins, planned) in changes {
            while self.sim.elapsed() < at {
                self.step()?;
            }
            events::note("fault", format_args!("{} {:?}", if begins { "begins" } else { "ends" }, planned.fault));
            if begins {
                self.begin(planned)?;
            } else {
                self.end(planned.fault);
            }
        }
        Ok(())
    }

    fn step(&mut self) -> Step {
        events::tick(self.sim.elapsed());
        self.sim.step().map(drop).map_err(|error| format!("the simulation ended: {error}"))
    }

    fn until(&mut self, what: &str, most: Duration, is_so: impl Fn(&Self) -> bool) -> Step {
        let end = self.sim.elapsed() + most;
        while !is_so(self) {
            if self.sim.elapsed() > end {
                return Err(format!("{} s were not enough until {what}", most.as_secs()));
            }
            self.step()?;
        }
        Ok(())
    }

    fn begin(&mut self, planned: Planned) -> Step {
        let host = planned.fault.host();
        match planned.fault {
            Fault::Partition(_) => self.links(host, |sim, peer| sim.partition(host, peer)),
            Fault::Mute(_) => self.links(host, |sim, peer| sim.partition_oneway(host, peer)),
            Fault::Deaf(_) => self.links(host, |sim, peer| sim.partition_oneway(peer, host)),
            Fault::Stop(_) => self.links(host, |sim, peer| sim.hold(host, peer)),
            Fault::Drops(_) => self.links(host, |sim, peer| sim.set_link_fail_rate(host, peer, DROPS)),
            Fault::Slow(_) => self.links(host, |sim, peer| sim.set_link_max_message_latency(host, peer, SLOW)),
            Fault::Crash(_) => self.crash(host)?,
            Fault::PowerLoss(_) => {
                self.links(host, |sim, peer| sim.partition(host, peer));
                self.stop(host);
                self.links(host, |sim, peer| sim.repair(host, peer));
            }
            Fault::DiskLost => {
                self.crash(host)?;
                self.farm.disk.lose();
                let held = |id: &_| self.farm.is_held(&SHARED, *id);
                self.farm.acknowledged.borrow_mut().retain(held);
                self.farm.owed.replace(self.farm.sent.borrow().clone());
            }
            Fault::DiskFull => self.farm.disk.fill(true),
            Fault::ClockJump(by) => drop(self.farm.clock.send_replace(by)),
            Fault::Away => drop(self.farm.away.send_replace(planned.to - planned.from)),
        }
        Ok(())
    }

    fn end(&mut self, fault: Fault) {
        let host = fault.host();
        let latency = Duration::from_millis(self.schedule.latency);
        match fault {
            Fault::Partition(_) | Fault::Mute(_) | Fault::Deaf(_) => {
                self.links(host, |sim, peer| sim.repair(host, peer))
            }
            Fault::Stop(_) => self.links(host, |sim, peer| sim.release(host, peer)),
            Fault::Drops(_) => self.links(host, |sim, peer| {
                sim.set_link_fail_rate(host, peer, 0.0);
                sim.repair(host, peer);
            }),
            Fault::Slow(_) => self.links(host, |sim, peer| sim.set_link_max_message_latency(host, peer, latency)),
            Fault::Crash(_) | Fault::PowerLoss(_) | Fault::DiskLost => {
                network::mend(self.sim.lookup(host));
                self.sim.bounce(host);
            }
            Fault::DiskFull => {
                self.check_kept();
                self.farm.disk.fill(false);
            }
            Fault::ClockJump(_) | Fault::Away => {}
        }
    }

    /// Does something to every link between a host and the server, or the server and everybody.
    fn links(&mut self, host: &str, mut change: impl FnMut(&mut Sim<'static>, &'static str)) {
        if host != SERVER {
            return change(&mut self.sim, SERVER);
        }
        for peer in self.clients() {
            change(&mut self.sim, peer);
        }
    }

    fn clients(&self) -> Vec<&'static str> {
        let Schedule { owners, workers, .. } = self.schedule;
        [&OWNERS[..owners], &WORKERS[..workers], &WITNESSES, &[SHARER, SLEEPER]].concat()
    }

    /// A machine crashes; its kernel closes the connections.
    fn crash(&mut self, host: &'static str) -> Step {
        network::cut(self.sim.lookup(host));
        self.step()?;
        self.stop(host);
        Ok(())
    }

    /// A machine is no more.
    fn stop(&mut self, host: &'static str) {
        drop(self.farm.replicas.borrow_mut().remove(host));
        self.sim.crash(host);
        if host == SERVER {
            self.check_kept();
        }
    }

    /// What was acknowledged, or only shown to others, is on the disk. After one was lost the replicas need some time to
    /// bring back what was on it.
    fn check_kept(&self) {
        let replica = self.farm.disk.replica();
        let kept = |id: &_| replica.set(&SHARED).is_some_and(|set| set.get(*id).is_some());
        self.farm.owed.borrow_mut().retain(|id| !kept(id));
        let owed = self.farm.owed.borrow();
        let lost = self.farm.acknowledged.borrow().iter().filter(|id| !kept(id) && !owed.contains(id)).count();
        if lost > 0 {
            events::wrong(format_args!("{lost} acknowledged records are not on the disk"));
        }
        let early = |id: &&RecordId| !kept(id) && !owed.contains(id) && self.farm.is_shown(**id);
        let early = self.farm.sent.borrow().iter().filter(early).count();
        if early > 0 {
            events::wrong(format_args!("{early} records are shown that are not on the disk"));
        }
    }

    /// Renders the last frame once more, with nothing in the way.
    fn repeat(&mut self) -> Step {
        let farm = self.farm.clone();
        let last = farm.frames.borrow().last().map(|frame| Frame::new(frame.owner, frame.spec.clone()));
        farm.frames.borrow_mut().extend(last);
        self.until("a quiet picture is done", PATIENCE, |_| farm.frames.borrow().iter().all(|frame| frame.done))?;
        let gathered = farm.frames.borrow().last().map_or(0, |frame| frame.gathered);
        if gathered > 0 && !self.server_suffers() {
            events::wrong(format_args!("a picture rendered again gathered {gathered} records"));
        }
        Ok(())
    }

    /// Whether something befalls the server, so that what is published may stay a draft.
    fn server_suffers(&self) -> bool {
        use Fault::{Crash, DiskFull, DiskLost, PowerLoss};
        let hits =
            |fault: Fault| fault.host() == SERVER && matches!(fault, Crash(_) | DiskFull | DiskLost | PowerLoss(_));
        self.schedule.faults.iter().any(|planned| hits(planned.fault))
    }

    /// Asks the server every now and then what it holds.
    fn inspect(&mut self) {
        let told = self.told.clone();
        self.sim.client("inspector", async move {
            let cache = client::cache(connect());
            loop {
                let mut asked = cache.clone();
                let answer = asked.info(v1::InfoRequest {}).await;
                *told.borrow_mut() = answer.ok().map(tonic::Response::into_inner);
                tokio::time::sleep(Duration::from_millis(500)).await;
            }
        });
    }

    /// In what the witnesses' replicas differ from the server's.
    fn differences(&self) -> Vec<String> {
        let told = self.told.borrow();
        let Some(told) = told.as_ref() else { return vec!["the server has not answered".into()] };
        let replicas = self.farm.replicas.borrow();
        let mut differences = Vec::new();
        for (name, (namespace, follower)) in
            replicas.iter().flat_map(|(name, all)| all.iter().map(move |one| (name, one)))
        {
            let held = told.namespaces.iter().find(|info| info.namespace == namespace.0[..]);
            let there = held.map_or_else(|| convert::digest_bytes(Default::default()), |info| info.digest.clone());
            let here = follower.read(|replica| convert::digest_bytes(replica.digest()));
            if here != there {
                differences.push(format!("{name} differs in {}", hex(namespace)));
            }
        }
        differences
    }

    fn check_acknowledged(&self) {
        // By now all of it is back.
        self.farm.owed.borrow_mut().clear();
        self.check_kept();
        let replicas = self.farm.replicas.borrow();
        let Some((_, follower)) = replicas.get(STEADY).and_then(|all| all.iter().find(|(n, _)| *n == SHARED)) else {
            return events::wrong("the steady witness is gone");
        };
        let lost = |id: &&_| follower.read(|replica| replica.get(**id).is_none());
        let lost = self.farm.acknowledged.borrow().iter().filter(lost).count();
        if lost > 0 {
            events::wrong(format_args!("{lost} acknowledged records are lost"));
        }
    }

    /// Drafts are gone when their frames are filled.
    fn check_namespaces(&self) {
        let told = self.told.borrow();
        let count = told.as_ref().map_or(0, |told| told.namespaces.len());
        if count > 2 && self.schedule.owners == 1 && !self.server_suffers() {
            events::wrong(format_args!("{count} namespaces are left, expected the one shared and the frames'"));
        }
    }

    /// Everybody leaves without a word; the server forgets them.
    fn leave(&mut self) -> Step {
        self.farm.replicas.borrow_mut().clear();
        for host in self.clients() {
            self.crash(host)?;
        }
        let nobody = |told: &v1::InfoResponse| told.subscribers + told.workers + told.frames == 0;
        let gone = self
            .until("the server forgot all who left", FORGET, |world| world.told.borrow().as_ref().is_some_and(nobody));
        let told = self.told.borrow();
        let left = told.as_ref().map(|told| (told.subscribers, told.workers, told.frames));
        gone.map_err(|error| format!("{error}: subscribers, workers, frames are {left:?}"))
    }
}

fn hex(namespace: &Namespace) -> String {
    namespace.0[..4].iter().map(|byte| format!("{byte:02x}")).collect()
}
