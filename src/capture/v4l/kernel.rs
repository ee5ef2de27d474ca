//! The part of `linux/videodev2.h` that a capture device needs: structures and request numbers.
//!
//! The header is the kernel's binary interface and does not change; a test compares every size, offset and number with
//! it if a C compiler is available, and with pinned values everywhere.

/// `V4L2_BUF_TYPE_VIDEO_CAPTURE`.
pub const BUFFER_TYPE_CAPTURE: u32 = 1;
/// `V4L2_MEMORY_MMAP`.
pub const MEMORY_MMAP: u32 = 1;
/// `V4L2_FIELD_NONE`: whole pictures.
pub const FIELD_NONE: u32 = 1;

/// `V4L2_CAP_VIDEO_CAPTURE`.
pub const CAP_VIDEO_CAPTURE: u32 = 0x1;
/// `V4L2_CAP_VIDEO_CAPTURE_MPLANE`.
pub const CAP_VIDEO_CAPTURE_MPLANE: u32 = 0x1000;
/// `V4L2_CAP_STREAMING`.
pub const CAP_STREAMING: u32 = 0x0400_0000;
/// `V4L2_CAP_DEVICE_CAPS`: `device_caps` describes this node alone.
pub const CAP_DEVICE_CAPS: u32 = 0x8000_0000;
/// `V4L2_CAP_TIMEPERFRAME`: the rate can be set.
pub const CAP_TIME_PER_FRAME: u32 = 0x1000;

/// `V4L2_BUF_FLAG_ERROR`: the picture is damaged.
pub const FLAG_ERROR: u32 = 0x40;
/// `V4L2_BUF_FLAG_TIMESTAMP_MASK`.
pub const FLAG_TIMESTAMP_MASK: u32 = 0xe000;
/// `V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC`.
pub const FLAG_TIMESTAMP_MONOTONIC: u32 = 0x2000;
/// `V4L2_BUF_FLAG_TSTAMP_SRC_MASK`.
pub const FLAG_STAMP_SOURCE_MASK: u32 = 0x7_0000;
/// `V4L2_BUF_FLAG_TSTAMP_SRC_SOE`: the stamp is the start of the exposure, else the end of the frame.
pub const FLAG_STAMP_START: u32 = 0x1_0000;

/// `V4L2_CTRL_FLAG_DISABLED`.
pub const CONTROL_DISABLED: u32 = 0x1;
/// `V4L2_CTRL_FLAG_READ_ONLY`.
pub const CONTROL_READ_ONLY: u32 = 0x4;
/// `V4L2_CTRL_FLAG_INACTIVE`.
pub const CONTROL_INACTIVE: u32 = 0x10;
/// `V4L2_CTRL_FLAG_WRITE_ONLY`.
pub const CONTROL_WRITE_ONLY: u32 = 0x40;
/// `V4L2_CTRL_FLAG_NEXT_CTRL`: requests the control after this one.
pub const CONTROL_NEXT: u32 = 0x8000_0000;

/// `V4L2_CTRL_TYPE_INTEGER`: with those below, the type of a control's value.
pub const CONTROL_TYPE_INTEGER: u32 = 1;
/// `V4L2_CTRL_TYPE_BOOLEAN`.
pub const CONTROL_TYPE_BOOLEAN: u32 = 2;
/// `V4L2_CTRL_TYPE_MENU`.
pub const CONTROL_TYPE_MENU: u32 = 3;
/// `V4L2_CTRL_TYPE_INTEGER_MENU`.
pub const CONTROL_TYPE_INTEGER_MENU: u32 = 9;

/// `V4L2_FRMSIZE_TYPE_DISCRETE` and `V4L2_FRMIVAL_TYPE_DISCRETE`.
pub const ENUMERATION_DISCRETE: u32 = 1;

/// A kernel structure: plain numbers, for which all-zero bits are a value.
///
/// # Safety
/// The type is `repr(C)` and every bit pattern of it is valid.
pub unsafe trait KernelStruct: Copy {}

/// A structure with all bits zero, as the interface requires of reserved fields.
pub fn zeroed<T: KernelStruct>() -> T {
    // SAFETY: by the trait's contract every bit pattern is a value.
    unsafe { std::mem::zeroed() }
}

// SAFETY: an integer.
unsafe impl KernelStruct for i32 {}

macro_rules! kernel_structs {
    ($($(#[$about:meta])* $kind:ident $name:ident { $($field:ident: $type:ty),* $(,)? })*) => { $(
        $(#[$about])*
        #[repr(C)]
        #[derive(Clone, Copy)]
        pub $kind $name { $(pub $field: $type),* }

        // SAFETY: `repr(C)` structures of integers, and unions of them.
        unsafe impl KernelStruct for $name {}
    )* };
}

/// `struct v4l2_fract`: a frame period in seconds.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Fraction {
    /// Numerator.
    pub numerator: u32,
    /// Denominator.
    pub denominator: u32,
}

/// Bytes of the unions in [`Format`] and [`StreamParm`].
const UNION_BYTES: usize = 200;

// The last fields of a structure, of which none is used, are one: `rest`.
kernel_structs! {
    /// `struct v4l2_capability`.
    struct Capability {
        driver: [u8; 16],
        card: [u8; 32],
        bus_info: [u8; 32],
        version: u32,
        capabilities: u32,
        device_caps: u32,
        rest: [u32; 3],
    }

    /// `struct v4l2_fmtdesc`.
    struct FormatDescription {
        index: u32,
        buffer_type: u32,
        flags: u32,
        description: [u8; 32],
        pixel_format: u32,
        rest: [u32; 4],
    }

    /// `struct v4l2_pix_format`.
    struct PixFormat {
        width: u32,
        height: u32,
        pixel_format: u32,
        field: u32,
        bytes_per_line: u32,
        rest: [u32; 7],
    }

    /// `struct v4l2_format` with the single-plane member of its union. The union holds pointers, so it is aligned like
    /// one.
    struct Format { buffer_type: u32, pix: FormatUnion }

    /// The union of `struct v4l2_format`; `pointer` gives it the alignment of its members with pointers.
    union FormatUnion { pix: PixFormat, raw: [u8; UNION_BYTES], pointer: usize }

    /// `struct v4l2_streamparm` with the capture member of its union.
    struct StreamParm {
        buffer_type: u32,
        capability: u32,
        capture_mode: u32,
        time_per_frame: Fraction,
        rest: [u8; UNION_BYTES - 16],
    }

    /// `struct v4l2_requestbuffers`.
    struct RequestBuffers { count: u32, buffer_type: u32, memory: u32, rest: [u32; 2] }

    /// `struct v4l2_buffer`.
    struct Buffer {
        index: u32,
        buffer_type: u32,
        bytes_used: u32,
        flags: u32,
        field: u32,
        timestamp: libc::timeval,
        time_code: [u32; 4],
        sequence: u32,
        memory: u32,
        place: BufferUnion,
        length: u32,
        rest: [u32; 2],
    }

    /// The union `m` of `struct v4l2_buffer`; for MMAP, the offset for `mmap`.
    union BufferUnion { offset: u32, pointer: usize }

    /// `struct v4l2_control`.
    struct Control { id: u32, value: i32 }

    /// `struct v4l2_queryctrl`.
    struct QueryControl {
        id: u32,
        kind: u32,
        name: [u8; 32],
        minimum: i32,
        maximum: i32,
        step: i32,
        default: i32,
        flags: u32,
        rest: [u32; 2],
    }

    /// `struct v4l2_querymenu`, packed; the name of an item, or its value (the first eight bytes).
    #[repr(packed)]
    struct QueryMenu { id: u32, index: u32, name: [u8; 32], rest: u32 }

    /// `struct v4l2_frmsizeenum`: discrete sizes hold `range[0]` × `range[1]`, others min, max and step of
    /// the width, then of the height.
    struct FrameSizeEnumeration {
        index: u32,
        pixel_format: u32,
        kind: u32,
        range: [u32; 6],
        rest: [u32; 2],
    }

    /// `struct v4l2_frmivalenum`: discrete periods hold `range[0]`, others min, max and step.
    struct FramePeriodEnumeration {
        index: u32,
        pixel_format: u32,
        width: u32,
        height: u32,
        kind: u32,
        range: [Fraction; 3],
        rest: [u32; 2],
    }
}

/// A request to the driver, with the structure that it takes.
pub struct Request<T> {
    /// Its number.
    pub number: u64,
    structure: std::marker::PhantomData<T>,
}

/// `_IOC(direction, 'V', number, size)` in Linux's generic encoding, which x86-64 and ARM64 use.
const fn request<T>(direction: u64, number: u64) -> Request<T> {
    let size = size_of::<T>() as u64;
    let number = direction << 30 | size << 16 | (b'V' as u64) << 8 | number;
    Request { number, structure: std::marker::PhantomData }
}

const WRITE: u64 = 1;
const READ: u64 = 2;

/// `VIDIOC_QUERYCAP`.
pub const QUERY_CAPABILITY: Request<Capability> = request(READ, 0);
/// `VIDIOC_ENUM_FMT`.
pub const ENUMERATE_FORMATS: Request<FormatDescription> = request(READ | WRITE, 2);
/// `VIDIOC_S_FMT`.
pub const SET_FORMAT: Request<Format> = request(READ | WRITE, 5);
/// `VIDIOC_REQBUFS`.
pub const REQUEST_BUFFERS: Request<RequestBuffers> = request(READ | WRITE, 8);
/// `VIDIOC_QUERYBUF`.
pub const QUERY_BUFFER: Request<Buffer> = request(READ | WRITE, 9);
/// `VIDIOC_QBUF`.
pub const ENQUEUE_BUFFER: Request<Buffer> = request(READ | WRITE, 15);
/// `VIDIOC_DQBUF`.
pub const DEQUEUE_BUFFER: Request<Buffer> = request(READ | WRITE, 17);
/// `VIDIOC_STREAMON`.
pub const STREAM_ON: Request<i32> = request(WRITE, 18);
/// `VIDIOC_STREAMOFF`.
pub const STREAM_OFF: Request<i32> = request(WRITE, 19);
/// `VIDIOC_G_PARM`.
pub const GET_PARM: Request<StreamParm> = request(READ | WRITE, 21);
/// `VIDIOC_S_PARM`.
pub const SET_PARM: Request<StreamParm> = request(READ | WRITE, 22);
/// `VIDIOC_G_CTRL`.
pub const GET_CONTROL: Request<Control> = request(READ | WRITE, 27);
/// `VIDIOC_S_CTRL`.
pub const SET_CONTROL: Request<Control> = request(READ | WRITE, 28);
/// `VIDIOC_QUERYCTRL`.
pub const QUERY_CONTROL: Request<QueryControl> = request(READ | WRITE, 36);
/// `VIDIOC_QUERYMENU`.
pub const QUERY_MENU: Request<QueryMenu> = request(READ | WRITE, 37);
/// `VIDIOC_ENUM_FRAMESIZES`.
pub const ENUMERATE_SIZES: Request<FrameSizeEnumeration> = request(READ | WRITE, 74);
/// `VIDIOC_ENUM_FRAMEINTERVALS`.
pub const ENUMERATE_PERIODS: Request<FramePeriodEnumeration> = request(READ | WRITE, 75);

#[cfg(test)]
mod tests {
    use super::*;
    use std::mem::offset_of;
    use std::process::Command;

    /// The values of the kernel's header on 64-bit machines, as a C expression and a number, next to ours.
    fn layout() -> Vec<(&'static str, u64, u64)> {
        let size = |bytes: usize| bytes as u64;
        vec![
            ("sizeof(struct v4l2_capability)", 104, size(size_of::<Capability>())),
            ("sizeof(struct v4l2_fmtdesc)", 64, size(size_of::<FormatDescription>())),
            ("sizeof(struct v4l2_pix_format)", 48, size(size_of::<PixFormat>())),
            ("sizeof(struct v4l2_format)", 208, size(size_of::<Format>())),
            ("sizeof(struct v4l2_streamparm)", 204, size(size_of::<StreamParm>())),
            ("sizeof(struct v4l2_requestbuffers)", 20, size(size_of::<RequestBuffers>())),
            ("sizeof(struct v4l2_buffer)", 88, size(size_of::<Buffer>())),
            ("sizeof(struct v4l2_control)", 8, size(size_of::<Control>())),
            ("sizeof(struct v4l2_queryctrl)", 68, size(size_of::<QueryControl>())),
            ("sizeof(struct v4l2_querymenu)", 44, size(size_of::<QueryMenu>())),
            ("sizeof(struct v4l2_frmsizeenum)", 44, size(size_of::<FrameSizeEnumeration>())),
            ("sizeof(struct v4l2_frmivalenum)", 52, size(size_of::<FramePeriodEnumeration>())),
            (
                "offsetof(struct v4l2_capability, device_caps)",
                88,
                size(offset_of!(Capability, device_caps)),
            ),
            (
                "offsetof(struct v4l2_fmtdesc, pixelformat)",
                44,
                size(offset_of!(FormatDescription, pixel_format)),
            ),
            ("offsetof(struct v4l2_format, fmt)", 8, size(offset_of!(Format, pix))),
            (
                "offsetof(struct v4l2_pix_format, bytesperline)",
                16,
                size(offset_of!(PixFormat, bytes_per_line)),
            ),
            (
                "offsetof(struct v4l2_streamparm, parm.capture.timeperframe)",
                12,
                size(offset_of!(StreamParm, time_per_frame)),
            ),
            (
                "offsetof(struct v4l2_requestbuffers, memory)",
                8,
                size(offset_of!(RequestBuffers, memory)),
            ),
            ("offsetof(struct v4l2_buffer, bytesused)", 8, size(offset_of!(Buffer, bytes_used))),
            ("offsetof(struct v4l2_buffer, flags)", 12, size(offset_of!(Buffer, flags))),
            ("offsetof(struct v4l2_buffer, timestamp)", 24, size(offset_of!(Buffer, timestamp))),
            ("offsetof(struct v4l2_buffer, sequence)", 56, size(offset_of!(Buffer, sequence))),
            ("offsetof(struct v4l2_buffer, memory)", 60, size(offset_of!(Buffer, memory))),
            ("offsetof(struct v4l2_buffer, m)", 64, size(offset_of!(Buffer, place))),
            ("offsetof(struct v4l2_buffer, length)", 72, size(offset_of!(Buffer, length))),
            (
                "offsetof(struct v4l2_queryctrl, minimum)",
                40,
                size(offset_of!(QueryControl, minimum)),
            ),
            ("offsetof(struct v4l2_queryctrl, flags)", 56, size(offset_of!(QueryControl, flags))),
            ("offsetof(struct v4l2_querymenu, name)", 8, size(offset_of!(QueryMenu, name))),
            (
                "offsetof(struct v4l2_frmsizeenum, stepwise)",
                12,
                size(offset_of!(FrameSizeEnumeration, range)),
            ),
            (
                "offsetof(struct v4l2_frmivalenum, stepwise)",
                20,
                size(offset_of!(FramePeriodEnumeration, range)),
            ),
            ("VIDIOC_QUERYCAP", 0x8068_5600, QUERY_CAPABILITY.number),
            ("VIDIOC_ENUM_FMT", 0xc040_5602, ENUMERATE_FORMATS.number),
            ("VIDIOC_S_FMT", 0xc0d0_5605, SET_FORMAT.number),
            ("VIDIOC_REQBUFS", 0xc014_5608, REQUEST_BUFFERS.number),
            ("VIDIOC_QUERYBUF", 0xc058_5609, QUERY_BUFFER.number),
            ("VIDIOC_QBUF", 0xc058_560f, ENQUEUE_BUFFER.number),
            ("VIDIOC_DQBUF", 0xc058_5611, DEQUEUE_BUFFER.number),
            ("VIDIOC_STREAMON", 0x4004_5612, STREAM_ON.number),
            ("VIDIOC_STREAMOFF", 0x4004_5613, STREAM_OFF.number),
            ("VIDIOC_G_PARM", 0xc0cc_5615, GET_PARM.number),
            ("VIDIOC_S_PARM", 0xc0cc_5616, SET_PARM.number),
            ("VIDIOC_G_CTRL", 0xc008_561b, GET_CONTROL.number),
            ("VIDIOC_S_CTRL", 0xc008_561c, SET_CONTROL.number),
            ("VIDIOC_QUERYCTRL", 0xc044_5624, QUERY_CONTROL.number),
            ("VIDIOC_QUERYMENU", 0xc02c_5625, QUERY_MENU.number),
            ("VIDIOC_ENUM_FRAMESIZES", 0xc02c_564a, ENUMERATE_SIZES.number),
            ("VIDIOC_ENUM_FRAMEINTERVALS", 0xc034_564b, ENUMERATE_PERIODS.number),
            ("V4L2_CAP_DEVICE_CAPS", 0x8000_0000, CAP_DEVICE_CAPS.into()),
            ("V4L2_CAP_STREAMING", 0x0400_0000, CAP_STREAMING.into()),
            ("V4L2_CAP_VIDEO_CAPTURE_MPLANE", 0x1000, CAP_VIDEO_CAPTURE_MPLANE.into()),
            ("V4L2_CAP_TIMEPERFRAME", 0x1000, CAP_TIME_PER_FRAME.into()),
            ("V4L2_BUF_FLAG_ERROR", 0x40, FLAG_ERROR.into()),
            ("V4L2_BUF_FLAG_TIMESTAMP_MASK", 0xe000, FLAG_TIMESTAMP_MASK.into()),
            ("V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC", 0x2000, FLAG_TIMESTAMP_MONOTONIC.into()),
            ("V4L2_BUF_FLAG_TSTAMP_SRC_MASK", 0x7_0000, FLAG_STAMP_SOURCE_MASK.into()),
            ("V4L2_BUF_FLAG_TSTAMP_SRC_SOE", 0x1_0000, FLAG_STAMP_START.into()),
            ("V4L2_CTRL_FLAG_NEXT_CTRL", 0x8000_0000, CONTROL_NEXT.into()),
            ("V4L2_CTRL_FLAG_INACTIVE", 0x10, CONTROL_INACTIVE.into()),
            ("V4L2_CTRL_TYPE_INTEGER_MENU", 9, CONTROL_TYPE_INTEGER_MENU.into()),
        ]
    }

    #[test]
    fn structures_and_numbers_are_those_of_the_kernel() {
        if cfg!(target_pointer_width = "64") {
            for (what, pinned, ours) in layout() {
                assert_eq!(ours, pinned, "{what}");
            }
        }
    }

    #[test]
    fn the_header_of_this_machine_agrees() {
        let lines: String = layout()
            .iter()
            .map(|(what, ..)| format!("printf(\"%llu\\n\", (unsigned long long)({what}));"))
            .collect();
        let program = format!(
            "#include <stdio.h>\n#include <stddef.h>\n#include <linux/videodev2.h>\nint main(void) {{ {lines} }}\n"
        );
        let folder = tempfile::tempdir().unwrap();
        let (source, binary) = (folder.path().join("layout.c"), folder.path().join("layout"));
        std::fs::write(&source, program).unwrap();
        let compiled = Command::new("cc").arg(&source).arg("-o").arg(&binary).output();
        if !compiled.as_ref().is_ok_and(|output| output.status.success()) {
            // No C compiler or no kernel headers: the pinned numbers, taken from them, must suffice.
            return;
        }
        let printed = Command::new(&binary).output().unwrap();
        let numbers: Vec<u64> = String::from_utf8(printed.stdout)
            .unwrap()
            .lines()
            .map(|n| n.parse().unwrap())
            .collect();
        assert_eq!(numbers.len(), layout().len());
        for ((what, _, ours), header) in layout().into_iter().zip(numbers) {
            assert_eq!(ours, header, "{what}");
        }
    }
}
