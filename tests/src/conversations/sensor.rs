//! A light sensor's client and any sensor, and a sensor and any host.

use super::trackers::{Memory, BEGIN_NS};
use super::{step, taken, Moved, Script};
use dpm_device::cobs::Deframer;
use dpm_device::sensor::client::{SensorClient, SensorConfig};
use dpm_device::sensor::device::{Adc, Clock, Sensor, SensorIdentity, Uart};
use dpm_device::sensor::wire::{
    BlockHead, LevelBits, Levels, Refusal, SensorHello, SensorMessage, MAX_FRAME, MAX_PACKET, MAX_SAMPLES,
    PERIOD_ONE,
};

/// Packs a message and appends it.
fn put(message: &SensorMessage<'_>, to: &mut Vec<u8>) {
    let mut frame = [0; MAX_FRAME];
    if let Some(n) = message.encode(&mut frame) {
        to.extend_from_slice(&frame[..n]);
    }
}

/// The client and any sensor, in memory. Checksums are right, and so are the tokens of the client's echo requests.
pub fn sensor_client(bytes: &[u8]) {
    let clock = Moved::at(BEGIN_NS);
    let line = Memory::default();
    let config = SensorConfig {
        port: "/nonexistent".into(),
        baud: 115_200,
        gain: 1,
        block: 128,
        samples_per_second: 0,
    };
    let mut client = SensorClient::over(config, clock.clone(), Box::new(line.clone())).expect("a client");
    let (mut said, mut token) = (Vec::new(), 0u64);
    let (mut blocks, mut samples, mut missing, mut next) = (0u64, 0u64, 0u64, None::<u32>);
    let mut deframer = Deframer::new([0u8; MAX_PACKET]);
    for step in Script(bytes) {
        let mut rest = step.bytes;
        match step.what % 6 {
            0 => put(&SensorMessage::Hello(hello(step.how, &mut rest)), &mut said),
            1 => put(
                &SensorMessage::EchoResponse { token, ticks: u64::from_le_bytes(taken(&mut rest)) },
                &mut said,
            ),
            2 | 3 => {
                let head = BlockHead {
                    sequence: u32::from_le_bytes(taken(&mut rest)),
                    lost: u32::from(taken::<1>(&mut rest)[0]),
                    first: u64::from_le_bytes(taken(&mut rest)),
                    period: 10 * PERIOD_ONE,
                    gain: step.how & 7,
                    cut_below: false,
                    cut_above: true,
                };
                let levels: Vec<u16> = rest.iter().map(|b| u16::from(*b) << 4).take(MAX_SAMPLES).collect();
                put(&SensorMessage::Samples(head, Levels::Values(LevelBits::Twelve, &levels)), &mut said);
            }
            4 => put(
                &SensorMessage::Refused([Refusal::Gain, Refusal::Running][usize::from(step.how & 1)]),
                &mut said,
            ),
            _ => said.extend_from_slice(rest),
        }
        if let (true, Some(byte)) = (step.how & 0x40 != 0, said.last_mut()) {
            *byte ^= step.how;
        }
        let cut = if step.how & 0x20 != 0 { said.len() / 2 } else { said.len() };
        line.say(&said[..cut]);
        said.drain(..cut);
        client.poll(clock.forward(step.wait_ns), &mut |block| {
            blocks += 1;
            samples += block.levels.len() as u64;
            missing += u64::from(block.missing);
            if let (Some(next), true) = (next, block.missing == 0) {
                // Or the stream was started anew.
                assert!(block.head.sequence == next || block.head.sequence == 0);
            }
            next = Some(block.head.sequence.wrapping_add(1));
        });
        deframer.push(&line.heard(), &mut |packet| match SensorMessage::decode(packet).expect("its own") {
            SensorMessage::EchoRequest { token: new } => token = new,
            SensorMessage::HelloRequest
            | SensorMessage::Stop
            | SensorMessage::Start
            | SensorMessage::Configure { .. } => {}
            other => panic!("a client says {other:?}"),
        });
    }
    let c = client.counters();
    assert_eq!((c.blocks, c.samples, c.lost_in_sensor + c.lost_on_line), (blocks, samples, missing));
    assert!(!client.status().is_empty());
}

fn hello(how: u8, rest: &mut &[u8]) -> SensorHello {
    SensorHello {
        version: if how & 0x10 == 0 { 1 } else { how },
        bits: LevelBits::Twelve,
        running: how & 1 != 0,
        ticks_per_second: u32::from_le_bytes(taken(rest)),
        samples_per_second: 100_000,
        floor: 0,
        ceiling: 4095,
        serial: u64::from_le_bytes(taken(rest)),
        name: taken(rest),
        gains_milli: [1000, 2000, 0, 0, 0, 0, 0, 0],
        gain: how >> 1 & 1,
    }
}

/// A board whose converter gives what a script says, and whose line has room for so many bytes.
struct Board<'a> {
    now: u64,
    running: bool,
    heard: &'a [u8],
    room: usize,
    line: Vec<u8>,
}

struct BoardAdc<'a>(&'a mut bool, u64, usize);
struct BoardUart<'a, 'b>(&'a mut &'b [u8], &'a mut Vec<u8>, usize);
struct BoardClock(u64);

impl Adc for BoardAdc<'_> {
    fn start(&mut self, _: u8, samples_per_second: u32) -> Option<u32> {
        *self.0 = samples_per_second < 1_000_000;
        self.0.then_some(10 * PERIOD_ONE)
    }
    fn stop(&mut self) {
        *self.0 = false;
    }
    fn take(&mut self, into: &mut [u16]) -> (usize, u64) {
        let n = if *self.0 { self.2.min(into.len()) } else { 0 };
        self.2 -= n;
        into[..n].fill(self.1 as u16);
        (n, self.1)
    }
}

impl Uart for BoardUart<'_, '_> {
    fn read(&mut self, into: &mut [u8]) -> usize {
        let n = self.0.len().min(into.len());
        into[..n].copy_from_slice(&self.0[..n]);
        *self.0 = &self.0[n..];
        n
    }
    fn write(&mut self, bytes: &[u8]) -> usize {
        let n = bytes.len().min(self.2);
        self.1.extend_from_slice(&bytes[..n]);
        n
    }
}

impl Clock for BoardClock {
    fn ticks(&mut self) -> u64 {
        self.0
    }
}

/// The sensor and any host: it says only what a sensor says, every block is sent or counted, and what it does not
/// stream it does not make.
pub fn sensor_device(bytes: &[u8]) {
    let identity = SensorIdentity {
        serial: 1,
        name: [b'x'; 16],
        bits: LevelBits::Twelve,
        ticks_per_second: 1_000_000,
        samples_per_second: 100_000,
        floor: 0,
        ceiling: 4095,
        gains_milli: [1000, 2000, 0, 0, 0, 0, 0, 0],
    };
    let mut sensor: Sensor<2048> = Sensor::new(identity);
    let mut board = Board { now: 1, running: false, heard: &[], room: 0, line: Vec::new() };
    let mut deframer = Deframer::new([0u8; MAX_PACKET]);
    let mut after = None::<BlockHead>;
    for step in Script(bytes) {
        let mut said = Vec::new();
        let mut rest = step.bytes;
        match step.what % 6 {
            0 => put(&SensorMessage::Start, &mut said),
            1 => put(&SensorMessage::Stop, &mut said),
            2 => {
                let [gain, block, high, rate] = taken(&mut rest);
                let block = u16::from_le_bytes([block, high & 1]);
                let samples_per_second = u32::from(rate) * 10_000;
                put(&SensorMessage::Configure { gain: gain & 3, block, samples_per_second }, &mut said);
            }
            3 => put(&SensorMessage::EchoRequest { token: u64::from_le_bytes(taken(&mut rest)) }, &mut said),
            4 => put(&SensorMessage::HelloRequest, &mut said),
            _ => said.extend_from_slice(rest),
        }
        if let (true, Some(byte)) = (step.how & 0x40 != 0, said.last_mut()) {
            *byte ^= step.how;
        }
        board.now += 1 + step.wait_ns as u64 / 1000;
        (board.heard, board.room) = (&said, usize::from(step.how & 0x3f) * 32);
        loop {
            let mut adc = BoardAdc(&mut board.running, board.now, usize::from(step.how) * 2);
            let mut uart = BoardUart(&mut board.heard, &mut board.line, board.room);
            sensor.step(&mut adc, &mut uart, &mut BoardClock(board.now));
            assert_eq!(sensor.is_running(), board.running);
            if board.heard.is_empty() {
                break;
            }
        }
        board.heard = &[];
        deframer.push(&std::mem::take(&mut board.line), &mut |packet| match SensorMessage::decode(packet)
            .expect("its own")
        {
            SensorMessage::Samples(head, levels) => {
                assert!(levels.len() <= MAX_SAMPLES);
                if let Some(before) = after.replace(head).filter(|before| before.sequence < head.sequence) {
                    let gap = head.sequence - before.sequence - 1;
                    assert!(gap <= head.lost.max(before.lost), "{before:?} {head:?}");
                }
            }
            SensorMessage::Hello(_) | SensorMessage::Refused(_) | SensorMessage::EchoResponse { .. } => {}
            other => panic!("a sensor says {other:?}"),
        });
    }
}

/// A stream from STOP to blocks, for both ends.
pub(super) fn recorded() -> Vec<(&'static str, &'static str, Vec<u8>)> {
    let ticks = 1_000_000u32.to_le_bytes();
    let block = |sequence: u32| {
        let first = (u64::from(sequence) * 1280).to_le_bytes();
        step(2, 1, 1, &[&sequence.to_le_bytes()[..], &[0], &first, &[5; 64]].concat())
    };
    let to_client = [
        step(0, 0, 1, &ticks),
        step(1, 0, 1, &5000u64.to_le_bytes()),
        step(0, 2, 1, &ticks),
        step(0, 3, 1, &ticks),
        block(0),
        block(1),
        block(4),
        step(1, 0, 1, &9000u64.to_le_bytes()),
    ];
    let to_sensor = [
        step(4, 0x3f, 1, &[]),
        step(2, 0x3f, 1, &[1, 64, 0, 10]),
        step(0, 0x3f, 1, &[]),
        step(3, 0x3f, 1, &[7; 8]),
        step(5, 0x3f, 1, &[]),
        step(5, 0, 20, &[1, 2, 0]),
        step(1, 0x3f, 1, &[]),
    ];
    vec![("sensor_client", "stream", to_client.concat()), ("sensor_device", "stream", to_sensor.concat())]
}
