//! Commands to the mapper, never carried out on the frame path.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::rc::Rc;

use crate::service::checkpoint::Kept;
use crate::service::config::MapConfig;
use crate::service::health::ProcessState;
use crate::service::map_file::write_map;
use crate::service::map_folder::map_folder_error::MapFolderError;
use crate::service::map_folder::numbering::Numbering;
use crate::service::map_folder::save_copy;
use crate::service::map_folder::session::{MapSession, check_loadable};
use crate::service::mapper::used_map::UsedMap;
use crate::service::mapper::{Shell, WRITES_MAP, publish_adjustments, report_while};
use crate::service::mode::Mode;
use crate::service::run_error::RunError;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::map::Map;
use crate::slam::mapper::Mapper;
use crate::slam::mapper::situation::Situation;
use crate::wire::command::Command;

/// Cause that a mapper reports while it reads another map, which may take long.
const LOADS_MAP: &str = "another map is being loaded";
const NO_MAP: &str = "it was started without a map: name the folder to save in";
const READ_ONLY: &str = "it only localises in this map (--read-only) and has nothing to save in it: name another folder";
const NO_FRAME: &str = "there is no map yet: no frame has arrived";

/// Outcome of a command; an error is returned to its sender.
type Answer = Result<(), Box<dyn Error>>;

impl Shell<'_> {
    pub(super) fn answer_commands(&mut self) -> Result<(), RunError> {
        let commands = Rc::clone(&self.commands);
        Ok(commands.answer(|command| match command {
            Command::SendKeyframe(keyframe_id) => {
                let map = self.mapper.as_ref().map(|(_, mapper)| mapper.map());
                self.output.publish_earlier(map, keyframe_id)
            }
            Command::SaveMap(path) => self.with_cause(WRITES_MAP, |shell| shell.save_map(&path)),
            Command::SaveFolder(path) => {
                self.with_cause(WRITES_MAP, |shell| shell.save_folder(&path))
            }
            Command::LoadFolder { folder, read_only } => {
                self.with_cause(LOADS_MAP, |shell| shell.load_folder(folder, read_only))
            }
        })?)
    }

    /// Reports `cause` during an act that may take longer than the pause between two signs of life.
    fn with_cause(
        &mut self,
        cause: &str,
        act: impl FnOnce(&mut Self) -> Answer,
    ) -> Result<(), String> {
        let before = self.health.current_state();
        self.health.enter(ProcessState::Running, cause);
        let outcome = act(self);
        self.health.restore_state(before);
        outcome.map_err(|error| error.to_string())
    }

    fn save_map(&mut self, path: &Path) -> Answer {
        // It is requested when the recording is over.
        if let Some((_, mapper)) = &mut self.mapper {
            let outcome = self.adjustments.finish(mapper);
            self.output.publish(mapper, &outcome)?;
            publish_adjustments(&mut self.adjustments, &self.output, &mut self.health)?;
        }
        let empty = Map::default();
        let map = self.mapper.as_ref().map_or(&empty, |(_, mapper)| mapper.map());
        let health = &mut self.health;
        let saved = write_map(path, map, &mut || health.report())
            .map_err(|error| format!("{}: {error}", path.display()));
        let kept = self.save_map_folder();
        saved?;
        Ok(kept?)
    }

    fn save_folder(&mut self, path: &Path) -> Answer {
        let Some((_, mapper)) = &self.mapper else { return Err(NO_FRAME.into()) };
        match &self.map {
            None if path.as_os_str().is_empty() => return Err(NO_MAP.into()),
            Some(map) if map.is_in(path) && map.is_read_only() => return Err(READ_ONLY.into()),
            Some(map) if map.is_in(path) => return Ok(self.save_map_folder()?),
            _ => {}
        }
        let (health, detail) = (&mut self.health, self.config.map.detail);
        Ok(save_copy(path, mapper, detail, &mut || health.report())?)
    }

    /// Switches to the map in another folder. On any error the current map continues unchanged.
    fn load_folder(&mut self, folder: PathBuf, read_only: bool) -> Answer {
        let Some((camera, mapper)) = &self.mapper else { return Err(NO_FRAME.into()) };
        let (camera, numbering) = (*camera, Numbering::above(mapper));
        if self.map.as_ref().is_some_and(|map| map.is_in(&folder)) {
            return Err(format!("the mapper already uses the map {}", folder.display()).into());
        }
        check_loadable(&folder, &camera).map_err(|error| match error {
            MapFolderError::Missing(_) => format!("{} holds no map", folder.display()),
            error => error.to_string(),
        })?;
        let name = folder
            .to_str()
            .ok_or_else(|| format!("{}: name a folder whose name is UTF-8", folder.display()))?;
        let map = MapConfig { folder: name.to_owned(), read_only, ..self.config.map.clone() };
        let (session, mut next) = self.start_in_map(&map, &camera, numbering)?;
        self.save_map_folder()?;
        let (switched_to, first_keyframe_id) = (Some(map), next.free_keyframe_id());
        self.used = UsedMap { switched_to, numbering, first_keyframe_id, ..self.used.clone() };
        self.note_loaded_map()?;
        if let Some((_, before)) = self.mapper.take() {
            next.replace_mapper(before);
        }
        self.adjustments.abandon();
        tracing::info!("the mapper switches to the map {}", folder.display());
        (self.map, self.mapper) = (Some(session), Some((camera, next)));
        Ok(())
    }

    /// Makes a mapper that begins in a map, which is read while signs of life continue.
    fn start_in_map(
        &mut self,
        map: &MapConfig,
        camera: &Intrinsics,
        numbering: Numbering,
    ) -> Result<(MapSession, Mapper), String> {
        let config = self.config;
        let waits = self.mode == Mode::Lockstep;
        let begin = || -> Result<(MapSession, Mapper), String> {
            let missing = || MapFolderError::Missing(PathBuf::from(&map.folder)).to_string();
            let session = MapSession::open(map, config.mapping.max_map_bytes(), numbering, waits);
            let session = session.map_err(|error| error.to_string())?;
            let mut session = session.ok_or_else(missing)?;
            let mut mapper =
                Mapper::new(*camera, config.mapping.clone()).map_err(|error| error.to_string())?;
            session.begin(&mut mapper, camera, None).map_err(|error| error.to_string())?;
            match mapper.situation() {
                Situation::Localising(_) => Ok((session, mapper)),
                _ => Err(format!("{}: no keyframe to relocalise against", map.folder)),
            }
        };
        report_while(&mut self.health, &self.pool, begin)
            .unwrap_or_else(|_| Err("reading the map has failed".to_owned()))
    }

    /// Notes the other map for the run's results and, live, for a successor, which does not begin with what was left of
    /// this one.
    fn note_loaded_map(&mut self) -> Result<(), String> {
        let (path, note) = (self.place.checkpoint_path(), self.place.loaded_map_path());
        let dropped = self.kept.take().map(|mut kept| kept.remove_on_drop());
        let written = self.used.write(&note);
        if dropped.is_some() {
            self.kept = Kept::open(&path).0;
            self.kept.iter_mut().for_each(Kept::reserve);
        }
        written.map_err(|error| format!("{}: {error}", note.display()))
    }
}
