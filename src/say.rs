//! What the program says. A reader who has seen enough and left is no reason to stop, let alone to panic.

use std::fmt::Display;
use std::io::{ErrorKind, Write as _, stderr, stdout};

use crate::failure::Failure;

/// Writes what was asked for to stdout.
///
/// # Errors
/// When it cannot be written although somebody reads: a full disk, say.
pub fn result(text: impl Display) -> Result<(), Failure> {
    let mut stdout = stdout().lock();
    match writeln!(stdout, "{text}").and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            Err(Failure::failed(format!("stdout cannot be written: {}", error.kind())))
        }
        _ => Ok(()),
    }
}

/// Writes a line to stderr. If that fails there is nobody left to tell.
pub fn line(text: impl Display) {
    drop(writeln!(stderr(), "ambience: {text}"));
}
