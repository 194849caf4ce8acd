//! The sensor's side against a board of software.

use super::*;
use crate::sensor::wire::MAX_PACKET;

struct Board {
    now: u64,
    /// The next sample's number since the start of sampling.
    next: u64,
    started: Option<u64>,
    to_sensor: Vec<u8>,
    room: usize,
    line: Vec<u8>,
}

const PERIOD: u64 = 10;

struct BoardAdc<'a>(&'a mut Board);
struct BoardUart<'a>(&'a mut Vec<u8>, &'a mut Vec<u8>, usize);
struct BoardClock(u64);

impl Adc for BoardAdc<'_> {
    fn start(&mut self, _: u8, samples_per_second: u32) -> Option<u32> {
        self.0.started = Some(self.0.now);
        self.0.next = 0;
        (samples_per_second == 100_000).then_some(PERIOD as u32 * PERIOD_ONE)
    }
    fn stop(&mut self) {
        self.0.started = None;
    }
    fn take(&mut self, into: &mut [u16]) -> (usize, u64) {
        let Some(started) = self.0.started else { return (0, 0) };
        let first = started + self.0.next * PERIOD;
        let due = (self.0.now - started) / PERIOD;
        let n = (due.saturating_sub(self.0.next) as usize).min(into.len());
        into[..n].iter_mut().zip(self.0.next..).for_each(|(to, k)| *to = (k % 4096) as u16);
        self.0.next += n as u64;
        (n, first)
    }
}

impl Uart for BoardUart<'_> {
    fn read(&mut self, into: &mut [u8]) -> usize {
        let n = self.0.len().min(into.len());
        into[..n].copy_from_slice(&self.0[..n]);
        self.0.drain(..n);
        n
    }
    fn write(&mut self, bytes: &[u8]) -> usize {
        let n = bytes.len().min(self.2);
        self.1.extend(&bytes[..n]);
        n
    }
}

impl Clock for BoardClock {
    fn ticks(&mut self) -> u64 {
        self.0
    }
}

const IDENTITY: SensorIdentity = SensorIdentity {
    serial: 7,
    name: [0; NAME_BYTES],
    bits: LevelBits::Twelve,
    ticks_per_second: 1_000_000,
    samples_per_second: 100_000,
    floor: 0,
    ceiling: 4095,
    gains_milli: [1000, 8000, 0, 0, 0, 0, 0, 0],
};

struct Bench {
    sensor: Sensor<2048>,
    board: Board,
    heard: Deframer<[u8; MAX_PACKET]>,
}

impl Bench {
    fn new() -> Self {
        let board = Board { now: 500, next: 0, started: None, to_sensor: vec![], room: 4096, line: vec![] };
        Self { sensor: Sensor::new(IDENTITY), board, heard: Deframer::new([0; MAX_PACKET]) }
    }

    fn say(&mut self, message: SensorMessage<'_>) {
        let mut frame = [0; MAX_FRAME];
        let n = message.encode(&mut frame).expect("room");
        self.board.to_sensor.extend(&frame[..n]);
    }

    /// Steps for `us`, and gives what the line carried: what is no block, and the blocks with their levels.
    fn run(&mut self, us: u64) -> (Vec<String>, Vec<(BlockHead, Vec<u16>)>) {
        let end = self.board.now + us;
        while self.board.now < end {
            self.board.now += 100;
            let (mut input, mut line) =
                (std::mem::take(&mut self.board.to_sensor), std::mem::take(&mut self.board.line));
            let (now, room) = (self.board.now, self.board.room);
            let mut uart = BoardUart(&mut input, &mut line, room);
            self.sensor.step(&mut BoardAdc(&mut self.board), &mut uart, &mut BoardClock(now));
            (self.board.to_sensor, self.board.line) = (input, line);
        }
        let (mut words, mut blocks) = (Vec::new(), Vec::new());
        let line = std::mem::take(&mut self.board.line);
        self.heard.push(&line, &mut |packet| match SensorMessage::decode(packet).expect("intact") {
            SensorMessage::Samples(head, levels) => blocks.push((head, levels.iter().collect())),
            SensorMessage::Hello(h) => words.push(format!("hello {} {}", h.running, h.gain)),
            other => words.push(format!("{other:?}")),
        });
        (words, blocks)
    }
}

#[test]
fn orders_are_answered_and_wrong_ones_refused() {
    let mut b = Bench::new();
    assert_eq!(b.run(100).0, ["hello false 0"]);
    let configure =
        |gain, block, samples_per_second| SensorMessage::Configure { gain, block, samples_per_second };
    for (order, answer) in [
        (configure(2, 100, 0), "Refused(Gain)"),
        (configure(9, 100, 0), "Refused(Gain)"),
        (configure(1, 0, 0), "Refused(Block)"),
        (configure(1, 257, 0), "Refused(Block)"),
        (configure(1, 100, 99), "Refused(Rate)"),
        (configure(1, 100, 100_000), "hello false 1"),
        (SensorMessage::Start, "hello true 1"),
        (configure(0, 100, 0), "Refused(Running)"),
        (SensorMessage::Start, "hello true 1"),
        (SensorMessage::Stop, "hello false 1"),
        (SensorMessage::HelloRequest, "hello false 1"),
    ] {
        b.say(order);
        assert_eq!(b.run(100).0, [answer]);
    }
    b.say(SensorMessage::EchoRequest { token: 9 });
    let now = b.board.now + 100;
    assert_eq!(b.run(100).0, [format!("EchoResponse {{ token: 9, ticks: {now} }}")]);
}

#[test]
fn samples_come_in_order_with_the_time_of_the_first() {
    let mut b = Bench::new();
    b.say(SensorMessage::Configure { gain: 0, block: 100, samples_per_second: 0 });
    b.say(SensorMessage::Start);
    b.run(100);
    let started = b.board.started.expect("it samples");
    let (_, blocks) = b.run(100_000);
    assert!((98..=100).contains(&blocks.len()), "{}", blocks.len());
    for (k, (head, levels)) in blocks.iter().enumerate() {
        assert_eq!((head.sequence, head.first), (k as u32, started + 1000 * k as u64));
        let from = 100 * k as u64;
        assert!(levels.iter().zip(from..).all(|(level, n)| u64::from(*level) == n % 4096), "block {k}");
        let has = |level: u64| (from..from + 100).any(|n| n % 4096 == level);
        assert_eq!((head.cut_below, head.cut_above), (has(0), has(4095)));
    }
}

#[test]
fn a_line_that_is_full_costs_whole_blocks_that_are_counted() {
    let mut b = Bench::new();
    b.say(SensorMessage::Start);
    b.run(100);
    b.board.room = 0;
    b.run(50_000);
    let lost = b.sensor.lost();
    assert!(lost > 20, "{lost}");
    b.board.room = 4096;
    let (_, blocks) = b.run(20_000);
    let last = blocks.last().expect("it goes on").0;
    assert_eq!(
        (last.lost, blocks.len() as u32),
        (lost, last.sequence + 1 - lost),
        "every block is sent or counted"
    );
    let gap =
        blocks.windows(2).map(|w| w[1].0.sequence - w[0].0.sequence - 1).sum::<u32>() + blocks[0].0.sequence;
    assert_eq!(gap, lost);
}

#[test]
fn a_gap_in_the_samples_begins_a_new_block() {
    let mut b = Bench::new();
    b.say(SensorMessage::Start);
    b.run(100);
    b.board.started = None;
    b.run(0);
    b.sensor.on_samples(&[1, 2, 3], 1_000_000);
    b.sensor.on_samples(&[4], 1_000_030);
    b.sensor.on_samples(&[5, 6], 1_000_500);
    b.sensor.on_samples(&[7; 126], 1_000_520);
    let (_, blocks) = b.run(100);
    let tail: Vec<_> =
        blocks.iter().rev().take(2).rev().map(|(head, levels)| (head.first, levels.len())).collect();
    assert_eq!(tail, [(1_000_000, 4), (1_000_500, 128)]);
}

#[test]
fn a_sensor_whose_host_is_gone_falls_silent_and_noise_is_survived() {
    let mut b = Bench::new();
    b.say(SensorMessage::Start);
    b.run(4_900_000);
    assert!(b.sensor.is_running());
    b.board.to_sensor.extend((0..5000u32).map(|k| (k * k % 251) as u8));
    b.run(200_000);
    assert!(!b.sensor.is_running() && b.board.started.is_none());
    b.board.to_sensor.push(0);
    b.say(SensorMessage::Start);
    assert!(b.run(100).0.contains(&"hello true 0".to_owned()));
}
