//! Lives in which one guard of the light stands alone.
//!
//! A guard behind which another one stands can be broken without any wrong light. Here the others are switched off by
//! what is simulated around the program, and only that strikes which the remaining guard has to answer.

use crate::dice::Dice;
use crate::kinds::Kind;
use dpm_device::link::{Header, HostMessage, MessageType, Packet, HEADER_BYTES, MAX_CONTROL_BYTES};
use dpm_device::time::DeviceTicks;

/// A guard of the light.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Guard {
    /// The projector's watchdog: who falls silent is dark. Frames are said to end ten seconds later than they do, and a
    /// neighbour disturbs the cable with damaged packets while the program is silent.
    Watchdog,
    /// `dark from` of each frame. The watchdog bites after ten seconds only.
    DarkFrom,
    /// The limit to the age of poses where light leaves the host. Frames are said to end ten seconds later than they do.
    Age,
    /// BLACK, SAFE and STOP, and the file that keeps the first two. Neither the watchdog nor `dark from` is there in
    /// time, and the projector loses its memory when the program ends.
    Orders,
    /// The number of the session. Neither the watchdog nor `dark from` is there in time.
    Session,
    /// The map of the projector's clock, which is no guard but what all instants go by. The link is served late.
    Clock,
    /// The interlock, in half of the lives reset by hand. What it makes dark nothing else does.
    Interlock,
    /// A person's word for every start (`safety.start`), and what OSC may do. The projector loses its memory when the
    /// program ends.
    Hand,
    /// The limit to the mean of the light.
    Limits,
    /// What is done until the projector confirms an order to go dark. The cable loses such orders, and carries the rest.
    Unconfirmed,
    /// What the projector latches, until somebody acknowledges it. A neighbour sends it an ARM that acknowledges nothing.
    Latch,
    /// The eye guard. A person with glasses stands in the beam, and what the tracker reports of them is wrong or missing.
    Eyes,
}

/// The share of lives in which a guard stands alone.
const ALONE: f64 = 0.6;
/// A guard that is switched off acts after this time.
const LATE_NS: i64 = 10_000_000_000;
/// The longest by which the link is served late, nanoseconds; where slots are short, two fifths of one.
const LINK_LATE_NS: i64 = 5_000_000;

impl Guard {
    /// All guards.
    pub const ALL: [Self; 12] = [
        Self::Watchdog,
        Self::DarkFrom,
        Self::Age,
        Self::Orders,
        Self::Session,
        Self::Clock,
        Self::Interlock,
        Self::Hand,
        Self::Limits,
        Self::Unconfirmed,
        Self::Latch,
        Self::Eyes,
    ];

    /// As given on the command line.
    pub fn word(self) -> &'static str {
        [
            "watchdog",
            "dark-from",
            "age",
            "orders",
            "session",
            "clock",
            "interlock",
            "by-hand",
            "limits",
            "unconfirmed",
            "latch",
            "eyes",
        ][self as usize]
    }

    /// The guard that stands alone in the life of `seed`, if any.
    pub fn drawn(seed: u64) -> Option<Self> {
        let mut dice = Dice::new(seed, 0xa10e);
        dice.happens(ALONE).then(|| dice.one_of(&Self::ALL))
    }

    /// What this guard has to answer.
    pub fn kinds(self) -> &'static [Kind] {
        use Kind as K;
        match self {
            Self::Watchdog => &[K::U15, K::H2, K::X3, K::X4, K::X6],
            Self::DarkFrom => &[K::U15, K::X6, K::T2, K::G5, K::G6, K::H4, K::H5],
            Self::Age => &[K::G6, K::G7, K::H4, K::H8, K::H9, K::T2, K::X6],
            Self::Orders => &[K::X3, K::H2, K::X5, K::H6, K::X4, K::U15, K::X20, K::X21],
            Self::Session => &[K::U15, K::X4, K::H2],
            Self::Clock => &[K::H4, K::H8, K::H9, K::X6, K::U1, K::U8, K::U8, K::U15, K::T2],
            Self::Interlock => &[K::X19, K::X19, K::X19, K::U15, K::X4, K::X5, K::X21],
            Self::Hand => &[K::U15, K::X4, K::H5, K::H7, K::X3, K::X5, K::X20, K::X21],
            Self::Limits => &[K::X24, K::X24, K::X24, K::T2, K::U15, K::X4, K::X5, K::G7],
            Self::Unconfirmed => &[K::X22, K::X22, K::X22, K::U15, K::X4, K::T2],
            Self::Latch => &[K::X23, K::X23, K::X3, K::U12, K::X4],
            Self::Eyes => &[
                K::X25,
                K::X25,
                K::X26,
                K::X26,
                K::T1,
                K::T2,
                K::T3,
                K::T6,
                K::T7,
                K::G6,
                K::H4,
                K::U15,
                K::X6,
            ],
        }
    }

    /// `dark from` is told this much later than the host means, nanoseconds.
    pub fn stretches_ns(self) -> i64 {
        match self {
            Self::Watchdog | Self::Age | Self::Orders | Self::Session => LATE_NS,
            _ => 0,
        }
    }

    /// `safety.watchdog_ms`, where it is not the usual one.
    pub fn watchdog_ms(self) -> Option<i64> {
        matches!(self, Self::DarkFrom | Self::Orders | Self::Session).then_some(LATE_NS / 1_000_000)
    }

    /// What the rig file says of `[safety]` besides, for pictures of so many `planes`.
    pub fn keys(self, planes: u32) -> String {
        match self {
            Self::Hand => "start = \"by hand\"\n".into(),
            Self::Limits => {
                // Three quarters of the mean level of the pictures: the light rests again and again.
                let level = if planes > 8 { 0.05 } else { 0.02 };
                format!("limits = {{ mean_level = {level}, mean_window_s = 0.6 }}\n")
            }
            Self::Eyes => {
                let person = "[observer]\ntracked = { name = \"glasses\", id = 2 }\n";
                format!("eyes = {{ radius = {} }}\n{person}", crate::eyes::RADIUS_M)
            }
            _ => String::new(),
        }
    }

    /// The projector has forgotten everything when the program has ended.
    pub fn forgets(self) -> bool {
        matches!(self, Self::Orders | Self::Hand)
    }

    /// How much later than usual the link is served where a slot takes `slot_ns`.
    pub fn link_late_ns(self, slot_ns: i64) -> i64 {
        if self == Self::Clock {
            LINK_LATE_NS.min(slot_ns * 2 / 5)
        } else {
            0
        }
    }
}

/// The bytes of `packet` with light that ends `stretch` ticks later, if it says when light ends.
pub fn stretched(packet: &Packet<'_>, stretch: u64) -> Option<Vec<u8>> {
    let header = Header::decode(packet.header()).ok()?;
    let Ok(HostMessage::Commit(mut commit)) = HostMessage::parse(header.kind, packet.payload()) else {
        return None;
    };
    commit.dark_from = DeviceTicks(commit.dark_from.0.saturating_add(stretch));
    let mut payload = [0; MAX_CONTROL_BYTES];
    let (_, n) = HostMessage::Commit(commit).write(&mut payload);
    Some(Packet::new(header, &payload[..n]).to_vec())
}

/// The first packet of `bytes`, if it has a payload.
pub fn first_packet(bytes: &[u8]) -> Option<&[u8]> {
    let header = Header::decode(bytes.first_chunk::<HEADER_BYTES>()?).ok()?;
    let whole = dpm_device::link::packet_bytes(header.payload_bytes as usize);
    bytes.get(..whole).filter(|_| header.payload_bytes > 0)
}

/// The session of the first packet of `bytes`.
pub fn session(bytes: &[u8]) -> Option<u32> {
    Header::decode(bytes.first_chunk::<HEADER_BYTES>()?).ok().map(|header| header.session)
}

/// `packet` is an order to go dark.
pub fn darkens(packet: &Packet<'_>) -> bool {
    matches!(kind(packet), Some(MessageType::Black | MessageType::Safe | MessageType::Stop))
}

/// `packet` is FREEZE.
pub fn freezes(packet: &Packet<'_>) -> bool {
    kind(packet) == Some(MessageType::Freeze)
}

fn kind(packet: &Packet<'_>) -> Option<MessageType> {
    Header::decode(packet.header()).ok().map(|header| header.kind)
}

/// An ARM in `session` that acknowledges nothing.
pub fn bare_arm(session: u32) -> Vec<u8> {
    let mut payload = [0; MAX_CONTROL_BYTES];
    let (kind, n) = HostMessage::Arm(0).write(&mut payload);
    Packet::new(Header::control(kind, session, 0), &payload[..n]).to_vec()
}

/// Word of another host that its session goes on.
pub fn word_of_another_host(session: u32) -> Vec<u8> {
    let mut payload = [0; MAX_CONTROL_BYTES];
    let (kind, n) = HostMessage::Sync(0).write(&mut payload);
    Packet::new(Header::control(kind, !session, 0), &payload[..n]).to_vec()
}

/// `packet`, whole, as another host would send it.
pub fn of_another_host(packet: &[u8]) -> Option<Vec<u8>> {
    let header = Header::decode(packet.first_chunk::<HEADER_BYTES>()?).ok()?;
    let payload = packet.get(HEADER_BYTES..HEADER_BYTES + header.payload_bytes as usize)?;
    Some(Packet::new(Header { session: !header.session, ..header }, payload).to_vec())
}

/// Damages the payload of `packet`.
pub fn damage(packet: &mut [u8], dice: &mut Dice) {
    let at = HEADER_BYTES + dice.bits() as usize % (packet.len() - HEADER_BYTES).max(1);
    if let Some(byte) = packet.get_mut(at) {
        *byte ^= 1 << (dice.bits() % 8);
    }
}
