//! Writes the seeds of every target to `corpus/TARGET/`.

use std::fs;

fn main() -> std::io::Result<()> {
    for (target, _) in ambience_fuzz::TARGETS {
        let folder = format!("{}/corpus/{target}", env!("CARGO_MANIFEST_DIR"));
        fs::create_dir_all(&folder)?;
        for (number, seed) in ambience_fuzz::seeds::seeds(target).iter().enumerate() {
            fs::write(format!("{folder}/seed-{number}"), seed)?;
        }
    }
    Ok(())
}
