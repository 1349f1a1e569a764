//! One append as it lies on disk and in binary exports: entries behind a header that says what they are and a checksum
//! over both. It can be recognised wherever it lies, so the pieces of a damaged file still speak for themselves.
//!
//! | bytes | what |
//! |---|---|
//! | 0..8 | [`MAGIC`] |
//! | 8..12 | [`FORMAT`] |
//! | 12..16 | length of the payload in bytes |
//! | 16..24 | sequence number, from 0 |
//! | 24..32 | records in the values before this one |
//! | 32..40 | records in this value |
//! | 40..56 | first 16 bytes of the BLAKE3 of bytes 0..40 and the payload |
//! | 56.. | payload: entries, each a varint of its length and its protobuf bytes |
//!
//! All numbers are little endian.

use std::io;

use cache_core::Record;
use cache_proto::v1;
use cache_proto::v1::entry::Entry as Kind;
use prost::Message as _;

/// How a value begins.
pub const MAGIC: [u8; 8] = *b"\xa7ambval\n";

/// The format this build writes, and the newest it reads.
pub const FORMAT: u32 = 1;

/// Bytes before the payload.
pub const HEADER: usize = 56;

/// Most bytes of a payload: no entry a server accepts comes near it.
pub const PAYLOAD_MAX: usize = 16 << 20;

/// Appends of more bytes than this are split.
const PAYLOAD_USUAL: usize = 4 << 20;

/// What a header says.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub struct Header {
    /// Bytes of the payload.
    pub length: usize,
    /// Where it stands in the journal, from 0.
    pub sequence: u64,
    /// Records in the values before it.
    pub before: u64,
    /// Records in it.
    pub records: u64,
    checksum: [u8; 16],
}

/// Why bytes are not a value.
#[derive(Clone, Copy, PartialEq, Eq, Debug, thiserror::Error)]
pub enum Unsound {
    /// It does not begin as one.
    #[error("no value begins here")]
    Magic,
    /// Written by a newer build.
    #[error("format {0}, this build reads up to format {FORMAT}")]
    Newer(u32),
    /// It is shorter than its header says, or than a header.
    #[error("cut short")]
    Short,
    /// Its bytes are not those that were written.
    #[error("the checksum does not match")]
    Checksum,
    /// Its payload is no sequence of entries: whoever wrote it was not this program.
    #[error("the payload is not a sequence of entries")]
    Payload,
}

impl Header {
    /// Reads a header; whether the value is sound only [`Header::check`] tells.
    ///
    /// # Errors
    /// When no value of a known format begins here.
    pub fn read(bytes: &[u8]) -> Result<Self, Unsound> {
        let header = bytes.first_chunk::<HEADER>().ok_or(Unsound::Short)?;
        let four = |at: usize| u32::from_le_bytes([header[at], header[at + 1], header[at + 2], header[at + 3]]);
        let eight = |at: usize| u64::from(four(at)) | u64::from(four(at + 4)) << 32;
        if header[..8] != MAGIC {
            return Err(Unsound::Magic);
        }
        match four(8) {
            FORMAT => (),
            0 => return Err(Unsound::Checksum),
            newer => return Err(Unsound::Newer(newer)),
        }
        let length = four(12) as usize;
        if length > PAYLOAD_MAX {
            return Err(Unsound::Checksum);
        }
        let mut checksum = [0; 16];
        checksum.copy_from_slice(&header[40..]);
        Ok(Self { length, sequence: eight(16), before: eight(24), records: eight(32), checksum })
    }

    /// Checks the payload against the header.
    ///
    /// # Errors
    /// [`Unsound::Short`], [`Unsound::Checksum`].
    pub fn check(&self, payload: &[u8]) -> Result<(), Unsound> {
        if payload.len() != self.length {
            return Err(Unsound::Short);
        }
        (checksum(&self.begin(), payload) == self.checksum).then_some(()).ok_or(Unsound::Checksum)
    }

    /// The checksum it carries.
    pub fn checksum(&self) -> [u8; 16] {
        self.checksum
    }

    /// What comes before the checksum.
    fn begin(&self) -> [u8; 40] {
        let mut bytes = [0; 40];
        bytes[..8].copy_from_slice(&MAGIC);
        bytes[8..12].copy_from_slice(&FORMAT.to_le_bytes());
        bytes[12..16].copy_from_slice(&(self.length as u32).to_le_bytes());
        bytes[16..24].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[24..32].copy_from_slice(&self.before.to_le_bytes());
        bytes[32..].copy_from_slice(&self.records.to_le_bytes());
        bytes
    }
}

/// Where the next value stands.
#[derive(Clone, Copy, PartialEq, Eq, Debug, Default)]
pub struct Place {
    /// Its sequence number: how many values come before it.
    pub sequence: u64,
    /// Records in the values before it.
    pub before: u64,
}

impl Place {
    /// Puts entries, as [`split`] groups them, into one value, and moves on to the place behind it.
    pub fn seal(&mut self, entries: &[v1::Entry]) -> Vec<u8> {
        let mut value = Vec::new();
        self.seal_into(&mut value, entries);
        value
    }

    /// As [`Self::seal`], in the place of what `value` held: memory used before costs less than new memory.
    pub fn seal_into(&mut self, value: &mut Vec<u8>, entries: &[v1::Entry]) {
        value.clear();
        value.reserve(HEADER + entries.iter().map(weight).sum::<usize>());
        value.resize(HEADER, 0);
        for entry in entries {
            // A vector grows: there is room.
            let _ = entry.encode_length_delimited(value);
        }
        self.head(entries.iter().map(records).sum(), value);
    }

    /// Puts a payload of at most [`PAYLOAD_MAX`] bytes that holds so many records into a value.
    pub fn seal_payload(&mut self, records: u64, payload: &[u8]) -> Vec<u8> {
        let mut value = [&[0; HEADER], payload].concat();
        self.head(records, &mut value);
        value
    }

    /// Writes the header before the payload that stands behind it.
    fn head(&mut self, records: u64, value: &mut [u8]) {
        let (head, payload) = value.split_at_mut(HEADER);
        let (length, sequence, before) = (payload.len(), self.sequence, self.before);
        let mut header = Header { length, sequence, before, records, checksum: Default::default() };
        header.checksum = checksum(&header.begin(), payload);
        head[..40].copy_from_slice(&header.begin());
        head[40..].copy_from_slice(&header.checksum);
        *self = self.after(&header);
    }

    /// Whether a value of this header belongs here.
    pub fn fits(&self, header: &Header) -> bool {
        (header.sequence, header.before) == (self.sequence, self.before)
    }

    /// The place behind a value of this header.
    pub fn after(&self, header: &Header) -> Self {
        Self { sequence: self.sequence + 1, before: self.before.saturating_add(header.records) }
    }
}

/// Groups entries so that each group makes a value of a usual size.
///
/// # Errors
/// An entry of more than [`PAYLOAD_MAX`] bytes.
pub fn split(entries: &[v1::Entry]) -> io::Result<Vec<&[v1::Entry]>> {
    let (mut groups, mut rest) = (Vec::new(), entries);
    while let Some(first) = rest.first() {
        let mut length = weight(first);
        if length > PAYLOAD_MAX {
            let reason = format!("an entry of {length} bytes; the journal takes at most {PAYLOAD_MAX}");
            return Err(io::Error::new(io::ErrorKind::InvalidInput, reason));
        }
        let more = rest[1..].iter().take_while(|entry| {
            length += weight(entry);
            length <= PAYLOAD_USUAL
        });
        let (group, behind) = rest.split_at(1 + more.count());
        groups.push(group);
        rest = behind;
    }
    Ok(groups)
}

/// Reads and checks one value from the beginning of `bytes`.
///
/// # Errors
/// Why it is none.
pub fn open(bytes: &[u8]) -> Result<(Header, &[u8]), Unsound> {
    let header = Header::read(bytes)?;
    let payload = bytes.get(HEADER..HEADER + header.length).ok_or(Unsound::Short)?;
    header.check(payload).map(|()| (header, payload))
}

/// The entries of a payload, one at a time: in memory one may take a hundred times its bytes. [`Unsound::Payload`] where
/// none begins, and then no more.
pub fn entries(mut payload: &[u8]) -> impl Iterator<Item = Result<v1::Entry, Unsound>> {
    std::iter::from_fn(move || {
        if payload.is_empty() {
            return None;
        }
        let entry = v1::Entry::decode_length_delimited(&mut payload).map_err(|_| Unsound::Payload);
        if entry.is_err() {
            payload = &[];
        }
        Some(entry)
    })
}

/// How many records an entry holds.
pub fn records(entry: &v1::Entry) -> u64 {
    match &entry.entry {
        Some(Kind::Batch(batch)) => Record::bytes(batch.kind).map_or(0, |size| batch.records.len() / size) as u64,
        _ => 0,
    }
}

/// Bytes an entry takes in a payload.
fn weight(entry: &v1::Entry) -> usize {
    let length = entry.encoded_len();
    length + prost::length_delimiter_len(length)
}

fn checksum(begin: &[u8; 40], payload: &[u8]) -> [u8; 16] {
    let hash = blake3::Hasher::new().update(begin).update(payload).finalize();
    let mut checksum = [0; 16];
    checksum.copy_from_slice(&hash.as_bytes()[..16]);
    checksum
}
