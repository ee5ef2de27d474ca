//! A folder of images: stamps from `times.txt` or from the rig's frame rate.

use std::cmp::Ordering;
use std::collections::HashMap;
use std::io::Read;
use std::path::{Path, PathBuf};

use crate::capture::listing::{Row, read_text, rows};
use crate::capture::recording::{Contents, ListedImage, Recording};
use crate::capture::source_error::SourceError;
use crate::capture::tum::read_rig;
use crate::capture::{input_file, jpeg_image, png_image};

const NANOS_PER_SECOND: f64 = 1e9;
const NANOS_PER_MILLISECOND: f64 = 1e6;

/// Longest exposure that a list may give, milliseconds: with an exposure of a minute it is not video.
const LONGEST_EXPOSURE_MS: f64 = 60_000.0;

/// Opens the images in `folder`, in natural order of their names (`2.png` before `10.png`); without `rig`, its
/// `camera.txt` is used. Stamps come from `times.txt`, which has either one stamp in seconds per line, for the images
/// in order, or `name seconds [exposure in milliseconds]`, name with or without extension, for the images to use;
/// without that file the rig must give its rate.
pub fn open(folder: &Path, rig: Option<&Path>) -> Result<Recording, SourceError> {
    let images = list_images(folder)?;
    if images.is_empty() {
        return Err(SourceError::Empty { path: folder.to_owned() });
    }
    let (rig, rig_path) = read_rig(folder, rig)?;
    let times = folder.join("times.txt");
    let frames = if times.exists() {
        read_times(&times, images)?
    } else {
        let rate_hz = rig.rate_hz.ok_or_else(|| SourceError::NoStamps {
            folder: folder.to_owned(),
            rig: rig_path.clone(),
        })?;
        stamped_at(rate_hz, images)
    };
    let contents = Contents { frames, ..Contents::default() };
    Recording::new(contents, &rig, rig_path, folder.to_owned())
}

/// Whether `folder` contains an image.
pub(super) fn has_images(folder: &Path) -> bool {
    list_images(folder).is_ok_and(|images| !images.is_empty())
}

/// Lists the images of a folder in natural order: files that begin like a PNG or JPEG, and files named like one (so
/// that any error in them is found when they are reached).
fn list_images(folder: &Path) -> Result<Vec<PathBuf>, SourceError> {
    let list = || -> std::io::Result<Vec<PathBuf>> {
        let mut images = Vec::new();
        for entry in std::fs::read_dir(folder)? {
            let path = entry?.path();
            let is_hidden =
                path.file_name().is_some_and(|name| name.as_encoded_bytes().starts_with(b"."));
            if !is_hidden && (is_called_image(&path) || begins_like_image(&path)) {
                images.push(path);
            }
        }
        Ok(images)
    };
    let mut images =
        list().map_err(|source| SourceError::Read { path: folder.to_owned(), source })?;
    images.sort_by(|a, b| {
        natural_order(&a.to_string_lossy(), &b.to_string_lossy()).then_with(|| a.cmp(b))
    });
    Ok(images)
}

/// Whether a file has the extension of an image.
pub(super) fn is_called_image(path: &Path) -> bool {
    input_file::has_ending(path, &["png", "jpg", "jpeg"])
}

fn begins_like_image(path: &Path) -> bool {
    let read = || -> std::io::Result<Vec<u8>> {
        let mut start = Vec::new();
        input_file::open(path)?.take(png_image::SIGNATURE.len() as u64).read_to_end(&mut start)?;
        Ok(start)
    };
    // A file that cannot be read and is not named like an image is not one of ours.
    read().is_ok_and(|start| {
        start == png_image::SIGNATURE || start.starts_with(&jpeg_image::SIGNATURE)
    })
}

/// Compares names with runs of digits taken as numbers.
fn natural_order(a: &str, b: &str) -> Ordering {
    let (mut a, mut b) = (a, b);
    loop {
        let (digits_a, digits_b) = (digits(a), digits(b));
        let order = if digits_a > 0 && digits_b > 0 {
            let number_a = a[..digits_a].trim_start_matches('0');
            let number_b = b[..digits_b].trim_start_matches('0');
            (a, b) = (&a[digits_a..], &b[digits_b..]);
            number_a.len().cmp(&number_b.len()).then_with(|| number_a.cmp(number_b))
        } else {
            let (mut rest_a, mut rest_b) = (a.chars(), b.chars());
            let order = match (rest_a.next(), rest_b.next()) {
                (None, None) => return Ordering::Equal,
                (next_a, next_b) => next_a.cmp(&next_b),
            };
            (a, b) = (rest_a.as_str(), rest_b.as_str());
            order
        };
        if order != Ordering::Equal {
            return order;
        }
    }
}

/// Length of the leading run of ASCII digits.
fn digits(text: &str) -> usize {
    text.bytes().take_while(u8::is_ascii_digit).count()
}

/// Frames at a constant rate, starting at 0.
fn stamped_at(rate_hz: f64, images: Vec<PathBuf>) -> Vec<ListedImage> {
    let stamp = |i: usize| (i as f64 * NANOS_PER_SECOND / rate_hz).round() as i64;
    let frame = |(i, path)| ListedImage { nanos: stamp(i), path, exposure_nanos: 0 };
    images.into_iter().enumerate().map(frame).collect()
}

/// Frames with the stamps of a `times.txt`.
fn read_times(times: &Path, images: Vec<PathBuf>) -> Result<Vec<ListedImage>, SourceError> {
    let text = read_text(times)?;
    let rows: Vec<Row<'_>> = rows(times, &text).collect();
    let is_named = rows.first().is_some_and(|row| row.text.contains(char::is_whitespace));
    let mut by_name: HashMap<String, &PathBuf> = HashMap::new();
    for image in &images {
        let names = [image.file_name(), image.file_stem()];
        by_name.extend(names.into_iter().flatten().map(|n| (n.to_string_lossy().into(), image)));
    }
    let mut frames: Vec<ListedImage> = Vec::with_capacity(rows.len());
    for (i, row) in rows.iter().enumerate() {
        let fields: Vec<&str> = row.text.split_whitespace().collect();
        let (path, stamp, exposure) = match (is_named, &fields[..]) {
            (false, [stamp]) => {
                let missing = || row.error(format!("there are only {} images", images.len()));
                (images.get(i).ok_or_else(missing)?, stamp, None)
            }
            (true, [name, stamp, exposure @ ..]) if exposure.len() <= 1 => {
                let missing = || row.error(format!("there is no image `{name}` in the folder"));
                (*by_name.get(*name).ok_or_else(missing)?, stamp, exposure.first())
            }
            _ => {
                return Err(row.error(
                    "every line needs one stamp, or every line `name seconds [exposure_ms]`",
                ));
            }
        };
        let nanos = row.seconds(stamp)?;
        row.check_after(frames.last().map(|frame| frame.nanos), nanos)?;
        let exposure_nanos = exposure.map_or(Ok(0), |text| exposure_nanos(row, text))?;
        frames.push(ListedImage { nanos, path: path.clone(), exposure_nanos });
    }
    if !is_named && frames.len() < images.len() {
        return Err(SourceError::FewStamps {
            path: times.to_owned(),
            stamps: frames.len(),
            images: images.len(),
        });
    }
    Ok(frames)
}

fn exposure_nanos(row: &Row<'_>, text: &str) -> Result<u64, SourceError> {
    let exposure_ms = row.number(text)?;
    if !(0.0..=LONGEST_EXPOSURE_MS).contains(&exposure_ms) {
        let range = format!("0 to {LONGEST_EXPOSURE_MS} milliseconds");
        return Err(row.error(format!("the exposure is {exposure_ms}: must be {range}")));
    }
    Ok((exposure_ms * NANOS_PER_MILLISECOND).round() as u64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn digits_in_names_are_compared_as_numbers() {
        let mut names = ["b1", "a10.png", "a9.png", "a2b3", "a02b10", "a", "a007.png", "é"];
        names.sort_by(|a, b| natural_order(a, b));
        assert_eq!(names, ["a", "a2b3", "a02b10", "a007.png", "a9.png", "a10.png", "b1", "é"]);
        let long = "9".repeat(40);
        assert_eq!(natural_order(&long, &format!("1{long}")), Ordering::Less);
    }

    #[test]
    fn a_rate_gives_evenly_spaced_stamps() {
        let frames = stamped_at(30.0, vec![PathBuf::new(); 91]);
        assert_eq!(frames[1].nanos, 33_333_333);
        assert_eq!(frames[90].nanos, 3_000_000_000);
    }
}
