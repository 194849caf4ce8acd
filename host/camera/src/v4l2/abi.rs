//! What a capture device needs of `<linux/videodev2.h>`: structs, numbers of requests, flags.
//!
//! Names are this project's; the table of the tests has each beside its name in C, and holds sizes, offsets and numbers to
//! `abi.golden` and, where gcc and the header are there, to the header itself.

use libc::Ioctl;
use std::marker::PhantomData;

/// A request to the driver, with the struct that it reads and fills.
pub(super) struct Call<T> {
    /// Its number.
    pub number: Ioctl,
    of: PhantomData<fn(&mut T)>,
}

/// The letter of all requests of V4L2.
const LETTER: u32 = b'V' as u32;

impl<T> Call<T> {
    const fn filled(number: u32) -> Self {
        Self { number: libc::_IOR::<T>(LETTER, number), of: PhantomData }
    }

    const fn given(number: u32) -> Self {
        Self { number: libc::_IOW::<T>(LETTER, number), of: PhantomData }
    }

    const fn both(number: u32) -> Self {
        Self { number: libc::_IOWR::<T>(LETTER, number), of: PhantomData }
    }
}

pub(super) const QUERY_CAPABILITY: Call<Capability> = Call::filled(0);
pub(super) const LIST_FORMAT: Call<FormatEntry> = Call::both(2);
pub(super) const SET_FORMAT: Call<Format> = Call::both(5);
pub(super) const TRY_FORMAT: Call<Format> = Call::both(64);
pub(super) const REQUEST_BUFFERS: Call<BufferRequest> = Call::both(8);
pub(super) const QUERY_BUFFER: Call<Buffer> = Call::both(9);
pub(super) const GIVE_BUFFER: Call<Buffer> = Call::both(15);
pub(super) const TAKE_BUFFER: Call<Buffer> = Call::both(17);
pub(super) const STREAM_ON: Call<i32> = Call::given(18);
pub(super) const STREAM_OFF: Call<i32> = Call::given(19);
pub(super) const GET_RATE: Call<StreamParameters> = Call::both(21);
pub(super) const SET_RATE: Call<StreamParameters> = Call::both(22);
pub(super) const QUERY_CONTROL: Call<ControlRange> = Call::both(36);
pub(super) const GET_CONTROLS: Call<Controls> = Call::both(71);
pub(super) const SET_CONTROLS: Call<Controls> = Call::both(72);
pub(super) const LIST_SIZE: Call<FrameSize> = Call::both(74);
pub(super) const LIST_INTERVAL: Call<FrameInterval> = Call::both(75);

/// `V4L2_BUF_TYPE_VIDEO_CAPTURE`.
pub(super) const CAPTURE: u32 = 1;
/// `V4L2_MEMORY_MMAP`.
pub(super) const MEMORY_MAPPED: u32 = 1;
/// `V4L2_FIELD_NONE`: whole pictures, not every second row.
pub(super) const FIELD_NONE: u32 = 1;

/// `V4L2_CAP_VIDEO_CAPTURE`.
pub(super) const CAN_CAPTURE: u32 = 0x1;
/// `V4L2_CAP_VIDEO_CAPTURE_MPLANE`.
pub(super) const CAN_CAPTURE_PLANES: u32 = 0x1000;
/// `V4L2_CAP_STREAMING`.
pub(super) const CAN_STREAM: u32 = 0x0400_0000;
/// `V4L2_CAP_DEVICE_CAPS`: the capabilities of this device file stand apart from those of the whole hardware.
pub(super) const HAS_DEVICE_CAPABILITIES: u32 = 0x8000_0000;
/// `V4L2_CAP_TIMEPERFRAME`: the rate can be set.
pub(super) const CAN_SET_RATE: u32 = 0x1000;

/// `V4L2_FRMSIZE_TYPE_DISCRETE` and `V4L2_FRMIVAL_TYPE_DISCRETE`: one value, not a range.
pub(super) const DISCRETE: u32 = 1;

/// `V4L2_CTRL_WHICH_CUR_VAL`.
pub(super) const PRESENT_VALUE: u32 = 0;
/// `V4L2_CTRL_FLAG_DISABLED`.
pub(super) const CONTROL_DISABLED: u32 = 0x1;
/// `V4L2_CID_AUTOGAIN`.
pub(super) const AUTO_GAIN: u32 = 0x0098_0912;
/// `V4L2_CID_GAIN`.
pub(super) const GAIN: u32 = 0x0098_0913;
/// `V4L2_CID_EXPOSURE_AUTO`.
pub(super) const EXPOSURE_AUTO: u32 = 0x009a_0901;
/// `V4L2_CID_EXPOSURE_ABSOLUTE`, in 100 us.
pub(super) const EXPOSURE_ABSOLUTE: u32 = 0x009a_0902;
/// `V4L2_CID_EXPOSURE_AUTO_PRIORITY`: whether the camera may take fewer pictures for the sake of its exposure.
pub(super) const EXPOSURE_OVER_RATE: u32 = 0x009a_0903;
/// `V4L2_CID_ANALOGUE_GAIN`.
pub(super) const ANALOGUE_GAIN: u32 = 0x009e_0903;
/// `V4L2_EXPOSURE_MANUAL`: exposure and iris by hand.
pub(super) const BY_HAND: i32 = 1;
/// `V4L2_EXPOSURE_SHUTTER_PRIORITY`: the exposure by hand, the iris by the camera.
pub(super) const IRIS_BY_CAMERA: i32 = 2;

/// `V4L2_BUF_FLAG_ERROR`.
pub(super) const IS_DAMAGED: u32 = 0x40;
/// `V4L2_BUF_FLAG_TIMESTAMP_MASK`.
pub(super) const STAMP_CLOCK: u32 = 0xe000;
/// `V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC`.
pub(super) const STAMP_MONOTONIC: u32 = 0x2000;
/// `V4L2_BUF_FLAG_TIMESTAMP_COPY`.
pub(super) const STAMP_COPIED: u32 = 0x4000;
/// `V4L2_BUF_FLAG_TSTAMP_SRC_MASK`.
pub(super) const STAMP_MOMENT: u32 = 0x7_0000;
/// `V4L2_BUF_FLAG_TSTAMP_SRC_EOF`.
pub(super) const STAMP_AT_END: u32 = 0;
/// `V4L2_BUF_FLAG_TSTAMP_SRC_SOE`.
pub(super) const STAMP_AT_BEGIN: u32 = 0x1_0000;

/// `struct v4l2_capability`: names end with a zero byte.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct Capability {
    pub driver: [u8; 16],
    pub card: [u8; 32],
    pub bus: [u8; 32],
    pub version: u32,
    /// Of the whole hardware.
    pub capabilities: u32,
    /// Of this device file.
    pub device_capabilities: u32,
    pub reserved: [u32; 3],
}

/// `struct v4l2_fmtdesc`.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct FormatEntry {
    pub index: u32,
    pub kind: u32,
    pub flags: u32,
    pub description: [u8; 32],
    pub code: u32,
    pub media_code: u32,
    pub reserved: [u32; 3],
}

/// `struct v4l2_format` with its `pix`.
#[repr(C)]
#[derive(Clone, Copy)]
pub(super) struct Format {
    pub kind: u32,
    /// The union holds pointers, whose alignment it has.
    align: [usize; 0],
    pub pixels: PixelFormat,
    rest: [u8; 152],
}

impl Format {
    /// Of a capture device.
    pub(super) fn capture(pixels: PixelFormat) -> Self {
        Self { kind: CAPTURE, align: [], pixels, rest: [0; 152] }
    }
}

/// `struct v4l2_pix_format`.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct PixelFormat {
    pub width: u32,
    pub height: u32,
    pub code: u32,
    pub field: u32,
    pub bytes_per_row: u32,
    pub bytes: u32,
    pub colours: u32,
    pub private: u32,
    pub flags: u32,
    pub encoding: u32,
    pub quantization: u32,
    pub transfer: u32,
}

/// `struct v4l2_streamparm` with its `capture`.
#[repr(C)]
#[derive(Clone, Copy)]
pub(super) struct StreamParameters {
    pub kind: u32,
    pub capability: u32,
    mode: u32,
    /// Seconds for a picture, as a fraction.
    pub interval: [u32; 2],
    extended: u32,
    buffers: u32,
    reserved: [u32; 4],
    rest: [u32; 40],
}

impl StreamParameters {
    /// Of a capture device with this time for a picture.
    pub(super) fn capture(interval: [u32; 2]) -> Self {
        Self {
            kind: CAPTURE,
            capability: 0,
            mode: 0,
            interval,
            extended: 0,
            buffers: 0,
            reserved: [0; 4],
            rest: [0; 40],
        }
    }
}

/// `struct v4l2_requestbuffers`.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct BufferRequest {
    pub count: u32,
    pub kind: u32,
    pub memory: u32,
    pub capabilities: u32,
    pub flags: u32,
}

/// `struct v4l2_buffer` of a single plane.
#[repr(C)]
#[derive(Clone, Copy)]
pub(super) struct Buffer {
    pub index: u32,
    kind: u32,
    pub bytes_used: u32,
    pub flags: u32,
    field: u32,
    /// `struct timeval`: seconds and microseconds.
    pub stamp: [libc::c_long; 2],
    timecode: [u32; 4],
    pub sequence: u32,
    memory: u32,
    /// Of its union, `offset` is the first half, or all.
    place: [u32; size_of::<usize>() / 4],
    pub length: u32,
    reserved: u32,
    request: u32,
}

impl Buffer {
    /// Buffer `index` in memory of the driver: no other field is a pointer then.
    pub(super) fn mapped(index: u32) -> Self {
        Self {
            index,
            kind: CAPTURE,
            bytes_used: 0,
            flags: 0,
            field: 0,
            stamp: [0; 2],
            timecode: [0; 4],
            sequence: 0,
            memory: MEMORY_MAPPED,
            place: [0; size_of::<usize>() / 4],
            length: 0,
            reserved: 0,
            request: 0,
        }
    }

    /// Where mmap(2) finds it.
    pub(super) fn offset(&self) -> u32 {
        self.place[0]
    }

    /// The time of its stamp, nanoseconds of the clock that its flags name.
    pub(super) fn stamp_ns(&self) -> i64 {
        #[allow(clippy::unnecessary_cast, reason = "a long has 32 bits on some machines")]
        let [s, us] = self.stamp.map(|part| part as i64);
        s.saturating_mul(1_000_000_000).saturating_add(us.saturating_mul(1_000))
    }
}

/// `struct v4l2_queryctrl`.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct ControlRange {
    pub id: u32,
    pub kind: u32,
    pub name: [u8; 32],
    pub least: i32,
    pub most: i32,
    pub step: i32,
    pub usual: i32,
    pub flags: u32,
    pub reserved: [u32; 2],
}

/// `struct v4l2_ext_control`. In C it is packed; without its pointers no gap arises either way.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct Control {
    pub id: u32,
    pub size: u32,
    pub reserved: u32,
    /// Of its union, `value` is the first half.
    pub value: [i32; 2],
}

/// `struct v4l2_ext_controls`.
#[repr(C)]
#[derive(Clone, Copy)]
pub(super) struct Controls {
    pub which: u32,
    pub count: u32,
    pub failed: u32,
    pub request: i32,
    pub reserved: u32,
    pub list: *mut Control,
}

/// `struct v4l2_frmsizeenum`.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct FrameSize {
    pub index: u32,
    pub code: u32,
    pub kind: u32,
    /// Width and height; or least, most and step of the width, then of the height.
    pub sizes: [u32; 6],
    pub reserved: [u32; 2],
}

/// `struct v4l2_frmivalenum`.
#[repr(C)]
#[derive(Clone, Copy, Default)]
pub(super) struct FrameInterval {
    pub index: u32,
    pub code: u32,
    pub width: u32,
    pub height: u32,
    pub kind: u32,
    /// Seconds for a picture as a fraction; or the least, the most, the step.
    pub intervals: [u32; 6],
    pub reserved: [u32; 2],
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::mem::{align_of, offset_of};
    use std::process::Command;

    /// The committed numbers, a line each: an expression in C and its value on 64 bits.
    const GOLDEN: &str = include_str!("abi.golden");

    /// An expression in C beside what stands here.
    macro_rules! beside {
        ($($ours:ident $theirs:literal { $($field:ident $member:literal),* $(,)? })*) => {
            vec![$(
                (concat!("sizeof(struct ", $theirs, ")").to_owned(), size_of::<$ours>() as u64),
                $((concat!("offsetof(struct ", $theirs, ", ", $member, ")").to_owned(), offset_of!($ours, $field) as u64),)*
            )*]
        };
    }

    fn structs() -> Vec<(String, u64)> {
        beside! {
            Capability "v4l2_capability" {
                driver "driver", card "card", bus "bus_info", version "version", capabilities "capabilities",
                device_capabilities "device_caps"
            }
            FormatEntry "v4l2_fmtdesc" {
                index "index", kind "type", flags "flags", description "description", code "pixelformat"
            }
            Format "v4l2_format" { kind "type", pixels "fmt.pix" }
            PixelFormat "v4l2_pix_format" {
                width "width", height "height", code "pixelformat", field "field", bytes_per_row "bytesperline",
                bytes "sizeimage", colours "colorspace", private "priv", flags "flags", encoding "ycbcr_enc",
                quantization "quantization", transfer "xfer_func"
            }
            StreamParameters "v4l2_streamparm" {
                kind "type", capability "parm.capture.capability", mode "parm.capture.capturemode",
                interval "parm.capture.timeperframe", extended "parm.capture.extendedmode",
                buffers "parm.capture.readbuffers"
            }
            BufferRequest "v4l2_requestbuffers" {
                count "count", kind "type", memory "memory", capabilities "capabilities"
            }
            Buffer "v4l2_buffer" {
                index "index", kind "type", bytes_used "bytesused", flags "flags", field "field", stamp "timestamp",
                timecode "timecode", sequence "sequence", memory "memory", place "m.offset", length "length"
            }
            ControlRange "v4l2_queryctrl" {
                id "id", kind "type", name "name", least "minimum", most "maximum", step "step",
                usual "default_value", flags "flags"
            }
            Control "v4l2_ext_control" { id "id", size "size", value "value" }
            Controls "v4l2_ext_controls" {
                which "which", count "count", failed "error_idx", request "request_fd", list "controls"
            }
            FrameSize "v4l2_frmsizeenum" {
                index "index", code "pixel_format", kind "type", sizes "discrete"
            }
            FrameInterval "v4l2_frmivalenum" {
                index "index", code "pixel_format", width "width", height "height", kind "type", intervals "discrete"
            }
        }
    }

    fn calls() -> Vec<(String, u64)> {
        #[allow(clippy::unnecessary_cast, reason = "musl has signed numbers")]
        fn of<T>(name: &str, call: &Call<T>) -> (String, u64) {
            (name.to_owned(), call.number as u64)
        }
        vec![
            of("VIDIOC_QUERYCAP", &QUERY_CAPABILITY),
            of("VIDIOC_ENUM_FMT", &LIST_FORMAT),
            of("VIDIOC_S_FMT", &SET_FORMAT),
            of("VIDIOC_TRY_FMT", &TRY_FORMAT),
            of("VIDIOC_REQBUFS", &REQUEST_BUFFERS),
            of("VIDIOC_QUERYBUF", &QUERY_BUFFER),
            of("VIDIOC_QBUF", &GIVE_BUFFER),
            of("VIDIOC_DQBUF", &TAKE_BUFFER),
            of("VIDIOC_STREAMON", &STREAM_ON),
            of("VIDIOC_STREAMOFF", &STREAM_OFF),
            of("VIDIOC_G_PARM", &GET_RATE),
            of("VIDIOC_S_PARM", &SET_RATE),
            of("VIDIOC_QUERYCTRL", &QUERY_CONTROL),
            of("VIDIOC_G_EXT_CTRLS", &GET_CONTROLS),
            of("VIDIOC_S_EXT_CTRLS", &SET_CONTROLS),
            of("VIDIOC_ENUM_FRAMESIZES", &LIST_SIZE),
            of("VIDIOC_ENUM_FRAMEINTERVALS", &LIST_INTERVAL),
        ]
    }

    fn numbers() -> Vec<(String, u64)> {
        let signed = [("V4L2_EXPOSURE_MANUAL", BY_HAND), ("V4L2_EXPOSURE_SHUTTER_PRIORITY", IRIS_BY_CAMERA)];
        let all = [
            ("V4L2_BUF_TYPE_VIDEO_CAPTURE", CAPTURE),
            ("V4L2_MEMORY_MMAP", MEMORY_MAPPED),
            ("V4L2_FIELD_NONE", FIELD_NONE),
            ("V4L2_CAP_VIDEO_CAPTURE", CAN_CAPTURE),
            ("V4L2_CAP_VIDEO_CAPTURE_MPLANE", CAN_CAPTURE_PLANES),
            ("V4L2_CAP_STREAMING", CAN_STREAM),
            ("V4L2_CAP_DEVICE_CAPS", HAS_DEVICE_CAPABILITIES),
            ("V4L2_CAP_TIMEPERFRAME", CAN_SET_RATE),
            ("V4L2_FRMSIZE_TYPE_DISCRETE", DISCRETE),
            ("V4L2_FRMIVAL_TYPE_DISCRETE", DISCRETE),
            ("V4L2_CTRL_WHICH_CUR_VAL", PRESENT_VALUE),
            ("V4L2_CTRL_FLAG_DISABLED", CONTROL_DISABLED),
            ("V4L2_CID_AUTOGAIN", AUTO_GAIN),
            ("V4L2_CID_GAIN", GAIN),
            ("V4L2_CID_EXPOSURE_AUTO", EXPOSURE_AUTO),
            ("V4L2_CID_EXPOSURE_ABSOLUTE", EXPOSURE_ABSOLUTE),
            ("V4L2_CID_EXPOSURE_AUTO_PRIORITY", EXPOSURE_OVER_RATE),
            ("V4L2_CID_ANALOGUE_GAIN", ANALOGUE_GAIN),
            ("V4L2_BUF_FLAG_ERROR", IS_DAMAGED),
            ("V4L2_BUF_FLAG_TIMESTAMP_MASK", STAMP_CLOCK),
            ("V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC", STAMP_MONOTONIC),
            ("V4L2_BUF_FLAG_TIMESTAMP_COPY", STAMP_COPIED),
            ("V4L2_BUF_FLAG_TSTAMP_SRC_MASK", STAMP_MOMENT),
            ("V4L2_BUF_FLAG_TSTAMP_SRC_EOF", STAMP_AT_END),
            ("V4L2_BUF_FLAG_TSTAMP_SRC_SOE", STAMP_AT_BEGIN),
        ];
        let signed = signed.map(|(name, value)| (name.to_owned(), value as u64));
        let all = all.map(|(name, value)| (name.to_owned(), u64::from(value)));
        let codes = super::super::luma::LAYOUTS.iter().map(|l| (l.c_name.to_owned(), u64::from(l.code)));
        all.into_iter().chain(signed).chain(codes).collect()
    }

    fn ours() -> Vec<(String, u64)> {
        [structs(), calls(), numbers()].concat()
    }

    fn lines(all: &[(String, u64)]) -> String {
        all.iter().map(|(expression, value)| format!("{expression} = {value}\n")).collect()
    }

    #[test]
    fn sizes_offsets_and_numbers_are_the_committed_ones() {
        if size_of::<usize>() != 8 {
            eprintln!("the committed numbers are those of machines with 64 bits");
            return;
        }
        assert_eq!(align_of::<Format>(), 8);
        let own = lines(&ours());
        assert!(own.lines().count() > 100);
        assert!(own == GOLDEN, "{own}");
    }

    /// The same expressions, worked out by gcc from the header of this system.
    #[test]
    fn the_systems_header_says_the_same() {
        if !std::path::Path::new("/usr/include/linux/videodev2.h").exists() {
            eprintln!("skipped: this system has no /usr/include/linux/videodev2.h");
            return;
        }
        let folder = std::env::temp_dir().join(format!("dpm-v4l2-abi-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let (source, program) = (folder.join("abi.c"), folder.join("abi"));
        let mut text =
            "#include <stddef.h>\n#include <stdio.h>\n#include <linux/videodev2.h>\nint main(void) {\n"
                .to_owned();
        for (expression, _) in ours() {
            text += &format!(
                "printf(\"{expression} = %llu\\n\", (unsigned long long)(unsigned)({expression}));\n"
            );
        }
        std::fs::write(&source, text + "return 0;\n}\n").unwrap();
        let built = match Command::new("gcc").arg("-o").arg(&program).arg(&source).output() {
            Ok(output) => output,
            Err(e) => {
                eprintln!("skipped: gcc cannot be started: {e}");
                return;
            }
        };
        assert!(built.status.success(), "{}", String::from_utf8_lossy(&built.stderr));
        let said = Command::new(&program).output().unwrap();
        std::fs::remove_dir_all(&folder).unwrap();
        assert_eq!(lines(&ours()), String::from_utf8_lossy(&said.stdout));
    }
}
