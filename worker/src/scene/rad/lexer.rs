//! Words and numbers of a Radiance file, each with the line it stands on.
//!
//! The rules are those of Radiance's own reader: words are parted by white space and may be quoted; a comment runs from
//! `#` to the end of the line, but only where an object or a number may begin; a command runs from `!` to the end of
//! the line, and a backslash at the end of the line continues it.

use std::borrow::Cow;

use crate::scene::SceneError;

/// Longest name quoted in a message, in characters.
const SHOWN: usize = 60;

/// What begins at the reader's position.
pub(super) enum Item {
    /// A line after `!`, continuations joined.
    Command(Vec<u8>),
    /// An object: modifier, type, name and arguments follow.
    Object,
}

/// A position in the bytes of one file.
pub(super) struct Lexer<'a> {
    file: &'a str,
    bytes: &'a [u8],
    at: usize,
    /// Line of the next byte.
    current: usize,
    /// Line of what was read last.
    line: usize,
}

impl<'a> Lexer<'a> {
    /// Starts at the first byte; `file` is only for messages.
    pub(super) fn new(file: &'a str, bytes: &'a [u8]) -> Self {
        Self { file, bytes, at: 0, current: 1, line: 1 }
    }

    /// The file's name, for messages.
    pub(super) fn file(&self) -> &'a str {
        self.file
    }

    /// Line of what was read last, counted from 1.
    pub(super) fn line(&self) -> usize {
        self.line
    }

    /// An error at the line of what was read last.
    pub(super) fn error(&self, message: impl std::fmt::Display) -> SceneError {
        SceneError(format!("{}:{}: {message}", self.file, self.line))
    }

    /// Goes to the next object or command; `None` at the end of the file.
    pub(super) fn item(&mut self) -> Option<Item> {
        self.skip_space_and_comments();
        self.line = self.current;
        match self.peek()? {
            b'!' => {
                self.at += 1;
                Some(Item::Command(self.rest_of_line()))
            }
            _ => Some(Item::Object),
        }
    }

    /// The next word, without its quotes. `what` says what it would be.
    pub(super) fn word(&mut self, what: &str) -> Result<&'a [u8], SceneError> {
        self.skip_space();
        let Some(first) = self.peek() else { return Err(self.at_end(what)) };
        self.line = self.current;
        if first == b'"' || first == b'\'' { self.quoted(first) } else { Ok(self.take(is_space)) }
    }

    /// The next number of arguments.
    pub(super) fn count(&mut self, what: &str) -> Result<u64, SceneError> {
        let token = self.number(what)?;
        std::str::from_utf8(token)
            .ok()
            .and_then(|text| text.parse().ok())
            .ok_or_else(|| self.error(format_args!("`{}` is not {what}; expected a whole number >= 0", show(token))))
    }

    /// The next real number, finite.
    pub(super) fn real(&mut self, what: std::fmt::Arguments) -> Result<f64, SceneError> {
        let token = self.number(what)?;
        finite(token).ok_or_else(|| self.error(format_args!("{what} is `{}`; expected a finite number", show(token))))
    }

    fn peek(&self) -> Option<u8> {
        self.bytes.get(self.at).copied()
    }

    fn at_end(&mut self, what: impl std::fmt::Display) -> SceneError {
        self.line = self.current;
        self.error(format_args!("the file ends where {what} was expected"))
    }

    /// Takes bytes up to the first that `ends` the token.
    fn take(&mut self, ends: impl Fn(u8) -> bool) -> &'a [u8] {
        let rest = &self.bytes[self.at..];
        let length = rest.iter().position(|&b| ends(b)).unwrap_or(rest.len());
        self.at += length;
        &rest[..length]
    }

    fn number(&mut self, what: impl std::fmt::Display) -> Result<&'a [u8], SceneError> {
        self.skip_space_and_comments();
        if self.at == self.bytes.len() {
            return Err(self.at_end(what));
        }
        self.line = self.current;
        Ok(self.take(|b| is_space(b) || b == b'#'))
    }

    fn quoted(&mut self, quote: u8) -> Result<&'a [u8], SceneError> {
        let rest = &self.bytes[self.at + 1..];
        match rest.iter().position(|&b| b == quote || b == b'\n') {
            Some(length) if rest[length] == quote => {
                self.at += length + 2;
                Ok(&rest[..length])
            }
            _ => Err(self.error("a quoted word does not end on its line; expected the closing quote")),
        }
    }

    fn skip_space(&mut self) {
        while let Some(byte) = self.peek().filter(|&b| is_space(b)) {
            self.current += usize::from(byte == b'\n');
            self.at += 1;
        }
    }

    fn skip_space_and_comments(&mut self) {
        self.skip_space();
        while self.peek() == Some(b'#') {
            self.take(|b| b == b'\n');
            self.skip_space();
        }
    }

    fn rest_of_line(&mut self) -> Vec<u8> {
        let mut text = Vec::new();
        while let Some(byte) = self.peek() {
            self.at += 1;
            match byte {
                b'\n' => {
                    self.current += 1;
                    if text.last() != Some(&b'\\') {
                        break;
                    }
                    text.pop();
                }
                b'\r' => {}
                _ => text.push(byte),
            }
        }
        text
    }
}

/// White space of C's `isspace`.
pub(super) fn is_space(byte: u8) -> bool {
    matches!(byte, b' ' | b'\t'..=b'\r')
}

/// The finite number that the whole of `token` spells.
pub(super) fn finite(token: &[u8]) -> Option<f64> {
    std::str::from_utf8(token).ok()?.parse().ok().filter(|v: &f64| v.is_finite())
}

/// A name as messages show it: printable, and not longer than a message can bear.
pub(in crate::scene) fn show(name: &[u8]) -> String {
    let head = &name[..name.len().min(4 * SHOWN)];
    let text: Cow<str> = String::from_utf8_lossy(head);
    let mut shown: String =
        text.chars().take(SHOWN).map(|c| if c.is_control() { char::REPLACEMENT_CHARACTER } else { c }).collect();
    if text.chars().nth(SHOWN).is_some() {
        shown.push_str("...");
    }
    shown
}
