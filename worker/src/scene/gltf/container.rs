//! From a file to its JSON and the bytes of its buffers. Everything here and in the other readers looks indices up with
//! `get`: the crate's own wrappers panic on documents that its validation lets through, and its validation panics on
//! some that it should refuse.

use std::path::{Path, PathBuf};

use ::gltf::json::{self, Index, Root, buffer};

use super::{Fault, Files};

/// Extensions that are read, so that a file may require them.
const SUPPORTED: [&str; 5] = [
    "KHR_lights_punctual",
    "KHR_materials_emissive_strength",
    "KHR_materials_ior",
    "KHR_materials_specular",
    "KHR_mesh_quantization",
];

/// A glTF file and its buffers in memory.
pub(super) struct Document {
    /// The JSON.
    pub(super) root: Root,
    buffers: Vec<Vec<u8>>,
    folder: PathBuf,
    files: Files,
}

impl Document {
    /// Reads `path`, .glb or .gltf by its content, and all of its buffers.
    pub(super) fn open(path: &Path, files: &Files) -> Result<Self, Fault> {
        let bytes = files.read(path).map_err(|e| format!("cannot be read: {e}"))?;
        let (text, blob) = if bytes.starts_with(b"glTF") { split_glb(&bytes)? } else { (&bytes[..], None) };
        let root = parse(text)?;
        check_version(&root)?;
        check_required(&root)?;
        let folder = path.parent().unwrap_or(path).to_path_buf();
        let mut document = Self { root, buffers: Vec::new(), folder, files: files.clone() };
        for (index, buffer) in document.root.buffers.iter().enumerate() {
            let data = document.buffer_bytes(buffer, if index == 0 { blob } else { None });
            let data = data.map_err(|fault| format!("buffer {index}: {fault}"))?;
            document.buffers.push(data);
        }
        Ok(document)
    }

    /// Names in extensionsUsed that are not read; a file that does not require them may be shown without.
    pub(super) fn ignored_extensions(&self) -> impl Iterator<Item = &str> {
        self.root.extensions_used.iter().map(String::as_str).filter(|name| !SUPPORTED.contains(name))
    }

    /// The bytes of a buffer view.
    pub(super) fn view(&self, index: Index<buffer::View>) -> Result<&[u8], Fault> {
        let named = |fault: String| format!("bufferView {index}: {fault}");
        let view = self.root.get(index).ok_or_else(|| named(beyond(self.root.buffer_views.len())))?;
        let buffer = self.buffers.get(view.buffer.value());
        let buffer = buffer.ok_or_else(|| named(format!("buffer {}: {}", view.buffer, beyond(self.buffers.len()))))?;
        let start = view.byte_offset.unwrap_or_default().0;
        slice(buffer, start, view.byte_length.0).ok_or_else(|| {
            named(format!(
                "byteOffset {start} and byteLength {} reach beyond buffer {}, which has {} bytes",
                view.byte_length.0,
                view.buffer,
                buffer.len()
            ))
        })
    }

    /// The content of a `data:` URI or of a file beside the scene.
    pub(super) fn resource(&self, uri: &str) -> Result<Vec<u8>, Fault> {
        if uri.starts_with("data:") {
            return match ::gltf::buffer::Data::from_source(::gltf::buffer::Source::Uri(uri), None) {
                Ok(data) => Ok(data.0),
                Err(e) => Err(format!("its data URI is not base64: {e}")),
            };
        }
        if uri.contains(':') {
            return Err(format!("uri {uri:?} is not supported; expected a relative file name or a data URI"));
        }
        let name = percent_decode(uri).ok_or_else(|| format!("uri {uri:?} is not a percent-encoded UTF-8 name"))?;
        self.files.read(&self.folder.join(&name)).map_err(|e| format!("file {name:?} cannot be read: {e}"))
    }

    fn buffer_bytes(&self, buffer: &json::Buffer, blob: Option<&[u8]>) -> Result<Vec<u8>, Fault> {
        let mut data = match (&buffer.uri, blob) {
            (Some(uri), _) => self.resource(uri)?,
            (None, Some(blob)) => blob.to_vec(),
            (None, None) => return Err("has neither a uri nor the binary chunk of a .glb".into()),
        };
        let length = buffer.byte_length.0;
        if (data.len() as u64) < length {
            return Err(format!("byteLength is {length}, but only {} bytes are there", data.len()));
        }
        data.truncate(length as usize);
        Ok(data)
    }
}

/// What is wrong with an index into a list of `count`.
pub(super) fn beyond(count: usize) -> String {
    match count {
        0 => "does not exist; the file has none".into(),
        _ => format!("does not exist; the last one is {}", count - 1),
    }
}

/// `bytes[start..start + length]` where that exists.
pub(super) fn slice(bytes: &[u8], start: u64, length: u64) -> Option<&[u8]> {
    let end = usize::try_from(start.checked_add(length)?).ok()?;
    bytes.get(usize::try_from(start).ok()?..end)
}

/// JSON and binary chunk of a .glb.
fn split_glb(bytes: &[u8]) -> Result<(&[u8], Option<&[u8]>), Fault> {
    let number = |at: usize| -> Option<u32> { Some(u32::from_le_bytes(bytes.get(at..at + 4)?.try_into().ok()?)) };
    let (Some(version), Some(length)) = (number(4), number(8)) else {
        return Err(format!("truncated: {} bytes, but the header of a .glb has 12", bytes.len()));
    };
    if version != 2 {
        return Err(format!("binary glTF version {version} is not supported; expected 2"));
    }
    if (bytes.len() as u64) < u64::from(length) {
        return Err(format!("truncated: its header says {length} bytes, but it has {}", bytes.len()));
    }
    let bytes = &bytes[..length as usize];
    let (mut text, mut blob, mut at) = (None, None, 12);
    while let (Some(size), Some(kind)) = (number(at), bytes.get(at + 4..at + 8)) {
        let chunk = slice(bytes, at as u64 + 8, u64::from(size));
        let chunk = chunk.ok_or_else(|| format!("chunk at byte {at} says {size} bytes and reaches beyond the file"))?;
        match kind {
            b"JSON" if text.is_none() => text = Some(chunk),
            b"BIN\0" if blob.is_none() => blob = Some(chunk),
            // Others are for extensions; the format says to skip them.
            _ => {}
        }
        at += 8 + chunk.len();
    }
    Ok((text.ok_or("has no JSON chunk")?, blob))
}

fn parse(text: &[u8]) -> Result<Root, Fault> {
    Root::from_slice(text).or_else(|error| {
        // The crate reads parts that we do not, more strictly than the format. Its error message is kept, for it
        // alone knows the line.
        let fault = || format!("not glTF 2.0: {error}");
        let mut value: json::Value = json::deserialize::from_slice(text).map_err(|_| fault())?;
        strip_unread(&mut value);
        json::deserialize::from_value(value).map_err(|_| fault())
    })
}

/// Takes out `extras` everywhere and the insides of animations.
fn strip_unread(value: &mut json::Value) {
    match value {
        json::Value::Object(fields) => {
            fields.remove("extras");
            if let Some(animations) = fields.get_mut("animations").and_then(|a| a.as_array_mut()) {
                let empty = [("channels", json::Value::Array(vec![])), ("samplers", json::Value::Array(vec![]))];
                animations.fill(empty.into_iter().map(|(k, v)| (k.to_string(), v)).collect());
            }
            fields.values_mut().for_each(strip_unread);
        }
        json::Value::Array(values) => values.iter_mut().for_each(strip_unread),
        _ => {}
    }
}

fn check_version(root: &Root) -> Result<(), Fault> {
    let needed = root.asset.min_version.as_ref();
    if !root.asset.version.starts_with("2.") || needed.is_some_and(|v| v != "2.0") {
        let needed = needed.unwrap_or(&root.asset.version);
        return Err(format!("asset: glTF version {needed:?} is not supported; expected \"2.0\""));
    }
    Ok(())
}

fn check_required(root: &Root) -> Result<(), Fault> {
    match root.extensions_required.iter().find(|name| !SUPPORTED.contains(&name.as_str())) {
        None => Ok(()),
        Some(name) => {
            Err(format!("extensionsRequired: {name:?} is not supported; supported are {}", SUPPORTED.join(", ")))
        }
    }
}

fn percent_decode(uri: &str) -> Option<String> {
    let mut bytes = Vec::with_capacity(uri.len());
    let mut rest = uri.bytes();
    while let Some(byte) = rest.next() {
        if byte != b'%' {
            bytes.push(byte);
            continue;
        }
        let mut digit = || char::from(rest.next()?).to_digit(16);
        bytes.push((digit()? * 16 + digit()?) as u8);
    }
    String::from_utf8(bytes).ok()
}
