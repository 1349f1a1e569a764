//! `ambience compare`: how far a picture is from a reference.

use std::path::PathBuf;

use serde_json::json;
use worker::{compare, film};

use crate::failure::Failure;
use crate::say;

/// Arguments of `compare`.
#[derive(Clone, Debug, clap::Args)]
pub struct CompareArgs {
    /// The picture
    #[arg(value_name = "A.exr")]
    pub picture: PathBuf,
    /// The reference
    #[arg(value_name = "B.exr")]
    pub reference: PathBuf,
    /// Print one JSON object: relative_rmse, bias, worst_block, worst_block_at [x, y], size [w, h]
    #[arg(long)]
    pub json: bool,
}

/// Compares and prints.
///
/// # Errors
/// Pictures that cannot be read or compared.
pub fn run(args: &CompareArgs) -> Result<(), Failure> {
    let read = |path| film::read(path).map_err(Failure::usage);
    let (picture, reference) = (read(&args.picture)?, read(&args.reference)?);
    let found = compare::compare(&picture, &reference).map_err(|reason| {
        Failure::usage(format!("{} against {}: {reason}", args.picture.display(), args.reference.display()))
    })?;
    let ((x, y), (width, height)) = (found.worst_at, found.size);
    if args.json {
        let object = json!({
            "relative_rmse": found.relative_rmse,
            "bias": found.bias,
            "worst_block": found.worst_block,
            "worst_block_at": [x, y],
            "size": [width, height],
        });
        return say::result(object);
    }
    say::result(format_args!(
        "size           {width}x{height}\nrelative RMSE  {:.5}\nbias           {:+.5}\nworst block    {:.5} at x {x}, y {y}",
        found.relative_rmse, found.bias, found.worst_block
    ))
}
