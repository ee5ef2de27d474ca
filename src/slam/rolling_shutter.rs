//! Rolling shutter: a camera that exposes row after row sees the scene from another pose in each of them. Images are
//! resampled as if all rows had been exposed with the middle one.
//!
//! What moves the image most, rotation and motion at the scene's mean depth, is measured between successive images by
//! `image_motion`, before anything is tracked, and undone row by row by `rows`. What translation does to surfaces
//! nearer or farther than the mean is left: it hardly changes from image to image.

mod rows;
#[cfg(test)]
mod tests;

use crate::slam::geometry::camera_model::CameraModel;
use crate::slam::geometry::intrinsics::Intrinsics;
use crate::slam::image::repeats::{Repeats, Shown};
use crate::slam::image::sums::{MAX_LEVELS, SumPyramid};
use crate::slam::image_motion::{ImageMotion, MotionEstimator};
use crate::slam::rolling_shutter::rows::RowTimes;

/// Longest interval over which a motion is measured, seconds: five frames at 20 Hz.
const MAX_INTERVAL_S: f64 = 0.25;

/// Shortest one, in read-out times: a sensor does not begin an image before it has read the last one, but stamps may
/// come in bursts.
const MIN_READOUTS: f64 = 0.8;

/// Largest motion during the read-out that is undone, radians or relative scale: a hand turns by 0.3.
const MAX_MOTION: f64 = 0.5;

/// Motion of the image per second, at the middle of the time between two images.
#[derive(Debug, Clone, Copy)]
struct Rate {
    per_second: ImageMotion,
    interval_s: f64,
}

/// Undoes the rolling shutter of one camera, image after image.
#[derive(Debug)]
pub struct RollingShutter {
    readout_s: f64,
    /// Time in which a row is read, times the focal length in rows.
    vertical_s: f64,
    rows: RowTimes,
    pyramid: SumPyramid,
    repeats: Repeats,
    estimator: MotionEstimator,
    /// Stamp of the last image that repeats none.
    last_nanos: Option<i64>,
    /// Rates up to the last image and up to the one before it.
    rates: [Option<Rate>; 2],
    /// Motion of the first image, measured to the one after it.
    first: Option<ImageMotion>,
    /// The image before it is resampled.
    rolling: Vec<u8>,
}

impl RollingShutter {
    /// Prepares for the rectified images, with `rectified` intrinsics, of `camera`, whose rows are read out within
    /// `readout_s`.
    pub fn new(camera: &CameraModel, rectified: &Intrinsics, readout_s: f64) -> Self {
        let Intrinsics { width, height, .. } = *rectified;
        let pyramid = SumPyramid::with_size(width, height, MAX_LEVELS, 1);
        Self {
            readout_s,
            vertical_s: readout_s / height as f64 * rectified.fy,
            rows: RowTimes::new(camera, rectified, readout_s),
            repeats: Repeats::with_size_of(&pyramid),
            pyramid,
            estimator: MotionEstimator::new(rectified),
            last_nanos: None,
            rates: [None; 2],
            first: None,
            rolling: vec![0; width * height],
        }
    }

    /// Whether an image has been taken since the start.
    pub fn has_begun(&self) -> bool {
        self.last_nanos.is_some()
    }

    /// Forgets all images, as before a jump in the source.
    pub fn restart(&mut self) {
        self.last_nanos = None;
        self.rates = [None; 2];
        self.first = None;
        self.repeats = Repeats::with_size_of(&self.pyramid);
    }

    /// Measures how the first image moves, from the one after it.
    pub fn look_ahead(&mut self, first: (i64, &[u8]), second: (i64, &[u8])) {
        if first.1 == second.1 {
            return;
        }
        for (capture_nanos, pixels) in [first, second] {
            self.pyramid.fill(pixels);
            self.measure(capture_nanos);
        }
        let first = self.rates[0].map(|rate| rate.per_second);
        self.restart();
        self.first = first;
    }

    /// Resamples an image, its grey levels with 0 for no data, as if all its rows had been exposed together. What was out
    /// of view then has no data. Does nothing to an image whose motion is not known, such as the first one without
    /// [`RollingShutter::look_ahead`], and if the size differs.
    pub fn undo(&mut self, capture_nanos: i64, pixels: &mut [u8]) {
        if pixels.len() != self.rolling.len() {
            return;
        }
        self.pyramid.fill(pixels);
        // A repeated image is resampled as the first time.
        if self.repeats.observe(&self.pyramid) != Shown::Repeat {
            let is_first = !self.has_begun();
            self.measure(capture_nanos);
            self.first = self.first.filter(|_| is_first);
        }
        let is_plausible = |motion: &ImageMotion| {
            motion.iter().all(|value| value.abs() * self.readout_s <= MAX_MOTION)
        };
        if let Some(motion) = self.motion_per_second().or(self.first).filter(is_plausible) {
            self.rolling.copy_from_slice(pixels);
            self.rows.resample(&motion, &self.rolling, pixels);
        }
    }

    /// Measures the motion from the last image to this one.
    fn measure(&mut self, capture_nanos: i64) {
        let interval_s =
            self.last_nanos.map(|last| capture_nanos.saturating_sub(last) as f64 * 1e-9);
        self.last_nanos = Some(capture_nanos);
        let shortest_s = MIN_READOUTS * self.readout_s;
        let interval_s =
            interval_s.filter(|interval_s| (shortest_s..=MAX_INTERVAL_S).contains(interval_s));
        self.estimator.take(&self.pyramid);
        let rate = interval_s.and_then(|interval_s| {
            let predicted =
                self.rates[0].map(|rate| rate.per_second.map(|per_s| per_s * interval_s));
            let motion = self.estimator.motion(predicted)?;
            // What moves down is exposed later.
            let exposed_s = (interval_s - self.vertical_s * motion[0]).max(0.5 * interval_s);
            Some(Rate { per_second: motion.map(|value| value / exposed_s), interval_s })
        });
        // A rate is extrapolated only from one right before it.
        self.rates = [rate, self.rates[0].filter(|_| rate.is_some())];
    }

    /// Motion while the last image was exposed: half an interval after the middle of the last one.
    fn motion_per_second(&self) -> Option<ImageMotion> {
        let [last, before] = self.rates;
        let last = last?;
        let Some(before) = before else { return Some(last.per_second) };
        let ahead = last.interval_s / (last.interval_s + before.interval_s);
        let value = |i: usize| {
            let (last, before) = (last.per_second[i], before.per_second[i]);
            last + ahead * (last - before)
        };
        Some(std::array::from_fn(value))
    }
}
