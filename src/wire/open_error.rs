//! Why a process cannot take part in an instance, and what to do about it.

use crate::wire::folders::SHARED_MEMORY;
use crate::wire::place::Place;
use crate::wire::place_error::PlaceError;
use crate::wire::topic::WIRE_VERSION;

/// Why a process cannot take part.
#[derive(Debug, thiserror::Error)]
pub enum OpenError {
    /// The place cannot be used.
    #[error(transparent)]
    Place(#[from] PlaceError),
    /// iceoryx2 cannot create a node there.
    #[error("cannot join the instance in {root}: {reason}")]
    Node {
        /// Folder.
        root: String,
        /// Error of iceoryx2.
        reason: String,
    },
    /// No process offers this topic.
    #[error(
        "nothing is running as instance `{instance}` in {root}: start `semidense run`, or name another with --instance"
    )]
    NotRunning {
        /// Instance.
        instance: String,
        /// Folder.
        root: String,
    },
    /// The instance runs, but its topics cannot be opened from here.
    #[error(
        "instance `{instance}` runs (process {holder}), but its shared memory is not in {SHARED_MEMORY}: it is just starting, or this container has its own {SHARED_MEMORY} (docker run --ipc=host shares the host's)"
    )]
    Elsewhere {
        /// Instance.
        instance: String,
        /// One of its processes.
        holder: String,
    },
    /// The instance has a different wire version.
    #[error(
        "instance `{instance}` uses wire version {found}, this program {WIRE_VERSION}: stop the old one, or use programs of the same version"
    )]
    Version {
        /// Instance.
        instance: String,
        /// Its version.
        found: u32,
    },
    /// The topic has no room for another subscriber.
    #[error(
        "topic {topic} already has its maximum of {subscribers} subscribers: stop one of {holders}, or use what one of them forwards"
    )]
    TooManySubscribers {
        /// Its name.
        topic: String,
        /// Maximum number of subscribers.
        subscribers: usize,
        /// Processes that subscribe to it.
        holders: String,
    },
    /// A topic cannot be opened.
    #[error("topic {topic}: {reason}")]
    Topic {
        /// Its name.
        topic: String,
        /// Error of iceoryx2.
        reason: String,
    },
}

impl OpenError {
    /// Whether no process offers the topic, as far as can be seen from here.
    pub fn is_absence(&self) -> bool {
        matches!(self, Self::NotRunning { .. } | Self::Elsewhere { .. })
    }
}

pub(in crate::wire) fn not_running(place: &Place) -> OpenError {
    if let Some(holder) = place.running() {
        return OpenError::Elsewhere { instance: place.instance.clone(), holder };
    }
    let (instance, root) = (place.instance.clone(), place.root.display().to_string());
    OpenError::NotRunning { instance, root }
}

pub(in crate::wire) fn topic_error(name: &str, error: &dyn std::fmt::Display) -> OpenError {
    OpenError::Topic { topic: name.to_owned(), reason: explain(&error.to_string()) }
}

/// Explains an error that iceoryx2 gives by the name of a type, and says what the user can do about it.
pub(in crate::wire) fn explain(reason: &str) -> String {
    const CAUSES: [(&[&str], &str); 4] = [
        (
            &["ExceedsMaxNumberOfNodes", "ExceedsMaxSupported"],
            "the instance has no room for another program; stop one that reads it",
        ),
        (
            &["HangsInCreation", "ServiceInCorruptedState"],
            "another process created it, but its shared memory is not in /dev/shm here; containers that share a runtime \
             folder must share /dev/shm (docker run --ipc=host), else set SEMIDENSE_ROOT to a folder for each",
        ),
        (
            &["InsufficientPermissions", "PermissionDenied"],
            "another user created it; run as that user, or set SEMIDENSE_ROOT to a folder of your own",
        ),
        (
            &["InternalFailure", "InternalError", "UnableToCreate", "Unable"],
            "the system refuses files or memory for it; check ulimit -n, ulimit -v and the space in /dev/shm and the \
             runtime folder (semidense doctor lists them)",
        ),
    ];
    let cause = CAUSES.iter().find(|(names, _)| names.iter().any(|name| reason.contains(name)));
    cause.map_or_else(|| reason.to_owned(), |(_, words)| format!("{words} ({reason})"))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_of_types_are_explained() {
        let hangs = explain("PublishSubscribeOpenError::HangsInCreation");
        assert!(hangs.contains("--ipc=host") && hangs.ends_with("HangsInCreation)"), "{hangs}");
        let files = explain("EventCreateError(InternalFailure)");
        assert!(files.contains("ulimit -n"), "{files}");
        let full = explain("EventOpenError::ExceedsMaxNumberOfNodes");
        assert!(full.starts_with("the instance has no room for another program"), "{full}");
        assert_eq!(explain("IncompatibleTypes"), "IncompatibleTypes");
    }
}
