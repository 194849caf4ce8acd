//! Pictures from the cameras of this machine, through V4L2: USB cameras and others whose driver streams into memory.
//!
//! `abi` has the kernel's structs and numbers, `kernel` makes the calls, `device` and `exposure` set the camera to what the
//! rig file asks, `luma` and `jpeg` read its pixels, `stamp` its stamps. This file keeps a camera open.

mod abi;
mod device;
mod exposure;
mod jpeg;
mod kernel;
mod luma;
mod stamp;

use crate::source::{
    offset_ns, CameraDoubt, CameraLook, Picture, PictureLosses, PictureRequest, PictureSource, SourceKind,
};
pub use jpeg::motion_jpeg_grey;

use device::{Identity, PictureForm};
use dpm_common::unix::monotonic_ns;
use dpm_device::time::{HostClock, HostTime};
use kernel::{Filling, Stream};
use stamp::Moment;
use std::sync::Arc;
use std::time::{Duration, Instant};

/// A camera of this machine.
pub(crate) static KIND: SourceKind = SourceKind {
    place: |device| device.strip_prefix("v4l2:").or_else(|| device.starts_with('/').then_some(device)),
    form: "\"/dev/video0\" or a name below /dev/v4l/by-id",
    open,
    examine: Some(examine),
};

/// Buffers that the driver fills in turn.
const BUFFERS: u32 = 4;
/// A camera that is open and gives nothing for so long is opened anew.
const SILENCE: Duration = Duration::from_secs(3);
/// Pictures of a look, after which rate and stamps are judged.
const LOOKED_AT: usize = 12;
/// The longest look.
const LOOK: Duration = Duration::from_millis(2_500);
/// By how much the rate of a look may differ from what is asked.
const RATE_TOLERANCE: f64 = 0.1;

fn open(
    place: &str,
    request: &PictureRequest,
    clock: &Arc<dyn HostClock>,
) -> Result<Box<dyn PictureSource>, String> {
    if !place.starts_with('/') {
        return Err(format!("{place:?} is no device file; write {}", KIND.form));
    }
    Ok(Box::new(V4l2Source {
        place: place.to_owned(),
        request: *request,
        offset_ns: offset_ns(&**clock),
        running: None,
        known: None,
        losses: PictureLosses::default(),
        number: 0,
    }))
}

/// A camera that streams.
struct Running {
    stream: Stream,
    identity: Identity,
    form: PictureForm,
    exposure_ns: i64,
    /// The driver's number of the newest picture.
    sequence: Option<u32>,
    /// When it was begun or gave a picture last.
    heard: Instant,
}

impl Running {
    /// Opens the camera, sets it and begins.
    fn begin(
        place: &str,
        request: &PictureRequest,
        doubts: &mut Vec<CameraDoubt>,
    ) -> Result<Self, CameraDoubt> {
        let (node, identity) = device::open(place)?;
        let form = device::set(&node, place, request, doubts)?;
        let exposure_ns = exposure::set(&node, place, request, doubts)?;
        let stream = Stream::begin(node, BUFFERS).map_err(|e| device::failure(place, "to stream", &e))?;
        Ok(Self { stream, identity, form, exposure_ns, sequence: None, heard: Instant::now() })
    }

    /// The newest picture that waits, if any within `timeout`; all older ones go back to the driver. `losses` counts what is
    /// missing between it and the one before.
    fn newest(
        &mut self,
        place: &str,
        timeout: Duration,
        losses: &mut PictureLosses,
    ) -> Result<Option<Filling>, CameraDoubt> {
        let failed = |e: &std::io::Error| device::failure(place, "the next picture", e);
        if !self.stream.node().wait(timeout).map_err(|e| failed(&e))? {
            return Ok(None);
        }
        let mut newest: Option<Filling> = None;
        // A camera cannot fill more than it was given; what it gets back meanwhile is for the next call.
        for _ in 0..self.stream.buffers() {
            let taken = match self.stream.take() {
                Ok(Some(taken)) => taken,
                Ok(None) => break,
                Err(e) => return Err(failed(&e)),
            };
            self.heard = Instant::now();
            losses.lost += self.missing_before(taken.sequence);
            let least = self.form.layout.least_bytes(self.form.stride, self.form.size);
            let mut back = Some(taken.index);
            if taken.flags & abi::IS_DAMAGED != 0 || taken.bytes < least {
                losses.damaged += 1;
            } else {
                back = newest.replace(taken).map(|older| older.index);
                losses.passed_over += u64::from(back.is_some());
            }
            if let Some(index) = back {
                self.stream.give(index).map_err(|e| failed(&e))?;
            }
        }
        Ok(newest)
    }

    /// How many pictures the driver left out before the one with this number.
    fn missing_before(&mut self, sequence: u32) -> u64 {
        let step = self.sequence.map_or(1, |last| sequence.wrapping_sub(last));
        self.sequence = Some(sequence);
        // A number that goes back, or repeats, says nothing.
        if step == 0 || step > u32::MAX / 2 {
            return 0;
        }
        u64::from(step - 1)
    }
}

/// A camera that is kept open: it is opened when it is asked for a picture, and again after every loss.
struct V4l2Source {
    place: String,
    request: PictureRequest,
    /// The host's clock less CLOCK_MONOTONIC, ns.
    offset_ns: i64,
    running: Option<Running>,
    /// The camera that was there first: another one has another lens.
    known: Option<Identity>,
    losses: PictureLosses,
    /// Of the newest picture. It counts what was lost while the camera was open, and goes on after it was gone.
    number: u32,
}

impl V4l2Source {
    fn begin(&mut self) -> Result<&mut Running, CameraDoubt> {
        if self.running.is_none() {
            let running = Running::begin(&self.place, &self.request, &mut Vec::new())?;
            let known = self.known.get_or_insert_with(|| running.identity.clone());
            if known.card != running.identity.card {
                let found =
                    format!("{} is {:?} now, and was {:?}", self.place, running.identity.card, known.card);
                let remedy = "its lens is another one: name the camera by /dev/v4l/by-id, or start anew";
                return Err(CameraDoubt::new(found, remedy));
            }
            self.running = Some(running);
        }
        Ok(self.running.as_mut().expect("just begun"))
    }

    fn try_next(&mut self, timeout: Duration, picture: &mut Picture) -> Result<bool, CameraDoubt> {
        self.begin()?;
        let (place, losses) = (&self.place, &mut self.losses);
        let Some(running) = self.running.as_mut() else { return Ok(false) };
        let before = losses.all();
        let taken = running.newest(place, timeout, losses)?;
        self.number = self.number.wrapping_add((losses.all() - before) as u32);
        let Some(taken) = taken else {
            if running.heard.elapsed() > SILENCE {
                let found = format!("{place} has given no picture for {} s", SILENCE.as_secs());
                return Err(CameraDoubt::new(found, "it is opened anew; check cable and supply"));
            }
            return Ok(false);
        };
        self.number = self.number.wrapping_add(1);
        let moment = stamp::moment(taken.flags, taken.stamp_ns, monotonic_ns() as i64);
        let moment = moment.map_err(|why| unknown_stamps(place, &why));
        let form = running.form;
        let read = moment.map(|moment| {
            let readout_ns = i64::from(self.request.readout_us) * 1_000;
            let begin_ns = moment.begin_ns(taken.stamp_ns, running.exposure_ns, readout_ns);
            picture.begin = HostTime(begin_ns.saturating_add(self.offset_ns));
            picture.exposure_ns = running.exposure_ns;
            picture.row_ns = readout_ns / form.size[1].max(1) as i64;
            picture.number = self.number;
            [picture.width, picture.height] = form.size;
            let bytes = running.stream.bytes(taken.index);
            form.layout.grey(
                &bytes[..taken.bytes.min(bytes.len())],
                form.stride,
                form.size,
                &mut picture.pixels,
            )
        });
        running.stream.give(taken.index).map_err(|e| device::failure(place, "a buffer", &e))?;
        self.losses.damaged += u64::from(read == Ok(false));
        read
    }
}

impl PictureSource for V4l2Source {
    fn next(&mut self, timeout: Duration, picture: &mut Picture) -> Result<bool, String> {
        self.try_next(timeout, picture).map_err(|doubt| {
            self.running = None;
            doubt.to_string()
        })
    }

    fn name(&self) -> &str {
        &self.place
    }

    fn losses(&self) -> PictureLosses {
        self.losses
    }
}

fn unknown_stamps(place: &str, why: &str) -> CameraDoubt {
    CameraDoubt::new(
        format!("{place}: {why}"),
        "the time of its pictures is unknown, and none is used; for a USB camera see that the module uvcvideo has clock=CLOCK_MONOTONIC",
    )
}

/// Opens the camera as a run does, takes some pictures, and closes it.
fn examine(place: &str, request: &PictureRequest) -> Result<CameraLook, CameraDoubt> {
    let mut doubts = Vec::new();
    let mut running = Running::begin(place, request, &mut doubts)?;
    let (mut losses, mut stamps, mut moment) = (PictureLosses::default(), Vec::new(), Moment::Begin);
    let begin = Instant::now();
    while stamps.len() < LOOKED_AT && begin.elapsed() < LOOK {
        let Some(taken) = running.newest(place, Duration::from_millis(200), &mut losses)? else { continue };
        let judged = stamp::moment(taken.flags, taken.stamp_ns, monotonic_ns() as i64);
        moment = judged.map_err(|why| unknown_stamps(place, &why))?;
        stamps.push((running.sequence, taken.stamp_ns));
        running.stream.give(taken.index).map_err(|e| device::failure(place, "a buffer", &e))?;
    }
    let Identity { card, driver, bus } = &running.identity;
    let [w, h] = running.form.size;
    let format = luma::name_of(running.form.layout.code);
    let us = running.exposure_ns / 1_000;
    let rate = counted_hz(&stamps);
    let seen = match rate {
        Some(hz) => format!("{hz:.1} pictures a second"),
        None => format!("{} pictures in {:.1} s", stamps.len(), begin.elapsed().as_secs_f64()),
    };
    let found = format!(
        "{card} ({driver}, {bus}): {w} x {h} {format}, {seen}, exposed for {us} us; CLOCK_MONOTONIC stamps {}",
        moment.told()
    );
    match rate {
        None => {
            let found = format!("{place} gave {} pictures while it was looked at", stamps.len());
            doubts.push(CameraDoubt::new(found, "check cable and supply; a hub without a supply starves it"));
        }
        Some(hz) if (hz / f64::from(request.rate_hz) - 1.0).abs() > RATE_TOLERANCE => {
            let found =
                format!("{place} gives {hz:.1} pictures a second where {} are asked", request.rate_hz);
            let remedy = "set tracker.rate_hz to that, or a shorter tracker.exposure_us";
            doubts.push(CameraDoubt::new(found, remedy));
        }
        Some(_) => {}
    }
    if losses.lost + losses.damaged > 0 {
        let found = format!("{place} lost {} pictures and damaged {}", losses.lost, losses.damaged);
        doubts.push(CameraDoubt::new(found, "give it a USB port of its own, without a hub"));
    }
    Ok(CameraLook { found, doubts })
}

/// Pictures per second by number and stamp of the first and the last; `None` of fewer than three.
fn counted_hz(stamps: &[(Option<u32>, i64)]) -> Option<f64> {
    let [(Some(first), begin), .., (Some(last), end)] = stamps else { return None };
    let (count, ns) = (last.wrapping_sub(*first), end - begin);
    (stamps.len() >= 3 && ns > 0 && count > 0).then(|| 1e9 * f64::from(count) / ns as f64)
}
