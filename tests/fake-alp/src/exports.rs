//! The functions of the ALP API, with the types that they have on Linux: every integer has 32 bits.

// The vendor's names.
#![allow(non_snake_case)]
// What a C library exports is called with raw pointers.
#![allow(unsafe_code)]

use std::ffi::c_void;

use crate::codes::*;
use crate::faults::Fault;
use crate::projection::Progress;
use crate::world::{hash, world, Device};

/// A call of `id`'s device: its faults first, then `act`.
fn call(id: u32, name: &str, act: impl FnOnce(&mut Device, i64) -> Result<(), i32>) -> i32 {
    let (mut slow_ns, mut code) = (0, OK);
    {
        let mut world = world();
        let Some(device) = world.by_id(id) else { return NOT_AVAILABLE };
        device.look_at_plan();
        let now = device.now();
        device.panel.advance(now);
        match device.strike(name) {
            Some(Fault::Code(planned)) => return planned,
            Some(Fault::Slow(ms)) => slow_ns = i64::from(ms) * 1_000_000,
            Some(Fault::Removed) | None => {}
        }
        if !device.is_plugged() && name != "free" {
            return DEVICE_REMOVED;
        }
        if let Err(refusal) = act(device, now) {
            device.refuse(refusal);
            code = refusal;
        }
        device.pass(slow_ns + i64::from(device.panel.settings.call_us) * 1000);
        if !device.is_real() {
            return code;
        }
    }
    std::thread::sleep(std::time::Duration::from_nanos(slow_ns as u64));
    code
}

/// Writes what was inquired to the caller's variable.
fn answer(to: *mut i32, value: i32) -> Result<(), i32> {
    if to.is_null() {
        return Err(ADDR_INVALID);
    }
    // SAFETY: not null; the API demands a variable of the caller's.
    unsafe { to.write(value) };
    Ok(())
}

/// Opens a device. `id` is set to `u32::MAX` on failure.
///
/// # Safety
/// `id` is null or points to a variable of the caller's.
#[no_mangle]
unsafe extern "C" fn AlpDevAlloc(number: i32, init_flag: i32, id: *mut u32) -> i32 {
    if id.is_null() {
        return ADDR_INVALID;
    }
    let (code, value) = match world().allocate(number, init_flag) {
        Ok(allocated) => (OK, allocated),
        Err(code) => (code, INVALID_ID),
    };
    // SAFETY: not null, and the caller's.
    unsafe { id.write(value) };
    code
}

/// Stops everything.
#[no_mangle]
extern "C" fn AlpDevHalt(id: u32) -> i32 {
    call(id, "halt", |device, now| {
        device.panel.stop(now);
        device.write(format_args!("stop at={now}"));
        Ok(())
    })
}

/// Closes a device that shows nothing.
#[no_mangle]
extern "C" fn AlpDevFree(id: u32) -> i32 {
    call(id, "free", |device, now| {
        if device.panel.running.is_some() && device.is_plugged() {
            return Err(NOT_IDLE);
        }
        device.panel.release(now);
        device.allocated = None;
        let leaked = device.panel.leaked;
        device.write(format_args!("free at={now} leaked={leaked}"));
        Ok(())
    })
}

/// Sets a property of the device.
#[no_mangle]
extern "C" fn AlpDevControl(id: u32, what: i32, value: i32) -> i32 {
    call(id, "control", |device, _| match (what, value) {
        (USB_DISCONNECT_BEHAVIOUR, USB_IGNORE | USB_RESET) => {
            device.panel.disconnect = value;
            Ok(())
        }
        _ => Err(PARM_INVALID),
    })
}

/// Asks for a property of the device.
///
/// # Safety
/// `to` is null or points to a variable of the caller's.
#[no_mangle]
unsafe extern "C" fn AlpDevInquire(id: u32, what: i32, to: *mut i32) -> i32 {
    call(id, "inquire", |device, _| {
        let (panel, settings) = (&device.panel, &device.panel.settings);
        let value = match what {
            DEVICE_NUMBER => id as i32 + 7000,
            VERSION => 0x0420_0019,
            DEV_STATE if panel.running.is_some() => DEV_BUSY,
            DEV_STATE => DEV_IDLE,
            AVAIL_MEMORY => panel.free_memory() as i32,
            DEV_DMDTYPE => settings.dmd_type,
            DDC_FPGA_TEMPERATURE | APPS_FPGA_TEMPERATURE | PCB_TEMPERATURE => {
                (settings.celsius * 256.0) as i32
            }
            2145..=2147 => 85 * 256,
            DISPLAY_HEIGHT => settings.height as i32,
            DISPLAY_WIDTH => settings.width as i32,
            USB_DISCONNECT_BEHAVIOUR => panel.disconnect,
            _ => return Err(PARM_INVALID),
        };
        answer(to, value)
    })
}

/// Takes memory for a sequence. `sequence` is set to `u32::MAX` on failure.
///
/// # Safety
/// `sequence` is null or points to a variable of the caller's.
#[no_mangle]
unsafe extern "C" fn AlpSeqAlloc(id: u32, bit_planes: i32, pictures: i32, sequence: *mut u32) -> i32 {
    if sequence.is_null() {
        return ADDR_INVALID;
    }
    // SAFETY: not null, and the caller's.
    unsafe { sequence.write(INVALID_ID) };
    call(id, "seq-alloc", |device, _| {
        let allocated = device.panel.allocate(bit_planes, pictures)?;
        // SAFETY: as above.
        unsafe { sequence.write(allocated) };
        Ok(())
    })
}

/// Gives the memory of a sequence back.
#[no_mangle]
extern "C" fn AlpSeqFree(id: u32, sequence: u32) -> i32 {
    call(id, "seq-free", |device, _| {
        if device.panel.in_use(sequence) {
            return Err(SEQ_IN_USE);
        }
        device.panel.sequences.remove(&sequence).map(|_| ()).ok_or(PARM_INVALID)
    })
}

/// Sets a property of a sequence.
#[no_mangle]
extern "C" fn AlpSeqControl(id: u32, sequence: u32, what: i32, value: i32) -> i32 {
    call(id, "seq-control", |device, _| {
        if device.panel.in_use(sequence) {
            return Err(SEQ_IN_USE);
        }
        let sequence = device.panel.sequences.get_mut(&sequence).ok_or(PARM_INVALID)?;
        match sequence.control(what, value) {
            OK => Ok(()),
            refusal => Err(refusal),
        }
    })
}

/// Sets the times of a sequence, microseconds; 0 is the default of each.
#[no_mangle]
extern "C" fn AlpSeqTiming(
    id: u32,
    sequence: u32,
    illuminate: i32,
    picture: i32,
    synch_delay: i32,
    synch_pulse: i32,
    trigger_delay: i32,
) -> i32 {
    call(id, "timing", |device, _| {
        if device.panel.in_use(sequence) {
            return Err(SEQ_IN_USE);
        }
        if synch_delay < 0 || trigger_delay < 0 {
            return Err(PARM_INVALID);
        }
        let sequence = device.panel.sequences.get_mut(&sequence).ok_or(PARM_INVALID)?;
        match sequence.set_timing(illuminate, picture, synch_pulse) {
            OK => Ok(()),
            refusal => Err(refusal),
        }
    })
}

/// Asks for a property of a sequence.
///
/// # Safety
/// `to` is null or points to a variable of the caller's.
#[no_mangle]
unsafe extern "C" fn AlpSeqInquire(id: u32, sequence: u32, what: i32, to: *mut i32) -> i32 {
    call(id, "seq-inquire", |device, _| {
        let sequence = device.panel.sequences.get(&sequence).ok_or(PARM_INVALID)?;
        answer(to, sequence.inquire(what)?)
    })
}

/// Writes pictures of a sequence, and returns when they have crossed the cable.
///
/// # Safety
/// `data` is null or points to the pictures in the sequence's format.
#[no_mangle]
unsafe extern "C" fn AlpSeqPut(id: u32, sequence: u32, offset: i32, load: i32, data: *const c_void) -> i32 {
    let mut wait_ns = 0;
    let code = call(id, "put", |device, _| {
        if data.is_null() {
            return Err(ADDR_INVALID);
        }
        let (bytes, per_s) = (device.panel.settings.plane_bytes(), device.panel.settings.usb_bytes_per_s);
        let in_use = device.panel.in_use(sequence);
        let known = device.panel.sequences.get_mut(&sequence).ok_or(PARM_INVALID)?;
        let (first, count) = (u32::try_from(offset), u32::try_from(load));
        let (Ok(first), Ok(count)) = (first, count) else { return Err(PARM_INVALID) };
        let count = if count == 0 { known.pictures.saturating_sub(first) } else { count };
        if count == 0 || first.checked_add(count).is_none_or(|end| end > known.pictures) {
            return Err(PARM_INVALID);
        }
        if known.format != DATA_BINARY_TOPDOWN {
            return Err(CONFIG_MISMATCH);
        }
        if in_use && known.is_locked() {
            return Err(SEQ_IN_USE);
        }
        let mut hashes = Vec::new();
        for picture in 0..count {
            let at = picture as usize * bytes;
            // SAFETY: the caller's data hold `count` pictures of `bytes` bytes.
            let plane = unsafe { std::slice::from_raw_parts(data.cast::<u8>().add(at), bytes) };
            known.put(first + picture, plane);
            hashes.push(plane);
        }
        wait_ns = (f64::from(count) * bytes as f64 / per_s * 1e9) as i64;
        device.pass(wait_ns);
        if device.has_log() {
            for (picture, plane) in (first..).zip(hashes) {
                let hash = hash(plane);
                device.write(format_args!("put sequence={sequence} picture={picture} hash={hash:016x}"));
            }
        }
        wait_ns *= i64::from(device.is_real());
        Ok(())
    });
    if code == OK {
        std::thread::sleep(std::time::Duration::from_nanos(wait_ns as u64));
    }
    code
}

fn start(id: u32, sequence: u32, for_ever: bool) -> i32 {
    call(id, "start", |device, now| {
        let queue_id = device.panel.start(sequence, for_ever, now)?;
        if device.has_log() {
            let until = device.panel.runs_until().map_or("for-ever".into(), |until| until.to_string());
            let end = if device.panel.ends_dark() { "dark" } else { "lit" };
            device.write(format_args!(
                "start sequence={sequence} entry={queue_id} at={now} until={until} then={end}"
            ));
        }
        Ok(())
    })
}

/// Shows a sequence as often as its `ALP_SEQ_REPEAT` says.
#[no_mangle]
extern "C" fn AlpProjStart(id: u32, sequence: u32) -> i32 {
    start(id, sequence, false)
}

/// Shows a sequence for ever.
#[no_mangle]
extern "C" fn AlpProjStartCont(id: u32, sequence: u32) -> i32 {
    start(id, sequence, true)
}

/// Ends the projection, some milliseconds later.
#[no_mangle]
extern "C" fn AlpProjHalt(id: u32) -> i32 {
    call(id, "proj-halt", |device, now| {
        device.panel.halt(now);
        device.write(format_args!("halt at={now}"));
        Ok(())
    })
}

/// Sets a property of the projection.
#[no_mangle]
extern "C" fn AlpProjControl(id: u32, what: i32, value: i32) -> i32 {
    call(id, "proj-control", |device, now| match device.panel.projection_control(what, value, now) {
        OK => {
            device.write(format_args!("control what={what} value={value} at={now}"));
            Ok(())
        }
        refusal => Err(refusal),
    })
}

/// Asks for a property of the projection.
///
/// # Safety
/// `to` is null or points to a variable of the caller's.
#[no_mangle]
unsafe extern "C" fn AlpProjInquire(id: u32, what: i32, to: *mut i32) -> i32 {
    call(id, "proj-inquire", |device, _| answer(to, device.panel.projection_inquire(what)?))
}

/// Asks for the progress of the projection.
///
/// # Safety
/// `to` is null or points to a [`Progress`] of the caller's.
#[no_mangle]
unsafe extern "C" fn AlpProjInquireEx(id: u32, what: i32, to: *mut c_void) -> i32 {
    call(id, "progress", |device, _| {
        if what != PROJ_PROGRESS {
            return Err(PARM_INVALID);
        }
        if to.is_null() {
            return Err(ADDR_INVALID);
        }
        // SAFETY: not null; the struct may lie anywhere, since the API's structs are packed.
        unsafe { to.cast::<Progress>().write_unaligned(device.panel.progress()) };
        Ok(())
    })
}
