//! The button that saves the map through the mapper, as `semidense map save` does.

use std::path::{Path, PathBuf};
use std::sync::Mutex;
use std::time::{Duration, SystemTime};

use semidense::service::health::ProcessState;
use semidense::service::peers::Peer;
use semidense::service::results::output_folder::utc_stamp;
use semidense::wire::command::{Command, CommandClient, CommandError};
use semidense::wire::place::Place;
use semidense::wire::port::{Access, Hub, OpenError};
use semidense::wire::topic::MAPPER_HEALTH;

/// Upper limit for the time to save: a map of an hour on a slow card.
const LONGEST_SAVE: Duration = Duration::from_secs(120);

/// Why the map was not saved.
#[derive(Debug, thiserror::Error)]
pub enum SaveError {
    /// A save is in progress.
    #[error("the map is already being saved")]
    Busy,
    /// A folder for the map cannot be created.
    #[error("cannot create a folder for maps in {path}: {source}; name another one with --maps")]
    Folder {
        /// The folder.
        path: PathBuf,
        /// The system's error.
        source: std::io::Error,
    },
    /// No instance is running.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// The mapper failed or refused.
    #[error(transparent)]
    Command(#[from] CommandError),
}

/// Saves maps into new folders, one at a time.
#[derive(Debug)]
pub struct Saver {
    place: Place,
    folder: PathBuf,
    busy: Mutex<()>,
}

impl Saver {
    /// Saves maps of the instance at `place` into new folders below `folder`.
    pub fn new(place: Place, folder: &Path) -> Self {
        Self { place, folder: folder.to_owned(), busy: Mutex::new(()) }
    }

    /// Saves the map and returns its folder. The server chooses the folder: a page cannot name one.
    pub fn save(&self) -> Result<PathBuf, SaveError> {
        let _busy = self.busy.try_lock().map_err(|_| SaveError::Busy)?;
        let hub = Hub::join(&self.place, "view-save", Access::Observer)?;
        let mut mapper = Peer::open(&hub, &MAPPER_HEALTH)?;
        let failed = |source| SaveError::Folder { path: self.folder.clone(), source };
        let parent = std::path::absolute(&self.folder).map_err(failed)?;
        std::fs::create_dir_all(&parent).map_err(failed)?;
        let folder = parent.join(format!("map-{}", utc_stamp(SystemTime::now())));
        let is_alive = || {
            let is_over =
                matches!(mapper.state(), Some(ProcessState::Finished | ProcessState::Failed));
            mapper.update().is_ok() && !is_over
        };
        CommandClient::open(&hub)?.ask(
            &Command::SaveFolder(folder.clone()),
            LONGEST_SAVE,
            is_alive,
        )?;
        Ok(folder)
    }
}
