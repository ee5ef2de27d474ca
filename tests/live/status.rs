//! `semidense status --watch`: it waits for a run, follows it and the next, and ends with Ctrl-C.

use std::io::{BufRead, BufReader};
use std::process::Child;
use std::sync::mpsc::{Receiver, channel};
use std::time::Instant;

use crate::support::{Rig, WATCH_DOG, end, finish, signal};
use rustix::process::Signal;
use serde_json::Value;

/// The lines of a child's standard output as they arrive.
fn lines(child: &mut Child) -> Receiver<String> {
    let stdout = BufReader::new(child.stdout.take().unwrap());
    let (tell, told) = channel();
    std::thread::spawn(move || {
        stdout.lines().map_while(Result::ok).try_for_each(|line| tell.send(line)).ok()
    });
    told
}

fn next(lines: &Receiver<String>) -> Value {
    let line = lines.recv_timeout(WATCH_DOG).unwrap();
    serde_json::from_str(&line).unwrap_or_else(|error| panic!("{error}: {line}"))
}

/// The first object that satisfies `is_right`.
fn until(lines: &Receiver<String>, is_right: impl Fn(&Value) -> bool) -> Value {
    let begin = Instant::now();
    loop {
        let value = next(lines);
        if is_right(&value) {
            return value;
        }
        assert!(begin.elapsed() < WATCH_DOG, "waited in vain: {value}");
    }
}

#[test]
fn watching_continues_past_the_ends_of_runs_with_an_object_per_line() {
    let rig = Rig::new();
    let mut watch = rig.command(&["status", "--watch", "--json"]).spawn().unwrap();
    let said = lines(&mut watch);
    let nothing = next(&said);
    assert_eq!((&nothing["ended"], &nothing["capture"]), (&true.into(), &Value::Null));
    for _ in 0..2 {
        let child = rig.run(60, &["--live", "--source", "loop:1000000:15:sim"]).spawn().unwrap();
        let on = until(&said, |value| value["tracker"]["frames"].as_u64() > Some(5));
        assert_eq!((&on["ended"], &on["instance"]), (&false.into(), &"semidense".into()));
        let mut late = rig.command(&["status", "--json"]).spawn().unwrap();
        let first = next(&lines(&mut late));
        assert!(first["pose"].is_object(), "the first update lacks the pose: {first}");
        signal(&late, Signal::INT);
        end(late);
        signal(&child, Signal::INT);
        assert_eq!(end(child).status.code(), Some(130));
        let off = until(&said, |value| value["ended"] == true);
        let keys = |value: &Value| value.as_object().unwrap().keys().cloned().collect::<Vec<_>>();
        assert_eq!((keys(&off), keys(&nothing)), (keys(&on), keys(&on)));
    }
    signal(&watch, Signal::INT);
    let ended = end(watch);
    assert!(ended.status.success() && ended.stderr.is_empty(), "{}", ended.stderr);
}

#[test]
fn watching_reports_as_text_that_nothing_runs() {
    let rig = Rig::new();
    let mut watch = rig.command(&["status", "--watch"]).spawn().unwrap();
    let said = lines(&mut watch);
    for _ in 0..2 {
        let line = said.recv_timeout(WATCH_DOG).unwrap();
        assert!(line.starts_with("nothing is running as instance `semidense`"), "{line}");
    }
    signal(&watch, Signal::INT);
    assert!(end(watch).status.success());
    let both = finish(rig.command(&["status", "--watch", "--once"]));
    assert_eq!(both.status.code(), Some(2), "{}", both.stderr);
    let without = finish(rig.command(&["status"]));
    assert_eq!(without.status.code(), Some(1), "{}", without.stderr);
}
