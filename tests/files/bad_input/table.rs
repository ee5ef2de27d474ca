//! The rows of `docs/bad-inputs.md`.

mod environment;

use environment::{CONFIGURATION, LIMITS, OUTPUT, TRAJECTORIES};

/// One bad input.
pub struct Row {
    /// Description in words.
    pub tried: &'static str,
    /// Shell commands that damage the folder.
    pub setup: &'static str,
    /// The command line, in the shell.
    pub command: &'static str,
    /// The exit code.
    pub code: i32,
    /// Words that the output must contain.
    pub words: &'static [&'static str],
}

/// Rows about one kind of input.
pub struct Section {
    /// Its heading.
    pub title: &'static str,
    /// Its rows.
    pub rows: &'static [Row],
}

pub const INTRODUCTION: &str = "\
# Bad inputs

The messages that semidense prints for invalid inputs, with its exit codes: 0 done (the message names what was left out), 1 failed, \
2 wrong command line, 3 nothing was tracked, 130 stopped by Ctrl-C. `tests/files/bad_input.rs` runs every row and fails if the \
program prints anything else; `SEMIDENSE_WRITE_DOCS=1 cargo test --release --test files bad_input` writes the page. `recording` is a folder \
in TUM layout with twenty images of 160x120 pixels, `rig.toml` the calibration of its camera, `…` the folder where the command runs, N a number \
that depends on the machine.
";

const fn row(
    tried: &'static str,
    setup: &'static str,
    command: &'static str,
    code: i32,
    words: &'static [&'static str],
) -> Row {
    Row { tried, setup, command, code, words }
}

pub const SECTIONS: &[Section] = &[
    Section { title: "Sources", rows: SOURCES },
    Section { title: "Images", rows: IMAGES },
    Section { title: "Lists", rows: LISTS },
    Section { title: "Rigs and calibrations", rows: RIGS },
    Section { title: "Cameras", rows: CAMERAS },
    Section { title: "Configuration", rows: CONFIGURATION },
    Section { title: "Output", rows: OUTPUT },
    Section { title: "Trajectories", rows: TRAJECTORIES },
    Section { title: "Limits, shared memory and the runtime folder", rows: LIMITS },
];

const SOURCES: &[Row] = &[
    row(
        "a missing folder",
        "",
        "semidense run nowhere",
        1,
        &["error: there is no such file or folder: nowhere; check the path"],
    ),
    row(
        "the number of a camera",
        "",
        "semidense run 0",
        1,
        &["no such file or folder: 0; a camera is named v4l:0"],
    ),
    row("the same with a layout", "", "semidense replay tum:nowhere", 1, &["no folder nowhere"]),
    row("an unknown kind", "", "semidense run ros:topic", 1, &["unknown kind"]),
    row("no folder after the kind", "", "semidense run euroc:", 1, &["the folder is missing"]),
    row("an unknown scene", "", "semidense run sim:moon", 1, &["sim:moon"]),
    row("an empty folder", "mkdir empty", "semidense run empty", 1, &["it is empty", "rgb.txt"]),
    row(
        "a folder with other files",
        "mkdir other; touch other/a.txt other/b.bin",
        "semidense replay other",
        1,
        &["found a.txt, b.bin"],
    ),
    row(
        "the folder above a recording",
        "mkdir outer; mv recording outer",
        "semidense run outer",
        1,
        &["there is a recording in it: tum:outer/recording"],
    ),
    row(
        "a layout other than the one named",
        "",
        "semidense run euroc:recording",
        1,
        &["looks like tum:"],
    ),
    row(
        "a video",
        "touch walk.mp4",
        "semidense run walk.mp4",
        1,
        &["this looks like a video file", "<br>mkdir 'walk.frames' && ffmpeg -i 'walk.mp4'"],
    ),
    row("an archive", "touch a.zip", "semidense replay a.zip", 1, &["unpack it"]),
    row("a ROS bag", "touch a.bag", "semidense replay a.bag", 1, &["convert it to MCAP"]),
    row(
        "a list in place of its folder",
        "",
        "semidense run recording/rgb.txt",
        1,
        &["name its folder, recording"],
    ),
    row("a loop without its numbers", "", "semidense run loop:sim", 1, &["loop:FRAMES:HZ:SOURCE"]),
    row("a source twice", "", "semidense run recording --source sim", 2, &["cannot be used"]),
    row(
        "a benchmark at an impossible rate",
        "",
        "semidense bench latency --fps 1e9 --seconds 0.001",
        1,
        &["--fps 1000000000: choose 0.01"],
    ),
    row(
        "a benchmark of a source that is repeated already",
        "",
        "semidense bench soak --source loop:9:30:sim",
        1,
        &["--source loop:9:30:sim: ", "name sim and the rate"],
    ),
    row(
        "the images of a recording",
        "",
        "semidense run recording/rgb",
        1,
        &["a folder of images in a recording: name that, tum:"],
    ),
];

const IMAGES: &[Row] = &[
    row(
        "images too small to start a map on",
        "",
        "semidense run sim --set simulator.width=40 --set simulator.height=24",
        1,
        &[
            "source `sim`: its images have 40x24 pixels, and tracking needs 32 to each side; enlarge them",
        ],
    ),
    row(
        "the same in a replay",
        "",
        "semidense replay sim --set simulator.width=40 --set simulator.height=24",
        1,
        &["source `sim`: its images have 40x24 pixels, and tracking needs 32 to each side"],
    ),
    row(
        "one truncated image",
        "halve $(image 3)",
        "semidense replay recording --output out",
        0,
        &["1 of 20 images"],
    ),
    row(
        "the same in three processes",
        "halve $(image 3)",
        "semidense run recording --output out",
        0,
        &["damaged PNG"],
    ),
    row(
        "one missing image",
        "rm $(image 2)",
        "semidense replay recording --output out",
        0,
        &["1 of 20 images"],
    ),
    row(
        "one empty image",
        "truncate -s 0 $(image 2)",
        "semidense run recording --output out",
        0,
        &["is empty"],
    ),
    row(
        "one image that is text",
        "echo hello > $(image 2)",
        "semidense run recording --output out",
        0,
        &["neither PNG nor JPEG"],
    ),
    row(
        "one image of another size",
        "semidense simulate --frames 1 --width 32 --height 32 --output small; cp small/rgb/*.png $(image 4)",
        "semidense run recording --output out",
        0,
        &["is 32x32 pixels, but the rig expects 160x120"],
    ),
    row(
        "a folder in place of an image",
        "i=$(image 5); rm $i; mkdir $i",
        "semidense run recording --output out",
        0,
        &["it is a folder"],
    ),
    row(
        "a pipe in place of an image",
        "i=$(image 5); rm $i; mkfifo $i",
        "semidense run recording --output out",
        0,
        &["a named pipe"],
    ),
    row(
        "a device in place of an image",
        "ln -sf /dev/zero $(image 1)",
        "semidense run recording --output out",
        0,
        &["a device"],
    ),
    row(
        "a dangling link",
        "ln -sf none $(image 1)",
        "semidense run recording --output out",
        0,
        &["No such file"],
    ),
    row(
        "half of the images truncated",
        "for i in $(seq 1 2 20); do halve $(image $i); done",
        "semidense replay recording --output out",
        0,
        &["10 of 20 images"],
    ),
    row(
        "a damaged image, with --strict",
        "halve $(image 3)",
        "semidense replay --strict recording",
        1,
        &["damaged PNG"],
    ),
    row(
        "a missing image in three processes, with --strict",
        "rm $(image 3)",
        "semidense run --strict recording",
        1,
        &["No such file"],
    ),
    row(
        "no usable image",
        "truncate -s 0 recording/rgb/*",
        "semidense run recording",
        1,
        &["none of its 20 images"],
    ),
    row(
        "all images of another size than the camera's",
        "echo '100 100 50 50 320 240' > recording/camera.txt",
        "semidense replay recording",
        1,
        &["none of its 20 images", "320x240"],
    ),
    row(
        "a mask of another size than the camera's images",
        "cp $(image 1) mask.png && echo '100 100 50 50 320 240' > recording/camera.txt",
        "semidense run recording --mask mask.png",
        1,
        &["mask.png", "160x120", "320x240", "draw it over one of them"],
    ),
    row(
        "a mask that does not exist",
        "",
        "semidense replay recording --mask mask.png",
        1,
        &["mask.png", "this mask cannot be read", "check the path"],
    ),
];

const LISTS: &[Row] = &[
    row(
        "a list without images",
        "echo '# none' > recording/rgb.txt",
        "semidense run recording",
        1,
        &["has no frames"],
    ),
    row(
        "stamps that go backwards",
        "change recording/rgb.txt '4{h;d};5{p;x}'",
        "semidense replay recording",
        1,
        &["line 5", "earlier"],
    ),
    row(
        "two equal stamps",
        "change recording/rgb.txt 4p",
        "semidense replay recording",
        1,
        &["line 5", "same time stamp"],
    ),
    row(
        "a line without a stamp",
        "change recording/rgb.txt '4s/^[^ ]* //'",
        "semidense run recording",
        1,
        &["line 4", "timestamp"],
    ),
    row(
        "a stamp that is not a number",
        "change recording/rgb.txt '3s/^[^ ]*/inf/'",
        "semidense run recording",
        1,
        &["line 3", "`inf`"],
    ),
    row(
        "a list that is not text",
        r"printf '1.0 \377.png\n' > recording/rgb.txt",
        "semidense replay recording",
        1,
        &["not UTF-8", "line 1"],
    ),
    row(
        "a list that is a pipe",
        "rm recording/rgb.txt; mkfifo recording/rgb.txt",
        "semidense run tum:recording",
        1,
        &["a named pipe"],
    ),
    row(
        "a list that is a folder",
        "rm recording/rgb.txt; mkdir recording/rgb.txt",
        "semidense run tum:recording",
        1,
        &["a folder"],
    ),
    row(
        "an endless list (device)",
        "ln -sf /dev/zero recording/rgb.txt",
        "semidense replay tum:recording",
        1,
        &["a device"],
    ),
    row(
        "ground truth with a bad line",
        "echo '99 1 2' >> recording/groundtruth.txt",
        "semidense replay recording",
        1,
        &["groundtruth.txt", "eight numbers"],
    ),
    row(
        "fewer stamps than images",
        "mv recording/rgb images; echo 1 > images/times.txt",
        "semidense run images --rig rig.toml",
        1,
        &["1 time stamp for 20 images"],
    ),
    row(
        "images without stamps or rate",
        "mv recording/rgb images",
        "semidense run images --rig rig.toml",
        1,
        &["no times.txt", "rate_hz"],
    ),
];

const RIGS: &[Row] = &[
    row("no calibration", "rm recording/camera.txt", "semidense run recording", 1, &["--rig FILE"]),
    row(
        "a missing rig",
        "",
        "semidense run recording --rig none.toml",
        1,
        &["none.toml", "No such file"],
    ),
    row("a rig that is a folder", "", "semidense run recording --rig recording", 1, &["a folder"]),
    row(
        "an endless rig (device)",
        "",
        "semidense replay recording --rig /dev/zero",
        1,
        &["a device"],
    ),
    row(
        "an unknown key",
        "echo 'lens = 3' >> rig.toml",
        "semidense run recording --rig rig.toml",
        1,
        &["unknown field `lens`"],
    ),
    row(
        "a calibration of ROS",
        "printf 'image_width: 160\\nimage_height: 120\\ndistortion_model: plumb_bob\\n' > camera.yaml",
        "semidense run recording --rig camera.yaml",
        1,
        &["a calibration of ROS (camera_info), not a rig", "model = \"radtan\""],
    ),
    row(
        "a value that is not a number",
        "echo 'nan 131 79.5 59.5 160 120' > recording/camera.txt",
        "semidense run recording",
        1,
        &["camera.txt", "nan"],
    ),
    row(
        "a principal point outside the image",
        "change rig.toml 's/cx = .*/cx = 999/'",
        "semidense run recording --rig rig.toml",
        1,
        &["cx = 999", "0 to 159"],
    ),
    row(
        "a field of view that is impossible for the lens",
        "change rig.toml 's/fx = .*/fx = 3/'",
        "semidense run recording --rig rig.toml",
        1,
        &["fx = 3", "field of view"],
    ),
    row(
        "an unusual field of view",
        "change rig.toml 's/f\\([xy]\\) = .*/f\\1 = 2000/'; rm recording/camera.txt",
        "semidense replay recording --rig rig.toml --output out",
        3,
        &["field of view of 4.6°"],
    ),
    row(
        "a focal length ten times that of the other",
        "change rig.toml 's/fx = .*/fx = 1310/'; rm recording/camera.txt",
        "semidense replay recording --rig rig.toml --output out --frames 2",
        3,
        &["warning: rig.toml: fx = 1310 and fy = 131", "10.0 times"],
    ),
    row(
        "the rig of another camera",
        "change rig.toml 's/f\\([xy]\\) = .*/f\\1 = 140/'",
        "semidense run recording --rig rig.toml --output out",
        0,
        &["rig.toml", "camera.txt", "differ by up to"],
    ),
    row("a rig for the simulator", "", "semidense run sim --rig rig.toml", 1, &["takes no rig"]),
];

const CAMERAS: &[Row] = &[
    row("a camera without a rig", "", "semidense run v4l:/dev/video99", 1, &["needs a rig file"]),
    row(
        "a camera in lockstep",
        "",
        "semidense run --lockstep v4l:/dev/video99 --rig rig.toml",
        1,
        &["leave out --lockstep"],
    ),
    row(
        "a camera to replay",
        "",
        "semidense replay v4l:0 --rig rig.toml",
        1,
        &["cannot be replayed", "semidense run v4l:0"],
    ),
    row(
        "a camera to repeat",
        "",
        "semidense run loop:9:30:v4l:0 --rig rig.toml",
        1,
        &["cannot be repeated"],
    ),
    row(
        "a missing camera, until Ctrl-C",
        "",
        "until_said waiting semidense run v4l:/dev/video99 --rig rig.toml --output out",
        130,
        &["waiting: there is no camera /dev/video99", "Ctrl-C stops the run"],
    ),
];
