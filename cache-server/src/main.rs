//! `cache-server`: thin over the library; `ambience serve` runs the same code.

use std::io::Write as _;
use std::process::ExitCode;

use cache_server::ServeArgs;
use clap::Parser;

#[derive(Parser)]
#[command(name = "cache-server", version, about = "Keeps and shares records of indirect light")]
struct Cli {
    #[command(flatten)]
    serve: ServeArgs,
}

#[tokio::main]
async fn main() -> ExitCode {
    let cli = Cli::parse();
    cache_server::cli::log_to_stderr(cli.serve.log_format);
    match cache_server::run(cli.serve).await {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // Nobody is left to tell if that fails.
            drop(writeln!(std::io::stderr(), "cache-server: {error}"));
            ExitCode::from(error.exit_code())
        }
    }
}
