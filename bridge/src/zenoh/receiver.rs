//! Receiving: takes the messages of one robot from Zenoh and publishes them in the shared memory of this machine.
//!
//! Zenoh's threads only put into queues in which the newest wins; one thread unpacks what is large, one asks the sender
//! whether it is there, and the main one publishes: a pose never waits for an image.

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

use crate::zenoh::error::ZenohError;
use crate::zenoh::kind::Kind;
use crate::zenoh::link::{Endpoints, declare_error, open as open_network};
use crate::zenoh::mirror::Mirror;
use crate::zenoh::poll::poll;
use crate::zenoh::shared::Shared;

/// Longest wait for a message without a look at the silence and at subscribers that came late.
const WAKE_PERIOD: Duration = Duration::from_millis(100);

/// Time between two lines of the log.
const TELL_PERIOD: Duration = Duration::from_secs(10);

/// What is received from where.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReceiveOptions {
    /// Links.
    pub endpoints: Endpoints,
    /// Name of the instance on the robot.
    pub from: String,
}

/// Receives until the signal, and publishes as the instance at `place`. Waits for a robot that is not there yet.
pub fn receive(
    place: &Place,
    options: &ReceiveOptions,
    shutdown: &Shutdown,
) -> Result<(), ZenohError> {
    let mut mirror = Mirror::open(place)?;
    let network = open_network(&options.endpoints)?;
    let (woken, wake) = UnixStream::pair()?;
    woken.set_nonblocking(true)?;
    wake.set_nonblocking(true)?;
    let shared = Arc::new(Shared::new(wake));
    subscribe(&network, &options.from, &shared)?;
    let outcome = std::thread::scope(|scope| {
        let named = |name: &str| std::thread::Builder::new().name(name.to_owned());
        let (running, stop) = channel::<()>();
        let (to_unpack, to_ask) = (Arc::clone(&shared), Arc::clone(&shared));
        let (network, from) = (&network, options.from.as_str());
        let started =
            named("unpack").spawn_scoped(scope, move || to_unpack.unpack_large()).and_then(|_| {
                named("ask").spawn_scoped(scope, move || poll(network, from, &to_ask, &stop))
            });
        let outcome = started
            .map_err(ZenohError::from)
            .and_then(|_| publish(&mut mirror, options, &shared, &woken, shutdown));
        shared.large.close();
        drop(running);
        outcome
    });
    // What cannot be told any more is noticed by the other side's lease.
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
    options: &ReceiveOptions,
    shared: &Shared,
    mut woken: &UnixStream,
    shutdown: &Shutdown,
) -> Result<(), ZenohError> {
    let endpoints = options.endpoints.to_string();
    let mut told = Instant::now();
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
        let silence = shared.remote().silence(&options.from, &endpoints, Instant::now());
        if let Some(cause) = silence {
            mirror.tell_silence(&cause)?;
        }
        if told.elapsed() >= TELL_PERIOD {
            told = Instant::now();
            tell(shared);
        }
    }
    Ok(())
}

/// What was missed, for the log.
fn tell(shared: &Shared) {
    let remote = shared.remote();
    let lost: Vec<String> = Kind::ALL
        .into_iter()
        .filter(|kind| remote.lost(*kind) > 0)
        .map(|kind| format!("{kind:?} {}", remote.lost(kind)))
        .collect();
    let clock = remote.clock.uncertainty_nanos();
    let clock = clock.map_or("by CLOCK_REALTIME".to_owned(), |nanos| {
        format!("known to {:.1} ms", nanos as f64 * 1e-6)
    });
    tracing::info!(
        "lost: [{}]; refused {}; the robot's clock is {clock}",
        lost.join(", "),
        remote.refused
    );
}
