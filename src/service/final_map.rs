//! The map at the end of a run: asked of the mapper, which writes it into a file.

use std::io;
use std::path::Path;
use std::time::{Duration, Instant};

use crate::service::child::Child;
use crate::service::config::SupervisorConfig;
use crate::service::health::cause;
use crate::service::map_file::read_map;
use crate::service::mapper::WRITES_MAP;
use crate::service::shutdown::Shutdown;
use crate::service::supervised::Supervised;
use crate::slam::map::Map;
use crate::wire::command::{Command, CommandClient, CommandError};

/// Has the mapper write its map into `folder`, and reads it. One that hangs is not waited for: it is given
/// as long to begin as the watchdog allows between two signs of life, and only then the time that writing may take. An
/// error says why there is none, for the user.
pub fn final_map(
    mapper: &mut Supervised,
    commands: &CommandClient,
    folder: &Path,
    config: &SupervisorConfig,
    shutdown: &Shutdown,
) -> Result<Map, String> {
    let file = format!(".semidense-map-{}.bin", std::process::id());
    let path = std::path::absolute(folder.join(file))
        .map_err(|error| format!("the output folder's path is not usable ({error})"))?;
    let of_checkpoint = |why: &str| format!("{why}; the map is that of its last checkpoint");
    let silent = || of_checkpoint("the mapper does not respond");
    let timeout = Duration::from_secs_f64(config.save_timeout_s);
    let watchdog = Duration::from_secs_f64(config.watchdog_s);
    mapper.listen().map_err(|error| error.to_string())?;
    if mapper.is_silent(watchdog) {
        return Err(silent());
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
        Ok(()) => read_map(&path).map_err(|error| error.to_string()),
        Err(_) if is_gone => Err(of_checkpoint("the mapper is gone")),
        Err(CommandError::NoAnswer(_)) if !has_begun => Err(silent()),
        Err(error) => Err(of_checkpoint(&error.to_string())),
    };
    if let Err(error) = std::fs::remove_file(&path)
        && error.kind() != io::ErrorKind::NotFound
    {
        tracing::warn!("{}: cannot be removed ({error})", path.display());
    }
    map
}
