//! Domain and reach of a node, from options and from the environment variables that ROS users know.

use std::net::{IpAddr, Ipv4Addr};
use std::str::FromStr;

/// The highest domain with valid ports: 7400 + 250 × 232 is the last below 65 536.
const MAX_DOMAIN: u16 = 232;

/// How far a node reaches.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Reach {
    /// Programs on this machine.
    Localhost,
    /// Every network of this machine.
    All,
    /// The networks of these addresses of this machine.
    Addresses(Vec<IpAddr>),
}

impl FromStr for Reach {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "localhost" => Ok(Self::Localhost),
            "all" => Ok(Self::All),
            _ => {
                let addresses = text.split(',').map(|part| part.trim().parse::<IpAddr>());
                addresses.collect::<Result<_, _>>().map(Self::Addresses).map_err(|_| {
                    "write localhost, all, or addresses of this machine, such as 192.168.1.5,10.0.0.2"
                        .to_owned()
                })
            }
        }
    }
}

impl Reach {
    /// The addresses whose networks are used; `None` for all.
    pub fn addresses(&self) -> Option<Vec<IpAddr>> {
        match self {
            Self::Localhost => Some(vec![IpAddr::V4(Ipv4Addr::LOCALHOST)]),
            Self::All => None,
            Self::Addresses(addresses) => Some(addresses.clone()),
        }
    }
}

/// Domain and reach of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Network {
    /// DDS domain: nodes of other domains do not see it.
    pub domain: u16,
    /// The reach of the node.
    pub reach: Reach,
}

/// Why a network cannot be chosen.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum NetworkError {
    /// An invalid domain.
    #[error("{origin}: `{value}` is not a domain; it must be a number from 0 to 232")]
    Domain {
        /// Option or variable.
        origin: &'static str,
        /// Its value.
        value: String,
    },
    /// An unknown range.
    #[error(
        "ROS_AUTOMATIC_DISCOVERY_RANGE: `{0}` is not a range; it must be LOCALHOST, SUBNET, SYSTEM_DEFAULT or OFF"
    )]
    Range(String),
    /// Discovery is off.
    #[error(
        "ROS_AUTOMATIC_DISCOVERY_RANGE is OFF, so no other node could discover this one; set its reach with --network"
    )]
    Off,
}

impl Network {
    /// Chooses by the options, else by the environment, else domain 0 on this machine. `variable` looks up a
    /// variable of the environment.
    pub fn choose(
        domain: Option<u16>,
        reach: Option<Reach>,
        variable: impl Fn(&str) -> Option<String>,
    ) -> Result<Self, NetworkError> {
        let set = |name| variable(name).filter(|value| !value.trim().is_empty());
        let (origin, text) = match domain {
            Some(domain) => ("--domain", domain.to_string()),
            None => ("ROS_DOMAIN_ID", set("ROS_DOMAIN_ID").unwrap_or_else(|| "0".to_owned())),
        };
        let parsed = text.trim().parse().ok().filter(|domain| *domain <= MAX_DOMAIN);
        let domain = parsed.ok_or(NetworkError::Domain { origin, value: text })?;
        let reach = match reach {
            Some(reach) => reach,
            // If set, the older variable takes precedence, as in ROS.
            None if set("ROS_LOCALHOST_ONLY").is_some_and(|only| only == "1") => Reach::Localhost,
            None => match set("ROS_AUTOMATIC_DISCOVERY_RANGE").as_deref() {
                None | Some("LOCALHOST") => Reach::Localhost,
                Some("SUBNET" | "SYSTEM_DEFAULT") => Reach::All,
                Some("OFF") => return Err(NetworkError::Off),
                Some(other) => return Err(NetworkError::Range(other.to_owned())),
            },
        };
        Ok(Self { domain, reach })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn chosen(
        options: (Option<u16>, Option<Reach>),
        set: &[(&str, &str)],
    ) -> Result<Network, String> {
        let variable = |name: &str| {
            set.iter().find(|(known, _)| *known == name).map(|(_, value)| (*value).to_owned())
        };
        Network::choose(options.0, options.1, variable).map_err(|error| error.to_string())
    }

    #[test]
    fn options_override_the_environment_and_by_default_nothing_leaves_the_machine() {
        let network = |domain, reach| Ok(Network { domain, reach });
        let none = (None, None);
        assert_eq!(chosen(none.clone(), &[]), network(0, Reach::Localhost));
        assert_eq!(chosen(none.clone(), &[("ROS_DOMAIN_ID", "42")]), network(42, Reach::Localhost));
        let subnet = ("ROS_AUTOMATIC_DISCOVERY_RANGE", "SUBNET");
        assert_eq!(chosen(none.clone(), &[subnet]), network(0, Reach::All));
        let both = [("ROS_LOCALHOST_ONLY", "1"), subnet];
        assert_eq!(chosen(none.clone(), &both), network(0, Reach::Localhost));
        assert_eq!(chosen((Some(7), Some(Reach::All)), &both), network(7, Reach::All));
        assert_eq!(
            chosen((Some(7), None), &[("ROS_DOMAIN_ID", "x")]),
            network(7, Reach::Localhost)
        );
        for (set, words) in [
            (("ROS_DOMAIN_ID", "233"), "ROS_DOMAIN_ID: `233`"),
            (("ROS_DOMAIN_ID", "-1"), "0 to 232"),
            (("ROS_AUTOMATIC_DISCOVERY_RANGE", "OFF"), "--network"),
            (("ROS_AUTOMATIC_DISCOVERY_RANGE", "far"), "`far`"),
        ] {
            let error = chosen(none.clone(), &[set]).unwrap_err();
            assert!(error.contains(words), "{error}");
        }
    }

    #[test]
    fn a_reach_is_a_word_or_addresses() {
        assert_eq!("all".parse(), Ok(Reach::All));
        let two: Reach = "127.0.0.1, 10.0.0.2".parse().unwrap();
        assert_eq!(two.addresses().unwrap().len(), 2);
        assert!("eth0".parse::<Reach>().unwrap_err().contains("192.168.1.5"));
    }
}
