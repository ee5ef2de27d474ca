//! The map at the end of a run: requested from the mapper, which writes it into a file.

use std::io;
use std::path::Path;
use std::time::{Duration, Instant};

use crate::service::child::Child;
use crate::service::config::SupervisorConfig;
use crate::service::health::cause;
use crate::service::map_file::{MapFileError, read_map};
use crate::service::mapper::WRITES_MAP;
use crate::service::shutdown::Shutdown;
use crate::service::supervised::Supervised;
use crate::slam::map::Map;
use crate::wire::command::{Command, CommandClient, CommandError};
use crate::wire::port::ReceiveError;

/// Why the mapper provides no map.
#[derive(Debug, thiserror::Error)]
pub enum FinalMapError {
    /// It does not answer.
    #[error("the mapper does not respond; using the map of its last checkpoint")]
    Silent,
    /// It has ended.
    #[error("the mapper has exited; using the map of its last checkpoint")]
    Gone,
    /// Its signs of life cannot be received.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
    /// It refuses, or takes too long.
    #[error("{0}; using the map of its last checkpoint")]
    Command(#[from] CommandError),
    /// Its file cannot be read.
    #[error(transparent)]
    File(#[from] MapFileError),
    /// The folder has no path that another process could use.
    #[error("the output folder's path is not usable ({0})")]
    Path(#[from] io::Error),
}

/// Has the mapper write its map into `folder`, and reads it. Does not wait for a mapper that hangs: it must begin
/// within the watchdog's time between two signs of life, and only then has the time allowed for writing.
pub fn final_map(
    mapper: &mut Supervised,
    commands: &CommandClient,
    folder: &Path,
    config: &SupervisorConfig,
    shutdown: &Shutdown,
) -> Result<Map, FinalMapError> {
    let file = format!(".semidense-map-{}.bin", std::process::id());
    let path = std::path::absolute(folder.join(file))?;
    let timeout = Duration::from_secs_f64(config.save_timeout_s);
    let watchdog = Duration::from_secs_f64(config.watchdog_s);
    mapper.listen()?;
    if mapper.is_silent(watchdog) {
        return Err(FinalMapError::Silent);
    }
    let mut is_able = |child: &mut Child| matches!(child.poll(), Ok(None)) && !child.is_stopped();
    let asked = Instant::now();
    let (mut has_begun, mut is_gone) = (false, false);
    let is_worth_waiting = || {
        has_begun |= mapper.listen().is_ok()
            && mapper.peer.last().is_some_and(|health| cause(health) == WRITES_MAP);
        let may_begin = has_begun || watchdog.is_zero() || asked.elapsed() < watchdog;
        is_gone = !mapper.child().is_some_and(&mut is_able);
        may_begin && !is_gone && !shutdown.is_urgent()
    };
    let answer = commands.ask(&Command::SaveMap(path.clone()), timeout, is_worth_waiting);
    let map = match answer {
        Ok(()) => read_map(&path).map_err(FinalMapError::File),
        Err(_) if is_gone => Err(FinalMapError::Gone),
        Err(CommandError::NoAnswer(_)) if !has_begun => Err(FinalMapError::Silent),
        Err(error) => Err(error.into()),
    };
    if let Err(error) = std::fs::remove_file(&path)
        && error.kind() != io::ErrorKind::NotFound
    {
        tracing::warn!("{}: cannot be removed ({error})", path.display());
    }
    map
}
