//! Processes that must not outlive the one that started them, however it ends.

use std::path::PathBuf;
use std::time::Duration;

/// How soon an orphan notices.
const LOOK: Duration = Duration::from_millis(200);

/// Arguments `render` gives to its own children.
#[derive(Clone, Debug, clap::Args)]
pub struct OwnedArgs {
    /// End when this process, the parent, is gone.
    #[arg(long, hide = true, value_name = "PID")]
    exit_with_parent: Option<u32>,
    /// The parent's folder, removed when the parent could not.
    #[arg(long, hide = true, value_name = "FOLDER", requires = "exit_with_parent")]
    private: Option<PathBuf>,
}

impl OwnedArgs {
    /// Watches the parent from a thread of its own, so that nothing that blocks can hide its end.
    pub fn watch(self) {
        #[cfg(unix)]
        if let Some(parent) = self.exit_with_parent {
            std::thread::spawn(move || {
                // An orphan gets another parent at once; a parent that ended before we looked has been replaced already.
                while std::os::unix::process::parent_id() == parent {
                    std::thread::sleep(LOOK);
                }
                if let Some(folder) = self.private {
                    // Nobody is left to be told.
                    drop(std::fs::remove_dir_all(folder));
                }
                std::process::exit(1)
            });
        }
    }
}
