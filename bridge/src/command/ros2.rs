//! `semidense-bridge ros2` and `ros2-camera`: ROS 2 without an installation of ROS.

use std::io::{IsTerminal, Write};
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

use clap::Args;
use semidense::service::shutdown::Shutdown;

use crate::command::{CommandResult, CommonArguments, note, number_within};
use crate::ros::frame_ids::FrameIds;
use crate::ros::topic::namespace;
use crate::ros2::camera;
use crate::ros2::network::{Network, Reach};
use crate::ros2::node::RosNode;
use crate::ros2::publishing::{PublishParams, Publishers};
use crate::session::{Session, Wants};

/// Network of the node.
#[derive(Debug, Args)]
pub struct NetworkArguments {
    /// Reach of the node: localhost, all, or addresses of this machine, such as 192.168.1.5 [default: from
    /// ROS_AUTOMATIC_DISCOVERY_RANGE and ROS_LOCALHOST_ONLY, else localhost]
    #[arg(long, value_name = "REACH", help_heading = "Network")]
    network: Option<Reach>,
    /// DDS domain, 0 to 232 [default: ROS_DOMAIN_ID, else 0]
    #[arg(long, value_name = "N", help_heading = "Network")]
    domain: Option<u16>,
}

impl NetworkArguments {
    fn network(&self) -> Result<Network, Box<dyn std::error::Error>> {
        let variable = |name: &str| std::env::var(name).ok();
        Ok(Network::choose(self.domain, self.network.clone(), variable)?)
    }
}

/// Publish poses, transforms, images and depth to ROS 2, which need not be installed
#[derive(Debug, Args)]
#[command(
    after_help = "Topics, below /semidense for the instance semidense: odom (nav_msgs/Odometry with twist), pose \
                  (PoseWithCovarianceStamped in map), points (PointCloud2 of the active keyframe), image_rect and \
                  camera_info, keyframes (PoseArray); and /tf (map, odom, camera), /tf_static, /diagnostics.\n\n\
                  Nothing leaves this machine unless --network or ROS_AUTOMATIC_DISCOVERY_RANGE says so: DDS knows no \
                  passwords. For rviz on a laptop: semidense ros2 --network all.\n\n\
                  Examples:\n  semidense ros2\n  semidense ros2 --network all --domain 7\n  \
                  semidense ros2 --no-images --frame-camera camera_color_optical_frame"
)]
pub struct Ros2Arguments {
    #[command(flatten)]
    network: NetworkArguments,
    /// Namespace of node and topics [default: the instance's name]
    #[arg(long, value_name = "/NAME")]
    namespace: Option<String>,
    /// Name of the node
    #[arg(long, value_name = "NAME", default_value = "semidense")]
    node_name: String,
    /// Frame id of the map
    #[arg(long, value_name = "ID", default_value = "map")]
    frame_map: String,
    /// Frame id of the odometry frame
    #[arg(long, value_name = "ID", default_value = "odom")]
    frame_odom: String,
    /// Frame id of the camera's optical frame: x right, y down, z forward [default: INSTANCE_optical_frame]
    #[arg(long, value_name = "ID")]
    frame_camera: Option<String>,
    /// Frame id of the camera body on /tf_static: x forward, y left, z up; empty to omit it [default: INSTANCE_link]
    #[arg(long, value_name = "ID")]
    frame_camera_link: Option<String>,
    /// Do not publish images, which make up most of the bytes
    #[arg(long)]
    no_images: bool,
    /// Do not publish point clouds
    #[arg(long)]
    no_points: bool,
    /// Do not publish /tf and /tf_static, for when another node publishes these frames
    #[arg(long)]
    no_tf: bool,
    /// Maximum rate of images; 0 for all
    #[arg(long, value_name = "HZ", default_value_t = 0.0, value_parser = parse_rate)]
    image_hz: f64,
    /// Maximum rate of point clouds; the newest revision is sent
    #[arg(long, value_name = "HZ", default_value_t = 1.0, value_parser = parse_rate)]
    points_hz: f64,
    /// Publish images and clouds reliably too, for subscribers that require it, as rviz does by default
    #[arg(long)]
    reliable_sensors: bool,
}

/// Parses a rate, 0 to 1000 Hz.
fn parse_rate(text: &str) -> Result<f64, String> {
    number_within(text, 0.0..=1000.0, "needs a number from 0 to 1000")
}

/// Minimum time between two messages at a rate; 0 is no limit.
fn period(rate_hz: f64) -> Duration {
    if rate_hz > 0.0 { Duration::from_secs_f64(1.0 / rate_hz) } else { Duration::ZERO }
}

impl Ros2Arguments {
    fn params(&self, instance: &str) -> PublishParams {
        let usual = FrameIds::of_instance(instance);
        let link = self.frame_camera_link.clone().unwrap_or_else(|| format!("{instance}_link"));
        PublishParams {
            instance: instance.to_owned(),
            namespace: self.namespace.clone().unwrap_or_else(|| namespace(instance)),
            frames: FrameIds {
                map: self.frame_map.clone(),
                odom: self.frame_odom.clone(),
                camera: self.frame_camera.clone().unwrap_or(usual.camera),
            },
            camera_link: Some(link).filter(|link| !link.is_empty()),
            tf: !self.no_tf,
            image_period: (!self.no_images).then(|| period(self.image_hz)),
            points_period: (!self.no_points).then(|| period(self.points_hz)),
            reliable_sensors: self.reliable_sensors,
        }
    }
}

/// Publishes until a signal arrives.
pub fn run(common: &CommonArguments, arguments: &Ros2Arguments) -> CommandResult {
    let place = common.place()?;
    let params = arguments.params(&place.instance);
    let network = arguments.network.network()?;
    let shutdown = Shutdown::install()?;
    let wants = Wants {
        frames: params.image_period.is_some(),
        keyframes: true,
        graph: true,
        ..Wants::default()
    };
    let node = RosNode::new(&network, &params.namespace, &arguments.node_name)?;
    let reach = match &network.reach {
        Reach::Localhost => "this machine only; --network all for others".to_owned(),
        Reach::All => "all networks of this machine".to_owned(),
        Reach::Addresses(addresses) => format!("{addresses:?}"),
    };
    let mut session = Session::new(place, "ros2", wants);
    let publishers = Publishers::open(node, params.clone())?;
    let mut reader = publishers.reader();
    let PublishParams { instance, namespace, .. } = &params;
    let domain = network.domain;
    note(&format!(
        "publishing {instance} on ROS 2, topics below {namespace}, domain {domain}, {reach}"
    ));
    let thread = std::thread::Builder::new().name("publisher".to_owned());
    let publishing = thread.spawn(move || publishers.run())?;
    let outcome = loop {
        if shutdown.is_requested() || publishing.is_finished() {
            break Ok(());
        }
        if let Err(error) = reader.read(&mut session, Some(shutdown.descriptor())) {
            break Err(error);
        }
    };
    drop(reader);
    publishing.join().map_err(|_| "the publishing thread failed")?;
    outcome?;
    Ok(ExitCode::SUCCESS)
}

/// Write the images of a ROS 2 topic as frames for capture: `semidense run ros2:TOPIC` starts this command
#[derive(Debug, Args)]
#[command(
    after_help = "Writes to standard output, or to the socket of `semidense capture stream:PATH`, as under systemd:\n  \
                  semidense-bridge ros2-camera /camera/image_raw --stream /run/semidense/front.frames\n\
                  Writes the camera's calibration, of its CameraInfo, into a rig file:\n  \
                  semidense-bridge ros2-camera /camera/image_raw --write-rig front.toml"
)]
pub struct Ros2CameraArguments {
    #[command(flatten)]
    network: NetworkArguments,
    /// Topic of type sensor_msgs/Image, or CompressedImage if its name ends in /compressed
    #[arg(value_name = "TOPIC")]
    topic: String,
    /// Name of the node
    #[arg(long, value_name = "NAME", default_value = "semidense_camera")]
    node_name: String,
    /// Socket to write to [default: standard output]
    #[arg(long, value_name = "PATH")]
    stream: Option<PathBuf>,
    /// Write a rig file from the camera's CameraInfo and exit
    #[arg(long, value_name = "FILE", conflicts_with = "stream")]
    write_rig: Option<PathBuf>,
    /// Topic of the CameraInfo [default: camera_info next to the image topic]
    #[arg(long, value_name = "TOPIC", requires = "write_rig")]
    camera_info: Option<String>,
    /// How long to wait for the CameraInfo
    #[arg(long, value_name = "SECONDS", default_value_t = 10, requires = "write_rig")]
    timeout: u64,
}

/// Writes frames until a signal arrives or the reader closes the stream.
pub fn run_camera(arguments: &Ros2CameraArguments) -> CommandResult {
    // The exit code of wrong usage, so that it is not restarted over and over.
    const WRONG_USAGE: u8 = 2;
    if let Err(error) = crate::ros2::node::dds_name(&arguments.topic) {
        note(&format!("error: {error}"));
        return Ok(ExitCode::from(WRONG_USAGE));
    }
    let network = arguments.network.network()?;
    let shutdown = Shutdown::install()?;
    let open = || RosNode::new(&network, "/", &arguments.node_name);
    if let Some(path) = &arguments.write_rig {
        let longest = Duration::from_secs(arguments.timeout);
        let camera_info = arguments.camera_info.as_deref();
        let text = camera::await_rig(open()?, &arguments.topic, camera_info, longest, &shutdown)?;
        semidense::service::atomic_file::write_atomically(path, |file| {
            file.write_all(text.as_bytes())
        })?;
        return Ok(ExitCode::SUCCESS);
    }
    if arguments.stream.is_none() && std::io::stdout().is_terminal() {
        return Err("standard output is a terminal: pipe the frames to a program, as `semidense run ros2:TOPIC` does, or use --stream PATH".into());
    }
    camera::run(open()?, arguments.topic.clone(), arguments.stream.clone(), &shutdown)?;
    Ok(ExitCode::SUCCESS)
}
