//! Finds the values in the bytes of a journal's file without the store's help, wherever they lie: each says by itself
//! what it is. This is how damaged files are read, and files nobody may write to.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::fs::File;
use std::io;
use std::ops::RangeInclusive;
use std::os::unix::fs::FileExt as _;

use memchr::memmem;

use super::value::{HEADER, Header, MAGIC, Unsound};

/// Bytes looked through at a time.
const WINDOW: usize = 4 << 20;

/// What lies in a file.
#[derive(Debug, Default)]
pub struct Found {
    /// Sound values in the order they were appended: where their payload begins, by sequence number. Two of one number
    /// are both there: an append that failed may leave its own behind.
    pub values: Vec<(u64, Header)>,
    /// Sequence numbers of values whose header is there and whose payload is not what it was.
    pub broken: BTreeSet<u64>,
    /// A format newer than this build's that a value claims to have.
    pub newer: Option<u32>,
}

/// What is missing from a sequence of values.
#[derive(Clone, PartialEq, Eq, Debug, Default)]
pub struct Gaps {
    /// Sequence numbers of the values that are not there.
    pub lost: Vec<RangeInclusive<u64>>,
    /// How many records they held.
    pub records: u64,
}

impl Found {
    /// Looks through a file.
    ///
    /// # Errors
    /// When it cannot be read.
    pub fn scan(file: &File) -> io::Result<Self> {
        let end = file.metadata()?.len();
        let finder = memmem::Finder::new(&MAGIC);
        let mut found = Self::default();
        let mut values = BTreeMap::new();
        let (mut window, mut start) = (vec![0; WINDOW], 0);
        while start < end {
            let size = WINDOW.min((end - start) as usize);
            let bytes = &mut window[..size];
            file.read_exact_at(bytes, start)?;
            // The next window begins where this one could not see a whole magic any more, or behind its last value.
            let mut next = start + (size.saturating_sub(MAGIC.len() - 1)).max(1) as u64;
            let mut at = 0;
            while let Some(hit) = bytes.get(at..).and_then(|rest| finder.find(rest)) {
                let begin = start + (at + hit) as u64;
                at += hit + MAGIC.len();
                let header = match header_at(file, begin, end)? {
                    Ok(header) => header,
                    Err(Unsound::Newer(format)) => {
                        found.newer = Some(format);
                        continue;
                    }
                    Err(_) => continue,
                };
                let behind = begin + (HEADER + header.length) as u64;
                if behind > end || payload(file, begin + HEADER as u64, &header).is_err() {
                    found.broken.insert(header.sequence);
                    continue;
                }
                values.insert((header.sequence, header.checksum()), (begin + HEADER as u64, header));
                at = (behind - start) as usize;
                next = next.max(behind);
            }
            start = next;
        }
        found.values = values.into_values().collect();
        Ok(found)
    }

    /// What the sequence numbers say is missing before the last value.
    pub fn gaps(&self) -> Gaps {
        let (mut gaps, mut place, mut before) = (Gaps::default(), 0, 0);
        for (_, header) in &self.values {
            if header.sequence > place {
                gaps.lost.push(place..=header.sequence - 1);
                gaps.records = gaps.records.saturating_add(header.before.saturating_sub(before));
            }
            place = header.sequence.saturating_add(1);
            before = header.before.saturating_add(header.records);
        }
        gaps
    }
}

/// Whether a file is a journal's, whatever happened to it: somewhere in it is a magic of ours, or it is all zeros.
///
/// # Errors
/// When it cannot be read.
pub fn ours(file: &File) -> io::Result<bool> {
    let end = file.metadata()?.len();
    let (mut window, mut start, mut blank) = (vec![0; WINDOW], 0, true);
    while start < end {
        let bytes = &mut window[..WINDOW.min((end - start) as usize)];
        file.read_exact_at(bytes, start)?;
        if memmem::find(bytes, &MAGIC).is_some() {
            return Ok(true);
        }
        blank &= bytes.iter().all(|b| *b == 0);
        start += (bytes.len().saturating_sub(MAGIC.len() - 1)).max(1) as u64;
    }
    Ok(blank)
}

/// Reads the payload of a value that was found.
///
/// # Errors
/// When it cannot be read, or is not what it was.
pub fn payload(file: &File, at: u64, header: &Header) -> io::Result<Vec<u8>> {
    let mut payload = vec![0; header.length];
    file.read_exact_at(&mut payload, at)?;
    header.check(&payload).map_err(io::Error::other)?;
    Ok(payload)
}

fn header_at(file: &File, begin: u64, end: u64) -> io::Result<Result<Header, Unsound>> {
    if begin + HEADER as u64 > end {
        return Ok(Err(Unsound::Short));
    }
    let mut header = [0; HEADER];
    file.read_exact_at(&mut header, begin)?;
    Ok(Header::read(&header))
}

impl fmt::Display for Gaps {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const SHOWN: usize = 8;
        let count: u64 = self.lost.iter().map(|r| (r.end() - r.start()).saturating_add(1)).sum();
        if count == 0 {
            return f.write_str("no append before the last readable one is lost");
        }
        write!(f, "lost {count} appends with {} records (", self.records)?;
        for (index, range) in self.lost.iter().take(SHOWN).enumerate() {
            let comma = if index == 0 { "" } else { ", " };
            match range.start() == range.end() {
                true => write!(f, "{comma}{}", range.start())?,
                false => write!(f, "{comma}{} to {}", range.start(), range.end())?,
            }
        }
        if self.lost.len() > SHOWN {
            write!(f, ", and {} more ranges)", self.lost.len() - SHOWN)
        } else {
            f.write_str(")")
        }
    }
}
