//! A fake camera: the test sets what it offers, delivers and refuses.

use std::collections::{BTreeMap, VecDeque};
use std::os::fd::BorrowedFd;
use std::path::PathBuf;
use std::sync::{Arc, Mutex, MutexGuard};

use rustix::io::Errno;

use super::kernel::{CAP_STREAMING, CAP_VIDEO_CAPTURE, FIELD_NONE, FLAG_TIMESTAMP_MONOTONIC};
use super::pixel_format::PixelFormat;
use super::video_device::{
    Capability, ControlRange, Filled, FourCc, Fraction, Layout, OfferedFormat, OpenFailure,
    PeriodRange, SizeRange, VideoDevice, VideoSystem,
};

/// Formats with sizes and the fastest rate.
type Offer = (PixelFormat, Vec<(u32, u32)>, u32);

/// The same in the form that tests write.
type OfferedHere<'a> = (PixelFormat, &'a [(u32, u32)], u32);

/// Outcome of a dequeue.
#[derive(Debug, Clone)]
pub enum Event {
    /// A frame of these bytes and this number, with flags and the time since the stamp.
    Frame { bytes: Vec<u8>, used: Option<usize>, sequence: u32, flags: u32, age_nanos: i64 },
    /// An error.
    Fails(Errno),
}

/// A valid frame.
pub fn frame(sequence: u32, bytes: Vec<u8>) -> Event {
    let (flags, age_nanos) = (FLAG_TIMESTAMP_MONOTONIC, 5_000_000);
    Event::Frame { bytes, used: None, sequence, flags, age_nanos }
}

#[derive(Debug)]
struct Inner {
    offers: Vec<Offer>,
    padding: u32,
    flags: u32,
    controls: BTreeMap<u32, (ControlRange, i32)>,
    control_error: Option<Errno>,
    refused_value: Option<(u32, i32)>,
    layout_error: Option<Errno>,
    open_error: Option<OpenFailure>,
    enqueue_errors: VecDeque<Errno>,
    events: VecDeque<Event>,
    now_nanos: i64,
    opened: usize,
    rate: u32,
    is_open: bool,
}

/// The test's handle to the camera.
#[derive(Debug, Clone)]
pub struct Fake(Arc<Mutex<Inner>>);

impl Default for Fake {
    fn default() -> Self {
        Self::with_formats(&[(PixelFormat::Grey, &[(640, 480)], 30)])
    }
}

impl Fake {
    pub fn with_formats(offers: &[OfferedHere<'_>]) -> Self {
        let offers = offers.iter().map(|(f, sizes, rate)| (*f, sizes.to_vec(), *rate)).collect();
        Self(Arc::new(Mutex::new(Inner {
            offers,
            padding: 0,
            flags: CAP_VIDEO_CAPTURE | CAP_STREAMING,
            controls: BTreeMap::new(),
            control_error: None,
            refused_value: None,
            layout_error: None,
            open_error: None,
            enqueue_errors: VecDeque::new(),
            events: VecDeque::new(),
            now_nanos: 1_000_000_000_000,
            opened: 0,
            rate: 30,
            is_open: false,
        })))
    }

    fn inner(&self) -> MutexGuard<'_, Inner> {
        self.0.lock().unwrap()
    }

    pub fn with_control(
        self,
        id: u32,
        name: &str,
        (minimum, maximum, step): (i32, i32, i32),
        value: i32,
        flags: u32,
    ) -> Self {
        let name = name.to_owned();
        let range =
            ControlRange { id, name, kind: 1, minimum, maximum, step, default: value, flags };
        self.inner().controls.insert(id, (range, value));
        self
    }

    pub fn device(&self) -> FakeDevice {
        self.inner().is_open = true;
        FakeDevice { fake: self.clone(), buffers: Vec::new(), is_streaming: false }
    }

    pub fn value_of(&self, id: u32) -> i32 {
        self.inner().controls[&id].1
    }

    pub fn set(&self, id: u32, value: i32) {
        self.inner().controls.get_mut(&id).unwrap().1 = value;
    }

    pub fn refuse_controls(&self, error: Errno) {
        self.inner().control_error = Some(error);
    }

    pub fn refuse_value(&self, id: u32, value: i32) {
        self.inner().refused_value = Some((id, value));
    }

    pub fn refuse_layout(&self, error: Errno) {
        self.inner().layout_error = Some(error);
    }

    pub fn refuse_opening(&self, failure: Option<OpenFailure>) {
        self.inner().open_error = failure;
    }

    pub fn refuse_enqueues(&self, errors: &[Errno]) {
        self.inner().enqueue_errors.extend(errors);
    }

    pub fn pad_rows(&self, padding: u32) {
        self.inner().padding = padding;
    }

    pub fn set_capability_flags(&self, flags: u32) {
        self.inner().flags = flags;
    }

    pub fn give(&self, event: Event) {
        self.inner().events.push_back(event);
    }

    pub fn pass(&self, nanos: i64) {
        self.inner().now_nanos += nanos;
    }

    pub fn now_nanos(&self) -> i64 {
        self.inner().now_nanos
    }

    /// Number of times it was opened.
    pub fn opened(&self) -> usize {
        self.inner().opened
    }

    pub fn is_open(&self) -> bool {
        self.inner().is_open
    }
}

pub struct FakeDevice {
    fake: Fake,
    /// Memory, and whether the driver owns it.
    buffers: Vec<(Vec<u8>, bool)>,
    is_streaming: bool,
}

impl Drop for FakeDevice {
    fn drop(&mut self) {
        self.fake.inner().is_open = false;
    }
}

impl VideoDevice for FakeDevice {
    fn capability(&self) -> Result<Capability, Errno> {
        Ok(Capability { flags: self.fake.inner().flags, ..Capability::default() })
    }

    fn formats(&self) -> Vec<OfferedFormat> {
        let offers = &self.fake.inner().offers;
        let offered = |(format, ..): &Offer| OfferedFormat {
            code: format.code(),
            description: format!("{format:?}"),
        };
        offers.iter().map(offered).collect()
    }

    fn sizes(&self, code: FourCc) -> Vec<SizeRange> {
        let inner = self.fake.inner();
        let offer = inner.offers.iter().find(|(format, ..)| format.code() == code);
        let size = |&size: &(u32, u32)| SizeRange { smallest: size, largest: size };
        offer.map_or(Vec::new(), |(_, sizes, _)| sizes.iter().map(size).collect())
    }

    fn periods(&self, code: FourCc, width: u32, height: u32) -> Vec<PeriodRange> {
        let inner = self.fake.inner();
        let offer = inner
            .offers
            .iter()
            .find(|(format, sizes, _)| format.code() == code && sizes.contains(&(width, height)));
        offer.map_or(Vec::new(), |(.., rate)| {
            let period = Fraction { numerator: 1, denominator: *rate };
            vec![PeriodRange { shortest: period, longest: period }]
        })
    }

    fn set_layout(&mut self, code: FourCc, width: u32, height: u32) -> Result<Layout, Errno> {
        let mut inner = self.fake.inner();
        if let Some(error) = inner.layout_error {
            return Err(error);
        }
        let (format, sizes, rate) = inner
            .offers
            .iter()
            .find(|(format, ..)| format.code() == code)
            .or(inner.offers.first())
            .cloned()
            .ok_or(Errno::INVAL)?;
        inner.rate = rate;
        let wanted = (width, height);
        let (width, height) = if sizes.contains(&wanted) { wanted } else { sizes[0] };
        let bytes = match format {
            PixelFormat::Mjpeg => 0,
            PixelFormat::Grey | PixelFormat::Nv12 => width,
            _ => 2 * width,
        };
        let stride = bytes + inner.padding;
        Ok(Layout { code: format.code(), width, height, stride, field: FIELD_NONE })
    }

    fn period(&self) -> Result<(Fraction, bool), Errno> {
        Ok((Fraction { numerator: 1, denominator: self.fake.inner().rate }, true))
    }

    fn set_period(&mut self, _: Fraction) -> Result<Fraction, Errno> {
        self.period().map(|(period, _)| period)
    }

    fn controls(&self) -> Vec<ControlRange> {
        self.fake.inner().controls.values().map(|(range, _)| range.clone()).collect()
    }

    fn menu(&self, _: &ControlRange) -> Vec<(u32, String)> {
        Vec::new()
    }

    fn control(&self, id: u32) -> Option<ControlRange> {
        self.fake.inner().controls.get(&id).map(|(range, _)| range.clone())
    }

    fn value(&self, id: u32) -> Result<i32, Errno> {
        self.fake.inner().controls.get(&id).map(|(_, value)| *value).ok_or(Errno::INVAL)
    }

    fn set_value(&mut self, id: u32, value: i32) -> Result<(), Errno> {
        let mut inner = self.fake.inner();
        if let Some(error) = inner.control_error {
            return Err(error);
        }
        if inner.refused_value == Some((id, value)) {
            return Err(Errno::INVAL);
        }
        let (range, held) = inner.controls.get_mut(&id).ok_or(Errno::INVAL)?;
        *held = value.clamp(range.minimum, range.maximum);
        Ok(())
    }

    fn make_buffers(&mut self, count: u32) -> Result<usize, Errno> {
        self.buffers = vec![(Vec::new(), false); count as usize];
        Ok(self.buffers.len())
    }

    fn enqueue(&mut self, index: usize) -> Result<(), Errno> {
        if let Some(error) = self.fake.inner().enqueue_errors.pop_front() {
            return Err(error);
        }
        let (_, is_queued) = self.buffers.get_mut(index).ok_or(Errno::INVAL)?;
        // The mistake that ends a stream: enqueueing a buffer that the driver owns.
        assert!(!std::mem::replace(is_queued, true), "buffer {index} is the driver's");
        Ok(())
    }

    fn dequeue(&mut self) -> Result<Filled, Errno> {
        assert!(self.is_streaming);
        let mut inner = self.fake.inner();
        let Some(index) = self.buffers.iter().position(|(_, is_queued)| *is_queued) else {
            return Err(Errno::AGAIN);
        };
        match inner.events.pop_front() {
            None => Err(Errno::AGAIN),
            Some(Event::Fails(error)) => Err(error),
            Some(Event::Frame { bytes, used, sequence, flags, age_nanos }) => {
                let used = used.unwrap_or(bytes.len());
                self.buffers[index] = (bytes, false);
                let stamp_nanos = inner.now_nanos - age_nanos;
                Ok(Filled { index, used, sequence, stamp_nanos, flags })
            }
        }
    }

    fn start(&mut self) -> Result<(), Errno> {
        self.is_streaming = true;
        Ok(())
    }

    fn memory(&self, index: usize) -> &[u8] {
        self.buffers.get(index).filter(|(_, queued)| !queued).map_or(&[], |(bytes, _)| bytes)
    }

    fn wait(&self, _: Option<BorrowedFd<'_>>, millis: u32) -> Result<bool, Errno> {
        if !self.fake.inner().events.is_empty() {
            return Ok(true);
        }
        self.fake.pass(i64::from(millis) * 1_000_000);
        Ok(false)
    }
}

impl VideoSystem for Fake {
    type Device = FakeDevice;

    fn open(&mut self, _: &str) -> Result<(PathBuf, FakeDevice), OpenFailure> {
        if let Some(failure) = self.inner().open_error.clone() {
            return Err(failure);
        }
        self.inner().opened += 1;
        Ok((PathBuf::from("/dev/video0"), self.device()))
    }

    fn now_nanos(&self) -> i64 {
        self.inner().now_nanos
    }

    fn pause(&self, _: Option<BorrowedFd<'_>>, millis: u32) {
        self.pass(i64::from(millis) * 1_000_000);
    }
}
