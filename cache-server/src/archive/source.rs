//! Reads a cache directory or an exported file. Whatever it is, it is only read.

use std::fs::File;
use std::io::{self, BufReader};
use std::path::Path;

use cache_proto::v1::Entry;

use super::{Archive, ArchiveError, binary, json};
use crate::journal::recovery::OpenError;
use crate::journal::survey::{State, Survey};

/// The form of an exported file, by its name's ending.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub enum Form {
    /// `.jsonl`.
    JsonLines,
    /// `.ambience`.
    Binary,
}

impl Form {
    /// The form a path's ending asks for.
    ///
    /// # Errors
    /// [`ArchiveError::Input`] for any other ending.
    pub fn of(path: &Path) -> Result<Self, ArchiveError> {
        match path.extension().and_then(|ending| ending.to_str()) {
            Some("jsonl") => Ok(Self::JsonLines),
            Some("ambience") => Ok(Self::Binary),
            _ => {
                let path = path.display();
                Err(ArchiveError::Input(format!("{path}: expected a file that ends in .jsonl or .ambience")))
            }
        }
    }
}

/// What was read, besides its records.
#[derive(Clone, PartialEq, Debug)]
pub struct Source {
    /// Bytes of the file.
    pub bytes: u64,
    /// How it was left; exported files are whole, or they are refused.
    pub state: State,
}

impl Archive {
    /// Unites with what a cache directory or an exported file holds.
    ///
    /// # Errors
    /// [`ArchiveError`]; then only a part may have been united.
    pub fn unite(&mut self, path: &Path) -> Result<Source, ArchiveError> {
        let source = if path.is_dir() { self.directory(path) } else { self.file(path) }?;
        self.settle();
        Ok(source)
    }

    fn directory(&mut self, path: &Path) -> Result<Source, ArchiveError> {
        let survey = Survey::open(path)?;
        let apply = &mut |entry: Entry| self.apply(&entry).map_err(io::Error::other);
        survey.replay(apply).map_err(|error| ArchiveError::Input(format!("{}: {error}", path.display())))?;
        Ok(Source { bytes: survey.bytes, state: survey.state })
    }

    fn file(&mut self, path: &Path) -> Result<Source, ArchiveError> {
        let wrong = |reason: String| ArchiveError::Input(format!("{}: {reason}", path.display()));
        let file = File::open(path).map_err(|error| wrong(error.to_string()))?;
        let data = file.metadata().map_err(|error| wrong(error.to_string()))?;
        let form = Form::of(path)
            .map_err(|_| wrong("expected a cache directory, or a file that ends in .jsonl or .ambience".into()))?;
        if !data.is_file() {
            return Err(wrong("not a file".into()));
        }
        let apply = &mut |entry: Entry| self.apply(&entry).map_err(|error| error.to_string());
        let file = BufReader::with_capacity(1 << 20, file);
        match form {
            Form::JsonLines => json::read(file, apply),
            Form::Binary => binary::read(file, apply),
        }
        .map_err(wrong)?;
        Ok(Source { bytes: data.len(), state: State::Closed })
    }
}

impl From<OpenError> for ArchiveError {
    fn from(error: OpenError) -> Self {
        match error.exit_code() {
            2 => Self::Input(error.to_string()),
            _ => Self::Failed(error.to_string()),
        }
    }
}
