//! When a session joins an instance and when it leaves it.

use zerocopy::FromZeros;

use super::*;
use crate::wire::port::Publisher;

/// The three processes, as far as their health.
struct Processes {
    health: Vec<Publisher<HealthMessage, ()>>,
    _poses: Publisher<PoseMessage, ()>,
    _hub: Hub,
}

impl Processes {
    fn start(place: &Place) -> Self {
        let hub = Hub::join(place, "run", Access::Member).unwrap();
        let health = HEALTH_TOPICS.iter().map(|topic| hub.publisher(topic, 1).unwrap());
        Self { health: health.collect(), _poses: hub.publisher(&POSE, 1).unwrap(), _hub: hub }
    }

    fn report(&self, state: ProcessState) {
        let message = HealthMessage { state: state.code(), ..HealthMessage::new_zeroed() };
        self.health.iter().for_each(|port| drop(port.send((), &[message])));
    }

    fn serve_late_joiners(&self) {
        self.health.iter().for_each(Publisher::serve_late_joiners);
    }
}

/// What a session reads in some time: `+` for joining, `-` for leaving, `.` for a message.
fn read(session: &mut Session, processes: Option<&Processes>, time: Duration) -> String {
    let (begun, mut said) = (Instant::now(), String::new());
    while begun.elapsed() < time {
        let take = |event: Event| {
            said.push(match event {
                Event::Joined => '+',
                Event::Left => '-',
                _ => '.',
            });
        };
        session.read(None, Duration::from_millis(10), take).unwrap();
        processes.into_iter().for_each(Processes::serve_late_joiners);
    }
    said
}

#[test]
fn a_session_joins_with_the_first_message_and_leaves_with_the_last() {
    let folder = tempfile::tempdir().unwrap();
    let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
    let mut session = Session::new(place.clone(), "reader", Wants::default());
    let long = 2 * RETRY_PERIOD;
    let processes = Processes::start(&place);
    assert_eq!(read(&mut session, Some(&processes), long), "", "topics alone are no instance");
    assert!(!session.is_joined());
    processes.report(ProcessState::Running);
    assert_eq!(read(&mut session, Some(&processes), long), "+...");
    assert!(session.is_joined());
    processes.report(ProcessState::Finished);
    // Its last messages reach late joiners, and begin nothing.
    assert_eq!(read(&mut session, Some(&processes), 2 * long), "...-");
    assert!(!session.is_joined());
    drop(processes);
    // The next run begins at once; the services are those of the first.
    let processes = Processes::start(&place);
    processes.report(ProcessState::Running);
    assert_eq!(read(&mut session, Some(&processes), 2 * long), "+...");
    drop((processes, session));
    place.tidy();
}

#[test]
fn the_end_of_a_run_that_is_read_with_the_next_run_is_not_taken_for_its_beginning() {
    let folder = tempfile::tempdir().unwrap();
    let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
    let [mut early, mut joined] =
        ["early", "joined"].map(|name| Session::new(place.clone(), name, Wants::default()));
    let processes = Processes::start(&place);
    // However busy the machine is.
    let take = |session: &mut Session, count: usize| {
        let (begun, mut said) = (Instant::now(), String::new());
        while said.len() < count && begun.elapsed() < LONGEST_SILENCE {
            said += &read(session, Some(&processes), Duration::from_millis(20));
        }
        said
    };
    joined.try_to_join().unwrap();
    processes.report(ProcessState::Running);
    assert_eq!(take(&mut joined, 4), "+...");
    // It has opened the topics and not read them yet when the run ends and the next one begins.
    early.try_to_join().unwrap();
    assert!(early.ports.is_some());
    processes.serve_late_joiners();
    processes.report(ProcessState::Finished);
    processes.report(ProcessState::Running);
    assert_eq!(take(&mut early, 4), "+...");
    assert_eq!(take(&mut joined, 11), "......-+...");
    drop((early, joined, processes));
    place.tidy();
}

#[test]
fn two_readers_do_not_keep_each_other_joined() {
    let folder = tempfile::tempdir().unwrap();
    let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
    let mut sessions =
        ["one", "other"].map(|name| Session::new(place.clone(), name, Wants::default()));
    let processes = Processes::start(&place);
    sessions.iter_mut().for_each(|session| drop(read(session, None, Duration::from_millis(50))));
    processes.report(ProcessState::Running);
    for session in &mut sessions {
        assert_eq!(read(session, Some(&processes), Duration::from_millis(50)), "+...");
    }
    // Killed: the topics stay open as long as a reader holds them.
    drop(processes);
    let mut said = [String::new(), String::new()];
    let begun = Instant::now();
    while begun.elapsed() < LONGEST_SILENCE + 4 * RETRY_PERIOD {
        for (session, said) in sessions.iter_mut().zip(&mut said) {
            said.push_str(&read(session, None, Duration::from_millis(20)));
        }
    }
    assert_eq!(said, ["-", "-"]);
    drop(sessions);
    place.tidy();
}

#[test]
fn a_topic_without_a_place_for_another_reader_is_named() {
    let folder = tempfile::tempdir().unwrap();
    let place = Place::new("rig", folder.path().to_str().unwrap()).unwrap();
    let processes = Processes::start(&place);
    let hub = Hub::join(&place, "crowd", Access::Observer).unwrap();
    let mut crowd: Vec<Subscriber<PoseMessage, ()>> = Vec::new();
    while let Ok(port) = hub.subscriber(&POSE) {
        crowd.push(port);
    }
    let mut session = Session::new(place.clone(), "reader", Wants::default());
    // However busy the machine is.
    let until = |session: &mut Session, is_done: fn(&Session, &str) -> bool| {
        let (begun, mut said) = (Instant::now(), String::new());
        while !is_done(session, &said) && begun.elapsed() < 10 * LONGEST_SILENCE {
            said += &read(session, Some(&processes), Duration::from_millis(20));
        }
        said
    };
    assert_eq!(until(&mut session, |session, _| session.obstacle().is_some()), "");
    assert!(session.obstacle().is_some_and(|reason| reason.contains("crowd")));
    crowd.pop();
    processes.report(ProcessState::Running);
    assert_eq!(until(&mut session, |_, said| said.len() == 4), "+...");
    assert_eq!(session.obstacle(), None);
    drop((session, crowd, hub, processes));
    place.tidy();
}
