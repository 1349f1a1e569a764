//! The compose file: read by types that know no other keys than those there are.

use docker_compose_types::{Command, Compose, Entrypoint, Secrets, Service, Volumes};

use crate::container::{Container, Mount, USER};
use crate::{Test, deploy, documents, takes, typed};

pub fn test() -> Test {
    ("compose_file_is_sound", Ok(Box::new(sound)))
}

fn sound() {
    for container in containers() {
        container.sees_its_files();
        // Each has a secret that is not there.
        takes(&container.arguments, &[], "/run/secrets/");
    }
}

/// The services.
pub fn containers() -> [Container; 3] {
    let text = std::fs::read_to_string(deploy("container/compose.yaml")).expect("a file");
    let [document] = documents(&text).try_into().expect("one document");
    let file: Compose = typed(&document);
    ["server", "worker", "render"].map(|name| {
        let service = file.services.0[name].as_ref().expect("a service");
        container(name, service, &file)
    })
}

fn container(name: &str, service: &Service, file: &Compose) -> Container {
    assert_eq!((service.user.as_deref(), service.read_only), (Some(USER), true), "{name}");
    assert_eq!((&service.cap_drop[..], service.privileged), (&["ALL".to_string()][..], false), "{name}");
    assert_eq!(service.security_opt, ["no-new-privileges:true"], "{name}");
    assert!(service.cap_add.is_empty(), "{name}");
    // The image has an entry point; the program in it is the first word of another one.
    let arguments = match (&service.entrypoint, &service.command) {
        (None, Some(Command::Args(words))) => words.clone(),
        (Some(Entrypoint::List(words)), None) if words[0] == "/ambience" => {
            [&words[1..], &["scene.glb", "-o", "out.exr"].map(String::from)].concat()
        }
        _ => panic!("{name}: no command"),
    };
    let Some(Secrets::Simple(secrets)) = &service.secrets else { panic!("{name}: no secrets") };
    let secrets = secrets.iter().map(|secret| {
        assert!(file.secrets.as_ref().is_some_and(|all| all.0.contains_key(secret)), "{name}: no secret {secret}");
        Mount { source: format!("secrets/{secret}"), target: format!("/run/secrets/{secret}"), writable: false }
    });
    let volumes = service.volumes.iter().map(|volume| {
        let Volumes::Simple(text) = volume else { panic!("{name}: {volume:?}") };
        let (source, target) = text.split_once(':').expect("where it is mounted");
        assert!(source.starts_with("./") || file.volumes.0.contains_key(source), "{name}: no volume {source}");
        Mount { source: source.trim_start_matches("./").into(), target: target.into(), writable: true }
    });
    Container {
        arguments,
        mounts: secrets.chain(volumes).collect(),
        environment: Vec::new(),
        folder: service.working_dir.clone(),
    }
}
