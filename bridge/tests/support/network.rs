//! Network namespaces: a host and robots, each with its own cable to the host.

use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};

/// A host and its robots.
pub struct Network {
    name: String,
    robots: usize,
}

impl Network {
    /// A host with this many robots; `None`, reported on standard error, if this user may not create namespaces.
    pub fn new(robots: usize) -> Option<Self> {
        static COUNT: AtomicU32 = AtomicU32::new(0);
        let count = COUNT.fetch_add(1, Ordering::Relaxed);
        let network = Self { name: format!("sd{}x{count}", std::process::id()), robots };
        if !is_root() {
            eprintln!("SKIPPED: network namespaces need root");
            return None;
        }
        let host = network.host();
        network.ip(&["netns", "add", &host]);
        network.ip(&["-n", &host, "link", "set", "lo", "up"]);
        for robot in 0..robots {
            let name = network.robot(robot);
            let (here, there) = (format!("h{robot}"), format!("r{robot}"));
            network.ip(&["netns", "add", &name]);
            network.ip(&["-n", &name, "link", "set", "lo", "up"]);
            let link = ["-n", &host, "link", "add", &here, "type", "veth", "peer", "name", &there];
            network.ip(&[&link[..], &["netns", &name]].concat());
            for (namespace, device, address) in
                [(&host, &here, host_address(robot)), (&name, &there, robot_address(robot))]
            {
                network.ip(&[
                    "-n",
                    namespace,
                    "addr",
                    "add",
                    &format!("{address}/24"),
                    "dev",
                    device,
                ]);
                network.ip(&["-n", namespace, "link", "set", device, "up"]);
            }
        }
        Some(network)
    }

    /// A program on the host.
    pub fn on_host(&self, program: &str) -> Command {
        in_namespace(&self.host(), program)
    }

    /// A program on a robot.
    pub fn on_robot(&self, robot: usize, program: &str) -> Command {
        in_namespace(&self.robot(robot), program)
    }

    /// Unplugs the cable of a robot, or plugs it in.
    pub fn connect(&self, robot: usize, is_connected: bool) {
        let state = if is_connected { "up" } else { "down" };
        self.ip(&["-n", &self.host(), "link", "set", &format!("h{robot}"), state]);
    }

    fn host(&self) -> String {
        format!("{}h", self.name)
    }

    fn robot(&self, robot: usize) -> String {
        format!("{}r{robot}", self.name)
    }

    fn ip(&self, arguments: &[&str]) {
        let output = Command::new("ip").args(arguments).output().expect("ip of iproute2");
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success(), "ip {}: {said}", arguments.join(" "));
    }
}

impl Drop for Network {
    fn drop(&mut self) {
        for name in (0..self.robots).map(|robot| self.robot(robot)).chain([self.host()]) {
            // A namespace that was not created does not exist.
            let _ = Command::new("ip").args(["netns", "del", &name]).output();
        }
    }
}

/// Address of a robot.
pub fn robot_address(robot: usize) -> String {
    format!("10.77.{robot}.2")
}

fn host_address(robot: usize) -> String {
    format!("10.77.{robot}.1")
}

/// `ip netns exec` becomes the program: its process id is that of the child.
fn in_namespace(namespace: &str, program: &str) -> Command {
    let mut command = Command::new("ip");
    command.args(["netns", "exec", namespace, program]);
    command
}

fn is_root() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let effective = status.lines().find_map(|line| line.strip_prefix("Uid:"));
    effective.and_then(|ids| ids.split_whitespace().nth(1)) == Some("0")
}
