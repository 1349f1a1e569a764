//! The Radiance scene description, as its reference manual defines it: plastic, metal, light, glow and constant mixfunc
//! materials; polygon, sphere, bubble, ring, cylinder, tube, cone, cup and source surfaces; alias; and `!xform`, worked
//! out without starting a program. Anything else is an error that names file and line: nothing is dropped silently.
//!
//! Lengths are the file's own, radiances W/(sr m2), angles degrees. `light` and `glow` emit from the front only, reflect
//! nothing and are black behind: Radiance tells them apart only to choose how to look for them. Everything else reflects on both sides.

mod lexer;
mod material;
mod polygon;
mod primitive;
mod tessellate;
#[cfg(test)]
mod tests;
mod xform;

use std::fmt::{Arguments, Display};
use std::path::{Path, PathBuf};

pub(super) use lexer::show;
use lexer::{Item, Lexer};
use xform::{Frame, Xform};

use super::{Files, Scene, SceneError};

/// Deepest nesting of files.
const MAX_DEPTH: usize = 32;
/// Most files read, copies counted: arrays in arrays reach billions with a few lines.
const MAX_INCLUDES: usize = 1_000_000;
/// Most warnings kept.
const MAX_WARNINGS: usize = 100;

/// Reads a .rad file and all it includes.
///
/// # Errors
/// One line `FILE:LINE: TYPE NAME: what is wrong; what would be right`.
pub(super) fn load(path: &Path, files: &Files) -> Result<Scene, SceneError> {
    let source = Source::read(path, files).map_err(SceneError)?;
    let home = source.directory().to_path_buf();
    let mut reader = Reader { home, files: files.clone(), ..Reader::default() };
    reader.file(&source, &Frame::default())?;
    if reader.scene.triangles.is_empty() && reader.scene.distant.is_empty() {
        return Err(SceneError(format!("{}: nothing to render; expected at least one surface", source.shown)));
    }
    if reader.unsaid > 0 {
        reader.scene.warnings.push(format!("{}: {} more warnings are not shown", source.shown, reader.unsaid));
    }
    Ok(reader.scene)
}

/// The content of a file.
struct Source {
    path: PathBuf,
    shown: String,
    bytes: Vec<u8>,
}

impl Source {
    fn read(path: &Path, files: &Files) -> Result<Source, String> {
        let shown = path.display().to_string();
        let bytes = files.read(path).map_err(|e| format!("{shown}: cannot be read: {e}"))?;
        Ok(Source { path: path.to_path_buf(), shown, bytes })
    }

    fn directory(&self) -> &Path {
        self.path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
    }
}

/// An object as it is written, up to and including its arguments.
struct Statement<'a> {
    file: &'a str,
    line: usize,
    prefix: &'a str,
    modifier: &'a [u8],
    kind: &'a [u8],
    name: &'a [u8],
    strings: Vec<&'a [u8]>,
    reals: Vec<f64>,
}

impl<'a> Statement<'a> {
    /// Reads modifier, type and name; arguments are left to `arguments`, since an alias has none.
    fn head(lexer: &mut Lexer<'a>, prefix: &'a str) -> Result<Statement<'a>, SceneError> {
        let modifier = lexer.word("a modifier")?;
        let line = lexer.line();
        let kind = lexer.word("a type")?;
        let name = lexer.word("a name")?;
        Ok(Statement { file: lexer.file(), line, prefix, modifier, kind, name, strings: vec![], reals: vec![] })
    }

    fn arguments(&mut self, lexer: &mut Lexer<'a>) -> Result<(), SceneError> {
        // Counts are what the file claims: nothing is allocated for them before the arguments are there.
        for _ in 0..lexer.count("the number of strings")? {
            self.strings.push(lexer.word("a string argument")?);
        }
        if lexer.count("the number of integers")? != 0 {
            return Err(self.error("has integer arguments; expected 0 of them"));
        }
        let count = lexer.count("the number of real arguments")?;
        for i in 1..=count {
            let value = lexer.real(format_args!("argument {i} of {count} of {}", self.title()))?;
            self.reals.push(value);
        }
        Ok(())
    }

    fn title(&self) -> String {
        format!("{} {}{}", show(self.kind), self.prefix, show(self.name))
    }

    /// A message's line about this object.
    fn line(&self, message: impl Display) -> String {
        format!("{}:{}: {}: {message}", self.file, self.line, self.title())
    }

    fn error(&self, message: impl Display) -> SceneError {
        SceneError(self.line(message))
    }

    /// Checks the number of real arguments; `what` lists them.
    fn needs_reals(&self, count: usize, what: &str) -> Result<(), SceneError> {
        let strings = if self.kind == b"mixfunc" { 0 } else { self.strings.len() };
        if self.reals.len() == count && strings == 0 {
            return Ok(());
        }
        Err(self.error(format_args!(
            "has {strings} strings and {} numbers; expected 0 and {count} ({what})",
            self.reals.len()
        )))
    }
}

/// What has been read so far.
#[derive(Default)]
struct Reader {
    scene: Scene,
    library: material::Library,
    files: Files,
    /// Directory of the outermost file.
    home: PathBuf,
    /// The files being read, outermost first.
    open: Vec<PathBuf>,
    includes: usize,
    unsaid: usize,
}

impl Reader {
    fn file(&mut self, source: &Source, frame: &Frame) -> Result<(), SceneError> {
        self.open.push(identity(&source.path));
        let mut lexer = Lexer::new(&source.shown, &source.bytes);
        while let Some(item) = lexer.item() {
            match item {
                Item::Command(line) => self.command(&lexer, &line, source, frame)?,
                Item::Object => self.object(&mut lexer, frame)?,
            }
        }
        self.open.pop();
        Ok(())
    }

    fn object<'a>(&mut self, lexer: &mut Lexer<'a>, frame: &'a Frame) -> Result<(), SceneError> {
        let mut statement = Statement::head(lexer, &frame.prefix)?;
        if statement.kind == b"alias" {
            let target = lexer.word("the alias's target")?;
            return self.library.alias(&statement, target);
        }
        let is_material = material::TYPES.contains(&statement.kind);
        if !is_material && !primitive::TYPES.contains(&statement.kind) {
            return Err(unsupported(&statement));
        }
        statement.arguments(lexer)?;
        if !is_material {
            return primitive::add(self, &statement, frame);
        }
        let mut warnings = Vec::new();
        self.library.define(&statement, &mut |warning| warnings.push(warning))?;
        warnings.into_iter().for_each(|warning| self.warn(warning));
        Ok(())
    }

    fn command(&mut self, lexer: &Lexer, line: &[u8], outer: &Source, frame: &Frame) -> Result<(), SceneError> {
        let fail = |wrong: String| lexer.error(format_args!("command `{}`: {wrong}", show(line)));
        let words = xform::words(line).map_err(&fail)?;
        let Some((_, args)) = words.split_first().filter(|(program, _)| *program == b"xform") else {
            return Err(fail("only xform is supported; expected !xform [options] file".into()));
        };
        for args in self.argument_lists(args, outer).map_err(&fail)? {
            let xform = Xform::parse(&args).map_err(&fail)?;
            let sources: Vec<Source> =
                xform.files.iter().map(|name| self.find(name, outer)).collect::<Result<_, _>>().map_err(&fail)?;
            for inner in xform.frames() {
                let inner = frame.around(&inner);
                for source in &sources {
                    self.includes += 1;
                    if self.includes > MAX_INCLUDES {
                        return Err(fail(format!("reads more than {MAX_INCLUDES} files; expected fewer copies")));
                    }
                    self.file(source, &inner)?;
                }
            }
        }
        Ok(())
    }

    /// Replaces `-f FILE` by each line of FILE in turn.
    fn argument_lists(&self, args: &[Vec<u8>], outer: &Source) -> Result<Vec<Vec<Vec<u8>>>, String> {
        let Some(at) = args.iter().position(|a| a == b"-f") else { return Ok(vec![args.to_vec()]) };
        let name = args.get(at + 1).ok_or("xform -f ends the line; expected a file of arguments")?;
        let list = self.find(name, outer)?;
        let mut lists = Vec::new();
        for line in list.bytes.split(|&b| b == b'\n').filter(|l| !l.is_empty() && l[0] != b'#') {
            let mut words = xform::words(line.strip_prefix(b"!").unwrap_or(line))?;
            if words.first().is_some_and(|w| w == b"xform") {
                words.remove(0);
            }
            let whole = [&args[..at], &words, &args[at + 2..]].concat();
            if whole.iter().any(|a| a == b"-f") {
                return Err("xform -f is given twice; expected one file of arguments".into());
            }
            lists.push(whole);
        }
        Ok(lists)
    }

    /// Reads an included file. As xform does, names are taken relative to the file that has them; failing that, to the
    /// outermost file and to the directory the program runs in.
    fn find(&self, name: &[u8], outer: &Source) -> Result<Source, String> {
        let shown = show(name);
        let name = std::str::from_utf8(name).map_err(|_| format!("file name `{shown}` is not UTF-8"))?;
        let places = [outer.directory().join(name), self.home.join(name), PathBuf::from(name)];
        let path = places
            .iter()
            .find(|p| self.files.has(p))
            .ok_or_else(|| format!("file `{shown}` is not found; expected it in {}", outer.directory().display()))?;
        if self.open.contains(&identity(path)) {
            return Err(format!("file `{shown}` includes itself; expected no circle"));
        }
        if self.open.len() >= MAX_DEPTH {
            return Err(format!("files are nested deeper than {MAX_DEPTH}; expected fewer levels"));
        }
        Source::read(path, &self.files)
    }

    fn warn(&mut self, warning: String) {
        if self.scene.warnings.len() < MAX_WARNINGS {
            self.scene.warnings.push(warning);
        } else {
            self.unsaid += 1;
        }
    }
}

/// The same for all names of one file.
fn identity(path: &Path) -> PathBuf {
    std::fs::canonicalize(path).unwrap_or_else(|_| path.to_path_buf())
}

/// The error for a type that is not read, in words that say what kind of thing it is.
fn unsupported(statement: &Statement) -> SceneError {
    const MATERIALS: &str = "expected plastic, metal, light, glow or a constant mixfunc";
    const SURFACES: &str = "expected polygon, sphere, bubble, ring, cylinder, tube, cone, cup or source";
    let error = |what: &str, right: &str| {
        let what: Arguments = format_args!("{what}; {right}");
        statement.error(what)
    };
    match statement.kind {
        b"instance" | b"mesh" => error("compiled geometry is not supported", SURFACES),
        b"texfunc" | b"texdata" => error("textures are not supported", MATERIALS),
        b"brightfunc" | b"brightdata" | b"brighttext" | b"colorfunc" | b"colordata" | b"colortext" | b"colorpict"
        | b"spectrum" | b"specfile" | b"specfunc" => error("patterns are not supported", MATERIALS),
        b"mixdata" | b"mixtext" | b"mixpict" => error("this mixture is not supported", MATERIALS),
        b"glass" | b"trans" | b"trans2" | b"dielectric" | b"interface" | b"plastic2" | b"metal2" | b"ashik2"
        | b"plasfunc" | b"metfunc" | b"transfunc" | b"BRTDfunc" | b"BSDF" | b"aBSDF" | b"plasdata" | b"metdata"
        | b"transdata" | b"illum" | b"spotlight" | b"mist" | b"mirror" | b"prism1" | b"prism2" | b"antimatter" => {
            error("this material is not supported", MATERIALS)
        }
        _ => error("unknown type", &format!("{SURFACES}, or a material: {MATERIALS}")),
    }
}
