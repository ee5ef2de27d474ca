//! A capture device of the kernel: requests, mapped buffers, waiting.

use std::fs::File;
use std::os::fd::{AsRawFd, BorrowedFd};
use std::path::{Path, PathBuf};
use std::ptr::{NonNull, null_mut};

use rustix::event::{PollFd, PollFlags, Timespec};
use rustix::io::{Errno, retry_on_intr};
use rustix::mm::{MapFlags, ProtFlags, mmap, munmap};
use rustix::time::{ClockId, clock_gettime};

use super::device_name::find;
use super::kernel::{
    self, BUFFER_TYPE_CAPTURE as CAPTURE, FramePeriodEnumeration, FrameSizeEnumeration,
    KernelStruct, MEMORY_MMAP, Request, zeroed,
};
use super::video_device::{
    Capability, ControlRange, Filled, FourCc, Fraction, Layout, OfferedFormat, OpenFailure,
    PeriodRange, SizeRange, VideoDevice, VideoSystem,
};

/// Maximum number of entries of an enumeration: a driver without an end is broken.
const MAX_ENTRIES: u32 = 1024;
/// Maximum number of buffers.
const MAX_BUFFERS: u32 = 32;

/// Memory of the driver, mapped for reading.
struct Mapping {
    start: NonNull<libc::c_void>,
    length: usize,
    /// Whether the driver owns it, and may write.
    is_queued: bool,
}

// SAFETY: the mapping is memory of this process, bound to no thread.
unsafe impl Send for Mapping {}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: `start` and `length` are those of a mapping that nobody else unmaps; slices of it
        // borrow the device that owns it.
        let _ = unsafe { munmap(self.start.as_ptr(), self.length) };
    }
}

/// An open device node.
pub struct KernelDevice {
    // Before the file, so that buffers are unmapped before they are released.
    buffers: Vec<Mapping>,
    file: File,
}

impl KernelDevice {
    /// Opens a node, without blocking.
    pub fn open(path: &Path) -> Result<Self, Errno> {
        use rustix::fs::{Mode, OFlags};
        let flags = OFlags::RDWR | OFlags::NONBLOCK | OFlags::CLOEXEC;
        let descriptor = retry_on_intr(|| rustix::fs::open(path, flags, Mode::empty()))?;
        Ok(Self { buffers: Vec::new(), file: File::from(descriptor) })
    }

    /// Makes one request; the driver reads and writes `structure`.
    fn request<T: KernelStruct>(
        &self,
        request: &Request<T>,
        structure: &mut T,
    ) -> Result<(), Errno> {
        retry_on_intr(|| {
            // SAFETY: the number encodes the size of `T`, which is the structure of this request, and
            // the kernel keeps no pointer to it.
            let answer = unsafe {
                libc::ioctl(
                    self.file.as_raw_fd(),
                    request.number as _,
                    std::ptr::from_mut(structure),
                )
            };
            let error = || std::io::Error::last_os_error();
            if answer < 0 {
                Err(Errno::from_io_error(&error()).unwrap_or(Errno::IO))
            } else {
                Ok(())
            }
        })
    }

    /// Reads entry after entry, until the driver has no more.
    fn enumerate<T: KernelStruct, R>(
        &self,
        request: &Request<T>,
        first: impl Fn(u32) -> T,
        read: impl Fn(&T) -> R,
    ) -> Vec<R> {
        let answer = |mut entry: T| self.request(request, &mut entry).ok().map(|()| read(&entry));
        (0..MAX_ENTRIES).map(first).map_while(answer).collect()
    }

    fn map(&self, index: u32) -> Result<Mapping, Errno> {
        let mut buffer = blank_buffer(index);
        self.request(&kernel::QUERY_BUFFER, &mut buffer)?;
        let length = buffer.length as usize;
        // SAFETY: for MMAP buffers the union holds the offset.
        let offset = unsafe { buffer.place.offset };
        let (readable, flags) = (ProtFlags::READ, MapFlags::SHARED);
        // SAFETY: a new mapping of `length` bytes, which the kernel places; nothing else is touched.
        let start = unsafe { mmap(null_mut(), length, readable, flags, &self.file, offset.into()) };
        let start = NonNull::new(start?).ok_or(Errno::NOMEM)?;
        Ok(Mapping { start, length, is_queued: false })
    }
}

fn blank_buffer(index: u32) -> kernel::Buffer {
    kernel::Buffer { index, buffer_type: CAPTURE, memory: MEMORY_MMAP, ..zeroed() }
}

/// A text from the kernel, up to its zero byte.
fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|&b| b == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).trim().to_owned()
}

fn control_range(query: &kernel::QueryControl) -> ControlRange {
    ControlRange {
        id: query.id,
        name: text(&query.name),
        kind: query.kind,
        minimum: query.minimum,
        maximum: query.maximum,
        step: query.step,
        default: query.default,
        flags: query.flags,
    }
}

/// The driver's stamp in nanoseconds.
fn stamp_nanos(stamp: libc::timeval) -> i64 {
    let micros = stamp.tv_usec.saturating_mul(1000);
    stamp.tv_sec.saturating_mul(1_000_000_000).saturating_add(micros)
}

impl VideoDevice for KernelDevice {
    fn capability(&self) -> Result<Capability, Errno> {
        let mut found = zeroed::<kernel::Capability>();
        self.request(&kernel::QUERY_CAPABILITY, &mut found)?;
        let has_own = found.capabilities & kernel::CAP_DEVICE_CAPS != 0;
        Ok(Capability {
            driver: text(&found.driver),
            card: text(&found.card),
            bus: text(&found.bus_info),
            flags: if has_own { found.device_caps } else { found.capabilities },
        })
    }

    fn formats(&self) -> Vec<OfferedFormat> {
        let first = |index| kernel::FormatDescription { index, buffer_type: CAPTURE, ..zeroed() };
        self.enumerate(&kernel::ENUMERATE_FORMATS, first, |entry| OfferedFormat {
            code: FourCc(entry.pixel_format),
            description: text(&entry.description),
        })
    }

    fn sizes(&self, code: FourCc) -> Vec<SizeRange> {
        let pixel_format = code.0;
        let first = |index| FrameSizeEnumeration { index, pixel_format, ..zeroed() };
        let mut sizes = self.enumerate(&kernel::ENUMERATE_SIZES, first, |entry| {
            let [a, b, _, d, e, _] = entry.range;
            match entry.kind {
                kernel::ENUMERATION_DISCRETE => SizeRange { smallest: (a, b), largest: (a, b) },
                _ => SizeRange { smallest: (a, d), largest: (b, e) },
            }
        });
        // A range has one entry; some drivers return it again for every index.
        sizes.dedup();
        sizes
    }

    fn periods(&self, code: FourCc, width: u32, height: u32) -> Vec<PeriodRange> {
        let size_and_format =
            FramePeriodEnumeration { pixel_format: code.0, width, height, ..zeroed() };
        let first = |index| FramePeriodEnumeration { index, ..size_and_format };
        let mut periods = self.enumerate(&kernel::ENUMERATE_PERIODS, first, |entry| {
            let [shortest, longest, _] = entry.range;
            match entry.kind {
                kernel::ENUMERATION_DISCRETE => PeriodRange { shortest, longest: shortest },
                _ => PeriodRange { shortest, longest },
            }
        });
        periods.dedup();
        periods
    }

    fn set_layout(&mut self, code: FourCc, width: u32, height: u32) -> Result<Layout, Errno> {
        let mut format = kernel::Format { buffer_type: CAPTURE, ..zeroed() };
        // All other fields zero: a leftover stride or size would be taken for a request.
        let (pixel_format, field) = (code.0, kernel::FIELD_NONE);
        format.pix.pix = kernel::PixFormat { width, height, pixel_format, field, ..zeroed() };
        self.request(&kernel::SET_FORMAT, &mut format)?;
        // SAFETY: every bit pattern is a value of every member.
        let pix = unsafe { format.pix.pix };
        Ok(Layout {
            code: FourCc(pix.pixel_format),
            width: pix.width,
            height: pix.height,
            stride: pix.bytes_per_line,
            field: pix.field,
        })
    }

    fn period(&self) -> Result<(Fraction, bool), Errno> {
        let mut parm = kernel::StreamParm { buffer_type: CAPTURE, ..zeroed() };
        self.request(&kernel::GET_PARM, &mut parm)?;
        Ok((parm.time_per_frame, parm.capability & kernel::CAP_TIME_PER_FRAME != 0))
    }

    fn set_period(&mut self, period: Fraction) -> Result<Fraction, Errno> {
        let mut parm =
            kernel::StreamParm { buffer_type: CAPTURE, time_per_frame: period, ..zeroed() };
        self.request(&kernel::SET_PARM, &mut parm)?;
        Ok(parm.time_per_frame)
    }

    fn controls(&self) -> Vec<ControlRange> {
        let mut found: Vec<ControlRange> = Vec::new();
        let mut id = 0;
        for _ in 0..MAX_ENTRIES {
            let mut query = kernel::QueryControl { id: id | kernel::CONTROL_NEXT, ..zeroed() };
            if self.request(&kernel::QUERY_CONTROL, &mut query).is_err() || query.id <= id {
                break;
            }
            id = query.id;
            if query.flags & kernel::CONTROL_DISABLED == 0 {
                found.push(control_range(&query));
            }
        }
        found
    }

    fn menu(&self, control: &ControlRange) -> Vec<(u32, String)> {
        let (Ok(first), Ok(last)) =
            (u32::try_from(control.minimum), u32::try_from(control.maximum))
        else {
            return Vec::new();
        };
        let item = |index| {
            let mut menu = kernel::QueryMenu { id: control.id, index, ..zeroed() };
            self.request(&kernel::QUERY_MENU, &mut menu).ok()?;
            let bytes = menu.name;
            let [a, b, c, d, e, f, g, h, ..] = bytes;
            Some(match control.kind {
                kernel::CONTROL_TYPE_INTEGER_MENU => {
                    (index, i64::from_ne_bytes([a, b, c, d, e, f, g, h]).to_string())
                }
                _ => (index, text(&bytes)),
            })
        };
        (first..=last).take(MAX_ENTRIES as usize).filter_map(item).collect()
    }

    fn control(&self, id: u32) -> Option<ControlRange> {
        let mut query = kernel::QueryControl { id, ..zeroed() };
        self.request(&kernel::QUERY_CONTROL, &mut query).ok()?;
        (query.flags & kernel::CONTROL_DISABLED == 0).then(|| control_range(&query))
    }

    fn value(&self, id: u32) -> Result<i32, Errno> {
        let mut control = kernel::Control { id, value: 0 };
        self.request(&kernel::GET_CONTROL, &mut control)?;
        Ok(control.value)
    }

    fn set_value(&mut self, id: u32, value: i32) -> Result<(), Errno> {
        self.request(&kernel::SET_CONTROL, &mut kernel::Control { id, value })
    }

    fn make_buffers(&mut self, count: u32) -> Result<usize, Errno> {
        let (buffer_type, memory) = (CAPTURE, MEMORY_MMAP);
        let mut wish = kernel::RequestBuffers { count, buffer_type, memory, ..zeroed() };
        self.buffers.clear();
        self.request(&kernel::REQUEST_BUFFERS, &mut wish)?;
        if count > 0 {
            for index in 0..wish.count.min(MAX_BUFFERS) {
                let mapping = self.map(index)?;
                self.buffers.push(mapping);
            }
        }
        Ok(self.buffers.len())
    }

    fn enqueue(&mut self, index: usize) -> Result<(), Errno> {
        let number = u32::try_from(index).map_err(|_| Errno::INVAL)?;
        if self.buffers.get(index).is_none_or(|buffer| buffer.is_queued) {
            return Err(Errno::INVAL);
        }
        self.request(&kernel::ENQUEUE_BUFFER, &mut blank_buffer(number))?;
        self.buffers[index].is_queued = true;
        Ok(())
    }

    fn dequeue(&mut self) -> Result<Filled, Errno> {
        let mut buffer = blank_buffer(0);
        self.request(&kernel::DEQUEUE_BUFFER, &mut buffer)?;
        let index = buffer.index as usize;
        // A driver that names a buffer that does not exist is not to be trusted.
        let mapping = self.buffers.get_mut(index).ok_or(Errno::IO)?;
        mapping.is_queued = false;
        Ok(Filled {
            index,
            used: buffer.bytes_used as usize,
            sequence: buffer.sequence,
            stamp_nanos: stamp_nanos(buffer.timestamp),
            flags: buffer.flags,
        })
    }

    fn start(&mut self) -> Result<(), Errno> {
        let mut buffer_type = CAPTURE as i32;
        self.request(&kernel::STREAM_ON, &mut buffer_type)
    }

    fn memory(&self, index: usize) -> &[u8] {
        let Some(mapping) = self.buffers.get(index).filter(|mapping| !mapping.is_queued) else {
            return &[];
        };
        // SAFETY: the mapping lives as long as the device, has `length` bytes, and is not the driver's:
        // it was dequeued, and `enqueue` needs `&mut self`, which ends this borrow.
        unsafe { std::slice::from_raw_parts(mapping.start.as_ptr().cast(), mapping.length) }
    }

    fn wait(&self, wake: Option<BorrowedFd<'_>>, millis: u32) -> Result<bool, Errno> {
        let own = PollFd::new(&self.file, PollFlags::IN);
        let events = match wake {
            None => poll(&mut [own], millis)?,
            Some(wake) => poll(&mut [own, PollFd::from_borrowed_fd(wake, PollFlags::IN)], millis)?,
        };
        // An error counts as ready too: the next dequeue reports it.
        Ok(!events.is_empty())
    }
}

impl Drop for KernelDevice {
    fn drop(&mut self) {
        let mut buffer_type = CAPTURE as i32;
        // Closing ends the stream too; a device that is gone refuses, which changes nothing.
        let _ = self.request(&kernel::STREAM_OFF, &mut buffer_type);
    }
}

/// Returns the events on the first descriptor within `millis`; none if a signal interrupts. Without a descriptor it is
/// a sleep.
pub fn poll(descriptors: &mut [PollFd<'_>], millis: u32) -> Result<PollFlags, Errno> {
    let timeout = Timespec {
        tv_sec: i64::from(millis / 1000),
        tv_nsec: i64::from(millis % 1000) * 1_000_000,
    };
    match rustix::event::poll(descriptors, Some(&timeout)) {
        Ok(_) => Ok(descriptors.first().map_or(PollFlags::empty(), PollFd::revents)),
        Err(Errno::INTR) => Ok(PollFlags::empty()),
        Err(error) => Err(error),
    }
}

/// The devices and the clock of this machine.
#[derive(Debug, Clone, Copy, Default)]
pub struct Kernel;

impl VideoSystem for Kernel {
    type Device = KernelDevice;

    fn open(&mut self, name: &str) -> Result<(PathBuf, KernelDevice), OpenFailure> {
        let path = find(Path::new("/dev"), name)?;
        match KernelDevice::open(&path) {
            Ok(device) => Ok((path, device)),
            Err(Errno::NOENT) => Err(OpenFailure::Missing),
            Err(error) => Err(OpenFailure::Refused(path, error)),
        }
    }

    fn now_nanos(&self) -> i64 {
        let now = clock_gettime(ClockId::Monotonic);
        now.tv_sec * 1_000_000_000 + now.tv_nsec
    }

    fn pause(&self, wake: Option<BorrowedFd<'_>>, millis: u32) {
        // The caller checks what caused the wake-up.
        let mut polled = wake.map(|wake| PollFd::from_borrowed_fd(wake, PollFlags::IN));
        let _ = poll(polled.as_mut_slice(), millis);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_device_other_than_a_camera_gives_errors_without_a_panic() {
        let mut null = KernelDevice::open(Path::new("/dev/null")).unwrap();
        assert_eq!(null.capability().unwrap_err(), Errno::NOTTY);
        assert!(null.formats().is_empty() && null.controls().is_empty());
        assert_eq!(null.make_buffers(4).unwrap_err(), Errno::NOTTY);
        assert_eq!(null.enqueue(0).unwrap_err(), Errno::INVAL);
        assert!(null.dequeue().is_err());
        assert!(null.memory(0).is_empty());
    }

    #[test]
    fn a_node_that_does_not_exist_is_missing() {
        let missing = Kernel.open("/dev/video-that-nobody-has").err();
        assert_eq!(missing, Some(OpenFailure::Missing));
    }

    #[test]
    fn stamps_and_texts_of_the_kernel_are_converted() {
        let stamp = libc::timeval { tv_sec: 3, tv_usec: 250_000 };
        assert_eq!(stamp_nanos(stamp), 3_250_000_000);
        assert_eq!(text(b"Vivid\0\0xx"), "Vivid");
        assert_eq!(text(&[0xff, b'a']), "\u{fffd}a");
    }
}
