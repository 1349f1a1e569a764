//! `ambience cache`: caches looked into, united, written to files and read back.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use cache_server::archive::source::{Form, Source};
use cache_server::archive::{Archive, ArchiveError, Summary, target};
use cache_server::journal::survey::State;
use serde_json::{Value, json};

use crate::failure::Failure;
use crate::say;

/// What to do with caches.
#[derive(Clone, Debug, clap::Subcommand)]
pub enum CacheCommand {
    /// Tell what a cache holds and whether it is whole; changes nothing
    Info(InfoArgs),
    /// Make one cache of several; of a single one, a compact and sound copy
    Merge(MergeArgs),
    /// Write a cache to a file that other programs can read
    ///
    /// Equal caches are written as equal bytes.
    Export(ExportArgs),
    /// Add exported files to a cache, made if it is not there
    Import(ImportArgs),
}

/// Arguments of `cache info`.
#[derive(Clone, Debug, clap::Args)]
pub struct InfoArgs {
    /// Cache directory or exported file
    #[arg(value_name = "DIR|FILE")]
    pub cache: PathBuf,
    /// Print one JSON object: path, bytes, state, damage, publications, namespaces
    #[arg(long)]
    pub json: bool,
}

/// Arguments of `cache merge`.
#[derive(Clone, Debug, clap::Args)]
pub struct MergeArgs {
    /// Cache directories or exported files
    #[arg(value_name = "DIR|FILE", required = true)]
    pub caches: Vec<PathBuf>,
    /// Where the united cache goes: a directory that is not there yet, or empty
    #[arg(short, long, value_name = "DIR")]
    pub output: PathBuf,
}

/// Arguments of `cache export`.
#[derive(Clone, Debug, clap::Args)]
pub struct ExportArgs {
    /// Cache directory or exported file
    #[arg(value_name = "DIR|FILE")]
    pub cache: PathBuf,
    /// The file: JSON lines if it ends in .jsonl, binary if it ends in .ambience
    #[arg(short, long, value_name = "FILE")]
    pub output: PathBuf,
}

/// Arguments of `cache import`.
#[derive(Clone, Debug, clap::Args)]
pub struct ImportArgs {
    /// Exported files (.jsonl, .ambience)
    #[arg(value_name = "FILE", required = true)]
    pub files: Vec<PathBuf>,
    /// The cache to add to
    #[arg(short, long, value_name = "DIR")]
    pub output: PathBuf,
}

/// Does it.
///
/// # Errors
/// Caches that cannot be read or written.
pub fn run(command: &CacheCommand) -> Result<(), Failure> {
    match command {
        CacheCommand::Info(args) => info(args),
        CacheCommand::Merge(args) => {
            target::free(&args.output).map_err(failure)?;
            read(&args.caches)?.make(&args.output).map_err(failure)
        }
        CacheCommand::Export(args) => {
            Form::of(&args.output).map_err(failure)?;
            read(std::slice::from_ref(&args.cache))?.export(&args.output).map_err(failure)
        }
        CacheCommand::Import(args) => {
            args.files.iter().try_for_each(|file| Form::of(file).map(drop)).map_err(failure)?;
            let (_, report) = read(&args.files)?.add_to(&args.output).map_err(failure)?;
            if let Some(damage) = report.damage {
                say::line(format_args!("warning: {} {damage}", args.output.display()));
            }
            Ok(())
        }
    }
}

/// The union of caches; warns of those that are damaged.
fn read(paths: &[PathBuf]) -> Result<Archive, Failure> {
    let mut archive = Archive::default();
    for path in paths {
        let source = archive.unite(path).map_err(failure)?;
        if let Some(damage) = damage(&source.state) {
            say::line(format_args!("warning: {} {damage}", path.display()));
        }
    }
    Ok(archive)
}

fn damage(state: &State) -> Option<String> {
    let State::Damaged { reason, gaps } = state else { return None };
    Some(format!("is damaged ({reason}): {gaps}; whether there were more cannot be known"))
}

fn failure(error: ArchiveError) -> Failure {
    if error.exit_code() == 2 { Failure::usage(error) } else { Failure::failed(error) }
}

fn info(args: &InfoArgs) -> Result<(), Failure> {
    let mut archive = Archive::default();
    let source = archive.unite(&args.cache).map_err(failure)?;
    match args.json {
        true => say::result(object(&args.cache, &source, &archive)),
        false => say::result(text(&source, &archive)),
    }
}

fn object(path: &Path, source: &Source, archive: &Archive) -> Value {
    let (state, damage) = match &source.state {
        State::Closed => ("closed", Value::Null),
        State::Crashed => ("crashed", Value::Null),
        State::Damaged { reason, gaps } => {
            let lost: Vec<_> = gaps.lost.iter().map(|range| [*range.start(), *range.end()]).collect();
            ("damaged", json!({ "reason": reason, "appends_lost": lost, "records_lost": gaps.records }))
        }
    };
    json!({
        "path": path.display().to_string(),
        "bytes": source.bytes,
        "state": state,
        "damage": damage,
        "publications": archive.publications(),
        "namespaces": archive.summaries().iter().map(namespace).collect::<Vec<_>>(),
    })
}

fn namespace(summary: &Summary) -> Value {
    let label = summary.label.as_ref().map(|label| {
        json!({
            "scene": label.scene,
            "scene_hash": hex::encode(&label.scene_hash),
            "method": label.method,
            "a": label.a,
            "rays": label.rays,
            "bounces": label.bounces,
            "seed": label.seed,
            "owner": label.owner,
        })
    });
    json!({
        "namespace": hex::encode(summary.namespace.0),
        "draft_of": summary.draft_of.map(|of| hex::encode(of.0)),
        "label": label,
        "records": summary.levels.values().sum::<u64>(),
        "levels": summary.levels,
        "digest": format!("{:032x}", summary.digest.0),
        "conflicts": summary.conflicts,
    })
}

fn text(source: &Source, archive: &Archive) -> String {
    let state = match &source.state {
        State::Closed => "whole".into(),
        State::Crashed => "whole, not closed: its server was killed".into(),
        damaged => damage(damaged).unwrap_or_default(),
    };
    let mut text = format!("{} bytes, {state}", source.bytes);
    for summary in archive.summaries() {
        let what = if summary.draft_of.is_some() { "draft" } else { "namespace" };
        // Writing to a string does not fail.
        let _ = write!(text, "\n{what} {}", hex::encode(summary.namespace.0));
        if let Some(of) = summary.draft_of {
            let _ = write!(text, "\n  of         {}", hex::encode(of.0));
        }
        if let Some(label) = &summary.label {
            let bounces = if label.bounces == u32::MAX { "all".into() } else { label.bounces.to_string() };
            let _ = write!(
                text,
                "\n  scene      {}\n  settings   --method {} --a {} --rays {} --bounces {bounces} --seed {}",
                label.scene.escape_debug(),
                label.method.escape_debug(),
                label.a,
                label.rays,
                label.seed
            );
        }
        let levels: Vec<_> = summary.levels.iter().map(|(level, count)| format!("{count} of level {level}")).collect();
        let records: u64 = summary.levels.values().sum();
        let _ = write!(text, "\n  records    {records} ({})", levels.join(", "));
        let _ = write!(text, "\n  digest     {:032x}\n  conflicts  {}", summary.digest.0, summary.conflicts);
    }
    text
}
