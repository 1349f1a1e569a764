//! Scenes that others send: asked for when this machine has no file of a frame's hash, read from memory, never written.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

use cache_proto::{SCENE_BYTES_MAX, v1};
use prost::bytes::Bytes;
use tokio::time::Instant;
use tonic::Status;

use crate::client::{self, Backoff, Frames, PATIENCE};
use crate::scene::{self, Files};
use crate::threads::{lock, off_thread};

/// Bytes of one part: the wire's bound.
const PART: usize = 1 << 20;

/// What came from owners of frames; the last scene stays, for the frames after it.
pub struct Scenes {
    frames: Frames,
    last: Mutex<Option<(Bytes, Files)>>,
}

impl Scenes {
    /// None yet; they come through `frames`.
    pub fn new(frames: Frames) -> Self {
        Self { frames, last: Mutex::default() }
    }

    /// The files of a frame's scene. Whoever reads them compares the scene's hash: nothing here is to be trusted.
    ///
    /// # Errors
    /// The server's.
    pub async fn of(&self, frame: u64, hash: &Bytes) -> Result<Files, Status> {
        if let Some((_, files)) = lock(&self.last).as_ref().filter(|(known, _)| known == hash) {
            return Ok(files.clone());
        }
        let (mut backoff, mut failing) = (Backoff::default(), None);
        let files = loop {
            match self.receive(frame).await {
                Ok(files) => break Files::sent(files),
                Err(status) if client::is_passing(&status) => {
                    if failing.get_or_insert_with(Instant::now).elapsed() >= PATIENCE {
                        return Err(status);
                    }
                    backoff.wait().await;
                }
                Err(status) => return Err(status),
            }
        };
        *lock(&self.last) = Some((hash.clone(), files.clone()));
        Ok(files)
    }

    async fn receive(&self, frame: u64) -> Result<BTreeMap<PathBuf, Vec<u8>>, Status> {
        let mut frames = self.frames.clone();
        let mut parts = frames.scene(v1::SceneRequest { frame }).await?.into_inner();
        let (mut files, mut bytes) = (BTreeMap::<PathBuf, Vec<u8>>::new(), 0);
        while let Some(v1::ScenePart { path, content }) = parts.message().await? {
            bytes += path.len() + content.len();
            if bytes > SCENE_BYTES_MAX {
                return Err(Status::resource_exhausted(too_large(bytes)));
            }
            files.entry(path.into()).or_default().extend_from_slice(&content);
        }
        Ok(files)
    }
}

/// The owner's side: sends the scene at `path`, or says why it cannot.
///
/// # Errors
/// The server's.
pub async fn offer(frames: &Frames, frame: u64, path: &Path) -> Result<(), Status> {
    let whole = path.to_path_buf();
    let read = off_thread(move || parts(&whole)).await.unwrap_or_else(Err);
    let requests: Vec<_> = match read {
        Ok(parts) => {
            parts.into_iter().map(|part| v1::OfferRequest { frame, part: Some(part), ..<_>::default() }).collect()
        }
        Err(refusal) => vec![v1::OfferRequest { frame, refusal, ..<_>::default() }],
    };
    let (mut backoff, began) = (Backoff::default(), Instant::now());
    loop {
        // Parts share their bytes: a copy of the list is small.
        match frames.clone().offer(tokio_stream::iter(requests.clone())).await {
            Ok(_) => return Ok(()),
            Err(status) if !client::is_passing(&status) || began.elapsed() >= PATIENCE => return Err(status),
            Err(_) => backoff.wait().await,
        }
    }
}

/// A scene's files in parts.
fn parts(path: &Path) -> Result<Vec<v1::ScenePart>, String> {
    let files = scene::files(path).map_err(|e| e.to_string())?;
    let bytes = files.iter().map(|(path, content)| path.as_os_str().len() + content.len()).sum();
    if bytes > SCENE_BYTES_MAX {
        return Err(too_large(bytes));
    }
    let mut parts = Vec::new();
    for (path, content) in files {
        let path = path.to_str().ok_or_else(|| format!("{}: the path is not UTF-8", path.display()))?.to_string();
        let mut content = Bytes::from(content);
        // Of an empty file the name is sent all the same.
        loop {
            let part = content.split_to(content.len().min(PART));
            parts.push(v1::ScenePart { path: path.clone(), content: part });
            if content.is_empty() {
                break;
            }
        }
    }
    Ok(parts)
}

fn too_large(bytes: usize) -> String {
    format!("its files have {bytes} bytes; at most {SCENE_BYTES_MAX} are sent: put them where workers can open them")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_scene_of_several_files_is_the_same_elsewhere() {
        let folder = tempfile::tempdir().expect("a folder");
        let write = |name: &str, text: &str| std::fs::write(folder.path().join(name), text).expect("written");
        let main = folder.path().join("main.rad");
        write("main.rad", "!xform -t 1 0 0 lamp.rad\n!xform -rz 9 empty.rad\n");
        write("lamp.rad", "void light lamp\n0\n0\n3 1 1 1\nlamp sphere bulb\n0\n0\n4 0 0 0 1\n");
        write("empty.rad", "");
        let here = scene::load(&main).expect("sound");
        let parts = parts(&main).expect("small");
        assert_eq!(parts.len(), 3);
        folder.close().expect("removed");
        let mut files = BTreeMap::<PathBuf, Vec<u8>>::new();
        for part in &parts {
            files.entry(part.path.clone().into()).or_default().extend_from_slice(&part.content);
        }
        let there = scene::load_from(&main, &Files::sent(files.clone())).expect("sent");
        assert_eq!(there.hash, here.hash);
        files.remove(Path::new(&parts[1].path));
        let error = scene::load_from(&main, &Files::sent(files)).expect_err("one file is missing").to_string();
        assert!(error.contains(".rad") && !error.contains('\n'), "{error}");
    }

    /// Names that others chose lead nowhere on this machine's disk.
    #[test]
    fn what_was_not_sent_is_not_read() {
        let own = concat!(env!("CARGO_MANIFEST_DIR"), "/../tests/scenes/cornell.glb");
        assert!(scene::load(own.as_ref()).is_ok());
        assert!(scene::load_from(own.as_ref(), &Files::sent(BTreeMap::new())).is_err());
        let lured = format!("!xform {own}.rad\n").into_bytes();
        assert!(scene::load_from("a.rad".as_ref(), &Files::sent([("a.rad".into(), lured)].into())).is_err());
    }
}
