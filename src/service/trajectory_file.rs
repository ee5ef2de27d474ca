//! Trajectory files: TUM (`timestamp tx ty tz qx qy qz qw`) in and out, EuRoC ground truth in.
//!
//! Stamps are nanoseconds as integers and numbers have enough digits to restore the same bits, so that two runs can be
//! compared byte by byte.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use crate::capture::input_file;
use crate::service::atomic_file::write_atomically;
use crate::slam::geometry::se3::SE3;
use crate::slam::trajectory::{EpochPose, StampedPose};

/// Largest file that is read, bytes: 18 hours of poses at 30 Hz. A larger one is not a trajectory.
const MAX_FILE_BYTES: u64 = 256 << 20;

/// Text before an epoch's number in the comment that marks its beginning; a colon follows.
const EPOCH_MARK: &str = "# epoch ";

const NANOS_PER_SEC: i64 = 1_000_000_000;

/// Why a trajectory file cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum TrajectoryFileError {
    /// The file cannot be opened or read.
    #[error(
        "cannot read {path}: {source}; name a trajectory file, lines of `seconds x y z qx qy qz qw`"
    )]
    Read {
        /// The file.
        path: PathBuf,
        /// The system's error.
        source: io::Error,
    },
    /// A line is not a pose.
    #[error("{path}:{line}: {fault}")]
    Line {
        /// The file.
        path: PathBuf,
        /// Its line, from 1.
        line: usize,
        /// What is wrong.
        fault: LineFault,
    },
    /// The file has no pose.
    #[error("{path} has no poses: expected lines 'timestamp tx ty tz qx qy qz qw'")]
    Empty {
        /// The file.
        path: PathBuf,
    },
}

/// What is wrong with a line.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LineFault {
    /// Its bytes are not text.
    #[error("not text: expected 'timestamp tx ty tz qx qy qz qw'")]
    NotText,
    /// The number of columns is wrong.
    #[error("{found} columns, expected {expected}")]
    Columns {
        /// Columns found.
        found: usize,
        /// Columns expected, in words.
        expected: &'static str,
    },
    /// A column is not a finite number.
    #[error("'{0}' is not a finite number")]
    Number(String),
    /// A stamp does not fit into 64 bits of nanoseconds.
    #[error("'{0}' is not a timestamp in {1}")]
    Stamp(String, &'static str),
    /// It is earlier than the previous line.
    #[error("timestamp {0} is earlier than the previous one: sort the file by time")]
    Order(String),
    /// Its quaternion has no direction.
    #[error("the quaternion has zero length: expected qx qy qz qw of length 1")]
    Quaternion,
}

/// The contents of a trajectory file.
#[derive(Debug, Clone, PartialEq)]
pub struct TrajectoryFile {
    /// Its poses, ordered by stamp, all of epoch 0 where it marks none.
    pub poses: Vec<EpochPose>,
    /// Whether it is in EuRoC's layout, with poses of the body that carries the camera.
    pub is_euroc: bool,
}

/// The poses of a file, of any epoch, ordered by stamp; see [`read_trajectory_file`].
pub fn read_trajectory(path: &Path) -> Result<Vec<StampedPose>, TrajectoryFileError> {
    Ok(read_trajectory_file(path)?.poses.into_iter().map(|of| of.pose).collect())
}

/// Reads a trajectory in TUM layout, or in EuRoC's (`nanoseconds, p x y z, q w x y z, …`) where
/// the columns are separated by commas.
pub fn read_trajectory_file(path: &Path) -> Result<TrajectoryFile, TrajectoryFileError> {
    let owned = || path.to_path_buf();
    let mut bytes = Vec::new();
    input_file::read_into(path, MAX_FILE_BYTES, &mut bytes)
        .map_err(|source| TrajectoryFileError::Read { path: owned(), source })?;
    let poses = parse_trajectory(&bytes).map_err(|(line, fault)| TrajectoryFileError::Line {
        path: owned(),
        line,
        fault,
    })?;
    if poses.is_empty() {
        return Err(TrajectoryFileError::Empty { path: owned() });
    }
    let is_entry =
        |line: &&[u8]| !line.trim_ascii().is_empty() && !line.trim_ascii().starts_with(b"#");
    let first = bytes.split(|&b| b == b'\n').find(is_entry);
    Ok(TrajectoryFile { poses, is_euroc: first.is_some_and(|line| line.contains(&b',')) })
}

/// Parses the poses in a file's bytes; the error has the faulty line, from 1. Comments except the marks of
/// [`write_epochs`] are ignored.
pub fn parse_trajectory(bytes: &[u8]) -> Result<Vec<EpochPose>, (usize, LineFault)> {
    let mut poses: Vec<EpochPose> = Vec::new();
    let mut epoch = 0;
    for (i, line) in bytes.split(|&b| b == b'\n').enumerate() {
        let at = |fault| (i + 1, fault);
        let line = std::str::from_utf8(line).map_err(|_| at(LineFault::NotText))?.trim();
        if line.is_empty() || line.starts_with('#') {
            epoch = epoch_mark(line).unwrap_or(epoch);
            continue;
        }
        let pose = parse_pose(line).map_err(at)?;
        if poses.last().is_some_and(|last| pose.nanos < last.pose.nanos) {
            let stamp = line.split([' ', '\t', ',']).next().unwrap_or_default();
            return Err(at(LineFault::Order(shortened(stamp))));
        }
        poses.push(EpochPose { epoch, pose });
    }
    Ok(poses)
}

/// The epoch whose beginning a comment marks.
fn epoch_mark(line: &str) -> Option<u32> {
    let (digits, _) = line.strip_prefix(EPOCH_MARK)?.split_once(':')?;
    let is_number = digits.bytes().all(|b| b.is_ascii_digit());
    is_number.then(|| digits.parse().ok()).flatten()
}

fn parse_pose(line: &str) -> Result<StampedPose, LineFault> {
    let is_euroc = line.contains(',');
    let columns: Vec<&str> = if is_euroc {
        line.split(',').map(str::trim).collect()
    } else {
        line.split_whitespace().collect()
    };
    let (fits, expected) = if is_euroc {
        (columns.len() >= 8, "at least 8: nanoseconds, px, py, pz, qw, qx, qy, qz")
    } else {
        (columns.len() == 8, "8: timestamp tx ty tz qx qy qz qw")
    };
    if !fits {
        return Err(LineFault::Columns { found: columns.len(), expected });
    }
    let nanos = if is_euroc {
        let unit = "whole nanoseconds";
        columns[0].parse().map_err(|_| LineFault::Stamp(shortened(columns[0]), unit))?
    } else {
        let fault = || LineFault::Stamp(shortened(columns[0]), "seconds");
        nanos_from_secs(columns[0]).ok_or_else(fault)?
    };
    let mut numbers = [0.0; 7];
    for (number, column) in numbers.iter_mut().zip(&columns[1..]) {
        *number = parse_finite(column)?;
    }
    let [tx, ty, tz, a, b, c, d] = numbers;
    let quaternion_xyzw = if is_euroc { [b, c, d, a] } else { [a, b, c, d] };
    let world_from_camera =
        SE3::try_from_parts(quaternion_xyzw, [tx, ty, tz]).ok_or(LineFault::Quaternion)?;
    Ok(StampedPose { nanos, world_from_camera })
}

fn parse_finite(column: &str) -> Result<f64, LineFault> {
    let number: Option<f64> = column.parse().ok();
    number.filter(|n| n.is_finite()).ok_or_else(|| LineFault::Number(shortened(column)))
}

/// The first characters of a column, so that a message stays one readable line.
fn shortened(column: &str) -> String {
    const LONGEST: usize = 40;
    if column.chars().count() <= LONGEST {
        return column.to_owned();
    }
    column.chars().take(LONGEST).chain("…".chars()).collect()
}

/// Nanoseconds of a stamp in seconds: exact for plain decimals of up to nine digits after the
/// point, through f64 for an exponent (`1.3e+09`), rounded to the nearest otherwise.
pub fn nanos_from_secs(text: &str) -> Option<i64> {
    exact_nanos(text).or_else(|| {
        let nanos = text.parse::<f64>().ok()? * NANOS_PER_SEC as f64;
        // i64::MAX as f64 is 2⁶³, the first value that does not fit.
        let fits = nanos.abs() < i64::MAX as f64;
        fits.then(|| nanos.round() as i64)
    })
}

fn exact_nanos(text: &str) -> Option<i64> {
    let (negative, digits) = match text.strip_prefix('-') {
        Some(rest) => (true, rest),
        None => (false, text),
    };
    let (secs, fraction) = digits.split_once('.').unwrap_or((digits, ""));
    let plain = |part: &str| part.bytes().all(|b| b.is_ascii_digit());
    if secs.is_empty() || !plain(secs) || !plain(fraction) {
        return None;
    }
    const DIGITS: usize = 9;
    let kept = &fraction[..fraction.len().min(DIGITS)];
    let rounds_up = fraction.as_bytes().get(DIGITS).is_some_and(|&digit| digit >= b'5');
    let nanos = format!("{kept:0<DIGITS$}").parse::<i64>().ok()? + i64::from(rounds_up);
    let total = secs.parse::<i64>().ok()?.checked_mul(NANOS_PER_SEC)?.checked_add(nanos)?;
    Some(if negative { -total } else { total })
}

/// A stamp as seconds with nine digits after the point.
pub fn secs_from_nanos(nanos: i64) -> String {
    let (sign, magnitude) = (if nanos < 0 { "-" } else { "" }, nanos.unsigned_abs());
    let per_sec = NANOS_PER_SEC.unsigned_abs();
    format!("{sign}{}.{:09}", magnitude / per_sec, magnitude % per_sec)
}

/// One pose as a TUM line without its end: the shortest digits that restore the same bits.
pub fn tum_line(pose: &StampedPose) -> String {
    let t = &pose.world_from_camera.translation;
    let [qx, qy, qz, qw] = pose.world_from_camera.quaternion_xyzw();
    format!("{} {} {} {} {qx} {qy} {qz} {qw}", secs_from_nanos(pose.nanos), t.x, t.y, t.z)
}

/// Writes a trajectory in TUM layout. `comment` is one line without the `#`.
pub fn write_trajectory(path: &Path, comment: &str, poses: &[StampedPose]) -> io::Result<()> {
    write_atomically(path, |file| {
        write_head(file, comment)?;
        poses.iter().try_for_each(|pose| writeln!(file, "{}", tum_line(pose)))
    })
}

/// As [`write_trajectory`], with a comment, `# epoch N: …`, before each of several epochs.
pub fn write_epochs(path: &Path, comment: &str, poses: &[EpochPose]) -> io::Result<()> {
    let is_one = poses.windows(2).all(|pair| pair[0].epoch == pair[1].epoch);
    write_atomically(path, |file| {
        write_head(file, comment)?;
        let mut epoch = None;
        poses.iter().try_for_each(|of| {
            if !is_one && epoch.replace(of.epoch) != Some(of.epoch) {
                let epoch = of.epoch;
                writeln!(file, "{EPOCH_MARK}{epoch}: a separate origin and unit of length")?;
            }
            writeln!(file, "{}", tum_line(&of.pose))
        })
    })
}

fn write_head(file: &mut dyn Write, comment: &str) -> io::Result<()> {
    writeln!(file, "# {comment}")?;
    writeln!(file, "# timestamp tx ty tz qx qy qz qw")
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector6;
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn stamps_keep_every_nanosecond() {
        for (text, nanos) in [
            ("1305033527.670034123", 1_305_033_527_670_034_123),
            ("1305033527.67", 1_305_033_527_670_000_000),
            ("0.0333333335", 33_333_334),
            ("12", 12_000_000_000),
            ("-0.5", -500_000_000),
            ("1e-3", 1_000_000),
            ("1.305031102175304e+09", 1_305_031_102_175_304_000),
        ] {
            let read = nanos_from_secs(text).unwrap();
            // Only a stamp that went through f64 may be rounded: to 2⁻²² s at today's stamps.
            assert!((read - nanos).abs() <= if text.contains('e') { 256 } else { 0 }, "{text}");
        }
        for text in ["", ".", "-", "1.2.3", "nan", "inf", "9e99", "99999999999999999999", "1,5"] {
            assert_eq!(nanos_from_secs(text), None, "{text}");
        }
    }

    proptest! {
        #[test]
        fn a_stamp_comes_back(nanos in i64::MIN + 1..i64::MAX) {
            prop_assert_eq!(nanos_from_secs(&secs_from_nanos(nanos)), Some(nanos));
        }

        #[test]
        fn a_line_is_a_fixed_point(xi in proptest::array::uniform6(-3.0f64..3.0), nanos in 0i64..i64::MAX) {
            // The reader may change the last bit of a quaternion when it normalises it; translation and stamp are read
            // back unchanged.
            let pose = StampedPose { nanos, world_from_camera: SE3::exp(&Vector6::from(xi)) };
            let read = parse_pose(&tum_line(&pose)).unwrap();
            prop_assert_eq!(read.nanos, pose.nanos);
            prop_assert_eq!(read.world_from_camera.translation, pose.world_from_camera.translation);
            let turned = read.world_from_camera.rotation.angle_to(&pose.world_from_camera.rotation);
            prop_assert!(turned < 1e-7);
        }

        #[test]
        fn any_bytes_are_read_or_refused(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _ = parse_trajectory(&bytes);
        }
    }

    #[test]
    fn both_layouts_are_read() {
        let tum =
            parse_trajectory(b"# c\n\n1.5 1 2 3 0 0 0 1\r\n2.5\t1 2 3 0.5 0.5 0.5 0.5\n").unwrap();
        let euroc = parse_trajectory(
            b"#t\n1500000000,1,2,3,1,0,0,0,9,9\n2500000000, 1, 2, 3, .5, .5, .5, .5\n",
        );
        assert_eq!(euroc.unwrap(), tum);
        assert_eq!(tum[0].pose.nanos, 1_500_000_000);
    }

    #[test]
    fn poses_belong_to_the_epoch_marked_last() {
        let at = |secs: i64, epoch| {
            let pose =
                StampedPose { nanos: secs * NANOS_PER_SEC, world_from_camera: SE3::identity() };
            EpochPose { epoch, pose }
        };
        let file = tempfile::NamedTempFile::new().unwrap();
        for poses in [vec![at(1, 0), at(2, 4), at(3, 4), at(4, 0)], vec![at(1, 0), at(2, 0)]] {
            write_epochs(file.path(), "c", &poses).unwrap();
            assert_eq!(read_trajectory_file(file.path()).unwrap().poses, poses);
        }
        // Nothing else is a mark; poses before the first are of epoch 0.
        let pose = "0 0 0 0 0 0 1\n";
        for (comment, epoch) in [
            ("# epoch 7: x", 7),
            ("# epoch 7", 0),
            ("# epoch x:", 0),
            ("# epoch :", 0),
            ("# epoch +7:", 0),
            ("# epoch 99999999999:", 0),
            ("#epoch 7:", 0),
            ("# the epoch 7: x", 0),
        ] {
            let text = format!("1 {pose}{comment}\n2 {pose}");
            let read = parse_trajectory(text.as_bytes()).unwrap();
            assert_eq!([read[0].epoch, read[1].epoch], [0, epoch], "{comment}");
        }
    }

    #[test]
    fn faults_name_their_line() {
        let fault = |text: &str| parse_trajectory(text.as_bytes()).unwrap_err();
        assert_eq!(fault("# c\n1 2 3\n").0, 2);
        assert!(matches!(fault("1 2 3").1, LineFault::Columns { found: 3, .. }));
        assert!(matches!(fault("1 0 0 0 0 0 0 1 9").1, LineFault::Columns { found: 9, .. }));
        assert!(matches!(fault("1,2,3").1, LineFault::Columns { found: 3, .. }));
        assert_eq!(fault("1 0 x 0 0 0 0 1").1, LineFault::Number("x".into()));
        assert_eq!(fault("1 0 NaN 0 0 0 0 1").1, LineFault::Number("NaN".into()));
        assert!(matches!(fault("t 0 0 0 0 0 0 1").1, LineFault::Stamp(..)));
        assert!(matches!(fault("1.5,0,0,0,1,0,0,0").1, LineFault::Stamp(..)));
        assert_eq!(fault("1 0 0 0 0 0 0 0").1, LineFault::Quaternion);
        let order = fault("2 0 0 0 0 0 0 1\n1 0 0 0 0 0 0 1\n");
        assert_eq!(order, (2, LineFault::Order("1".into())));
        assert_eq!(parse_trajectory(b"\xff\xfe").unwrap_err(), (1, LineFault::NotText));
    }
}
