//! The mask of a camera: an image, black where the camera sees the robot instead of the scene.

use std::path::Path;

use crate::capture::decode_error::DecodeError;
use crate::capture::image_file::{ImageFileError, ImageFileReader};
use crate::capture::source::FrameSource;
use crate::capture::source_error::SourceError;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::raise_black;

/// Grey level below which a pixel of the file is black.
const MIN_WHITE: u8 = 128;

/// Least share of the image that a mask must leave: with less there is nothing to track, and it is probably inverted.
const MIN_SEEN: f64 = 0.2;

/// Which pixels of a source's frames show the scene.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mask {
    /// All bits set where a pixel shows it, else none.
    seen: Vec<u8>,
}

impl Mask {
    /// Reads the mask at `path`, which is drawn over an unrectified image of the camera of `source`.
    pub fn read(path: &Path, source: &dyn FrameSource) -> Result<Self, SourceError> {
        let Intrinsics { width, height, .. } = source.intrinsics();
        let mut raw = vec![0; width * height];
        let refused = |problem| SourceError::Mask { path: path.to_owned(), problem };
        let mut reader = ImageFileReader::default();
        match reader.read_gray_into(path, width, height, &mut raw) {
            Err(ImageFileError::Decode { source: DecodeError::Size { found, .. }, .. }) => {
                return Err(refused(format!(
                    "this mask has {}x{} pixels and the camera's images {width}x{height}; draw it over one of them",
                    found.0, found.1
                )));
            }
            Err(ImageFileError::Read { source, .. }) => {
                return Err(refused(format!("this mask cannot be read: {source}; check the path")));
            }
            read => read?,
        }
        // The colours of such pixels are whatever the paint program left there.
        if reader.is_transparent(width, height).unwrap_or(false) {
            return Err(refused(
                "this mask is transparent in places; save it without transparency, the robot black and \
                 everything else white"
                    .to_owned(),
            ));
        }
        raw.iter_mut().for_each(|grey| *grey = if *grey < MIN_WHITE { 0 } else { u8::MAX });
        // Pixels that are black only in part show some of the robot.
        let mut seen = source.rectified(&raw);
        seen.iter_mut().filter(|grey| **grey < u8::MAX).for_each(|grey| *grey = 0);
        let share = seen.iter().filter(|&&seen| seen > 0).count() as f64 / seen.len().max(1) as f64;
        if share < MIN_SEEN {
            return Err(refused(format!(
                "this mask leaves {:.0} % of the image; paint the robot black and everything else white; is \
                 it inverted?",
                100.0 * share
            )));
        }
        Ok(Self { seen })
    }

    /// A mask that hides these pixels of `count`.
    #[cfg(test)]
    pub fn hiding(hidden: std::ops::Range<usize>, count: usize) -> Self {
        Self { seen: (0..count).map(|i| if hidden.contains(&i) { 0 } else { u8::MAX }).collect() }
    }

    /// Makes the pixels that it hides black, [`NO_DATA`](crate::slam::image::NO_DATA).
    pub fn hide(&self, pixels: &mut [u8]) {
        pixels.iter_mut().zip(&self.seen).for_each(|(grey, seen)| *grey &= seen);
    }

    /// The share of the image that it hides.
    pub fn hidden(&self) -> f64 {
        let hidden = self.seen.iter().filter(|&&seen| seen == 0).count();
        hidden as f64 / self.seen.len().max(1) as f64
    }
}

/// Marks the pixels of a frame that `mask` hides as without data, and raises black ones that show the scene above that
/// mark.
pub fn mark_hidden(mask: Option<&Mask>, pixels: &mut [u8]) {
    raise_black(pixels);
    mask.iter().for_each(|mask| mask.hide(pixels));
}

#[cfg(test)]
mod tests {
    use std::fs::File;

    use super::*;
    use crate::capture::image_file::write_gray_png;
    use crate::capture::tum;
    use crate::slam::image::NO_DATA;

    const SIZE: [usize; 2] = [160, 120];

    /// A recording without frames worth reading; its lens distorts if `is_distorted`.
    fn source(folder: &Path, is_distorted: bool) -> impl FrameSource {
        let lens = if is_distorted { " -0.3 0.1 0 0 0" } else { "" };
        std::fs::write(folder.join("camera.txt"), format!("130 130 79.5 59.5 160 120{lens}"))
            .unwrap();
        std::fs::write(folder.join("rgb.txt"), "1.0 rgb/1.png\n").unwrap();
        tum::open(folder, None).unwrap()
    }

    fn written(
        folder: &Path,
        [width, height]: [usize; 2],
        grey: impl Fn(usize, usize) -> u8,
    ) -> std::path::PathBuf {
        let path = folder.join("mask.png");
        let pixels: Vec<u8> = (0..width * height).map(|i| grey(i % width, i / width)).collect();
        write_gray_png(&path, width, height, &pixels).unwrap();
        path
    }

    #[test]
    fn what_is_black_has_no_data_and_black_that_is_seen_has() {
        let folder = tempfile::tempdir().unwrap();
        let source = source(folder.path(), false);
        let path = written(folder.path(), SIZE, |_, v| if v >= 90 { 40 } else { 200 });
        let mask = Mask::read(&path, &source).unwrap();
        let mut frame = vec![0; SIZE[0] * SIZE[1]];
        frame[7] = 9;
        mark_hidden(Some(&mask), &mut frame);
        let expected = |i: usize| {
            if i >= 90 * SIZE[0] {
                NO_DATA
            } else if i == 7 {
                9
            } else {
                1
            }
        };
        assert!(frame.iter().enumerate().all(|(i, &grey)| grey == expected(i)));
        mark_hidden(None, &mut frame);
        assert!(!frame.contains(&NO_DATA));
    }

    #[test]
    fn a_mask_is_rectified_with_the_images_and_hides_pixels_that_mix_both() {
        let folder = tempfile::tempdir().unwrap();
        let source = source(folder.path(), true);
        let path = written(folder.path(), SIZE, |u, v| if v >= 90 && u < 80 { 0 } else { 255 });
        let mask = Mask::read(&path, &source).unwrap();
        // The robot as it is seen, in a scene of one grey level.
        let raw: Vec<u8> = (0..SIZE[0] * SIZE[1])
            .map(|i| if i / SIZE[0] >= 90 && i % SIZE[0] < 80 { 10 } else { 200 })
            .collect();
        let mut frame = source.rectified(&raw);
        assert_ne!(frame, raw);
        assert!(frame.iter().any(|grey| (11..200).contains(grey)), "some pixels mix both");
        let robot = frame.iter().filter(|&&grey| grey != 200).count();
        mark_hidden(Some(&mask), &mut frame);
        assert!(frame.iter().all(|grey| [NO_DATA, 200].contains(grey)));
        assert_eq!(frame.iter().filter(|&&grey| grey == NO_DATA).count(), robot);
    }

    #[test]
    fn a_mask_of_another_camera_and_an_inverted_one_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let source = source(folder.path(), false);
        let refusal = |path: &Path| Mask::read(path, &source).unwrap_err().to_string();
        let text = refusal(&written(folder.path(), [80, 60], |_, _| 255));
        assert!(
            text.ends_with(
                "has 80x60 pixels and the camera's images 160x120; draw it over one of them"
            ),
            "{text}"
        );
        let text = refusal(&written(folder.path(), SIZE, |u, _| if u < 20 { 255 } else { 0 }));
        assert!(text.contains("leaves 12 % of the image") && text.contains("inverted"), "{text}");
        let path = folder.path().join("mask.png");
        File::create(&path).unwrap();
        assert!(refusal(&path).contains("is empty"));
        assert!(refusal(&folder.path().join("none.png")).contains("cannot be read"));
    }

    #[test]
    fn a_mask_that_is_transparent_in_places_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let source = source(folder.path(), false);
        let path = folder.path().join("mask.png");
        for (color, erased) in [(png::ColorType::Rgba, 254), (png::ColorType::GrayscaleAlpha, 0)] {
            for alpha in [u8::MAX, erased] {
                let mut pixels = vec![u8::MAX; SIZE[0] * SIZE[1] * color.samples()];
                pixels[70 * color.samples() - 1] = alpha;
                let [width, height] = SIZE.map(|side| side as u32);
                let mut encoder = png::Encoder::new(File::create(&path).unwrap(), width, height);
                encoder.set_color(color);
                encoder.write_header().unwrap().write_image_data(&pixels).unwrap();
                let read = Mask::read(&path, &source).map_err(|refused| refused.to_string());
                assert_eq!(read.is_ok(), alpha == u8::MAX, "{color:?} {alpha}");
                assert!(read.is_ok_and(|mask| mask.hidden() == 0.0) || alpha == erased);
            }
        }
    }
}
