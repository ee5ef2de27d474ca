//! Names the subscribers of a topic that has no room for another.

use iceoryx2::identifiers::UniqueNodeId;
use iceoryx2::node::{NodeState, NodeView};
use iceoryx2::prelude::{CallbackProgression, PortFactory as _, ipc};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;

use crate::wire::open_error::OpenError;
use crate::wire::port::Part;

/// Returns the error of a subscriber that finds the topic `name` full.
pub(super) fn too_many<T: Part, H: Part>(
    name: &str,
    service: &PortFactory<ipc::Service, [T], H>,
) -> OpenError {
    let mut holders = Vec::new();
    service.dynamic_config().list_subscribers(|subscriber| {
        holders.push(subscriber.node_id);
        CallbackProgression::Continue
    });
    let mut nodes: Vec<(UniqueNodeId, String)> = Vec::new();
    // Without names, the process ids have to suffice.
    let _ = service.nodes(|node| {
        if let NodeState::Alive(node) = node {
            let name = node.details().as_ref().map(|details| details.name().to_string());
            nodes.extend(name.map(|name| (*node.id(), name)));
        }
        CallbackProgression::Continue
    });
    let explain = |id: &UniqueNodeId| {
        let name = nodes.iter().find(|(known, _)| known == id).map(|(_, name)| name.as_str());
        let process =
            id.pid::<ipc::Service>().map_or("?".to_owned(), |pid| pid.value().to_string());
        format!("{} (process {process})", name.unwrap_or("a program"))
    };
    let holders: Vec<String> = holders.iter().map(explain).collect();
    OpenError::TooManySubscribers {
        topic: name.to_owned(),
        subscribers: service.static_config().max_subscribers(),
        holders: holders.join(", "),
    }
}
