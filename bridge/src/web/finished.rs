//! Loads a finished run from its folder: `keyframes.txt`, `trajectory.txt`, `map.ply`, `summary.json`.

use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};
use std::fs::{self, File};
use std::io::{self, BufRead, BufReader, Read};
use std::path::{Path, PathBuf};

use byteorder::{ByteOrder, LittleEndian};
use semidense::service::results::ply::read_surface;
use semidense::service::results::report::scene::{SceneInput, SceneKeyframe, ScenePoint, pack};
use semidense::service::trajectory_file::{
    TrajectoryFileError, nanos_from_secs, read_trajectory, read_trajectory_file,
};
use semidense::slam::geometry::intrinsics::Intrinsics;
use semidense::slam::geometry::se3::SE3;
use semidense::slam::geometry::sim3::Sim3;
use semidense::slam::trajectory::{EpochPose, StampedPose, gaps_in};
use semidense::slam::up::up_direction;
use serde_json::Value;

/// Upper limit for the header lines of a PLY.
const MAX_HEADER_LINES: usize = 256;
/// Upper limit for the bytes of one point of a PLY: ours has 40.
const MAX_POINT_BYTES: usize = 1024;
/// Points whose normals are used to find the up direction.
const MAX_NORMALS: usize = 20_000;
/// Points read at a time.
const CHUNK: usize = 4096;
/// The camera if the folder does not specify one: 640 by 480, 62° wide.
const USUAL_CAMERA: Intrinsics = Intrinsics::pinhole(640, 480, 530.0);

/// Why a run cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum FinishedError {
    /// A file that does not exist or cannot be read.
    #[error("{path}: {source}; name the folder that a run has written, for example output/latest")]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// A file with unexpected content.
    #[error("{path}: {what}")]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        what: String,
    },
    /// The trajectory could not be read.
    #[error(transparent)]
    Trajectory(#[from] TrajectoryFileError),
}

/// Reads a run's folder and packs it for the page, with at most `max_points` points.
pub fn read_run(folder: &Path, max_points: usize) -> Result<Vec<u8>, FinishedError> {
    let keyframes = read_keyframes(&folder.join("keyframes.txt"))?;
    let path = read_trajectory_file(&folder.join("trajectory.txt"))?.poses;
    // Does not contain frames that were placed afterwards.
    let online = read_trajectory(&folder.join("trajectory_online.txt")).unwrap_or_default();
    let Shown { keyframes, path, gaps } = of_longest_epoch(keyframes, &path, &online);
    let points = read_points(&folder.join("map.ply"), max_points)?;
    let intrinsics = camera(&read_summary(folder)).unwrap_or(USUAL_CAMERA);
    // Without normals, the up direction follows from the cameras alone.
    let surface = read_surface(&folder.join("map.ply"), MAX_NORMALS).unwrap_or_default();
    let up = up_direction(path.iter(), surface.iter().map(|point| point.normal));
    Ok(pack(&SceneInput {
        points: &points,
        keyframes: &keyframes,
        path: &path,
        gaps: &gaps,
        intrinsics: &intrinsics,
        up: up.map(Into::into),
        max_points,
    }))
}

/// The summary of a run; null if it has none.
pub fn read_summary(folder: &Path) -> Value {
    let bytes = fs::read(folder.join("summary.json")).unwrap_or_default();
    serde_json::from_slice(&bytes).unwrap_or_default()
}

/// The camera in the summary.
fn camera(summary: &Value) -> Option<Intrinsics> {
    let camera: Intrinsics = serde_json::from_value(summary.get("camera")?.clone()).ok()?;
    camera.is_valid().then_some(camera)
}

/// The keyframes with their epochs, sorted by stamp.
fn read_keyframes(path: &Path) -> Result<Vec<(u32, SceneKeyframe)>, FinishedError> {
    let text = fs::read_to_string(path)
        .map_err(|source| FinishedError::Read { path: path.to_owned(), source })?;
    let mut keyframes = Vec::new();
    for (number, line) in text.lines().enumerate().filter(|(_, line)| !line.starts_with('#')) {
        let keyframe = keyframe(line).ok_or_else(|| FinishedError::Content {
            path: path.to_owned(),
            what: format!("line {} is not a keyframe", number + 1),
        })?;
        keyframes.push(keyframe);
    }
    keyframes.sort_by_key(|(_, keyframe)| keyframe.nanos);
    Ok(keyframes)
}

/// The part of a run that is shown.
#[derive(Debug)]
struct Shown {
    keyframes: Vec<SceneKeyframe>,
    path: Vec<StampedPose>,
    /// Indices into the path before which a stretch of another epoch is left out.
    gaps: Vec<usize>,
}

/// Selects the epoch with the most tracked frames, which is that of map.ply: each epoch has its own origin
/// and unit. Frames that are not `online` got their pose afterwards and do not count. If `path` marks no
/// epochs and there are keyframes of several, a pose is assigned to the epoch of the newest keyframe at its
/// stamp, and poses that are not `online`, whose stamps are inconclusive, are left out.
fn of_longest_epoch(
    keyframes: Vec<(u32, SceneKeyframe)>,
    path: &[EpochPose],
    online: &[StampedPose],
) -> Shown {
    let is_marked = path.windows(2).any(|pair| pair[0].epoch != pair[1].epoch);
    let is_one = keyframes.windows(2).all(|pair| pair[0].0 == pair[1].0);
    let epoch_of = |of: &EpochPose| {
        let after = keyframes.partition_point(|(_, keyframe)| keyframe.nanos <= of.pose.nanos);
        let by_keyframe = || keyframes.get(after.saturating_sub(1)).map(|(epoch, _)| *epoch);
        if is_marked { Some(of.epoch) } else { by_keyframe() }
    };
    // A folder without published poses has only the final ones.
    let stamps: BTreeSet<i64> = online.iter().map(|pose| pose.nanos).collect();
    let is_online = |of: &EpochPose| stamps.is_empty() || stamps.contains(&of.pose.nanos);
    let mut counts: BTreeMap<u32, usize> = BTreeMap::new();
    let counted = path.iter().filter(|of| is_online(of)).filter_map(epoch_of);
    counted.for_each(|epoch| *counts.entry(epoch).or_default() += 1);
    let longest = counts.iter().max_by_key(|(epoch, count)| (**count, Reverse(**epoch)));
    let longest = longest.map(|(epoch, _)| *epoch);
    let is_all = is_one && !is_marked;
    let is_shown =
        |of: &&EpochPose| is_all || epoch_of(of) == longest && (is_marked || is_online(of));
    let shown = path.iter().filter(is_shown).map(|of| of.pose).collect();
    // Without marks, the poses left out may belong to this epoch too.
    let gaps = longest.filter(|_| is_marked).map_or_else(Vec::new, |epoch| gaps_in(path, epoch));
    let of_epoch = keyframes.iter().filter(|(epoch, _)| is_all || Some(*epoch) == longest);
    Shown { keyframes: of_epoch.map(|(_, keyframe)| *keyframe).collect(), path: shown, gaps }
}

/// Parses a line: stamp, translation, quaternion, unit, id, sequence, epoch …
fn keyframe(line: &str) -> Option<(u32, SceneKeyframe)> {
    let words: Vec<&str> = line.split_whitespace().collect();
    let numbers: Option<Vec<f64>> = words.get(1..9)?.iter().map(|word| word.parse().ok()).collect();
    let [x, y, z, qx, qy, qz, qw, scale] = numbers?.try_into().ok()?;
    let rigid = SE3::try_from_parts([qx, qy, qz, qw], [x, y, z])?;
    let place = Sim3::new(rigid, scale);
    let is_usable = scale > 0.0 && scale.is_finite();
    let keyframe = SceneKeyframe {
        keyframe_id: words.get(9)?.parse().ok()?,
        nanos: nanos_from_secs(words[0])?,
        place,
    };
    is_usable.then_some((words.get(11)?.parse().ok()?, keyframe))
}

/// Size of a number in bytes, and its decoder.
type Kind = (usize, fn(&[u8]) -> f64);

/// The number type of this name in a PLY.
fn kind_of(name: &str) -> Option<Kind> {
    let kind: Kind = match name {
        "char" | "int8" => (1, |bytes| f64::from(bytes[0] as i8)),
        "uchar" | "uint8" => (1, |bytes| f64::from(bytes[0])),
        "short" | "int16" => (2, |bytes| f64::from(LittleEndian::read_i16(bytes))),
        "ushort" | "uint16" => (2, |bytes| f64::from(LittleEndian::read_u16(bytes))),
        "int" | "int32" => (4, |bytes| f64::from(LittleEndian::read_i32(bytes))),
        "uint" | "uint32" => (4, |bytes| f64::from(LittleEndian::read_u32(bytes))),
        "float" | "float32" => (4, |bytes| f64::from(LittleEndian::read_f32(bytes))),
        "double" | "float64" => (8, LittleEndian::read_f64),
        _ => return None,
    };
    Some(kind)
}

/// Offset and encoding of a property within a point.
#[derive(Debug, Clone, Copy)]
struct Property {
    offset: usize,
    kind: Kind,
}

impl Property {
    fn read(self, point: &[u8]) -> f64 {
        let (length, read) = self.kind;
        read(&point[self.offset..][..length])
    }
}

/// Header of a binary, little-endian PLY whose first element is its vertices.
#[derive(Debug, Default)]
struct Layout {
    count: usize,
    bytes: usize,
    properties: Vec<(String, Property)>,
}

impl Layout {
    fn read(file: &mut impl BufRead) -> Result<Self, String> {
        let mut layout = Self::default();
        let (mut is_binary, mut element) = (false, String::new());
        for number in 0..MAX_HEADER_LINES {
            let mut line = String::new();
            let length = file.take(1 << 12).read_line(&mut line).map_err(|e| e.to_string())?;
            let words: Vec<&str> = line.split_whitespace().collect();
            match words.as_slice() {
                _ if length == 0 => return Err("its header has no end".to_owned()),
                ["ply"] if number == 0 => {}
                _ if number == 0 => return Err("it is not a PLY file".to_owned()),
                ["end_header"] if is_binary => return Ok(layout),
                ["end_header"] => return Err("it is not binary and little-endian".to_owned()),
                ["format", format, _] => is_binary = *format == "binary_little_endian",
                ["element", name, count] => {
                    if element.is_empty() && *name != "vertex" {
                        return Err(format!("its first element is {name} and not vertex"));
                    }
                    (*name).clone_into(&mut element);
                    if *name == "vertex" {
                        layout.count = count.parse().map_err(|_| format!("{count} points"))?;
                    }
                }
                ["property", kind, name] if element == "vertex" => layout.push(kind, name)?,
                ["property", "list", ..] if element == "vertex" => {
                    return Err("its points have lists".to_owned());
                }
                _ => {}
            }
        }
        Err("its header is too long".to_owned())
    }

    fn push(&mut self, kind: &str, name: &str) -> Result<(), String> {
        let kind = kind_of(kind).ok_or_else(|| format!("its property {name} is a {kind}"))?;
        self.properties.push((name.to_owned(), Property { offset: self.bytes, kind }));
        self.bytes += kind.0;
        if self.bytes > MAX_POINT_BYTES {
            Err("its points are too large".to_owned())
        } else {
            Ok(())
        }
    }

    fn property(&self, names: &[&str]) -> Option<Property> {
        names.iter().find_map(|name| {
            self.properties.iter().find(|(of, _)| of == name).map(|(_, property)| *property)
        })
    }
}

/// Reads the points; of more than `most`, the first ones, which cover the whole map, or every n-th if they
/// are ordered by keyframe.
fn read_points(path: &Path, most: usize) -> Result<Vec<ScenePoint>, FinishedError> {
    let content = |what: String| FinishedError::Content { path: path.to_owned(), what };
    let failed = |source| FinishedError::Read { path: path.to_owned(), source };
    let mut file = BufReader::new(File::open(path).map_err(failed)?);
    let layout = Layout::read(&mut file).map_err(content)?;
    let want = |name: &str| {
        layout.property(&[name]).ok_or_else(|| content(format!("its points have no {name}")))
    };
    let position = [want("x")?, want("y")?, want("z")?];
    let grey = layout.property(&["intensity", "green", "red"]);
    let (std_dev, keyframe) = (layout.property(&["sigma"]), layout.property(&["keyframe"]));
    let every = if keyframe.is_some() { layout.count.div_ceil(most.max(1)).max(1) } else { 1 };
    let mut points = Vec::with_capacity(most.min(layout.count).min(1 << 16));
    let mut chunk = vec![0; CHUNK * layout.bytes.max(1)];
    let mut index = 0;
    while index < layout.count {
        let length = CHUNK.min(layout.count - index);
        let bytes = &mut chunk[..length * layout.bytes];
        file.read_exact(bytes).map_err(failed)?;
        for point in bytes.chunks_exact(layout.bytes.max(1)) {
            if index.is_multiple_of(every) && points.len() < most {
                points.push(ScenePoint {
                    position: position.map(|property| property.read(point) as f32),
                    grey: grey.map_or(255, |property| property.read(point) as u8),
                    std_dev: std_dev.map_or(f32::NAN, |property| property.read(point) as f32),
                    keyframe_id: keyframe.map(|property| property.read(point) as u64),
                });
            }
            index += 1;
        }
    }
    Ok(points)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn ply(header: &str, points: &[u8]) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), [header.as_bytes(), points].concat()).unwrap();
        file
    }

    const HEADER: &str = "ply\nformat binary_little_endian 1.0\ncomment x\nelement vertex 2\nproperty float x\n\
        property uchar extra\nproperty float y\nproperty double z\nproperty uchar red\nproperty uchar green\nend_header\n";

    fn point(x: f32, y: f32, z: f64) -> Vec<u8> {
        [&x.to_le_bytes()[..], &[9], &y.to_le_bytes(), &z.to_le_bytes(), &[4, 5]].concat()
    }

    #[test]
    fn any_layout_of_a_binary_ply_is_read() {
        let file = ply(HEADER, &[point(1.0, 2.0, 3.0), point(4.0, 5.0, 6.0)].concat());
        let points = read_points(file.path(), 10).unwrap();
        assert_eq!((points[0].position, points[1].position), ([1.0, 2.0, 3.0], [4.0, 5.0, 6.0]));
        assert_eq!((points[0].grey, points[0].keyframe_id), (5, None));
        assert_eq!(read_points(file.path(), 1).unwrap().len(), 1);
    }

    #[test]
    fn errors_name_what_is_wrong_with_a_ply() {
        let cases = [
            (HEADER.replace("binary_little_endian", "ascii"), "not binary"),
            (HEADER.replace("float y", "float b"), "no y"),
            (HEADER.replace("double z", "list uchar int z"), "lists"),
            (HEADER.replace("ply\n", "png\n"), "not a PLY file"),
            (HEADER.replace("vertex 2", "vertex 3"), "fill whole buffer"),
            (HEADER.replace("end_header\n", ""), "no end"),
        ];
        for (header, expected) in cases {
            let points = if header.contains("end_header") {
                [point(1.0, 2.0, 3.0), point(4.0, 5.0, 6.0)].concat()
            } else {
                Vec::new()
            };
            let error = read_points(ply(&header, &points).path(), 10).unwrap_err().to_string();
            assert!(error.contains(expected), "{error} / {expected}");
        }
    }

    #[test]
    fn only_the_epoch_with_the_most_poses_is_shown() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let line = |secs: f64, id: u64, epoch: u32| {
            format!("{secs} 1 2 3 0 0 0 1 0.5 {id} 9 {epoch} 100 Established\n")
        };
        let lines = [line(1.0, 1, 0), line(6.0, 4, 0), line(3.0, 3, 1), line(2.5, 2, 1)];
        let text = format!("# c\n{}", lines.concat());
        fs::write(file.path(), &text).unwrap();
        let at = |secs: &[f64]| -> Vec<StampedPose> {
            let pose = |secs: &f64| StampedPose {
                nanos: (secs * 1e9) as i64,
                world_from_camera: SE3::identity(),
            };
            secs.iter().map(pose).collect()
        };
        let unmarked = |poses: &[StampedPose]| -> Vec<EpochPose> {
            poses.iter().map(|pose| EpochPose { epoch: 0, pose: *pose }).collect()
        };
        // The pose at 2.0 was placed afterwards: it dates from before the second epoch began.
        let (path, online) = (at(&[1.0, 1.5, 2.0, 2.5, 3.0, 6.0]), at(&[1.0, 1.5, 2.5, 3.0, 6.0]));
        let all = unmarked(&path);
        let shown = of_longest_epoch(read_keyframes(file.path()).unwrap(), &all, &online);
        assert_eq!(shown.keyframes.iter().map(|k| k.keyframe_id).collect::<Vec<_>>(), [1, 4]);
        assert_eq!((shown.path, shown.gaps), (at(&[1.0, 1.5, 6.0]), vec![]));
        // With a single epoch everything is shown.
        fs::write(file.path(), [line(1.0, 1, 0), line(2.0, 2, 0)].concat()).unwrap();
        let shown = of_longest_epoch(read_keyframes(file.path()).unwrap(), &all, &online);
        assert_eq!((shown.keyframes.len(), shown.path), (2, path));
        fs::write(file.path(), &text).unwrap();
        let shown = of_longest_epoch(read_keyframes(file.path()).unwrap(), &all, &[]);
        assert_eq!(shown.path, at(&[1.0, 1.5, 2.0, 6.0]));
        fs::write(file.path(), text.replace("0.5", "NaN")).unwrap();
        assert!(read_keyframes(file.path()).unwrap_err().to_string().contains("line 2"));
    }

    #[test]
    fn the_path_has_a_gap_where_another_marked_epoch_interrupts_it() {
        let folder = tempfile::tempdir().unwrap();
        let write = |name: &str, text: &str| fs::write(folder.path().join(name), text).unwrap();
        // The camera is relocalised in the first epoch while the newest keyframe belongs to the second.
        let keyframe = |secs: f64, id: u64, epoch: u32| {
            format!("{secs} 0 0 0 0 0 0 1 1 {id} 9 {epoch} 100 Established\n")
        };
        write("keyframes.txt", &[keyframe(1.0, 1, 0), keyframe(1.3, 2, 1)].concat());
        let pose = |tenths: i64| format!("{}.{} {tenths} 0 0 0 0 0 1\n", tenths / 10, tenths % 10);
        let poses = |of: &[i64]| of.iter().copied().map(pose).collect::<String>();
        let marked = format!(
            "# epoch 0: x\n{}# epoch 1: x\n{}# epoch 0: x\n{}",
            poses(&[10, 11, 12]),
            poses(&[13, 14, 15, 16]),
            poses(&[17, 18])
        );
        write("trajectory.txt", &marked);
        write("map.ply", &HEADER.replace("vertex 2", "vertex 0"));
        // The epoch with the most tracked frames counts: two of the second were placed afterwards.
        for (online, expected, gaps) in [
            (&[10, 11, 12, 15, 16, 17, 18][..], &[10, 11, 12, 17, 18][..], &[3][..]),
            (&[13, 14, 15, 16], &[13, 14, 15, 16], &[]),
        ] {
            write("trajectory_online.txt", &poses(online));
            let block = read_run(folder.path(), 10).unwrap();
            let length = u32::from_le_bytes(block[..4].try_into().unwrap()) as usize;
            let header: Value = serde_json::from_slice(&block[4..4 + length]).unwrap();
            let path = header["path"].as_array().unwrap().iter();
            let shown: Vec<i64> = path.map(|pose| pose[1].as_f64().unwrap() as i64).collect();
            assert_eq!((&shown[..], &header["gaps"]), (expected, &serde_json::json!(gaps)));
            assert_eq!(header["clusters"].as_array().unwrap().len(), 1);
        }
    }

    proptest! {
        #[test]
        fn damaged_headers_end_in_an_error_or_points(at in 0_usize..180, with in any::<u8>()) {
            let mut header = HEADER.as_bytes().to_vec();
            let at = at % header.len();
            header[at] = with;
            let _ = Layout::read(&mut header.as_slice()).map(|layout| layout.bytes);
        }
    }
}
