//! The benchmarks. Without a command: speed against accuracy.

use std::error::Error;

use ambience_bench::host::HostArgs;
use ambience_bench::{
    asked, details, farm, gloss, host, lamps, lookups, peers, pictures, rasterise, rays, relay, service, splat, start,
};
use clap::{Parser, Subcommand};

/// Speed against accuracy: every method at several settings, on the scenes with references.
#[derive(Parser)]
#[command(args_conflicts_with_subcommands = true)]
struct Args {
    #[command(subcommand)]
    command: Option<Command>,
    /// Edge of the pictures, a multiple of 128, and scenes as SCENE.DEPTH [default: 128, those of the README]
    #[arg(value_name = "EDGE | SCENE.DEPTH")]
    pictures: Vec<String>,
}

#[derive(Subcommand)]
enum Command {
    /// What each practical detail of irradiance caching buys
    Details(details::DetailsArgs),
    /// Whether `--error` gives the error asked for, and what it costs
    Asked(asked::AskedArgs),
    /// Records of radiance against sampling, by the sharpness of gloss
    Gloss(gloss::GlossArgs),
    /// Rays a second, against Embree
    Rays(rays::RaysArgs),
    /// Look-ups a second, against an octree of pointers
    Lookups(lookups::LookupsArgs),
    /// Records splat by a graphics adapter, against the octree with all cores
    Splat(splat::SplatArgs),
    /// Hemispheres of records rasterised by a graphics adapter, against traced ones
    Rasterise(rasterise::RasteriseArgs),
    /// A thousand lamps against one
    Lamps(lamps::LampsArgs),
    /// Radiance, Mitsuba, and Mitsuba with Open Image Denoise, on the same scenes
    Peers(peers::PeersArgs),
    /// From the start of the program to its first rays, and memory, in an arcade of some 65 000 triangles
    Start(start::StartArgs),
    /// The cache service against the bare stream under it
    Service(service::ServiceArgs),
    /// What a relay costs, beside the same without one
    Relay(relay::RelayArgs),
    /// One frame by simulated farms of many sizes
    Farm(farm::FarmArgs),
    /// The server's side of the other two
    #[command(hide = true)]
    Host(HostArgs),
}

fn main() -> Result<(), Box<dyn Error>> {
    let Args { command, pictures } = Args::parse();
    match command {
        None => pictures::run(pictures),
        Some(Command::Details(args)) => details::run(&args),
        Some(Command::Asked(args)) => asked::run(&args),
        Some(Command::Gloss(args)) => gloss::run(&args),
        Some(Command::Rays(args)) => rays::run(&args),
        Some(Command::Lookups(args)) => lookups::run(&args),
        Some(Command::Splat(args)) => splat::run(&args),
        Some(Command::Rasterise(args)) => rasterise::run(&args),
        Some(Command::Lamps(args)) => lamps::run(&args),
        Some(Command::Peers(args)) => peers::run(&args),
        Some(Command::Start(args)) => start::run(&args),
        Some(Command::Service(args)) => service::run(&args),
        Some(Command::Relay(args)) => relay::run(&args),
        Some(Command::Farm(args)) => farm::run(&args),
        Some(Command::Host(args)) => host::serve(&args),
    }
}
