//! The manifests: each read by the type of its kind; then what the types do not see, how they fit together.

use std::collections::{BTreeMap, BTreeSet};

use k8s_openapi::Resource;
use k8s_openapi::api::apps::v1::Deployment;
use k8s_openapi::api::batch::v1::Job;
use k8s_openapi::api::core::v1::{PersistentVolumeClaim, PodSpec, PodTemplateSpec, Probe, Service};
use k8s_openapi::api::networking::v1::{NetworkPolicy, NetworkPolicyPeer, NetworkPolicyPort};
use k8s_openapi::apimachinery::pkg::apis::meta::v1::LabelSelector;
use k8s_openapi::apimachinery::pkg::util::intstr::IntOrString;
use serde_json::Value;

use crate::container::{Container, Mount, USER};
use crate::{Test, deploy, documents, takes, typed};

type Labels = BTreeMap<String, String>;

pub fn test() -> Test {
    ("kubernetes_manifests_are_sound", Ok(Box::new(sound)))
}

fn sound() {
    let farm = Farm::read();
    for pod in farm.pods() {
        shut_in(spec(pod));
        farm.has_what_it_mounts(spec(pod));
    }
    farm.is_reached();
    farm.is_closed_to_others();
    for container in farm.containers() {
        container.sees_its_files();
        // What each mounts is not here.
        takes(&container.arguments, &[("AMBIENCE_TOKEN", "0123456789abcdef")], ": No such file");
    }
}

/// The server, a worker and a render.
pub fn containers() -> [Container; 3] {
    Farm::read().containers()
}

/// All that the manifests describe.
struct Farm {
    claims: Vec<PersistentVolumeClaim>,
    server: Deployment,
    service: Service,
    workers: Job,
    render: Job,
    policies: Vec<NetworkPolicy>,
    /// Secrets and maps that the comments say how to make.
    made: BTreeSet<String>,
}

impl Farm {
    fn read() -> Self {
        let text = ["kubernetes/farm.yaml", "kubernetes/render.yaml"]
            .map(|name| std::fs::read_to_string(deploy(name)).expect("a file"));
        let mut all: Vec<Value> = text.iter().flat_map(|text| documents(text)).collect();
        let [server] = take(&mut all);
        let [service] = take(&mut all);
        let [workers, render] = take(&mut all);
        let claims: [_; 2] = take(&mut all);
        let policies: [_; 2] = take(&mut all);
        assert!(all.is_empty(), "nobody looks at these: {all:?}");
        let made = text.iter().flat_map(|text| text.lines()).filter_map(|line| {
            let words: Vec<_> = line.split_once("kubectl create ")?.1.split_whitespace().collect();
            words.iter().take_while(|word| !word.starts_with("--")).last().map(ToString::to_string)
        });
        Self {
            made: made.collect(),
            claims: claims.into(),
            policies: policies.into(),
            server,
            service,
            workers,
            render,
        }
    }

    fn server(&self) -> &PodTemplateSpec {
        &self.server.spec.as_ref().expect("a spec").template
    }

    fn pods(&self) -> [&PodTemplateSpec; 3] {
        let [workers, render] = [&self.workers, &self.render].map(|job| &job.spec.as_ref().expect("a spec").template);
        [self.server(), workers, render]
    }

    fn has_what_it_mounts(&self, pod: &PodSpec) {
        let volumes = pod.volumes.iter().flatten();
        for volume in volumes.clone() {
            let source = source(pod, &volume.name);
            let claimed = self.claims.iter().any(|claim| claim.metadata.name.as_ref() == Some(&source));
            assert!(claimed || self.made.contains(&source), "nobody makes {source}");
        }
        let [container] = &pod.containers[..] else { panic!("one container") };
        for variable in container.env.iter().flatten() {
            let secret = variable.value_from.as_ref().and_then(|from| from.secret_key_ref.as_ref());
            assert!(secret.is_some_and(|secret| self.made.contains(&secret.name)), "nobody makes {}", variable.name);
        }
        let mounted: BTreeSet<_> = container.volume_mounts.iter().flatten().map(|mount| &mount.name).collect();
        assert_eq!(mounted, volumes.map(|volume| &volume.name).collect(), "volumes that are mounted and are there");
    }

    /// Service, ports and probes lead to the server, and its clients to the service.
    fn is_reached(&self) {
        let spec = self.server.spec.as_ref().expect("a spec");
        let labels = labels(self.server());
        assert!(selects(&spec.selector, labels), "the deployment's own pod");
        // Two servers never share a directory.
        assert_eq!(spec.strategy.as_ref().and_then(|strategy| strategy.type_.as_deref()), Some("Recreate"));
        assert_eq!(spec.replicas, Some(1));

        let service = self.service.spec.as_ref().expect("a spec");
        let selector = LabelSelector { match_labels: service.selector.clone(), ..LabelSelector::default() };
        assert!(selects(&selector, labels), "the service's pod");
        let container = spec_container(self.server());
        let port = |name: &str| {
            let mut ports = container.ports.iter().flatten();
            ports.find(|port| port.name.as_deref() == Some(name)).expect("a port").container_port
        };
        let [listen, health] = ["listen", "health"]
            .map(|name| option(container.args.as_deref(), name).rsplit_once(':').expect("a port").1);
        assert_eq!((listen, health), (&*port("ambience").to_string(), &*port("health").to_string()));
        let [offered] = service.ports.as_deref().expect("ports") else { panic!("one port") };
        assert_eq!(offered.target_port, Some(IntOrString::String("ambience".into())));
        let name = self.service.metadata.name.as_deref().expect("a name");
        for pod in &self.pods()[1..] {
            let server = option(spec_container(pod).args.as_deref(), "server");
            assert_eq!(server, format!("{name}:{}", offered.port));
        }
        let asks = |probe: &Option<Probe>| {
            let grpc = probe.as_ref().and_then(|probe| probe.grpc.clone()).expect("a gRPC probe");
            assert_eq!(grpc.port, port("health"));
            grpc.service
        };
        assert_eq!([&container.startup_probe, &container.readiness_probe].map(asks), [None, None]);
        // cache-server's own tests hold that it answers for this one also while the server is not ready.
        assert_eq!(asks(&container.liveness_probe).as_deref(), Some("grpc.health.v1.Health"));
    }

    /// Workers and renders may call the server, and nothing else is let in anywhere.
    fn is_closed_to_others(&self) {
        let [server, clients @ ..] = self.pods().map(labels);
        let port = spec_container(self.server()).ports.as_ref().expect("ports")[0].container_port;
        let of = |pod: &Labels| {
            let mut specs = self.policies.iter().filter_map(|policy| policy.spec.as_ref());
            let spec = specs.find(|spec| spec.pod_selector.as_ref().is_some_and(|selector| selects(selector, pod)));
            let spec = spec.expect("a policy for each pod");
            assert_eq!(spec.policy_types.as_deref(), Some(&["Ingress", "Egress"].map(String::from)[..]));
            spec
        };
        let [let_in] = of(server).ingress.as_deref().expect("rules") else { panic!("one rule") };
        assert_eq!(ports(&let_in.ports), [port]);
        let peers = let_in.from.as_deref().expect("peers");
        let named = |labels: &Labels| peers.iter().any(|peer| is(peer, labels));
        assert!(clients.into_iter().all(named), "clients are let in");
        assert!(!named(server) && !named(&Labels::new()), "who else is let in?");
        assert!(of(server).egress.is_none());
        for pod in clients {
            let mut rules = of(pod).egress.iter().flatten();
            assert!(of(pod).ingress.is_none());
            assert!(
                rules.any(|rule| {
                    ports(&rule.ports) == [port] && rule.to.iter().flatten().any(|peer| is(peer, server))
                })
            );
        }
    }

    fn containers(&self) -> [Container; 3] {
        self.pods().map(|pod| {
            let container = spec_container(pod);
            let mounts = container.volume_mounts.iter().flatten().map(|mount| Mount {
                source: source(spec(pod), &mount.name),
                target: mount.mount_path.clone(),
                writable: mount.read_only != Some(true),
            });
            Container {
                arguments: container.args.clone().expect("arguments"),
                mounts: mounts.collect(),
                environment: container.env.iter().flatten().map(|variable| variable.name.clone()).collect(),
                folder: container.working_dir.clone(),
            }
        })
    }
}

/// Takes the documents of a kind out of all, in their order.
fn take<T, const N: usize>(all: &mut Vec<Value>) -> [T; N]
where
    T: Resource + serde::Serialize + serde::de::DeserializeOwned,
{
    let is = |document: &mut Value| document["kind"] == T::KIND && document["apiVersion"] == T::API_VERSION;
    let taken: Vec<T> = all.extract_if(.., is).map(|document| typed(&document)).collect();
    taken.try_into().unwrap_or_else(|taken: Vec<T>| panic!("{} of kind {}", taken.len(), T::KIND))
}

fn spec(pod: &PodTemplateSpec) -> &PodSpec {
    pod.spec.as_ref().expect("a spec")
}

fn spec_container(pod: &PodTemplateSpec) -> &k8s_openapi::api::core::v1::Container {
    let [container] = &spec(pod).containers[..] else { panic!("one container") };
    container
}

fn labels(pod: &PodTemplateSpec) -> &Labels {
    pod.metadata.as_ref().and_then(|metadata| metadata.labels.as_ref()).expect("labels")
}

/// What a volume holds, by its name among the farm's.
fn source(pod: &PodSpec, name: &str) -> String {
    let volume = pod.volumes.iter().flatten().find(|volume| volume.name == name).expect("a volume");
    let claim = volume.persistent_volume_claim.as_ref().map(|claim| claim.claim_name.clone());
    let secret = volume.secret.as_ref().and_then(|secret| secret.secret_name.clone());
    let map = volume.config_map.as_ref().map(|map| map.name.clone());
    claim.or(secret).or(map).expect("a claim, a secret or a map")
}

/// The value of `--name=VALUE`.
fn option<'a>(arguments: Option<&'a [String]>, name: &str) -> &'a str {
    let mut values = arguments.expect("arguments").iter().filter_map(|argument| argument.strip_prefix("--"));
    values.find_map(|text| text.strip_prefix(name)?.strip_prefix('=')).expect("the option")
}

/// What Pod Security calls restricted, and read-only, and a share of the node.
fn shut_in(pod: &PodSpec) {
    let context = pod.security_context.as_ref().expect("a security context");
    assert_eq!((context.run_as_non_root, context.run_as_user, context.run_as_group), user());
    assert_eq!(context.seccomp_profile.as_ref().map(|profile| profile.type_.as_str()), Some("RuntimeDefault"));
    assert_eq!((pod.automount_service_account_token, pod.host_network), (Some(false), None));
    let [container] = &pod.containers[..] else { panic!("one container") };
    let context = container.security_context.as_ref().expect("a security context");
    let told = (context.allow_privilege_escalation, context.read_only_root_filesystem, context.privileged);
    assert_eq!(told, (Some(false), Some(true), None));
    let capabilities = context.capabilities.as_ref().expect("capabilities");
    assert_eq!((capabilities.drop.as_deref(), &capabilities.add), (Some(&["ALL".to_string()][..]), &None));
    let resources = container.resources.as_ref().expect("resources");
    let has = |of: &Option<BTreeMap<String, _>>, name: &str| of.as_ref().is_some_and(|of| of.contains_key(name));
    assert!(has(&resources.requests, "cpu") && has(&resources.requests, "memory") && has(&resources.limits, "memory"));
}

fn user() -> (Option<bool>, Option<i64>, Option<i64>) {
    let (user, group) = USER.split_once(':').expect("both");
    (Some(true), user.parse().ok(), group.parse().ok())
}

fn selects(selector: &LabelSelector, labels: &Labels) -> bool {
    let equal = selector.match_labels.iter().flatten().all(|(key, value)| labels.get(key) == Some(value));
    equal
        && selector.match_expressions.iter().flatten().all(|expression| {
            assert_eq!(expression.operator, "In");
            labels.get(&expression.key).is_some_and(|value| expression.values.iter().flatten().any(|one| one == value))
        })
}

fn is(peer: &NetworkPolicyPeer, labels: &Labels) -> bool {
    peer.pod_selector.as_ref().is_some_and(|selector| selects(selector, labels))
}

fn ports(ports: &Option<Vec<NetworkPolicyPort>>) -> Vec<i32> {
    let ports = ports.iter().flatten().map(|port| match port.port {
        Some(IntOrString::Int(number)) => number,
        _ => panic!("a number"),
    });
    ports.collect()
}
