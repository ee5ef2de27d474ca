//! The wire version of an instance: topics of another version have other names, so programs of different versions would
//! silently not hear each other.

use iceoryx2::prelude::*;
use iceoryx2::service::Service;

use crate::wire::topic::WIRE_VERSION;

/// The version in the name of a topic of `instance`: `<instance>/v<version>/…`.
fn version_of(name: &str, instance: &str) -> Option<u32> {
    let (version, _) = name.strip_prefix(instance)?.strip_prefix("/v")?.split_once('/')?;
    version.parse().ok()
}

/// Returns a different wire version that living processes of `instance` use; `None` if all use ours.
pub(in crate::wire) fn foreign_version(config: &Config, instance: &str) -> Option<u32> {
    let mut foreign = None;
    // Services that cannot be listed cannot be joined either: the caller's next step reports why.
    let _ = ipc::Service::list(config, |service| {
        let name = service.static_details.name().as_str();
        foreign = version_of(name, instance).filter(|&version| version != WIRE_VERSION);
        match foreign {
            Some(_) => CallbackProgression::Stop,
            None => CallbackProgression::Continue,
        }
    });
    foreign
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn versions_are_read_from_the_names_of_the_instance_alone() {
        assert_eq!(version_of("rig/v7/capture/frame", "rig"), Some(7));
        assert_eq!(version_of("rig2/v7/capture/frame", "rig"), None);
        assert_eq!(version_of("rig/vx/capture/frame", "rig"), None);
        assert_eq!(version_of("rig/v7", "rig"), None);
    }
}
