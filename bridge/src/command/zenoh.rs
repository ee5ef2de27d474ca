//! `semidense-bridge zenoh`: sends topics to another machine and back into shared memory there.

use std::process::ExitCode;

use clap::{Args, Subcommand};
use semidense::service::child::tidy_up;
use semidense::service::shutdown::Shutdown;
use semidense::wire::place::Place;

use crate::command::{CommandResult, CommonArguments, note, number_within};
use crate::zenoh::link::{Endpoint, Endpoints};
use crate::zenoh::receiver::receive;
use crate::zenoh::sender::{FrameOptions, SendOptions, send};

/// Send to another machine over Zenoh, or receive there
#[derive(Debug, Args)]
#[command(after_help = "\
On the robot:          semidense run v4l:0 --rig FILE &
                       semidense zenoh send --listen tcp/0.0.0.0:7447
On the other machine:  semidense zenoh receive --connect tcp/ROBOT:7447 &
                       semidense status

Nothing is encrypted. Without --password-file everybody who reaches the port can read all and put in what they like:
open it in a network that you trust, or leave it on 127.0.0.1 and go through ssh -L 7447:127.0.0.1:7447 ROBOT.")]
pub struct ZenohArguments {
    #[command(subcommand)]
    direction: Direction,
}

#[derive(Debug, Subcommand)]
enum Direction {
    Send(SendArguments),
    Receive(ReceiveArguments),
}

/// Send poses, health, map graph and keyframes of the local instance, whenever it runs
#[derive(Debug, Args)]
#[command(after_help = "\
Listens on tcp/127.0.0.1:7447 where neither --listen nor --connect is given. The network never holds the pipeline up:
what it does not take in time is dropped, the newest wins; --log info counts it every ten seconds.")]
struct SendArguments {
    #[command(flatten)]
    endpoints: Endpoints,
    /// Also send camera frames, as JPEG, while they are being received
    #[arg(long)]
    frames: bool,
    /// JPEG quality; 80 gives about 40 kB for 640 × 480
    #[arg(long, value_name = "1-100", default_value_t = 80, requires = "frames",
          value_parser = clap::value_parser!(u8).range(1..=100))]
    jpeg_quality: u8,
    /// Maximum rate of frames
    #[arg(long, value_name = "HZ", default_value_t = 10.0, requires = "frames", value_parser = rate)]
    frame_rate: f64,
    /// Maximum rate of revisions of a keyframe's depth; a new keyframe is sent at once
    #[arg(long, value_name = "HZ", default_value_t = 1.0, value_parser = rate)]
    keyframe_rate: f64,
}

/// Receive an instance from another machine and publish it here: subscribers work unmodified
#[derive(Debug, Args)]
#[command(after_help = "\
Stamps of CLOCK_MONOTONIC are translated to the clock of this machine, by asking the robot for its own once a second;
published_nanos then tells the age of a pose here. capture_nanos and realtime_nanos stay as the robot wrote them.
While the link is down health is `stale` with the cause. Several robots: one receiver each, with another --as.")]
#[command(group(clap::ArgGroup::new("link").args(["listen", "connect"]).required(true).multiple(true)))]
struct ReceiveArguments {
    #[command(flatten)]
    endpoints: Endpoints,
    /// Name of the instance on the robot
    #[arg(long, value_name = "INSTANCE", default_value = "semidense")]
    from: String,
    /// Name of the local instance [default: as on the robot]
    #[arg(long = "as", value_name = "INSTANCE")]
    local: Option<String>,
}

/// Parses a rate in Hz.
fn rate(text: &str) -> Result<f64, String> {
    /// Faster than any camera.
    const MAX_HZ: f64 = 1000.0;
    let wanted = format!("write a number above 0 and up to {MAX_HZ}, in Hz");
    number_within(text, f64::MIN_POSITIVE..=MAX_HZ, &wanted)
}

/// Sends or receives until a signal arrives.
pub fn run(common: &CommonArguments, arguments: &ZenohArguments) -> CommandResult {
    match &arguments.direction {
        Direction::Send(arguments) => run_send(common, arguments),
        Direction::Receive(arguments) => run_receive(common, arguments),
    }
}

fn run_send(common: &CommonArguments, arguments: &SendArguments) -> CommandResult {
    let place = common.place()?;
    let mut endpoints = arguments.endpoints.clone();
    if endpoints.listen.is_empty() && endpoints.connect.is_empty() {
        endpoints.listen.push("tcp/127.0.0.1".parse()?);
    }
    let SendArguments { jpeg_quality, frame_rate, .. } = *arguments;
    let frames = FrameOptions { jpeg_quality, rate_hz: frame_rate };
    let options = SendOptions {
        frames: arguments.frames.then_some(frames),
        keyframe_rate_hz: arguments.keyframe_rate,
        endpoints,
    };
    warn_of_open_port(&options.endpoints);
    note(&format!("sending instance `{}` on {}", place.instance, options.endpoints));
    let shutdown = Shutdown::install()?;
    let outcome = send(&place, &options, &shutdown);
    tidy_up(&place);
    outcome?;
    Ok(ExitCode::SUCCESS)
}

fn run_receive(common: &CommonArguments, arguments: &ReceiveArguments) -> CommandResult {
    // The remote name is part of a key: it must be a valid name of an instance.
    Place::new(&arguments.from, "")?;
    let named = common.instance.clone();
    let instance = arguments.local.clone().or(named).unwrap_or_else(|| arguments.from.clone());
    let place = CommonArguments { instance: Some(instance), ..common.clone() }.place()?;
    let ReceiveArguments { endpoints, from, .. } = arguments;
    warn_of_open_port(endpoints);
    let shutdown = Shutdown::install()?;
    note(&format!("receiving `{from}` from {endpoints} as instance `{}`", place.instance));
    let outcome = receive(&place, endpoints, from, &shutdown);
    tidy_up(&place);
    outcome?;
    Ok(ExitCode::SUCCESS)
}

/// Warns about a port that others can reach.
fn warn_of_open_port(endpoints: &Endpoints) {
    let open: Vec<String> =
        endpoints.listen.iter().filter(|e| !e.is_local()).map(Endpoint::to_string).collect();
    if open.is_empty() {
        return;
    }
    let who = match endpoints.password_file {
        Some(_) => "anyone with the password can read and write, and the traffic is not encrypted",
        None => {
            "anyone who reaches it can read and write, and the traffic is not encrypted (--password-file requires a password)"
        }
    };
    note(&format!("warning: {} is open beyond this machine: {who}", open.join(", ")));
}
