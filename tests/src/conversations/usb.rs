//! USB: the driver of a DLPC900 against any controller, the emulated controller against any host, and the USB/IP server
//! against any client.

use super::{step, taken, Script};
use dpm_device::time::HostTime;
use dpm_dlpc900::command::{Command, Opcode, Reply, ReplyAssembler, REPORT_BYTES};
use dpm_dlpc900::driver::{Dlpc900, HidPort, PortError};
use hil_mock::dlpc900::{Dlpc900Model, Options};
use hil_mock::usb_model::{Speed, UsbDeviceModel};
use hil_mock::usb_plug::{Completion, Request, Status, UsbCable};
use hil_mock::usbip::wire::{self, Urb};
use hil_mock::usbip::{serve, Export, Link};
use std::collections::{BTreeMap, VecDeque};
use std::io::{self, Read, Write};
use std::sync::{Arc, Mutex};
use std::time::Duration;

/// A controller that answers what the script says, to whatever it was asked: the sequence number is patched in.
struct AnyController<'a> {
    script: Script<'a>,
    sequence: u8,
    waiting: VecDeque<[u8; REPORT_BYTES]>,
    waited: Duration,
    written: usize,
}

impl HidPort for AnyController<'_> {
    fn write_report(&mut self, report: &[u8; REPORT_BYTES], timeout: Duration) -> Result<(), PortError> {
        assert!(timeout <= Duration::from_secs(2));
        self.sequence = report[1];
        self.written += 1;
        Ok(())
    }

    fn read_report(&mut self, report: &mut [u8; REPORT_BYTES], timeout: Duration) -> Result<(), PortError> {
        assert!(timeout <= Duration::from_secs(2));
        if self.waiting.is_empty() {
            let Some(step) = self.script.next() else {
                self.waited += timeout;
                return Err(PortError::Timeout);
            };
            match step.what % 8 {
                0 => return Err(PortError::Timeout),
                // Any report.
                1 => {
                    let mut rest = step.bytes;
                    self.waiting.push_back(taken(&mut rest));
                }
                kind => {
                    // One in six answers something else.
                    let sequence = if kind == 2 { step.wait_ns as u8 } else { self.sequence };
                    let reply = Reply { flags: step.how & 0xe0 | 0x40, sequence, data: step.bytes };
                    self.waiting.extend(reply.reports().into_iter().flatten());
                }
            }
        }
        *report = self.waiting.pop_front().unwrap_or([0; REPORT_BYTES]);
        Ok(())
    }

    fn pause(&mut self, time: Duration) {
        self.waited += time;
    }

    fn now(&self) -> Duration {
        self.waited
    }
}

/// A DLPC900's driver and any controller: every call ends, after a bounded time and a bounded number of reports.
pub fn dlpc900_driver(bytes: &[u8]) {
    let (calls, script) = bytes.split_at(bytes.len().min(3));
    let steps = Script(script).count();
    let port = AnyController {
        script: Script(script),
        sequence: 0,
        waiting: VecDeque::new(),
        waited: Duration::ZERO,
        written: 0,
    };
    let Ok(mut driver) = Dlpc900::new(port) else { return };
    for call in calls {
        let done = match call % 8 {
            0 => driver.status().map(|status| drop((status.complaint(), status.is_running()))),
            1 => driver.make_ready().map(drop),
            2 => driver.idle(),
            3 => driver.wake(),
            4 => driver.start(),
            5 => driver.error_text().map(drop),
            6 => driver.park(),
            _ => driver.read(Opcode::DISPLAY_MODE, &[]).map(drop),
        };
        if let Err(error) = done {
            assert!(error.to_string().len() < 2000);
        }
    }
    let counters = driver.counters();
    assert!(counters.replies <= counters.commands);
    let port = driver.into_port();
    assert!(port.waited < Duration::from_secs(60 + 20 * steps as u64), "{:?}", port.waited);
    assert!(port.written < 200 + 20 * steps, "{} reports", port.written);
}

/// The emulated DLPC900 and any host: commands with right headers, raw reports, requests of the HID class, time.
pub fn dlpc900_controller(bytes: &[u8]) {
    let [how] = taken(&mut &*bytes);
    let mut model = Dlpc900Model::new(Options { strict: how & 1 != 0, ..Options::default() });
    let mut now = HostTime(0);
    // A command that came in part, by raw reports, takes what follows for its rest.
    let mut is_whole = true;
    for step in Script(bytes) {
        match step.what % 8 {
            0 => {
                model.interrupt_out(now, 0x01, step.bytes);
                is_whole = false;
            }
            1 => {
                model.bus_reset(now);
                is_whole = true;
            }
            2 => {
                let mut rest = step.bytes;
                let mut data = [0u8; REPORT_BYTES + 1];
                let setup = hil_mock::usb_model::Setup::from_bytes(taken(&mut rest));
                data[..rest.len().min(65)].copy_from_slice(&rest[..rest.len().min(65)]);
                model.control(now, &setup, &mut data);
                is_whole = false;
            }
            _ => {
                let mut rest = step.bytes;
                let opcode = KNOWN[usize::from(u16::from_le_bytes(taken(&mut rest))) % KNOWN.len()];
                let flags = step.how & 0xc0;
                let command = Command { flags, sequence: step.how, opcode, data: rest };
                for report in command.reports().into_iter().flatten() {
                    model.interrupt_out(now, 0x01, &report);
                }
                let mut replies = ReplyAssembler::default();
                let mut n = 0;
                while let Some(report) = model.interrupt_in(0x81) {
                    n += 1;
                    assert!(n <= 9, "a reply has 512 bytes at most");
                    if let Ok(Some(reply)) = replies.push(&report) {
                        assert!(!is_whole || reply.sequence == step.how);
                    }
                }
            }
        }
        now = now.plus_ns(step.wait_ns);
        if let (Some((place, _)), table) = (model.showing(now), model.table()) {
            assert!(place < table.len());
        }
        assert!(model.warnings().len() <= 256 && model.executed().len() <= 4096);
    }
    assert!(model.summary(now).len() < 100_000);
}

const KNOWN: [Opcode; 24] = [
    Opcode::DISPLAY_MODE,
    Opcode::START_STOP,
    Opcode::LUT_DEFINITION,
    Opcode::LUT_CONFIG,
    Opcode::BMP_INIT_PRIMARY,
    Opcode::BMP_DATA_PRIMARY,
    Opcode::BMP_INIT_SECONDARY,
    Opcode::BMP_DATA_SECONDARY,
    Opcode::POWER_MODE,
    Opcode::DMD_IDLE,
    Opcode::DMD_PARK,
    Opcode::VERSION,
    Opcode::HARDWARE_ID,
    Opcode::ERROR_CODE,
    Opcode::ERROR_TEXT,
    Opcode::LED_CURRENT,
    Opcode::LED_ENABLE,
    Opcode::FLIP_LONG,
    Opcode::INPUT_SOURCE,
    Opcode::RECEIVER,
    Opcode::HARDWARE_STATUS,
    Opcode::MAIN_STATUS,
    Opcode::TRIG_OUT1,
    Opcode::INVERT,
];

/// A client's part of a connection, and what the server wrote.
struct AnyClient {
    says: io::Cursor<Vec<u8>>,
    hears: Arc<Mutex<Vec<u8>>>,
}

impl Read for AnyClient {
    fn read(&mut self, into: &mut [u8]) -> io::Result<usize> {
        self.says.read(into)
    }
}

impl Write for AnyClient {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.hears.lock().expect("no panic").extend_from_slice(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

impl Link for AnyClient {
    fn another(&self) -> io::Result<Self> {
        Ok(Self { says: io::Cursor::new(Vec::new()), hears: self.hears.clone() })
    }

    fn cut(&self) {}
}

/// A device that answers at once, but for endpoint 0x83, whose transfers wait until they are cancelled.
#[derive(Default)]
struct Bench {
    waiting: Mutex<BTreeMap<u64, Request>>,
}

impl UsbCable for Bench {
    fn descriptors(&self) -> Vec<u8> {
        let model = Dlpc900Model::default();
        [model.device_descriptor(), model.configuration_descriptor()].concat()
    }
    fn speed(&self) -> Speed {
        Speed::Full
    }
    fn submit(&self, request: Request) -> Result<(), Request> {
        if request.endpoint == 0x83 {
            self.waiting.lock().expect("no panic").insert(request.id, request);
            return Ok(());
        }
        let status = if request.endpoint & 0x7f == 4 { Status::Stall } else { Status::Ok };
        let actual =
            if request.endpoint & 0x7f == 5 { request.buffer.len() / 2 } else { request.buffer.len() };
        (request.done)(Completion { id: request.id, status, actual, buffer: request.buffer });
        Ok(())
    }
    fn cancel(&self, id: u64) -> bool {
        let found = self.waiting.lock().expect("no panic").remove(&id);
        let is_found = found.is_some();
        if let Some(request) = found {
            (request.done)(Completion { id, status: Status::Cancelled, actual: 0, buffer: request.buffer });
        }
        is_found
    }
    fn clear_halt(&self, _: u8) {}
    fn reset(&self, _: u8) {}
    fn set_configuration(&self, _: u8) {}
    fn on_unplug(&self, _: Box<dyn FnOnce() + Send>) {}
    fn unplug(&self) {}
}

/// A USB/IP server and any client: each transfer is answered once, and so is each unlink.
pub fn usbip_server(bytes: &[u8]) {
    let (mut says, mut transfers, mut unlinks) = (Vec::new(), 0, 0);
    let mut directions: BTreeMap<u32, Vec<bool>> = BTreeMap::new();
    if bytes.first().is_some_and(|b| b & 8 == 0) {
        says.extend(wire::Operation::Import("1-1".into()).encode());
    }
    let mut raw = says.is_empty();
    for step in Script(bytes) {
        let mut rest = step.bytes;
        match step.what % 8 {
            0 => {
                says.extend_from_slice(rest);
                raw = true;
            }
            1 | 2 => {
                let [victim] = taken::<1>(&mut rest);
                unlinks += 1;
                says.extend(
                    Urb::Unlink { seqnum: 1000 + unlinks, devid: 1, victim: u32::from(victim) }.encode(),
                );
            }
            _ => {
                let (is_in, endpoint) = (step.how & 0x80 != 0, step.how & 7);
                let [seqnum, packets, flags] = taken(&mut rest);
                let setup = hil_mock::usb_model::Setup::from_bytes(taken(&mut rest));
                let length = if is_in { u32::from(setup.length) } else { rest.len() as u32 };
                transfers += 1;
                directions.entry(u32::from(seqnum)).or_default().push(is_in);
                let submit = Urb::Submit {
                    seqnum: u32::from(seqnum),
                    devid: 1,
                    endpoint: if is_in && endpoint != 0 { endpoint | 0x80 } else { endpoint },
                    is_in,
                    flags: u32::from(flags),
                    length,
                    packets: if packets == 1 { 1 } else { 0 },
                    interval: 0,
                    setup,
                };
                says.extend(submit.encode());
                if !is_in {
                    says.extend_from_slice(rest);
                }
            }
        }
    }
    let hears = Arc::new(Mutex::new(Vec::new()));
    let bench = Arc::new(Bench::default());
    let client = AnyClient { says: io::Cursor::new(says), hears: hears.clone() };
    let export = Export::new("1-1", bench.clone());
    let ended = serve(client, std::slice::from_ref(&export));
    assert!(!export.is_in_use(), "the device is free again");
    assert!(bench.waiting.lock().expect("no panic").is_empty(), "a transfer outlived its client");
    if raw {
        return;
    }
    ended.expect("every message is well made");
    let hears = hears.lock().expect("no panic").clone();
    let mut rest = &hears[..];
    wire::read_import_reply(&mut rest).expect("a free device");
    let (mut answers, mut outcomes) = (0, 0);
    while let Some((header, after)) = rest.split_first_chunk::<{ wire::URB_HEADER }>() {
        rest = after;
        match Urb::decode(header).expect("its own message") {
            Urb::Submitted { seqnum, actual, .. } => {
                answers += 1;
                match directions.get(&seqnum).map(Vec::as_slice) {
                    Some([is_in, more @ ..]) if more.iter().all(|m| m == is_in) => {
                        rest = &rest[if *is_in { actual as usize } else { 0 }..];
                    }
                    // Which of several transfers with this number it answers is not known here.
                    _ => return,
                }
            }
            Urb::Unlinked { .. } => outcomes += 1,
            other => panic!("{other:?} from a server"),
        }
    }
    assert!(rest.is_empty());
    assert_eq!(outcomes, unlinks, "each unlink has one outcome");
    // One that waits may be cancelled by an unlink, or by the end.
    assert!(answers <= transfers, "{answers} answers to {transfers} transfers");
}

pub(super) fn recorded() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let mut seeds = Vec::new();
    // Version, hardware, then what each call asks.
    let greeting = [step(3, 0, 0, &[1, 0, 0, 6, 0, 0, 0, 0, 0, 0, 0, 0]), step(3, 0, 0, b"\0tag\0")].concat();
    let bytes = |values: &[u8]| values.iter().flat_map(|v| step(3, 0, 0, &[*v])).collect::<Vec<_>>();
    seeds.push((
        "dlpc900_driver",
        "status",
        [&[0, 0, 7][..], &greeting, &bytes(&[3, 1, 1, 2, 3, 1, 1, 2, 3])].concat(),
    ));
    seeds.push((
        "dlpc900_driver",
        "ready",
        [&[1, 4, 2][..], &greeting, &bytes(&[1, 0, 1, 0, 1, 0, 1, 0, 1, 0])].concat(),
    ));
    let refused = step(3, 0x20, 0, &[]);
    seeds.push((
        "dlpc900_driver",
        "refused",
        [&[1, 5, 6][..], &greeting, &refused, &bytes(&[9]), &step(3, 0, 0, b"why\0")].concat(),
    ));
    let command = |place: u8, flags: u8, data: &[u8]| step(3, flags, 30, &[&[place, 0][..], data].concat());
    let talk = [
        command(11, 0xc0, &[]),
        command(12, 0xc1, &[]),
        command(0, 0x42, &[3]),
        command(2, 0x43, &[0, 0, 100, 0, 0, 1, 0, 0, 0, 0, 0, 0]),
        command(3, 0x44, &[1, 0, 0, 0, 0, 0]),
        command(1, 0x45, &[2]),
        command(21, 0xc6, &[]),
        command(9, 0x47, &[1]),
        command(13, 0xc8, &[]),
        command(14, 0xc9, &[]),
    ];
    seeds.push(("dlpc900_controller", "patterns", talk.concat()));
    let reset =
        [command(10, 0x41, &[1]), step(1, 0, 0, &[]), step(2, 0, 9, &[0xa1, 1, 0, 0, 0, 0, 64, 0])].concat();
    seeds.push(("dlpc900_controller", "reset", reset));
    // A control request, a transfer that waits, its unlink, one that is short, one out.
    let urb = |how: u8, seqnum: u8, length: u8, more: &[u8]| {
        step(3, how, 0, &[&[seqnum, 0, 0, 0x80, 6, 0, 1, 0, 0, length, 0][..], more].concat())
    };
    let talk = [urb(0x80, 1, 18, &[]), urb(0x83, 2, 64, &[]), step(1, 0, 0, &[2]), urb(0x85, 3, 8, &[])];
    seeds.push(("usbip_server", "unlink", talk.concat()));
    seeds.push((
        "usbip_server",
        "out",
        [urb(0x01, 1, 0, &[1, 2, 3]), urb(0x04, 2, 0, &[5]), step(1, 0, 0, &[2])].concat(),
    ));
    seeds
}
