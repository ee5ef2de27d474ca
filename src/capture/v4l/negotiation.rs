//! The request to a camera and what it grants: format, size, rate.

use rustix::io::Errno;

use super::kernel::{CAP_STREAMING, CAP_VIDEO_CAPTURE, CAP_VIDEO_CAPTURE_MPLANE};
use super::pixel_format::{PixelFormat, is_usable};
use super::video_device::{Fraction, Layout, SizeRange, VideoDevice, rate_hz};

/// Share of the requested rate within which a granted one counts as equal: 29.97 for 30.
const RATE_TOLERANCE: f64 = 0.05;
/// Rates are requested in thousandths of a hertz.
const MILLIHERTZ: f64 = 1000.0;

/// The request.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct StreamRequest {
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Format; `None` for the best.
    pub format: Option<PixelFormat>,
    /// Frames per second; `None` for the camera's own.
    pub rate_hz: Option<f64>,
}

/// The grant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Grant {
    /// Format.
    pub format: PixelFormat,
    /// Bytes from row to row.
    pub stride: usize,
    /// Frames per second, if the driver reports it.
    pub rate_hz: Option<f64>,
}

/// Why a camera cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum NegotiationError {
    /// Not a capture device that streams.
    #[error("is not a usable camera: {0}")]
    NoCamera(&'static str),
    /// None of our formats.
    #[error(
        "offers {offered}, none of the requested formats; set capture.camera.format = \"auto\""
    )]
    NoFormat {
        /// The formats offered.
        offered: String,
    },
    /// Not the rig's size.
    #[error("delivers {found} instead of {wanted}; it offers {offered}")]
    Size {
        /// The layout that it delivers.
        found: String,
        /// The rig's size.
        wanted: String,
        /// Sizes of its formats.
        offered: String,
    },
    /// The driver refuses.
    #[error("{0}")]
    Device(Errno),
}

/// Requests format, size and rate, and checks the grant. A rate that is not granted is not an error; the grant contains
/// the actual one.
pub fn negotiate(
    device: &mut dyn VideoDevice,
    requested: &StreamRequest,
) -> Result<Grant, NegotiationError> {
    check_capability(device)?;
    let (format, layout) = agree_on_layout(device, requested)?;
    let rate_hz = agree_on_rate(device, requested.rate_hz);
    Ok(Grant { format, stride: layout.stride as usize, rate_hz })
}

/// Whether a granted rate differs from the requested one.
pub fn rate_differs(wanted: Option<f64>, granted: Option<f64>) -> bool {
    let pair = wanted.zip(granted);
    pair.is_some_and(|(wanted, granted)| (granted - wanted).abs() > RATE_TOLERANCE * wanted)
}

fn check_capability(device: &dyn VideoDevice) -> Result<(), NegotiationError> {
    let no_camera = NegotiationError::NoCamera;
    let capability = device.capability().map_err(|error| match error {
        Errno::NOTTY | Errno::INVAL => no_camera("it is not a video device"),
        error => NegotiationError::Device(error),
    })?;
    let has = |flag: u32| capability.flags & flag != 0;
    let problem = match (has(CAP_VIDEO_CAPTURE), has(CAP_VIDEO_CAPTURE_MPLANE)) {
        (true, _) if has(CAP_STREAMING) => return Ok(()),
        (true, _) => "it cannot stream",
        (false, true) => "it delivers only multi-planar images",
        (false, false) => {
            "it delivers no images; a camera may have several device nodes, try another"
        }
    };
    Err(no_camera(problem))
}

/// Formats in the order of trial: those that reach the rate in their order, then the others, fastest first. If a driver
/// does not report what it offers, all are tried.
fn candidates(device: &dyn VideoDevice, requested: &StreamRequest) -> Vec<PixelFormat> {
    let offered = device.formats();
    let is_wanted = |format: &PixelFormat| {
        requested.format.is_none_or(|wanted| wanted == *format)
            && (offered.is_empty() || offered.iter().any(|o| o.code == format.code()))
    };
    let fastest = |format: PixelFormat| {
        let periods = device.periods(format.code(), requested.width, requested.height);
        periods.iter().map(|period| rate_hz(period.shortest)).reduce(f64::max)
    };
    let mut found: Vec<(PixelFormat, f64)> = PixelFormat::ALL
        .into_iter()
        .filter(is_wanted)
        .map(|format| {
            let shortfall = match (requested.rate_hz, fastest(format)) {
                (Some(wanted), Some(fastest)) => wanted * (1.0 - RATE_TOLERANCE) - fastest,
                _ => 0.0,
            };
            (format, shortfall.max(0.0))
        })
        .collect();
    // Stable: formats that reach the rate keep their order.
    found.sort_by(|a, b| a.1.total_cmp(&b.1));
    found.into_iter().map(|(format, _)| format).collect()
}

fn agree_on_layout(
    device: &mut dyn VideoDevice,
    requested: &StreamRequest,
) -> Result<(PixelFormat, Layout), NegotiationError> {
    let mut found: Option<Layout> = None;
    for format in candidates(device, requested) {
        match device.set_layout(format.code(), requested.width, requested.height) {
            // This format or size is not available; another may be.
            Err(Errno::INVAL) => {}
            Err(error) => return Err(NegotiationError::Device(error)),
            Ok(layout) if layout.code != format.code() => {}
            Ok(layout)
                if (layout.width, layout.height) == (requested.width, requested.height)
                    && is_usable(&layout) =>
            {
                return Ok((format, layout));
            }
            Ok(layout) => found = found.or(Some(layout)),
        }
    }
    let Some(layout) = found else {
        let codes: Vec<String> = device.formats().iter().map(|o| o.code.to_string()).collect();
        let offered = if codes.is_empty() { "nothing".to_owned() } else { codes.join(", ") };
        return Err(NegotiationError::NoFormat { offered });
    };
    let order = if layout.field > 1 { " interlaced" } else { "" };
    Err(NegotiationError::Size {
        found: format!("{}x{} {}{order}", layout.width, layout.height, layout.code),
        wanted: format!("{}x{}", requested.width, requested.height),
        offered: offered_sizes(device),
    })
}

fn offered_sizes(device: &dyn VideoDevice) -> String {
    let known = device.formats().into_iter().filter(|o| PixelFormat::of(o.code).is_some());
    let mut sizes: Vec<SizeRange> = known.flat_map(|o| device.sizes(o.code)).collect();
    sizes.sort_by_key(|size| (size.smallest, size.largest));
    sizes.dedup();
    match sizes.as_slice() {
        [] => "no other sizes that its driver reports".to_owned(),
        sizes => sizes.iter().map(SizeRange::to_string).collect::<Vec<_>>().join(", "),
    }
}

fn agree_on_rate(device: &mut dyn VideoDevice, wanted: Option<f64>) -> Option<f64> {
    let (own, can_be_set) = device.period().ok()?;
    let granted = match wanted {
        Some(wanted) if can_be_set => {
            let denominator = (wanted * MILLIHERTZ).round().max(1.0) as u32;
            let period = Fraction { numerator: MILLIHERTZ as u32, denominator };
            device.set_period(period).unwrap_or(own)
        }
        _ => own,
    };
    Some(rate_hz(granted)).filter(|rate| *rate > 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::capture::v4l::fake::Fake;

    fn requested(format: Option<PixelFormat>, rate_hz: Option<f64>) -> StreamRequest {
        StreamRequest { width: 640, height: 480, format, rate_hz }
    }

    #[test]
    fn the_cheapest_format_that_reaches_the_rate_is_chosen() {
        // A webcam: raw pictures slowly, compressed ones fast.
        let webcam = Fake::with_formats(&[
            (PixelFormat::Mjpeg, &[(640, 480)], 30),
            (PixelFormat::Yuyv, &[(640, 480)], 10),
        ]);
        let granted =
            |requested: StreamRequest| negotiate(&mut webcam.device(), &requested).unwrap();
        assert_eq!(granted(requested(None, Some(30.0))).format, PixelFormat::Mjpeg);
        assert_eq!(granted(requested(None, Some(30.5))).format, PixelFormat::Mjpeg, "within 5 %");
        assert_eq!(granted(requested(None, Some(60.0))).format, PixelFormat::Mjpeg, "the fastest");
        let slow = granted(requested(None, Some(10.0)));
        assert_eq!((slow.format, slow.stride), (PixelFormat::Yuyv, 1280));
        assert_eq!(granted(requested(None, None)).format, PixelFormat::Yuyv);
        assert_eq!(granted(requested(Some(PixelFormat::Mjpeg), None)).format, PixelFormat::Mjpeg);
        assert!(rate_differs(Some(60.0), Some(30.0)) && !rate_differs(Some(30.0), Some(29.97)));
    }

    #[test]
    fn rows_are_as_long_as_granted() {
        let padded = Fake::with_formats(&[(PixelFormat::Grey, &[(640, 480)], 30)]);
        padded.pad_rows(64);
        let grant = negotiate(&mut padded.device(), &requested(None, Some(30.0))).unwrap();
        assert_eq!((grant.stride, grant.rate_hz), (704, Some(30.0)));
    }

    #[test]
    fn another_size_is_refused_with_the_sizes_offered() {
        let camera = Fake::with_formats(&[(PixelFormat::Yuyv, &[(320, 240), (1280, 720)], 30)]);
        let error = negotiate(&mut camera.device(), &requested(None, None)).unwrap_err();
        assert_eq!(
            error.to_string(),
            "delivers 320x240 YUYV instead of 640x480; it offers 320x240, 1280x720"
        );
        let grey = negotiate(&mut camera.device(), &requested(Some(PixelFormat::Grey), None));
        assert_eq!(grey.unwrap_err(), NegotiationError::NoFormat { offered: "YUYV".to_owned() });
    }

    #[test]
    fn devices_other_than_cameras_are_reported_as_such() {
        let fake = Fake::with_formats(&[(PixelFormat::Grey, &[(640, 480)], 30)]);
        let refused = |flags| {
            fake.set_capability_flags(flags);
            negotiate(&mut fake.device(), &requested(None, None)).unwrap_err().to_string()
        };
        assert!(refused(CAP_STREAMING).contains("no images"), "an output or metadata node");
        assert!(refused(CAP_VIDEO_CAPTURE).contains("cannot stream"));
        assert!(refused(CAP_VIDEO_CAPTURE_MPLANE | CAP_STREAMING).contains("multi-planar"));
    }

    #[test]
    fn a_busy_camera_is_not_a_format_error() {
        let fake = Fake::with_formats(&[(PixelFormat::Grey, &[(640, 480)], 30)]);
        fake.refuse_layout(Errno::BUSY);
        let error = negotiate(&mut fake.device(), &requested(None, None)).unwrap_err();
        assert_eq!(error, NegotiationError::Device(Errno::BUSY));
    }
}
