//! The interface of a capture device, call by call. `device.rs` implements it for the kernel's devices; everything that
//! decides works on this trait and is tested with a fake device.

use std::fmt;
use std::os::fd::BorrowedFd;
use std::path::PathBuf;

use rustix::io::Errno;

pub use super::kernel::Fraction;

/// Four letters that name a pixel format, the first in the lowest byte.
#[derive(Clone, Copy, PartialEq, Eq, Hash)]
pub struct FourCc(pub u32);

impl FourCc {
    /// The code of four letters.
    pub const fn new(letters: &[u8; 4]) -> Self {
        Self(u32::from_le_bytes(*letters))
    }
}

impl fmt::Display for FourCc {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        let letters = self.0.to_le_bytes().map(char::from);
        let text: String =
            letters.iter().map(|&c| if c.is_ascii_graphic() { c } else { ' ' }).collect();
        write!(out, "{}", text.trim_end())
    }
}

impl fmt::Debug for FourCc {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, out)
    }
}

/// Identity of a device.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Capability {
    /// The kernel driver.
    pub driver: String,
    /// The camera's name.
    pub card: String,
    /// Where it is plugged in.
    pub bus: String,
    /// Capabilities of this node (`V4L2_CAP_…`).
    pub flags: u32,
}

/// A pixel format that a device offers.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OfferedFormat {
    /// Its code.
    pub code: FourCc,
    /// Its name.
    pub description: String,
}

/// Image sizes from `smallest` to `largest` (width, height); one size if they are equal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SizeRange {
    /// Smallest.
    pub smallest: (u32, u32),
    /// Largest.
    pub largest: (u32, u32),
}

impl fmt::Display for SizeRange {
    fn fmt(&self, out: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(out, "{}x{}", self.smallest.0, self.smallest.1)?;
        if self.smallest != self.largest {
            write!(out, " to {}x{}", self.largest.0, self.largest.1)?;
        }
        Ok(())
    }
}

/// Frame periods from the shortest to the longest, seconds; one if they are equal.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PeriodRange {
    /// Shortest.
    pub shortest: Fraction,
    /// Longest.
    pub longest: Fraction,
}

/// Frames per second of a period; 0 if its numerator is 0.
pub fn rate_hz(period: Fraction) -> f64 {
    if period.numerator == 0 {
        return 0.0;
    }
    f64::from(period.denominator) / f64::from(period.numerator)
}

/// A layout of the picture, requested or granted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Layout {
    /// Pixel format.
    pub code: FourCc,
    /// Width, pixels.
    pub width: u32,
    /// Height, pixels.
    pub height: u32,
    /// Bytes from row to row; 0 for compressed pictures.
    pub stride: u32,
    /// Order of the lines; 1 is whole pictures.
    pub field: u32,
}

/// A control of a device.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ControlRange {
    /// Its number (`V4L2_CID_…`).
    pub id: u32,
    /// Its name.
    pub name: String,
    /// Type of its value (`V4L2_CTRL_TYPE_…`).
    pub kind: u32,
    /// Smallest value.
    pub minimum: i32,
    /// Largest value.
    pub maximum: i32,
    /// Step.
    pub step: i32,
    /// Value after plugging in.
    pub default: i32,
    /// Flags (`V4L2_CTRL_FLAG_…`).
    pub flags: u32,
}

/// A buffer that the driver has filled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Filled {
    /// Index of the buffer.
    pub index: usize,
    /// Bytes of it that are used, as reported by the driver.
    pub used: usize,
    /// The driver's number of the frame.
    pub sequence: u32,
    /// The driver's stamp.
    pub stamp_nanos: i64,
    /// Flags (`V4L2_BUF_FLAG_…`).
    pub flags: u32,
}

/// An open capture device.
pub trait VideoDevice: Send {
    /// Its identity.
    fn capability(&self) -> Result<Capability, Errno>;
    /// The formats that it offers.
    fn formats(&self) -> Vec<OfferedFormat>;
    /// The sizes of a format; empty if the driver does not report them.
    fn sizes(&self, code: FourCc) -> Vec<SizeRange>;
    /// The frame periods of a format and size; empty if the driver does not report them.
    fn periods(&self, code: FourCc, width: u32, height: u32) -> Vec<PeriodRange>;
    /// Requests a format and size; those that the driver grants may differ.
    fn set_layout(&mut self, code: FourCc, width: u32, height: u32) -> Result<Layout, Errno>;
    /// The frame period, and whether it can be set.
    fn period(&self) -> Result<(Fraction, bool), Errno>;
    /// Requests a frame period; the one that the driver grants may differ.
    fn set_period(&mut self, period: Fraction) -> Result<Fraction, Errno>;
    /// Every control.
    fn controls(&self) -> Vec<ControlRange>;
    /// The names of a menu control's items.
    fn menu(&self, control: &ControlRange) -> Vec<(u32, String)>;
    /// A control, if the device has it.
    fn control(&self, id: u32) -> Option<ControlRange>;
    /// Value of a control.
    fn value(&self, id: u32) -> Result<i32, Errno>;
    /// Sets a control.
    fn set_value(&mut self, id: u32, value: i32) -> Result<(), Errno>;
    /// Makes and maps buffers, and returns their number. With 0 only checks whether another program has some.
    fn make_buffers(&mut self, count: u32) -> Result<usize, Errno>;
    /// Gives a buffer to the driver.
    fn enqueue(&mut self, index: usize) -> Result<(), Errno>;
    /// Takes the oldest filled buffer; `Errno::AGAIN` if there is none.
    fn dequeue(&mut self) -> Result<Filled, Errno>;
    /// Starts streaming.
    fn start(&mut self) -> Result<(), Errno>;
    /// The whole memory of a buffer; empty while the driver owns it.
    fn memory(&self, index: usize) -> &[u8];
    /// Sleeps until a buffer is filled, `wake` can be read, or `millis` have passed. Returns whether a buffer, or an
    /// error, can be dequeued.
    fn wait(&self, wake: Option<BorrowedFd<'_>>, millis: u32) -> Result<bool, Errno>;
}

/// Source of devices and time.
pub trait VideoSystem: Send {
    /// Type of its devices.
    type Device: VideoDevice;
    /// Opens the device of a name; also returns its path, for messages.
    fn open(&mut self, name: &str) -> Result<(PathBuf, Self::Device), OpenFailure>;
    /// CLOCK_MONOTONIC, nanoseconds.
    fn now_nanos(&self) -> i64;
    /// Sleeps until `wake` can be read or `millis` have passed.
    fn pause(&self, wake: Option<BorrowedFd<'_>>, millis: u32);
}

/// Why a device cannot be opened.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum OpenFailure {
    /// No node of this name.
    Missing,
    /// The name fits several nodes.
    Ambiguous(Vec<PathBuf>),
    /// The kernel refuses.
    Refused(PathBuf, Errno),
}
