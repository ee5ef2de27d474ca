//! A separate process on the same machine, started at any time: prints every pose and keyframe.
//!
//! ```sh
//! cargo build --release --example subscribe    # first: it takes minutes
//! semidense run --live loop:9000:30:sim &
//! target/release/examples/subscribe
//! ```

use std::error::Error;
use std::process::ExitCode;
use std::time::Duration;

use semidense::service::shutdown::Shutdown;
use semidense::wire::conversion::pose_from_message;
use semidense::wire::keyframe_inbox::KeyframeInbox;
use semidense::wire::message::PoseMessage;
use semidense::wire::place::Place;
use semidense::wire::port::{Access, Hub, Subscriber, wait};
use semidense::wire::topic::POSE;

fn main() -> ExitCode {
    match subscribe() {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("subscribe: {error}");
            ExitCode::FAILURE
        }
    }
}

fn subscribe() -> Result<(), Box<dyn Error>> {
    // The first argument is the instance's name; its folder is the one that `semidense run` uses.
    let instance = std::env::args().nth(1).unwrap_or_else(|| "semidense".to_owned());
    let place = Place::new(&instance, "")?;
    let hub = Hub::join(&place, "subscribe", Access::Observer)?;
    let poses: Subscriber<PoseMessage, ()> = hub.subscriber(&POSE)?;
    // A late subscriber receives the active keyframe at once, from the topic's history.
    let mut keyframes = KeyframeInbox::open(&hub)?;
    let shutdown = Shutdown::install()?;
    while !shutdown.is_requested() {
        let events = [poses.events(), keyframes.events()];
        wait(&events, Some(shutdown.descriptor()), Duration::from_secs(1))?;
        if let Some(keyframe) = keyframes.newest()? {
            let (id, points) = (keyframe.keyframe_id, keyframe.points.len());
            println!("keyframe {id} revision {}: {points} points", keyframe.revision);
        }
        while let Some(message) = poses.receive()? {
            // A slice of one message in shared memory; validated before use.
            for pose in message.payload().iter().map(pose_from_message) {
                let pose = pose?;
                let [x, y, z] = pose.world_from_camera.translation.into();
                println!("frame {} {:?}: {x:.3} {y:.3} {z:.3}", pose.sequence, pose.state);
            }
        }
    }
    Ok(())
}
