//! Rows about configuration, output, trajectories and limits.

use super::{Row, row};

pub const CONFIGURATION: &[Row] = &[
    row(
        "a file that is not there",
        "",
        "semidense --config none.toml run",
        1,
        &["none.toml", "--config"],
    ),
    row("a file that never ends", "", "semidense --config /dev/zero run", 1, &["a device"]),
    row(
        "a pipe that nobody writes to",
        "mkfifo pipe",
        "semidense --config pipe run",
        1,
        &["a named pipe"],
    ),
    row("a folder", "", "semidense --config recording run", 1, &["a folder"]),
    row(
        "a file that is too large",
        "truncate -s 3M large.toml",
        "semidense --config large.toml run",
        1,
        &["larger than"],
    ),
    row("not TOML", "echo '[[[' > bad.toml", "semidense --config bad.toml run", 1, &["bad.toml:1"]),
    row(
        "a key that is not known",
        "",
        "semidense run --set mapper.thread=1",
        1,
        &["unknown key `mapper.thread`"],
    ),
    row(
        "a value out of its range",
        "",
        "semidense run --set mapper.threads=1000",
        1,
        &["0 to 256"],
    ),
    row(
        "a value of another kind",
        "",
        "semidense run --set tracker.deadline_ms=soon",
        1,
        &["expected a number"],
    ),
    row("an instance that is no name", "", "semidense run --instance a/b", 1, &["a/b"]),
    row("a word that is not a log level", "", "semidense run --log loud", 1, &["--log loud"]),
    row("an option that is not known", "", "semidense run --fast", 2, &["--fast"]),
];

pub const OUTPUT: &[Row] = &[
    row(
        "a file in the place of the folder",
        "touch file",
        "semidense run recording --output file",
        1,
        &["file"],
    ),
    row(
        "a folder below a file",
        "touch file",
        "semidense replay recording --output file/x",
        1,
        &["file/x"],
    ),
    row(
        "a folder that cannot be written",
        "",
        "semidense replay recording --output /proc/x",
        1,
        &["/proc/x"],
    ),
    row("a dataset below a file", "touch file", "semidense simulate --output file/x", 1, &["file"]),
    row(
        "a dataset into a folder with something in it",
        "",
        "semidense simulate --output recording",
        1,
        &["recording"],
    ),
    row(
        "a full standard output",
        "",
        "semidense evaluate recording/groundtruth.txt recording/groundtruth.txt > /dev/full",
        1,
        &["standard output"],
    ),
];

pub const TRAJECTORIES: &[Row] = &[
    row(
        "an estimate that is not there",
        "",
        "semidense evaluate none.txt recording/groundtruth.txt",
        1,
        &["none.txt"],
    ),
    row("a folder", "", "semidense evaluate recording recording/groundtruth.txt", 1, &["a folder"]),
    row(
        "a file that never ends",
        "",
        "semidense evaluate /dev/zero recording/groundtruth.txt",
        1,
        &["a device"],
    ),
    row(
        "a pipe that nobody writes to",
        "mkfifo pipe",
        "semidense evaluate pipe recording/groundtruth.txt",
        1,
        &["a named pipe"],
    ),
    row(
        "an empty file",
        "touch empty",
        "semidense evaluate empty recording/groundtruth.txt",
        1,
        &["empty has no poses"],
    ),
    row(
        "a line with too few numbers",
        "echo '1 2 3' > e",
        "semidense evaluate e recording/groundtruth.txt",
        1,
        &["e:1: 3 columns"],
    ),
    row(
        "something that is not a number",
        "echo '1 0 nan 0 0 0 0 1' > e",
        "semidense evaluate e recording/groundtruth.txt",
        1,
        &["'nan'"],
    ),
    row(
        "trajectories of other times",
        "printf '1 0 0 0 0 0 0 1\\n2 0 0 0 0 0 0 1\\n3 1 0 0 0 0 0 1\\n' > e; sed 's/^[0-9]/9/' e > f",
        "semidense evaluate e f",
        1,
        &["e against f"],
    ),
    row(
        "a sensor file that is not there",
        "",
        "semidense evaluate recording/groundtruth.txt recording/groundtruth.txt --sensor none.yaml",
        1,
        &["none.yaml"],
    ),
    row(
        "a sensor file that is none",
        "",
        "semidense evaluate recording/groundtruth.txt recording/groundtruth.txt --sensor rig.toml",
        1,
        &["rig.toml, line 1"],
    ),
];

pub const LIMITS: &[Row] = &[
    row(
        "12 open files",
        "",
        "ulimit -n 12; semidense run recording",
        1,
        &["only 12 open files", "ulimit -n"],
    ),
    row(
        "32 open files",
        "",
        "ulimit -n 32; semidense run recording",
        1,
        &["only 32 open files", "ulimit -n"],
    ),
    row(
        "100 MB of address space",
        "",
        "ulimit -v 100000; semidense run recording",
        1,
        &["address space", "ulimit -v"],
    ),
    row(
        "a runtime folder with a long path",
        "",
        "SEMIDENSE_ROOT=/tmp/$(printf 'x%.0s' {1..60}) semidense status",
        1,
        &["at most 48 bytes"],
    ),
    row(
        "a runtime folder that is a file",
        "touch file",
        "cd /; SEMIDENSE_ROOT=$OLDPWD/file semidense run sim",
        1,
        &["file", "SEMIDENSE_ROOT"],
    ),
    row("nothing that runs", "", "semidense status --once", 1, &["nothing is running"]),
];
