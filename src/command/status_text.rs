//! Output of `semidense status`: a table that fits the terminal, and a legend.

use serde_json::Value;

use crate::slam::counted::counted;

/// A column of the table.
struct Column {
    heading: &'static str,
    /// Widest text expected.
    width: usize,
    /// On a narrow terminal, columns with a higher rank are dropped first.
    rank: u8,
    /// JSON pointer to the value in a process's object, and its decimals.
    value: (&'static str, usize),
    legend: &'static str,
}

const fn column(
    heading: &'static str,
    width: usize,
    rank: u8,
    value: (&'static str, usize),
    legend: &'static str,
) -> Column {
    Column { heading, width, rank, value, legend }
}

/// Everything that can be shown about a process, in the order of the columns.
const COLUMNS: [Column; 8] = [
    column("frames", 8, 2, ("/frames", 0), "handled since the process started"),
    column("rate", 6, 1, ("/rate_hz", 1), "frames per second"),
    column("drop", 5, 4, ("/dropped", 0), "skipped for a newer frame"),
    column("late", 5, 3, ("/deadline_misses", 0), LATE_LEGEND),
    column("p50", 7, 5, ("/latency_ms/p50", 2), P50_LEGEND),
    column("p99", 7, 2, ("/latency_ms/p99", 2), "99th percentile of the same"),
    column("MiB", 5, 6, ("/peak_rss_mb", 0), "peak memory"),
    column("up", 7, 7, ("/uptime_secs", 0), "seconds since the process started"),
];
const LATE_LEGEND: &str =
    "poses published after the deadline, which counts from their frame's arrival";
const P50_LEGEND: &str =
    "median ms: capture from stamp to sending, tracker from stamp to pose, mapper per frame";

/// Name and state, before the columns: `capture  not running`.
const NAME_WIDTH: usize = 8;
const STATE_WIDTH: usize = 12;

/// The lines of one update, wrapped at words to `width` columns.
pub fn status_text(look: &Value, width: usize) -> String {
    let mut lines = wrapped(&headline(look), width, 0);
    if let Some(pose) = pose_line(&look["pose"]) {
        lines.extend(wrapped(&pose, width, 2));
    }
    let columns = fitting(width);
    let mut heading = format!("{:NAME_WIDTH$} {:STATE_WIDTH$}", "process", "state");
    for column in &columns {
        heading += &format!(" {:>1$}", column.heading, column.width);
    }
    lines.push(heading.trim_end().to_owned());
    for name in ["capture", "tracker", "mapper"] {
        lines.extend(process_lines(name, &look[name], &columns, width));
    }
    let legend: Vec<String> =
        columns.iter().map(|c| format!("{}: {}", c.heading, c.legend)).collect();
    lines.extend(wrapped(&legend.join("; "), width, 0));
    lines.join("\n") + "\n"
}

/// One line for each column, for `--help`.
pub fn legend() -> String {
    let mut text = "Columns (fewer on a narrow terminal):\n  state   as the process reports it; or `stopped` by a signal, `silent` for 3 s, `not running`\n".to_owned();
    for column in &COLUMNS {
        text += &format!("  {:7} {}\n", column.heading, column.legend);
    }
    text += "Below the mapper: joint estimates of keyframes that entered the map, of them those merged with a map that had newer keyframes, and those dropped because the map had changed.\n";
    text + "Exits when all processes of the run have ended."
}

/// The columns that fit, chosen by importance.
fn fitting(width: usize) -> Vec<&'static Column> {
    let mut columns: Vec<&Column> = COLUMNS.iter().collect();
    let needed = |columns: &[&Column]| {
        NAME_WIDTH + 1 + STATE_WIDTH + columns.iter().map(|c| c.width + 1).sum::<usize>()
    };
    while needed(&columns) > width {
        let Some(least) = (0..columns.len()).max_by_key(|&i| columns[i].rank) else { break };
        columns.remove(least);
    }
    columns
}

/// Instance, source, time and keyframes.
fn headline(look: &Value) -> String {
    let text = |key: &str| look[key].as_str().unwrap_or_default().to_owned();
    let mut parts = vec![text("instance")];
    parts.extend(Some(text("source")).filter(|source| !source.is_empty()));
    parts.extend(look["uptime_secs"].as_f64().map(|secs| format!("up {}", clock(secs))));
    parts.push(match look["keyframes"].as_u64() {
        None => "keyframes unknown".to_owned(),
        Some(count) => counted(count, "keyframe"),
    });
    parts.join(", ")
}

/// Minutes and seconds, with hours if there are any.
fn clock(secs: f64) -> String {
    let secs = secs.max(0.0) as u64;
    let (hours, minutes, secs) = (secs / 3600, secs / 60 % 60, secs % 60);
    if hours > 0 {
        format!("{hours}:{minutes:02}:{secs:02}")
    } else {
        format!("{minutes}:{secs:02}")
    }
}

/// Last pose: state, position if it has one, age.
fn pose_line(pose: &Value) -> Option<String> {
    let state = pose["state"].as_str()?;
    let age = pose["age_secs"].as_f64()?;
    let age =
        if age < 10.0 { format!("{:.0} ms ago", 1e3 * age) } else { format!("{age:.0} s ago") };
    let at: Option<Vec<f64>> = pose["position"]
        .as_array()
        .and_then(|position| position.iter().map(Value::as_f64).collect());
    let position = match at.as_deref() {
        Some([x, y, z]) => format!(", x {x:.2} y {y:.2} z {z:.2} map units"),
        _ => String::new(),
    };
    Some(format!("last pose {state}{position}, {age}"))
}

/// A process: its row, the reason for its state, and its warning.
fn process_lines(name: &str, row: &Value, columns: &[&Column], width: usize) -> Vec<String> {
    let state = row["state"].as_str().unwrap_or("not running");
    let mut line = format!("{name:NAME_WIDTH$} {state:STATE_WIDTH$}");
    for column in columns.iter().filter(|_| !row.is_null()) {
        let (place, digits) = column.value;
        let value = row.pointer(place).and_then(Value::as_f64);
        let shown = value.map_or("-".to_owned(), |x| format!("{x:.digits$}"));
        line += &format!(" {shown:>0$}", column.width);
    }
    let mut lines = vec![line.trim_end().to_owned()];
    for (key, label) in [("cause", ""), ("warning", "warning: ")] {
        let text = row[key].as_str().unwrap_or_default();
        if !text.is_empty() && text != state {
            lines.extend(wrapped(&format!("  {label}{text}"), width, 4));
        }
    }
    let lines_of = [joint_line(&row["adjustments"]), loop_line(&row["loops"])];
    lines.extend(lines_of.iter().flatten().flat_map(|line| wrapped(line, width, 4)));
    lines
}

/// Figures of the mapper's joint estimation of keyframes; `None` before the first estimate.
fn joint_line(adjustments: &Value) -> Option<String> {
    let (p50, p99) = (&adjustments["cpu_ms"]["p50"], &adjustments["cpu_ms"]["p99"]);
    Some(format!(
        "  joint estimation of keyframes: {} entered ({} merged), {} dropped; median {:.1} ms, p99 {:.1} ms of a CPU",
        adjustments["entered"].as_u64()?,
        adjustments["merged"].as_u64()?,
        adjustments["dropped"].as_u64()?,
        p50.as_f64()?,
        p99.as_f64()?,
    ))
}

/// Outcome of the mapper's search for loops; `None` before the first.
fn loop_line(loops: &Value) -> Option<String> {
    let of = |key: &str| loops[key].as_u64();
    of("searched").filter(|searched| *searched > 0)?;
    Some(format!(
        "  loops: {} searched, {} closed, {} held already, {} joined; refused: {}, {} \
         against the drift, {} unconfirmed, {} inconsistent",
        counted(of("searched")?, "keyframe"),
        of("closed")?,
        of("held")?,
        counted(of("joined")?, "epoch"),
        counted(of("other_places")?, "other place"),
        of("against_drift")?,
        of("unconfirmed")?,
        of("inconsistent")?,
    ))
}

/// Lines of at most `width` characters, broken at spaces; all but the first indented. Only a word longer than
/// a line is cut.
fn wrapped(text: &str, width: usize, indent: usize) -> Vec<String> {
    let width = width.max(indent + 8);
    let lead: String = text.chars().take_while(|c| *c == ' ').collect();
    let (mut lines, mut line) = (Vec::new(), lead);
    let mut is_begun = false;
    for word in text.split_whitespace() {
        let mut word = word;
        let length = |text: &str| text.chars().count();
        if is_begun && length(&line) + 1 + length(word) > width {
            lines.push(std::mem::replace(&mut line, " ".repeat(indent)));
            is_begun = false;
        }
        while length(&line) + length(word) > width && !is_begun {
            let room = width - length(&line);
            let cut = word.char_indices().nth(room).map_or(word.len(), |(at, _)| at);
            line.push_str(&word[..cut]);
            lines.push(std::mem::replace(&mut line, " ".repeat(indent)));
            word = &word[cut..];
        }
        if is_begun {
            line.push(' ');
        }
        line.push_str(word);
        is_begun = true;
    }
    if is_begun {
        lines.push(line);
    }
    lines
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    fn look() -> Value {
        let process = json!({
            "state": "running", "cause": "degraded: little of the keyframe is in view",
            "frames": 123_456, "rate_hz": 29.97, "dropped": 12, "deadline_misses": 3, "uptime_secs": 4120.0,
            "latency_ms": {"p50": 3.25, "p99": 12.5}, "peak_rss_mb": 182.0,
            "adjustments": {"entered": 41, "merged": 3, "dropped": 1, "cpu_ms": {"p50": 21.25, "p99": 60.5}},
            "loops": {"searched": 20, "closed": 2, "held": 3, "joined": 1, "other_places": 5, "against_drift": 4,
                      "unconfirmed": 3, "inconsistent": 2},
            "warning": "real-time scheduling was refused; raise RLIMIT_RTPRIO to 70 for this user",
        });
        json!({
            "instance": "front", "source": "tum:/data/a-folder-with-a-rather-long-name/and/below",
            "uptime_secs": 4125.0, "keyframes": 14, "capture": process, "tracker": process, "mapper": null,
            "pose": {"state": "tracking", "position": [1.2, -0.05, 3.0], "age_secs": 0.021},
        })
    }

    #[test]
    fn no_line_is_wider_than_the_terminal_and_no_word_is_cut() {
        let words = |text: &str| text.split_whitespace().map(str::to_owned).collect::<Vec<_>>();
        for width in [120, 80, 60, 45] {
            let text = status_text(&look(), width);
            for line in text.lines() {
                assert!(line.chars().count() <= width, "{width}: {line}");
            }
            let warning =
                "real-time scheduling was refused; raise RLIMIT_RTPRIO to 70 for this user";
            let shown = words(&text).join(" ");
            assert!(shown.contains(warning), "{width}: {text}");
            for part in [
                "front,",
                "up 1:08:45, 14 keyframes",
                "x 1.20 y -0.05 z 3.00",
                "21 ms ago",
                "mapper not running",
                "20 keyframes searched, 2 closed, 3 held already, 1 epoch joined; refused: 5 other places, 4 against",
                "3 unconfirmed, 2 inconsistent",
                "41 entered (3 merged), 1 dropped; median 21.2 ms, p99 60.5 ms of a CPU",
            ] {
                assert!(shown.contains(part), "{width}, {part}: {text}");
            }
            assert!(shown.contains("rate: frames per second"), "{text}");
        }
        assert!(status_text(&look(), 80).contains("12.50"));
        assert!(status_text(&look(), 120).contains("MiB: peak memory"));
        assert!(status_text(&look(), 45).contains("30.0"));
    }

    #[test]
    fn a_pose_without_a_position_has_its_state_and_age() {
        let mut look = look();
        for (state, is_shown) in [("degraded", true), ("lost", false)] {
            look["pose"]["state"] = json!(state);
            if !is_shown {
                look["pose"]["position"] = Value::Null;
            }
            let text = status_text(&look, 120);
            assert!(text.contains(&format!("last pose {state}, ")), "{text}");
            assert!(text.contains("21 ms ago") && text.contains("x 1.20") == is_shown, "{text}");
        }
    }

    #[test]
    fn loops_are_not_mentioned_before_a_search_for_them() {
        let mut look = look();
        look["tracker"]["loops"]["searched"] = json!(0);
        look["capture"]["loops"] = Value::Null;
        assert!(!status_text(&look, 120).contains("loops:"));
    }

    #[test]
    fn a_word_longer_than_a_line_is_cut_without_loss() {
        let lines = wrapped("a bcdefghijklmnopqrstuvwxyz z", 12, 2);
        assert!(lines.iter().all(|line| line.chars().count() <= 12), "{lines:?}");
        assert_eq!(lines.concat().replace(' ', ""), "abcdefghijklmnopqrstuvwxyzz");
        assert_eq!(wrapped("", 10, 2), Vec::<String>::new());
    }
}
