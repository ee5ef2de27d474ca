//! Requests to the mapper and its responses; never on the frame path.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use iceoryx2::port::client::Client;
use iceoryx2::port::server::Server;
use iceoryx2::prelude::*;

use crate::wire::message::{CommandRequest, CommandResponse, PATH_BYTES, TEXT_BYTES};
use crate::wire::open_error::{not_running, topic_error};
use crate::wire::port::{Access, Events, Hub, OpenError, Wake, retry, wait};
use crate::wire::topic::{MAPPER_COMMAND, service_name};

/// Maximum number of clients: the supervisor, an operator, a network link.
const MAX_CLIENTS: usize = 4;
/// Interval at which the client polls for the response.
const ANSWER_PAUSE: Duration = Duration::from_millis(10);

/// A request to the mapper.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Command {
    /// Write the whole map to this file.
    SaveMap(PathBuf),
    /// Send the depth and the image of this keyframe on `mapper/earlier_keyframe`.
    SendKeyframe(u64),
    /// Save the map to this folder; an empty path means the folder that the mapper keeps it in.
    SaveFolder(PathBuf),
    /// Switch to the map in this folder.
    LoadFolder {
        /// The folder.
        folder: PathBuf,
        /// Whether the camera is only localised in it.
        read_only: bool,
    },
}

/// Why a request was not sent, not understood or not answered.
#[derive(Debug, thiserror::Error)]
pub enum CommandError {
    /// The path does not fit in a message.
    #[error("{0}: a path may have at most {PATH_BYTES} bytes")]
    PathTooLong(PathBuf),
    /// A request of an unknown kind.
    #[error("the mapper received a request of unknown kind {0}")]
    Unknown(u32),
    /// The transport failed.
    #[error("mapper/command: {0}")]
    Transport(String),
    /// The mapper refused the request, or failed to carry it out.
    #[error("mapper: {0}")]
    Refused(String),
    /// No response arrived.
    #[error("the mapper did not answer within {0:?}")]
    NoAnswer(Duration),
}

fn failed(error: impl std::fmt::Display) -> CommandError {
    CommandError::Transport(error.to_string())
}

/// Encodes text for a message, truncated at a character boundary if it is too long.
pub fn text_bytes(text: &str) -> ([u8; TEXT_BYTES], u32) {
    let mut length = text.len().min(TEXT_BYTES);
    while !text.is_char_boundary(length) {
        length -= 1;
    }
    let mut bytes = [0; TEXT_BYTES];
    bytes[..length].copy_from_slice(&text.as_bytes()[..length]);
    (bytes, length as u32)
}

/// Decodes the text of a message; invalid UTF-8 and control characters are replaced.
pub fn text_from_bytes(bytes: &[u8; TEXT_BYTES], length: u32) -> String {
    let length = (length as usize).min(TEXT_BYTES);
    let text = String::from_utf8_lossy(&bytes[..length]);
    text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}

fn request_of(command: &Command) -> Result<CommandRequest, CommandError> {
    let (kind, keyframe_id, path) = match command {
        Command::SaveMap(path) => (0, 0, path.as_path()),
        Command::SendKeyframe(keyframe_id) => (1, *keyframe_id, Path::new("")),
        Command::SaveFolder(path) => (2, 0, path.as_path()),
        Command::LoadFolder { folder, read_only } => {
            (3 + u32::from(*read_only), 0, folder.as_path())
        }
    };
    let bytes = path.as_os_str().as_encoded_bytes();
    if bytes.len() > PATH_BYTES {
        return Err(CommandError::PathTooLong(path.to_owned()));
    }
    let (path_bytes, path) = (bytes.len() as u32, [0; PATH_BYTES]);
    let mut request = CommandRequest { keyframe_id, kind, path_bytes, path };
    request.path[..bytes.len()].copy_from_slice(bytes);
    Ok(request)
}

/// Decodes a request; its numbers are checked, never trusted.
pub fn command_of(request: &CommandRequest) -> Result<Command, CommandError> {
    use std::os::unix::ffi::OsStrExt;
    let length = (request.path_bytes as usize).min(PATH_BYTES);
    let path = Path::new(std::ffi::OsStr::from_bytes(&request.path[..length]));
    match request.kind {
        0 => Ok(Command::SaveMap(path.to_owned())),
        1 => Ok(Command::SendKeyframe(request.keyframe_id)),
        2 => Ok(Command::SaveFolder(path.to_owned())),
        kind @ (3 | 4) => Ok(Command::LoadFolder { folder: path.to_owned(), read_only: kind == 4 }),
        kind => Err(CommandError::Unknown(kind)),
    }
}

type Factory = iceoryx2::service::port_factory::request_response::PortFactory<
    ipc::Service,
    CommandRequest,
    (),
    CommandResponse,
    (),
>;

fn service(hub: &Hub, name: &str) -> Result<Factory, OpenError> {
    let service_name = ServiceName::new(name).map_err(|e| topic_error(name, &e))?;
    let builder = || {
        hub.node
            .service_builder(&service_name)
            .request_response::<CommandRequest, CommandResponse>()
    };
    match hub.access {
        Access::Observer => builder().open().map_err(|_| not_running(&hub.place)),
        Access::Member => retry(name, || {
            builder()
                .max_clients(MAX_CLIENTS)
                .max_servers(2)
                .enable_safe_overflow_for_requests(true)
                .enable_safe_overflow_for_responses(true)
                .open_or_create()
        }),
    }
}

/// The mapper's end.
#[derive(Debug)]
pub struct CommandServer {
    server: Server<ipc::Service, CommandRequest, (), CommandResponse, ()>,
    events: Events,
}

impl CommandServer {
    /// Opens the server.
    pub fn open(hub: &Hub) -> Result<Self, OpenError> {
        let name = service_name(&hub.place.instance, MAPPER_COMMAND);
        let server =
            service(hub, &name)?.server_builder().create().map_err(|e| topic_error(&name, &e))?;
        Ok(Self { server, events: hub.events(&name)? })
    }

    /// Events that wake the server, for [`wait`].
    pub fn events(&self) -> &Events {
        &self.events
    }

    /// Answers every pending request with the result of `act`.
    pub fn answer(
        &self,
        mut act: impl FnMut(Command) -> Result<(), String>,
    ) -> Result<(), CommandError> {
        while let Some(request) = self.server.receive().map_err(failed)? {
            let result = match command_of(request.payload()) {
                Ok(command) => act(command),
                Err(error) => Err(error.to_string()),
            };
            let (text, text_bytes) = text_bytes(result.as_ref().err().map_or("", String::as_str));
            let status = u32::from(result.is_err());
            let response = CommandResponse { status, text_bytes, text };
            request.send_copy(response).map_err(failed)?;
        }
        Ok(())
    }
}

/// The client's end.
#[derive(Debug)]
pub struct CommandClient {
    client: Client<ipc::Service, CommandRequest, (), CommandResponse, ()>,
    wake: Wake,
}

impl CommandClient {
    /// Opens the client.
    pub fn open(hub: &Hub) -> Result<Self, OpenError> {
        let name = service_name(&hub.place.instance, MAPPER_COMMAND);
        let client =
            service(hub, &name)?.client_builder().create().map_err(|e| topic_error(&name, &e))?;
        Ok(Self { client, wake: hub.notifier(&name)? })
    }

    /// Sends a request and waits for the response, until `timeout` has passed or `is_alive` returns false.
    pub fn ask(
        &self,
        command: &Command,
        timeout: Duration,
        mut is_alive: impl FnMut() -> bool,
    ) -> Result<(), CommandError> {
        let pending = self.client.send_copy(request_of(command)?).map_err(failed)?;
        self.wake.notify();
        let deadline = Instant::now() + timeout;
        while Instant::now() < deadline && is_alive() {
            if let Some(response) = pending.receive().map_err(failed)? {
                let response = response.payload();
                return match response.status {
                    0 => Ok(()),
                    _ => Err(CommandError::Refused(text_from_bytes(
                        &response.text,
                        response.text_bytes,
                    ))),
                };
            }
            wait(&[], None, ANSWER_PAUSE).map_err(failed)?;
        }
        Err(CommandError::NoAnswer(timeout))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_command_survives_the_round_trip() {
        let command = Command::SaveMap(PathBuf::from("/tmp/map.bin"));
        assert_eq!(command_of(&request_of(&command).unwrap()).unwrap(), command);
        let folder = Command::SaveFolder(PathBuf::from("/var/lib/semidense/map"));
        assert_eq!(command_of(&request_of(&folder).unwrap()).unwrap(), folder);
        for read_only in [false, true] {
            let load = Command::LoadFolder { folder: PathBuf::from("/maps/a"), read_only };
            assert_eq!(command_of(&request_of(&load).unwrap()).unwrap(), load);
        }
        let long = Command::SaveMap(PathBuf::from("x".repeat(PATH_BYTES + 1)));
        assert!(matches!(request_of(&long), Err(CommandError::PathTooLong(_))));
    }

    #[test]
    fn malformed_requests_are_truncated_or_refused() {
        let mut request = request_of(&Command::SaveMap(PathBuf::from("/tmp/x"))).unwrap();
        request.path_bytes = u32::MAX;
        assert!(command_of(&request).is_ok(), "a length is cut, never believed");
        request.kind = 77;
        assert!(matches!(command_of(&request), Err(CommandError::Unknown(77))));
    }

    #[test]
    fn texts_are_truncated_at_a_character_boundary() {
        let (bytes, length) = text_bytes(&"ä".repeat(TEXT_BYTES));
        assert_eq!(length as usize, TEXT_BYTES);
        assert_eq!(text_from_bytes(&bytes, length), "ä".repeat(TEXT_BYTES / 2));
        assert_eq!(text_from_bytes(&[0xff; TEXT_BYTES], u32::MAX).chars().next(), Some('\u{fffd}'));
    }
}
