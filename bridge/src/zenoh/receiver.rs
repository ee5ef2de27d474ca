//! Receives one robot's messages from Zenoh and publishes them in the shared memory of this machine.
//!
//! Zenoh's threads only put into queues in which the newest wins; one thread unpacks large messages, one
//! queries the sender's presence, and the main thread publishes: a pose never waits for an image.

use std::io::Read;
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::sync::Arc;
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};

use semidense::service::shutdown::Shutdown;
use semidense::wire::place::Place;
use semidense::wire::port::wait;
use zenoh::{Session, Wait};

use crate::last_time::LastTime;
use crate::zenoh::error::ZenohError;
use crate::zenoh::kind::Kind;
use crate::zenoh::link::{Endpoints, declare_error, open as open_network};
use crate::zenoh::mirror::Mirror;
use crate::zenoh::poll::poll;
use crate::zenoh::shared::Shared;

/// Upper limit for a wait for messages before silence and late subscribers are checked.
const WAKE_PERIOD: Duration = Duration::from_millis(100);

/// Time between two log lines.
const LOG_PERIOD: Duration = Duration::from_secs(10);

/// Receives the instance `from` of the robot until a signal arrives, and publishes it as the instance at
/// `place`. Waits for a robot that is not reachable yet.
pub fn receive(
    place: &Place,
    endpoints: &Endpoints,
    from: &str,
    shutdown: &Shutdown,
) -> Result<(), ZenohError> {
    let mut mirror = Mirror::open(place)?;
    let network = open_network(endpoints)?;
    let (woken, wake) = UnixStream::pair()?;
    woken.set_nonblocking(true)?;
    wake.set_nonblocking(true)?;
    let shared = Arc::new(Shared::new(wake));
    subscribe(&network, from, &shared)?;
    let outcome = std::thread::scope(|scope| {
        let named = |name: &str| std::thread::Builder::new().name(name.to_owned());
        let (running, stop) = channel::<()>();
        let (network, shared) = (&network, &*shared);
        let started =
            named("unpack").spawn_scoped(scope, move || shared.unpack_large()).and_then(|_| {
                named("ask").spawn_scoped(scope, move || poll(network, from, shared, &stop))
            });
        let silence = |now| shared.remote().silence_reason(from, &endpoints.to_string(), now);
        let outcome = started
            .map_err(ZenohError::from)
            .and_then(|_| publish(&mut mirror, shared, silence, &woken, shutdown));
        shared.large.close();
        drop(running);
        outcome
    });
    // If this cannot be sent, the other side notices by its lease.
    let _ = network.close().wait();
    outcome
}

fn subscribe(network: &Session, instance: &str, shared: &Arc<Shared>) -> Result<(), ZenohError> {
    for kind in Kind::ALL.into_iter().filter(|kind| kind.topic().is_some()) {
        let key = kind.key(instance);
        let shared = Arc::clone(shared);
        let take = move |sample: zenoh::sample::Sample| {
            shared.arrive(kind, sample.payload().clone());
        };
        let declared = network.declare_subscriber(key.clone()).callback(take).background().wait();
        declared.map_err(|error| declare_error(&key, &error))?;
    }
    Ok(())
}

fn publish(
    mirror: &mut Mirror,
    shared: &Shared,
    silence: impl Fn(Instant) -> Option<String>,
    mut woken: &UnixStream,
    shutdown: &Shutdown,
) -> Result<(), ZenohError> {
    let mut told = LastTime::now();
    while !shutdown.is_requested() {
        wait(&[], [shutdown.descriptor(), woken.as_fd()], WAKE_PERIOD)?;
        let mut bytes = [0; 64];
        while woken.read(&mut bytes).is_ok_and(|count| count == bytes.len()) {}
        mirror.serve_late_joiners();
        // Keyframes before poses: a pose names its keyframe.
        while let Some(arrival) = shared.ready.try_take() {
            mirror.publish(&arrival)?;
        }
        while let Some((kind, bytes)) = shared.urgent.try_take() {
            if let Some(arrival) = shared.unpack(kind, &bytes) {
                mirror.publish(&arrival)?;
            }
        }
        if let Some(cause) = silence(Instant::now()) {
            mirror.report_silence(&cause)?;
        }
        if told.is_due(LOG_PERIOD) {
            log_missed(shared);
        }
    }
    Ok(())
}

/// Logs what was lost.
fn log_missed(shared: &Shared) {
    let remote = shared.remote();
    let lost: Vec<String> = Kind::ALL
        .into_iter()
        .filter(|kind| remote.lost(*kind) > 0)
        .map(|kind| format!("{kind:?} {}", remote.lost(kind)))
        .collect();
    let clock = remote.clock.uncertainty_nanos();
    let clock = clock.map_or("taken from CLOCK_REALTIME".to_owned(), |nanos| {
        format!("known to {:.1} ms", nanos as f64 * 1e-6)
    });
    tracing::info!(
        "lost: [{}]; refused {}; the robot's clock is {clock}",
        lost.join(", "),
        remote.refused
    );
}
