//! An open device file of a fake camera: what each request does.

use std::ops::RangeInclusive;
use std::os::fd::RawFd;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};

use crate::buffers::{Buffers, APART};
use crate::hooks::raw;
use crate::layout::{self, Record};
use crate::pictures;
use crate::world::{lock, Camera};
use crate::Settings;

const GAIN: u32 = 0x0098_0913;
const AUTO_GAIN: u32 = 0x0098_0912;
const EXPOSURE_AUTO: u32 = 0x009a_0901;
const EXPOSURE_ABSOLUTE: u32 = 0x009a_0902;
const MANUAL: i32 = 1;
const APERTURE_PRIORITY: i32 = 3;

/// A format that the program has set.
#[derive(Clone, Debug)]
pub(crate) struct Form {
    pub code: String,
    pub size: [u32; 2],
    pub stride: u32,
    pub bytes: u32,
}

/// What changes while the file is open.
#[derive(Default)]
pub(crate) struct FileState {
    pub form: Option<Form>,
    pub rate: Option<u32>,
    pub buffers: Buffers,
    pub is_streaming: bool,
}

/// An open file.
pub(crate) struct OpenFile {
    pub camera: Arc<Camera>,
    pub state: Mutex<FileState>,
    /// The end of the pipe that makes the program's end readable; closed when the camera is gone.
    bell: Mutex<Option<RawFd>>,
    pub is_closed: AtomicBool,
    number: RawFd,
}

/// What a request ends with: nothing, or errno.
type Outcome = Result<(), i32>;

impl OpenFile {
    /// Opens the camera; the descriptor is for the program.
    #[allow(unsafe_code)]
    pub(crate) fn open(camera: Arc<Camera>, flags: i32) -> Result<(Arc<Self>, RawFd), i32> {
        let settings = camera.settings();
        if camera.is_gone() {
            return Err(libc::ENOENT);
        }
        if settings.is_denied {
            return Err(libc::EACCES);
        }
        let mut pair = [0; 2];
        // SAFETY: room for two descriptors.
        if unsafe { libc::pipe2(pair.as_mut_ptr(), libc::O_CLOEXEC | (flags & libc::O_NONBLOCK)) } != 0 {
            return Err(libc::EMFILE);
        }
        {
            let mut witness = lock(&camera.witness);
            witness.opened += 1;
            witness.open += 1;
        }
        let file = Self {
            camera,
            state: Mutex::default(),
            bell: Mutex::new(Some(pair[1])),
            is_closed: AtomicBool::new(false),
            number: pair[0],
        };
        Ok((Arc::new(file), pair[0]))
    }

    pub(crate) fn close(&self) {
        self.is_closed.store(true, Ordering::Release);
        self.hang_up();
        lock(&self.camera.witness).open -= 1;
        self.end_stream(&mut lock(&self.state));
    }

    /// The camera is gone: who waits is woken.
    pub(crate) fn hang_up(&self) {
        if let Some(bell) = lock(&self.bell).take() {
            raw::close(bell);
        }
    }

    /// A picture can be taken.
    #[allow(unsafe_code)]
    pub(crate) fn ring(&self) {
        if let Some(bell) = *lock(&self.bell) {
            // SAFETY: one byte of a constant.
            unsafe { libc::write(bell, [1u8].as_ptr().cast(), 1) };
        }
    }

    /// Takes the byte of one picture off the pipe.
    #[allow(unsafe_code)]
    fn unring(&self) {
        let mut byte = [0u8; 1];
        // SAFETY: room for one byte. A byte is there for every picture, so the call does not wait.
        unsafe { libc::syscall(libc::SYS_read, self.number, byte.as_mut_ptr(), 1) };
    }

    /// The memory of the buffer at `offset`, if it has so many bytes.
    pub(crate) fn memory(&self, offset: i64, bytes: usize) -> Option<RawFd> {
        use std::os::fd::AsRawFd;
        let state = lock(&self.state);
        let index = usize::try_from(offset).ok()? / APART as usize;
        let fits = bytes == state.buffers.bytes as usize && offset % i64::from(APART) == 0;
        state.buffers.all.get(index).filter(|_| fits).map(|b| b.memory.as_raw_fd())
    }

    /// Carries out a request.
    pub(crate) fn request(self: &Arc<Self>, request: (u32, u32), record: &mut Record) -> Outcome {
        if self.camera.is_gone() {
            return Err(libc::ENODEV);
        }
        let settings = self.camera.settings();
        let name = layout::NAMES.iter().find(|(_, r)| *r == request).ok_or(libc::ENOTTY)?.0;
        if let Some(errno) = settings.failures.get(name) {
            return Err(*errno);
        }
        let outcome = self.carried_out(request, record, &settings);
        let is_end = matches!(outcome, Err(libc::EINVAL))
            && [layout::ENUM_FMT, layout::ENUM_FRAMESIZES, layout::ENUM_FRAMEINTERVALS].contains(&request);
        let is_waiting = matches!(outcome, Err(libc::EAGAIN));
        let is_control = [layout::QUERYCTRL, layout::S_EXT_CTRLS, layout::G_EXT_CTRLS].contains(&request);
        if outcome.is_err() && !is_end && !is_waiting && !is_control && !settings.is_busy {
            lock(&self.camera.witness).refusals += 1;
        }
        outcome
    }

    fn carried_out(self: &Arc<Self>, request: (u32, u32), record: &mut Record, s: &Settings) -> Outcome {
        match request {
            layout::QUERYCAP => {
                record.put_text(0, 16, "fake_v4l2");
                record.put_text(16, 32, &s.card);
                record.put_text(48, 32, "usb-fake-1");
                record.put(80, 0x0006_0100);
                // DEVICE_CAPS, and on the hardware also META_CAPTURE.
                record.put(84, 0x8080_0000 | s.capabilities | 1);
                record.put(88, s.capabilities);
                Ok(())
            }
            layout::ENUM_FMT => {
                capture(record, 4)?;
                let code = s.formats.get(record.get(0) as usize).ok_or(libc::EINVAL)?;
                record.put_text(12, 32, code);
                record.put(44, four(code));
                Ok(())
            }
            layout::ENUM_FRAMESIZES => {
                let is_first = record.get(0) == 0 && s.formats.iter().any(|f| four(f) == record.get(4));
                is_first.then_some(()).ok_or(libc::EINVAL)?;
                record.put(8, 1);
                record.put(12, s.size[0]);
                record.put(16, s.size[1]);
                Ok(())
            }
            layout::ENUM_FRAMEINTERVALS => {
                let fits = [record.get(8), record.get(12)] == s.size;
                let rate = s.rates.get(record.get(0) as usize).filter(|_| fits).ok_or(libc::EINVAL)?;
                record.put(16, 1);
                record.put(20, 1);
                record.put(24, *rate);
                Ok(())
            }
            layout::TRY_FMT => form(record, s).map(drop),
            layout::S_FMT => self.set_form(record, s),
            layout::G_PARM | layout::S_PARM => self.rate(record, s, request == layout::S_PARM),
            layout::QUERYCTRL => query_control(record, s),
            layout::G_EXT_CTRLS => self.controls(record, s, false),
            layout::S_EXT_CTRLS => self.controls(record, s, true),
            layout::REQBUFS => self.make_buffers(record, s),
            layout::QUERYBUF => self.buffer(record, false),
            layout::QBUF => self.buffer(record, true),
            layout::DQBUF => self.take(record),
            layout::STREAMON => self.begin_stream(record),
            layout::STREAMOFF => {
                capture(record, 0)?;
                self.end_stream(&mut lock(&self.state));
                Ok(())
            }
            _ => Err(libc::ENOTTY),
        }
    }

    /// Another file streams.
    fn is_busy(&self, s: &Settings) -> bool {
        s.is_busy || lock(&self.camera.streaming).is_some_and(|by| by != self.number)
    }

    fn set_form(&self, record: &mut Record, s: &Settings) -> Outcome {
        let mut state = lock(&self.state);
        if self.is_busy(s) || !state.buffers.all.is_empty() {
            return Err(libc::EBUSY);
        }
        state.form = Some(form(record, s)?);
        Ok(())
    }

    fn rate(&self, record: &mut Record, s: &Settings, sets: bool) -> Outcome {
        capture(record, 0)?;
        let mut state = lock(&self.state);
        if sets {
            let [n, d] = [record.get(12), record.get(16)].map(f64::from);
            let asked = if n > 0.0 { d / n } else { 0.0 };
            let off = |r: &&u32| ((f64::from(**r) - asked).abs() * 1e6) as u64;
            state.rate = s.rates.iter().min_by_key(off).copied();
        }
        let rate = state.rate.or(s.rates.first().copied()).unwrap_or(30);
        record.put(4, 0x1000);
        record.put(12, 1);
        record.put(16, rate);
        Ok(())
    }

    fn controls(&self, record: &mut Record, s: &Settings, sets: bool) -> Outcome {
        if record.get(0) != 0 || record.get(4) != 1 {
            return Err(libc::EINVAL);
        }
        // SAFETY: the program passes one control.
        #[allow(unsafe_code)]
        let mut control = unsafe { record.behind(24, 20) };
        let (id, value) = (control.get(0), control.get(12) as i32);
        let range = range(id, s).ok_or(libc::EINVAL)?;
        let mut witness = lock(&self.camera.witness);
        if sets {
            if !range.contains(&value) {
                return Err(libc::ERANGE);
            }
            match id {
                // This camera knows by hand, and automatic with a fixed iris.
                EXPOSURE_AUTO if ![MANUAL, APERTURE_PRIORITY].contains(&value) => return Err(libc::EINVAL),
                EXPOSURE_AUTO => witness.is_automatic = value != MANUAL,
                EXPOSURE_ABSOLUTE if witness.is_automatic => return Err(libc::EACCES),
                EXPOSURE_ABSOLUTE => witness.exposure = value,
                GAIN => witness.gain = value,
                _ => {}
            }
        }
        let now = match id {
            EXPOSURE_AUTO if witness.is_automatic => APERTURE_PRIORITY,
            EXPOSURE_AUTO => MANUAL,
            EXPOSURE_ABSOLUTE => witness.exposure,
            GAIN => witness.gain,
            _ => 0,
        };
        control.put(12, now as u32);
        Ok(())
    }

    fn make_buffers(&self, record: &mut Record, s: &Settings) -> Outcome {
        capture(record, 4)?;
        let mut state = lock(&self.state);
        if record.get(8) != 1 || state.is_streaming {
            return Err(libc::EINVAL);
        }
        if self.is_busy(s) {
            return Err(libc::EBUSY);
        }
        let bytes = state.form.as_ref().ok_or(libc::EINVAL)?.bytes.next_multiple_of(4096);
        // Drivers give what they like: this one gives three at most.
        let count = record.get(0).min(3);
        state.buffers = Buffers::make(count as usize, bytes).map_err(|_| libc::ENOMEM)?;
        record.put(0, count);
        Ok(())
    }

    fn buffer(&self, record: &mut Record, gives: bool) -> Outcome {
        capture(record, 4)?;
        let mut state = lock(&self.state);
        let index = record.get(0) as usize;
        if index >= state.buffers.all.len() || record.get(60) != 1 {
            return Err(libc::EINVAL);
        }
        if gives {
            return state.buffers.give(index).ok_or(libc::EINVAL);
        }
        record.put(64, index as u32 * APART);
        record.put(68, 0);
        record.put(72, state.buffers.bytes);
        Ok(())
    }

    fn take(&self, record: &mut Record) -> Outcome {
        capture(record, 4)?;
        let mut state = lock(&self.state);
        if record.get(60) != 1 || !state.is_streaming {
            return Err(libc::EINVAL);
        }
        let filled = state.buffers.filled.pop_front().ok_or(libc::EAGAIN)?;
        state.buffers.all[filled.index].is_given = false;
        self.unring();
        record.put(0, filled.index as u32);
        record.put(8, filled.bytes);
        record.put(12, filled.flags);
        record.put_long(24, filled.stamp_ns / 1_000_000_000);
        record.put_long(32, filled.stamp_ns % 1_000_000_000 / 1_000);
        record.put(56, filled.sequence);
        record.put(72, state.buffers.bytes);
        lock(&self.camera.witness).pictures += 1;
        Ok(())
    }

    fn begin_stream(self: &Arc<Self>, record: &Record) -> Outcome {
        capture(record, 0)?;
        {
            let mut state = lock(&self.state);
            if state.is_streaming || state.buffers.empty.len() < 2 {
                return Err(libc::EINVAL);
            }
            state.is_streaming = true;
        }
        *lock(&self.camera.streaming) = Some(self.number);
        lock(&self.camera.witness).streams += 1;
        pictures::start(self.clone());
        Ok(())
    }

    fn end_stream(&self, state: &mut FileState) {
        if std::mem::take(&mut state.is_streaming) {
            *lock(&self.camera.streaming) = None;
        }
    }
}

/// The type of a record says that it is about capturing.
fn capture(record: &Record, offset: usize) -> Outcome {
    (record.get(offset) == 1).then_some(()).ok_or(libc::EINVAL)
}

fn four(code: &str) -> u32 {
    code.as_bytes().first_chunk().map_or(0, |four| u32::from_le_bytes(*four))
}

/// Changes what was asked to what there is.
fn form(record: &mut Record, s: &Settings) -> Result<Form, i32> {
    capture(record, 0)?;
    let asked = record.get(16);
    let code = s.formats.iter().find(|f| four(f) == asked).or(s.formats.first()).ok_or(libc::EINVAL)?;
    let stride = pictures::row_bytes(code, s.size[0]) + s.padding;
    let bytes = stride * s.size[1] * if code == "NV12" { 3 } else { 2 } / 2;
    let fields = [s.size[0], s.size[1], four(code), 1, stride, bytes];
    fields.iter().enumerate().for_each(|(i, value)| record.put(8 + 4 * i, *value));
    Ok(Form { code: code.clone(), size: s.size, stride, bytes })
}

/// What a control may be; `None` if this camera has none.
fn range(id: u32, s: &Settings) -> Option<RangeInclusive<i32>> {
    match id {
        EXPOSURE_AUTO if s.is_automatic => Some(0..=3),
        EXPOSURE_ABSOLUTE => s.exposure.clone(),
        GAIN => s.gain.clone(),
        AUTO_GAIN if s.gain.is_some() => Some(0..=1),
        _ => None,
    }
}

fn query_control(record: &mut Record, s: &Settings) -> Outcome {
    let range = range(record.get(0), s).ok_or(libc::EINVAL)?;
    record.put(40, *range.start() as u32);
    record.put(44, *range.end() as u32);
    record.put(48, 1);
    record.put(56, 0);
    Ok(())
}
