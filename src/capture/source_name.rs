//! Names of sources on the command line, and recognition of a path without a kind.

use std::ffi::{OsStr, OsString};
use std::fmt;
use std::io::ErrorKind;
use std::ops::RangeInclusive;
use std::os::unix::ffi::OsStrExt;
use std::os::unix::fs::FileTypeExt;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use crate::capture::input_file::{entries, has_ending};
use crate::capture::source_error::SourceError;
use crate::capture::{euroc, image_folder, tum};

/// The forms of a source name, for errors and help.
pub const SOURCE_FORMS: &str = "a folder (TUM, EuRoC or images), sim[:SCENE], tum:DIR, euroc:DIR, images:DIR, mcap:FILE[:TOPIC], v4l:DEVICE, ros2:TOPIC, stream:SOCKET and loop:FRAMES:HZ:SOURCE";

/// Extensions of video files.
const VIDEO_ENDINGS: [&str; 12] =
    ["mp4", "m4v", "mov", "mkv", "webm", "avi", "mpg", "mpeg", "ts", "wmv", "ogv", "h264"];
/// Extensions of archives in which recordings are packed.
const ARCHIVE_ENDINGS: [&str; 6] = ["zip", "tgz", "gz", "tar", "7z", "xz"];
/// Extensions of ROS recordings.
const BAG_ENDINGS: [&str; 2] = ["bag", "db3"];
/// Rates at which a source can be repeated, frames per second.
pub const LOOP_RATES_HZ: RangeInclusive<f64> = 0.01..=10_000.0;
/// Maximum number of a folder's entries that an error lists.
const MAX_LISTED: usize = 6;

/// The name of a source, as given on the command line.
#[derive(Debug, Clone, PartialEq)]
pub enum SourceName {
    /// `sim[:SCENE]`: the simulator.
    Simulator {
        /// The scene, if one is named.
        scene: Option<String>,
    },
    /// `tum:DIR`: a recording in the layout of TUM RGB-D.
    Tum(PathBuf),
    /// `euroc:DIR`: a recording in the layout of EuRoC (ASL).
    Euroc(PathBuf),
    /// `images:DIR`: a folder of images.
    Images(PathBuf),
    /// `mcap:FILE[:TOPIC]`: a recording of ours, or a ROS 2 bag.
    Mcap {
        /// The file.
        file: PathBuf,
        /// The topic of the images, if one is named.
        topic: Option<String>,
    },
    /// `v4l:DEVICE`: a camera, by its path, its number or the name that udev gives it.
    Camera(String),
    /// `stream:PATH`: a socket that another program sends frames to.
    Stream(PathBuf),
    /// `ros2:TOPIC`: images of a ROS 2 topic.
    Ros2(String),
    /// `loop:FRAMES:HZ:SOURCE`: a recording played back and forth, for benchmarks and soak tests.
    Looped {
        /// Total number of frames.
        num_frames: u64,
        /// Frames per second.
        rate_hz: f64,
        /// The source that is repeated.
        inner: Box<SourceName>,
    },
}

impl SourceName {
    /// Whether frames arrive at their own pace, whether or not they are read.
    pub fn is_camera(&self) -> bool {
        matches!(self, Self::Camera(_) | Self::Stream(_) | Self::Ros2(_))
    }

    /// The folder of a recording; `None` for anything else.
    pub fn folder(&self) -> Option<&Path> {
        match self {
            Self::Tum(folder) | Self::Euroc(folder) | Self::Images(folder) => Some(folder),
            Self::Looped { inner, .. } => inner.folder(),
            _ => None,
        }
    }

    /// Parses a name: `kind:place`, or a path, whose layout is recognised. A path may contain any bytes.
    pub fn parse(name: &OsStr) -> Result<Self, SourceError> {
        let error = |problem: &str| name_error(name, problem);
        let bytes = name.as_bytes();
        let (kind, rest) = match bytes.iter().position(|&byte| byte == b':') {
            Some(colon) => (&bytes[..colon], Some(OsStr::from_bytes(&bytes[colon + 1..]))),
            None => (bytes, None),
        };
        let rest = rest.filter(|rest| !rest.is_empty());
        let text = |rest: Option<&OsStr>| match rest.map(OsStr::to_str) {
            Some(None) => Err(error("its name is not text")),
            Some(Some(text)) => Ok(Some(text.to_owned())),
            None => Ok(None),
        };
        let place = |missing: &str| rest.map(PathBuf::from).ok_or_else(|| error(missing));
        let named = |missing: &str| text(rest)?.ok_or_else(|| error(missing));
        let no_folder = "the folder is missing";
        match kind {
            b"loop" => text(rest)?
                .and_then(|text| parse_loop(&text))
                .unwrap_or_else(|| Err(error("write loop:FRAMES:HZ:SOURCE, as loop:9000:30:sim"))),
            // A folder may have the name of a kind.
            b"tum" | b"euroc" | b"images" if bytes == kind && Path::new(name).is_dir() => {
                recognise(Path::new(name))
            }
            b"sim" if bytes == b"sim:" => Err(error("the scene's name is missing")),
            b"sim" => Ok(Self::Simulator { scene: text(rest)? }),
            b"tum" => place(no_folder).map(Self::Tum),
            b"euroc" => place(no_folder).map(Self::Euroc),
            b"images" => place(no_folder).map(Self::Images),
            b"mcap" => parse_mcap(&place("the file is missing, as in mcap:run.mcap")?),
            b"v4l" => named("the device is missing, as in v4l:/dev/video0").map(Self::Camera),
            b"stream" if bytes != kind => {
                place("the socket's path is missing, as in stream:/run/semidense/front.frames")
                    .map(Self::Stream)
            }
            b"ros2" if bytes != kind => {
                named("the topic is missing, as in ros2:/camera/image_raw").map(Self::Ros2)
            }
            _ => recognise(Path::new(name)),
        }
    }

    /// The name as an argument of another process, byte for byte.
    pub fn to_os_string(&self) -> OsString {
        fn with(kind: &str, place: impl AsRef<OsStr>) -> OsString {
            let mut name = OsString::from(kind);
            name.push(place);
            name
        }
        match self {
            Self::Simulator { scene: None } => OsString::from("sim"),
            Self::Simulator { scene: Some(scene) } => with("sim:", scene),
            Self::Tum(folder) => with("tum:", folder),
            Self::Euroc(folder) => with("euroc:", folder),
            Self::Images(folder) => with("images:", folder),
            Self::Mcap { file, topic } => {
                let mut name = with("mcap:", file);
                topic.iter().for_each(|topic| name.push(format!(":{topic}")));
                name
            }
            Self::Camera(device) => with("v4l:", device),
            Self::Stream(path) => with("stream:", path),
            Self::Ros2(topic) => with("ros2:", topic),
            Self::Looped { num_frames, rate_hz, inner } => {
                with(&format!("loop:{num_frames}:{rate_hz}:"), inner.to_os_string())
            }
        }
    }

    /// Whether the folder has the list that identifies its layout, or an image.
    pub(super) fn has_layout(&self) -> bool {
        match self {
            Self::Tum(folder) => folder.join(tum::FRAME_LIST).exists(),
            Self::Euroc(folder) => euroc::frame_list(folder).exists(),
            Self::Images(folder) => image_folder::has_images(folder),
            _ => false,
        }
    }

    /// Returns the recording in a folder, recognised by its layout.
    pub(super) fn of_folder(folder: &Path) -> Option<Self> {
        [Self::Tum, Self::Euroc, Self::Images]
            .into_iter()
            .map(|form| form(folder.to_owned()))
            .find(Self::has_layout)
    }
}

impl FromStr for SourceName {
    type Err = SourceError;

    fn from_str(name: &str) -> Result<Self, SourceError> {
        Self::parse(OsStr::new(name))
    }
}

impl fmt::Display for SourceName {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}", self.to_os_string().display())
    }
}

fn name_error(name: &OsStr, problem: &str) -> SourceError {
    SourceError::Name { name: name.to_string_lossy().into_owned(), problem: problem.to_owned() }
}

/// Parses `FILE[:TOPIC]`: a topic begins with `/`, and an existing path has no topic. A folder means its only file.
fn parse_mcap(whole: &Path) -> Result<SourceName, SourceError> {
    let bytes = whole.as_os_str().as_bytes();
    let colon = bytes.windows(2).rposition(|pair| pair == b":/").filter(|_| !whole.exists());
    let (file, topic) = match colon {
        Some(colon) => (Path::new(OsStr::from_bytes(&bytes[..colon])), Some(&bytes[colon + 1..])),
        None => (whole, None),
    };
    let topic = topic.map(|topic| String::from_utf8_lossy(topic).into_owned());
    let file = if file.is_dir() { only_mcap(file)? } else { file.to_owned() };
    Ok(SourceName::Mcap { file, topic })
}

/// Returns the only MCAP file of a folder, as `ros2 bag record` creates it.
fn only_mcap(folder: &Path) -> Result<PathBuf, SourceError> {
    let files = mcap_files(folder);
    match &files[..] {
        [file] => Ok(file.clone()),
        [] => Err(name_error(folder.as_os_str(), "there is no .mcap file in this folder")),
        [first, ..] => {
            let problem = format!(
                "there are {} .mcap files in this folder: name one, as mcap:{}",
                files.len(),
                first.display()
            );
            Err(name_error(folder.as_os_str(), &problem))
        }
    }
}

/// The MCAP files of a folder, sorted by name.
fn mcap_files(folder: &Path) -> Vec<PathBuf> {
    let mut files = entries(folder);
    files.retain(|path| has_ending(path, &["mcap"]));
    files
}

/// Parses `FRAMES:HZ:SOURCE`; `None` if it has another form.
fn parse_loop(text: &str) -> Option<Result<SourceName, SourceError>> {
    let mut parts = text.splitn(3, ':');
    let num_frames = parts.next()?.parse().ok().filter(|&frames| frames > 0)?;
    let rate_hz = parts.next()?.parse().ok().filter(|rate| LOOP_RATES_HZ.contains(rate))?;
    let inner = parts.next().filter(|inner| !inner.starts_with("loop"))?.parse();
    let looped = |inner| SourceName::Looped { num_frames, rate_hz, inner: Box::new(inner) };
    Some(inner.map(looped))
}

/// Recognises the source at a path; the error names what is there instead and what to do.
fn recognise(path: &Path) -> Result<SourceName, SourceError> {
    let error = |problem: String| Err(name_error(path.as_os_str(), &problem));
    let kind = match std::fs::metadata(path) {
        Ok(metadata) => metadata.file_type(),
        Err(_) if has_kind(path) => {
            return error(format!("unknown kind; sources are {SOURCE_FORMS}"));
        }
        Err(cause) if cause.kind() == ErrorKind::NotFound => return Err(missing_path(path)),
        Err(cause) => return error(cause.to_string()),
    };
    if kind.is_dir() {
        return match SourceName::of_folder(path) {
            Some(known) => Ok(known),
            None if mcap_files(path).is_empty() => error(no_recording_in(path)),
            None => only_mcap(path).map(|file| SourceName::Mcap { file, topic: None }),
        };
    }
    if kind.is_file() && has_ending(path, &["mcap"]) {
        return Ok(SourceName::Mcap { file: path.to_owned(), topic: None });
    }
    let is_video_device = || path.to_string_lossy().contains("video") && kind.is_char_device();
    match path.to_str() {
        Some(device) if is_video_device() => Ok(SourceName::Camera(device.to_owned())),
        _ if kind.is_file() && has_ending(path, &VIDEO_ENDINGS) => Err(video(path)),
        _ => error(file_advice(path)),
    }
}

/// Whether a name reads like `kind:place` with an unknown kind, and not like a path.
fn has_kind(name: &Path) -> bool {
    let name = name.to_string_lossy();
    name.split_once(':').is_some_and(|(kind, _)| !kind.is_empty() && !kind.contains(['/', '.']))
}

/// The error of a path that does not exist, with a hint: the number or the device of a camera is often tried.
fn missing_path(path: &Path) -> SourceError {
    let name = path.to_string_lossy();
    let number = name.strip_prefix("/dev/video").unwrap_or(&name);
    let is_number = !number.is_empty() && number.bytes().all(|byte| byte.is_ascii_digit());
    let hint = match name.starts_with("/dev/") {
        _ if is_number => {
            format!("a camera is named v4l:{number} (`semidense cameras` lists the cameras)")
        }
        true => format!("a camera is named v4l:{name} (`semidense cameras` lists the cameras)"),
        false => "check the path (`semidense run --help` lists the kinds of sources)".to_owned(),
    };
    SourceError::NoPath { path: name.into_owned(), hint }
}

/// The error of a file with the extension of a video, with the command that converts it to a folder.
fn video(path: &Path) -> SourceError {
    let (video, frames) = (quoted(path), quoted(&path.with_extension("frames")));
    let command = format!(
        "mkdir {frames} && ffmpeg -i {video} -fps_mode passthrough -pix_fmt gray {frames}/%06d.png && ffprobe -v error \
         -select_streams v:0 -show_entries frame=pts_time -of default=nw=1:nk=1 {video} > {frames}/times.txt"
    );
    SourceError::Video { path: path.to_string_lossy().into_owned(), command }
}

/// Advice for a file that is named instead of a folder.
fn file_advice(path: &Path) -> String {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let folder = folder.unwrap_or(Path::new("."));
    let is_list =
        path.file_name().is_some_and(|name| name == tum::FRAME_LIST || name == "data.csv");
    if has_ending(path, &ARCHIVE_ENDINGS) {
        return "this is an archive: unpack it and name its folder".to_owned();
    }
    if has_ending(path, &BAG_ENDINGS) {
        return "this is a ROS bag in an older format: convert it to MCAP (`ros2 bag convert`, or `rosbags-convert` from \
                PyPI's rosbags) and name that"
            .to_owned();
    }
    if image_folder::is_called_image(path) || is_list {
        return format!("this is one file of a recording: name its folder, {}", folder.display());
    }
    format!("this is a file; name a folder with a recording; sources are {SOURCE_FORMS}")
}

/// Quotes a path for a shell.
fn quoted(path: &Path) -> String {
    format!("'{}'", path.display().to_string().replace('\'', "'\\''"))
}

/// Describes what was searched for in a folder without a recording, and what was found.
fn no_recording_in(folder: &Path) -> String {
    let entries = entries(folder);
    let inner = entries.iter().filter(|path| path.is_dir()).find_map(|p| SourceName::of_folder(p));
    let name = |path: &PathBuf| path.file_name().unwrap_or_default().to_string_lossy().into_owned();
    let mut names: Vec<String> = entries.iter().take(MAX_LISTED).map(name).collect();
    if entries.len() > MAX_LISTED {
        names.push(format!("and {} more", entries.len() - MAX_LISTED));
    }
    let found = if names.is_empty() { "nothing: it is empty".to_owned() } else { names.join(", ") };
    let hint =
        inner.map_or(String::new(), |inner| format!("; there is a recording in it: {inner}"));
    format!(
        "no recording was recognised: looked for rgb.txt (TUM), mav0/cam0/data.csv or cam0/data.csv (EuRoC) and PNG or \
         JPEG images, found {found}{hint}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_keep_every_byte_of_a_path() {
        for name in [
            &b"tum:/a/\xff\xfe:b"[..],
            b"loop:5:30:images:/x",
            b"sim:room",
            b"v4l:0",
            b"ros2:/a/b",
            b"stream:/a\xff",
        ] {
            let name = OsStr::from_bytes(name);
            assert_eq!(SourceName::parse(name).unwrap().to_os_string(), name);
        }
        assert!(SourceName::parse(OsStr::from_bytes(b"v4l:\xff")).is_err());
    }

    #[test]
    fn a_folder_is_recognised_by_its_contents() {
        let root = tempfile::tempdir().unwrap();
        let make = |file: &str| {
            let path = root.path().join(file);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(&path, png_start()).unwrap();
        };
        make("t/rgb.txt");
        make("t/rgb/1.png");
        make("e/mav0/cam0/data.csv");
        make("i/1.png");
        make("odd: ä/1.png");
        make("outer/inner/rgb.txt");
        let of = |folder: &str| SourceName::parse(root.path().join(folder).as_os_str());
        assert!(matches!(of("t"), Ok(SourceName::Tum(_))));
        assert!(matches!(of("e"), Ok(SourceName::Euroc(_))));
        assert!(matches!(of("e/mav0"), Ok(SourceName::Euroc(_))));
        assert!(matches!(of("i"), Ok(SourceName::Images(_))));
        assert!(matches!(of("odd: ä"), Ok(SourceName::Images(_))));
        let error = of("outer").unwrap_err().to_string();
        assert!(error.contains("found inner; there is a recording in it: tum:"), "{error}");
        let error = of("none").unwrap_err().to_string();
        assert!(error.starts_with("there is no such file or folder: /"), "{error}");
        assert!(error.len() < 250 && error.contains("check the path"), "{error}");
    }

    fn png_start() -> [u8; 8] {
        crate::capture::png_image::SIGNATURE
    }

    #[test]
    fn errors_for_files_say_what_to_do_with_them() {
        let folder = tempfile::tempdir().unwrap();
        for (name, words) in [
            ("it's.MP4", "this looks like a video file"),
            ("a.zip", "unpack"),
            ("a.bag", "ROS bag"),
            ("rgb.txt", "name its folder"),
            ("1.png", "name its folder"),
            ("notes", "this is a file"),
        ] {
            let path = folder.path().join(name);
            std::fs::write(&path, "x").unwrap();
            let error = SourceName::parse(path.as_os_str()).unwrap_err().to_string();
            assert!(error.contains(words) && !error.contains('\n'), "{error}");
        }
        assert_eq!(quoted(Path::new("it's")), r"'it'\''s'");
        let video = SourceName::parse(folder.path().join("it's.MP4").as_os_str()).unwrap_err();
        assert!(video.command().unwrap().starts_with("mkdir '"), "{video:?}");
    }

    #[test]
    fn a_path_that_may_mean_a_camera_gets_a_hint() {
        let told = |name: &str| missing_path(Path::new(name)).to_string();
        assert!(told("0").contains("no such file or folder: 0; a camera is named v4l:0 "));
        assert!(told("/dev/video12").contains(": /dev/video12; a camera is named v4l:12 "));
        assert!(told("/dev/camera").contains("a camera is named v4l:/dev/camera "));
        for name in ["", "walk0", "/dev-0"] {
            assert!(!told(name).contains("v4l"), "{name}");
        }
    }
}
