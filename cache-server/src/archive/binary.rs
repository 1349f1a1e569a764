//! The binary form: the journal's values ([`crate::journal::value`]), one behind another, each with one entry; the last
//! has no payload and says that nothing is missing.

use std::io::{self, Read, Write};

use cache_proto::v1::Entry;

use crate::journal::value::{self, HEADER, Header, Place, Unsound};

/// Writes entries.
pub struct Writer<W> {
    out: W,
    place: Place,
}

impl<W: Write> Writer<W> {
    /// Begins.
    pub fn new(out: W) -> Self {
        Self { out, place: Place::default() }
    }

    /// Adds one.
    ///
    /// # Errors
    /// Those of writing.
    pub fn entry(&mut self, entry: Entry) -> io::Result<()> {
        self.out.write_all(&self.place.seal(&[entry]))
    }

    /// Says that this was all.
    ///
    /// # Errors
    /// Those of writing.
    pub fn end(mut self) -> io::Result<W> {
        self.out.write_all(&self.place.seal(&[]))?;
        Ok(self.out)
    }
}

/// Reads all entries of a file. Errors say at which byte.
///
/// # Errors
/// What is unsound, that of reading, or the first of `each`.
pub fn read(mut file: impl Read, each: &mut dyn FnMut(Entry) -> Result<(), String>) -> Result<(), String> {
    let (mut place, mut offset) = (Place::default(), 0u64);
    loop {
        let at = |reason: String| format!("byte {offset}: {reason}");
        let (header, payload) = next(&mut file).map_err(at)?;
        if !place.fits(&header) {
            return Err(at(format!("value {} is missing", place.sequence)));
        }
        place = place.after(&header);
        if payload.is_empty() {
            let mut rest = [0];
            return match file.read(&mut rest) {
                Ok(0) => Ok(()),
                Ok(_) => Err(at("something follows the end".into())),
                Err(error) => Err(at(error.to_string())),
            };
        }
        for entry in value::entries(&payload) {
            each(entry.map_err(|unsound| at(unsound.to_string()))?).map_err(at)?;
        }
        offset += (HEADER + header.length) as u64;
    }
}

fn next(file: &mut impl Read) -> Result<(Header, Vec<u8>), String> {
    let short = |error: io::Error| match error.kind() {
        io::ErrorKind::UnexpectedEof => Unsound::Short.to_string(),
        _ => error.to_string(),
    };
    let mut header = [0; HEADER];
    file.read_exact(&mut header).map_err(short)?;
    let header = Header::read(&header).map_err(|unsound| unsound.to_string())?;
    let mut payload = vec![0; header.length];
    file.read_exact(&mut payload).map_err(short)?;
    header.check(&payload).map_err(|unsound| unsound.to_string())?;
    Ok((header, payload))
}
