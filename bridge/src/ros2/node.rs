//! A node on the ROS 2 network: its name, its topics with their quality of service, and their readers.

use ros2_client::dds::rustdds::{
    self, DomainParticipant, DomainParticipantBuilder, Duration, QosPolicies, QosPolicyBuilder,
    TopicKind,
};
use ros2_client::dds::{Context, Node, NodeCreateError, Publisher, Subscription};
use ros2_client::ros2::policy;
use ros2_client::{CreateError, MessageTypeName, NodeName, NodeOptions};

use crate::ros::message::RosMessage;
use crate::ros::topic::{Durability, Reliability, RosTopic};
use crate::ros2::network::Network;

/// Messages kept for late readers of a transient-local topic. Without a bound the middleware keeps thousands,
/// and sends all of them to a late reader.
const KEPT_FOR_LATE_READERS: i32 = 4;

/// Why a node or one of its topics cannot be created.
#[derive(Debug, thiserror::Error)]
pub enum NodeError {
    /// A name that ROS does not allow.
    #[error(
        "`{name}` is not a valid ROS name ({reason}); use letters, digits and _, no leading digit, / between parts"
    )]
    Name {
        /// The name.
        name: String,
        /// What is wrong.
        reason: String,
    },
    /// The middleware reports an error on joining.
    #[error("cannot join the ROS 2 network: {0}")]
    Network(#[from] rustdds::dds::CreateError),
    /// The middleware refuses a topic or a node.
    #[error("cannot join the ROS 2 network: {0}")]
    Create(#[from] CreateError),
    /// The middleware refuses the node.
    #[error("cannot create the ROS 2 node: {0:?}")]
    Node(NodeCreateError),
}

/// A reader of one of our topics, somewhere on the network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RemoteReader {
    /// The topic as named in DDS: `rt/tf`.
    pub topic: String,
    /// Whether it accepts only a reliable publisher.
    pub wants_reliable: bool,
}

/// A ROS 2 node.
pub struct RosNode {
    namespace: String,
    participant: DomainParticipant,
    node: Node,
    _context: Context,
}

impl RosNode {
    /// Creates the node `name` in `namespace`, which begins with `/`.
    pub fn new(network: &Network, namespace: &str, name: &str) -> Result<Self, NodeError> {
        let node_name = NodeName::new(namespace, name).map_err(|error| NodeError::Name {
            name: format!("{}/{name}", namespace.trim_end_matches('/')),
            reason: error.to_string(),
        })?;
        let mut builder = DomainParticipantBuilder::new(network.domain);
        if let Some(addresses) = network.reach.addresses() {
            builder = builder.with_only_networks(addresses);
        }
        let participant = builder.build()?;
        let context = Context::from_domain_participant(participant.clone())?;
        // Parameters are set on the command line, and logs go to the journal.
        let options = NodeOptions::new().enable_rosout(false).start_parameter_services(false);
        let node = context.new_node(node_name, options).map_err(NodeError::Node)?;
        Ok(Self { namespace: namespace.to_owned(), participant, node, _context: context })
    }

    /// Creates a publisher of messages of type `M` for a topic in the node's namespace.
    pub fn publisher<M: RosMessage>(
        &mut self,
        topic: &RosTopic,
    ) -> Result<Publisher<M>, NodeError> {
        let made = self.topic::<M>(&topic.name_in(&self.namespace), topic)?;
        Ok(self.node.create_publisher(&made, None)?)
    }

    /// Subscribes to messages of type `M` on the topic `name` with the quality of service of `topic`.
    pub fn subscription<M: RosMessage + 'static>(
        &mut self,
        topic: &RosTopic,
        name: &str,
    ) -> Result<Subscription<M>, NodeError> {
        let made = self.topic::<M>(name, topic)?;
        Ok(self.node.create_subscription(&made, None)?)
    }

    fn topic<M: RosMessage>(
        &self,
        name: &str,
        topic: &RosTopic,
    ) -> Result<rustdds::Topic, NodeError> {
        let (package, kind) = M::TYPE.split_once('/').unwrap_or(("", M::TYPE));
        let dds_type = MessageTypeName::new(package, kind).dds_msg_type();
        let (dds_name, qos) = (dds_name(name)?, qos(topic));
        Ok(self.participant.create_topic(dds_name, dds_type, &qos, TopicKind::NoKey)?)
    }

    /// All readers of topics in the domain, ours or not.
    pub fn remote_readers(&self) -> Vec<RemoteReader> {
        let readers = self.participant.discovered_readers();
        let remote = |reader: &rustdds::discovery::DiscoveredReaderData| {
            let data = &reader.subscription_topic_data;
            RemoteReader {
                topic: data.topic_name().clone(),
                wants_reliable: data.qos().is_reliable(),
            }
        };
        readers.iter().map(remote).collect()
    }
}

/// The DDS name of a ROS topic: `rt/a/b` for `/a/b`.
pub fn dds_name(name: &str) -> Result<String, NodeError> {
    ros2_client::Name::parse(name)
        .ok()
        .filter(ros2_client::Name::is_absolute)
        .map(|_| format!("rt{name}"))
        .ok_or_else(|| NodeError::Name {
            name: name.to_owned(),
            reason: "a full topic name begins with /".to_owned(),
        })
}

/// The quality of service of a topic.
fn qos(topic: &RosTopic) -> QosPolicies {
    let depth = i32::try_from(topic.depth).unwrap_or(i32::MAX);
    let builder = QosPolicyBuilder::new().history(policy::History::KeepLast { depth });
    let builder = match topic.reliability {
        // A write never waits: what a reader has not confirmed in time is dropped and counted.
        Reliability::Reliable => builder.reliable(Duration::ZERO),
        Reliability::BestEffort => builder.best_effort(),
    };
    match topic.durability {
        Durability::Volatile => builder.durability(policy::Durability::Volatile).build(),
        Durability::TransientLocal => builder
            .durability(policy::Durability::TransientLocal)
            .resource_limits(policy::ResourceLimits {
                max_samples: KEPT_FOR_LATE_READERS,
                max_instances: 1,
                max_samples_per_instance: KEPT_FOR_LATE_READERS,
            })
            .build(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::topic::{KEYFRAMES, POINTS, TF};

    #[test]
    fn names_are_absolute_and_quality_of_service_follows_the_table() {
        assert_eq!(dds_name("/tf").unwrap(), "rt/tf");
        assert_eq!(dds_name("/a/b_c").unwrap(), "rt/a/b_c");
        for bad in ["tf", "/", "/a//b", "/1a", "/a b", "/a/", ""] {
            assert!(dds_name(bad).is_err(), "{bad}");
        }
        assert!(qos(&TF).is_reliable() && qos(&TF).is_volatile());
        assert!(!qos(&POINTS).is_reliable());
        assert!(!qos(&KEYFRAMES).is_volatile());
        assert_eq!(qos(&KEYFRAMES).resource_limits().unwrap().max_samples, 4);
    }
}
