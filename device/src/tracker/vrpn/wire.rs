//! Encodes and decodes VRPN messages. All numbers are big-endian; payloads are padded to multiples of 8 bytes.

use crate::pose::Pose;

/// Bytes of the greeting.
pub const COOKIE_BYTES: usize = 24;
/// The greeting of this implementation: version 07.38, no logging.
pub const COOKIE: [u8; COOKIE_BYTES] = *b"vrpn: ver. 07.38  0\0\0\0\0\0";
/// Bytes in front of each payload.
pub const HEADER_BYTES: usize = 24;
/// Largest payload accepted. Tracker messages have 64 bytes; a larger one comes from something that is not a tracker.
pub const MAX_PAYLOAD: usize = 8192;
/// Conventional port, UDP and TCP.
pub const PORT: u16 = 3883;

/// Numbers of the system messages.
pub mod system {
    /// Describes a sender: the number is in the sender field.
    pub const SENDER: i32 = -1;
    /// Describes a type: the number is in the sender field.
    pub const TYPE: i32 = -2;
    /// Announces a UDP port.
    pub const UDP: i32 = -3;
    /// Asks for a log.
    pub const LOG: i32 = -4;
    /// Ends the connection.
    pub const DISCONNECT: i32 = -5;
}

/// Names of the types used here.
pub mod type_name {
    /// A pose.
    pub const POS_QUAT: &str = "vrpn_Tracker Pos_Quat";
    /// Ping.
    pub const PING: &str = "vrpn_Base ping_message";
    /// The answer to a ping.
    pub const PONG: &str = "vrpn_Base pong_message";
}

/// Errors of decoding.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum VrpnError {
    /// The greeting is not one of VRPN.
    #[error("the other side does not greet as VRPN does: {0:?}")]
    NotVrpn(String),
    /// Another major version.
    #[error("the other side speaks VRPN {0}, this one 07")]
    Version(String),
    /// A length below the header's or above [`MAX_PAYLOAD`].
    #[error("a message claims {0} bytes; 24 to 8,216 are possible")]
    Length(u32),
    /// A known message with a payload of another size.
    #[error("{what}: {got} bytes of payload, {expected} expected")]
    Payload {
        /// Which message.
        what: &'static str,
        /// Its size.
        got: usize,
        /// The size it must have at least.
        expected: usize,
    },
}

/// Checks a greeting: the major version must agree, the minor may differ.
pub fn check_cookie(bytes: &[u8; COOKIE_BYTES]) -> Result<(), VrpnError> {
    if !bytes.starts_with(b"vrpn: ver. ") {
        return Err(VrpnError::NotVrpn(String::from_utf8_lossy(bytes).into_owned()));
    }
    if &bytes[11..13] != b"07" {
        return Err(VrpnError::Version(String::from_utf8_lossy(&bytes[11..16]).into_owned()));
    }
    Ok(())
}

/// A message; the payload is without its padding.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Message<'a> {
    /// Seconds of the sender's clock.
    pub seconds: u32,
    /// Microseconds, 0 to 999,999 in valid messages.
    pub microseconds: u32,
    /// Number of the sending device; for descriptions, the number described.
    pub sender: i32,
    /// Number of the type; negative for system messages.
    pub kind: i32,
    /// Sequence number on this connection.
    pub sequence: u32,
    /// Content.
    pub payload: &'a [u8],
}

impl Message<'_> {
    /// The stamp in microseconds.
    pub fn stamp_us(&self) -> u64 {
        u64::from(self.seconds) * 1_000_000 + u64::from(self.microseconds)
    }
}

fn be32(bytes: &[u8], at: usize) -> u32 {
    u32::from_be_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]])
}

/// Splits the first message off `bytes`: returns the message and the bytes it takes, or `None` if it is incomplete.
pub fn split(bytes: &[u8]) -> Result<Option<(Message<'_>, usize)>, VrpnError> {
    if bytes.len() < 4 {
        return Ok(None);
    }
    let length = be32(bytes, 0);
    let size = length as usize;
    if !(HEADER_BYTES..=HEADER_BYTES + MAX_PAYLOAD).contains(&size) {
        return Err(VrpnError::Length(length));
    }
    let padded = size.next_multiple_of(8);
    if bytes.len() < padded {
        return Ok(None);
    }
    let message = Message {
        seconds: be32(bytes, 4),
        microseconds: be32(bytes, 8),
        sender: be32(bytes, 12) as i32,
        kind: be32(bytes, 16) as i32,
        sequence: be32(bytes, 20),
        payload: &bytes[HEADER_BYTES..size],
    };
    Ok(Some((message, padded)))
}

/// Appends `message` to `out`, padded.
pub fn put(out: &mut Vec<u8>, message: &Message<'_>) {
    let start = out.len();
    let length = (HEADER_BYTES + message.payload.len()) as u32;
    for word in [
        length,
        message.seconds,
        message.microseconds,
        message.sender as u32,
        message.kind as u32,
        message.sequence,
    ] {
        out.extend_from_slice(&word.to_be_bytes());
    }
    out.extend_from_slice(message.payload);
    out.resize(start + (out.len() - start).next_multiple_of(8), 0);
}

/// Appends the description of sender (`kind` [`system::SENDER`]) or type ([`system::TYPE`]) number `number`.
pub fn put_description(out: &mut Vec<u8>, kind: i32, number: i32, name: &str) {
    let name = &name.as_bytes()[..name.len().min(99)];
    let mut payload = Vec::with_capacity(name.len() + 5);
    payload.extend_from_slice(&(name.len() as u32 + 1).to_be_bytes());
    payload.extend_from_slice(name);
    payload.push(0);
    let message =
        Message { seconds: 0, microseconds: 0, sender: number, kind, sequence: 0, payload: &payload };
    put(out, &message);
}

/// The name in a description's payload.
pub fn described_name(payload: &[u8]) -> Result<&[u8], VrpnError> {
    let short = VrpnError::Payload { what: "description", got: payload.len(), expected: 5 };
    let announced = payload.get(..4).map(|b| be32(b, 0) as usize).ok_or(short.clone())?;
    let name = &payload[4..];
    // Some senders announce the length without the zero, some pad: the zero ends the name, wherever it is.
    let end = name.iter().position(|b| *b == 0).unwrap_or(name.len());
    if end == 0 || announced > payload.len() {
        return Err(short);
    }
    Ok(&name[..end])
}

/// Bytes of a pose's payload.
pub const POS_QUAT_BYTES: usize = 64;

/// Sensor and pose of a `Pos_Quat` payload.
pub fn decode_pos_quat(payload: &[u8]) -> Result<(i32, Pose), VrpnError> {
    if payload.len() != POS_QUAT_BYTES {
        return Err(VrpnError::Payload { what: "Pos_Quat", got: payload.len(), expected: POS_QUAT_BYTES });
    }
    let number = |i: usize| {
        let at = 8 + 8 * i;
        let mut b = [0; 8];
        b.copy_from_slice(&payload[at..at + 8]);
        f64::from_be_bytes(b)
    };
    let pose = Pose {
        position_m: [number(0), number(1), number(2)],
        rotation_xyzw: [number(3), number(4), number(5), number(6)],
    };
    Ok((be32(payload, 0) as i32, pose))
}

/// The payload of a pose.
pub fn encode_pos_quat(sensor: i32, pose: &Pose) -> [u8; POS_QUAT_BYTES] {
    let mut out = [0; POS_QUAT_BYTES];
    out[..4].copy_from_slice(&sensor.to_be_bytes());
    for (i, value) in pose.position_m.iter().chain(&pose.rotation_xyzw).enumerate() {
        out[8 + 8 * i..16 + 8 * i].copy_from_slice(&value.to_be_bytes());
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn hex(text: &str) -> Vec<u8> {
        let digits: Vec<u8> = text.bytes().filter(|b| !b.is_ascii_whitespace()).collect();
        digits.chunks(2).map(|d| u8::from_str_radix(std::str::from_utf8(d).unwrap(), 16).unwrap()).collect()
    }

    #[test]
    fn a_pose_message_byte_for_byte() {
        // Length 88, 1.000002 s, sender 3, type 5, sequence 9; sensor 2 at (1, 2, -1), half a turn about z.
        let bytes = hex("00000058 00000001 00000002 00000003 00000005 00000009
             00000002 00000000
             3ff0000000000000 4000000000000000 bff0000000000000
             0000000000000000 0000000000000000 3ff0000000000000 0000000000000000");
        let pose = Pose { position_m: [1.0, 2.0, -1.0], rotation_xyzw: [0.0, 0.0, 1.0, 0.0] };
        let (message, used) = split(&bytes).unwrap().unwrap();
        assert_eq!((message.sender, message.kind, message.sequence, used), (3, 5, 9, 88));
        assert_eq!(message.stamp_us(), 1_000_002);
        assert_eq!(decode_pos_quat(message.payload).unwrap(), (2, pose));
        let mut out = Vec::new();
        put(&mut out, &Message { payload: &encode_pos_quat(2, &pose), ..message });
        assert_eq!(out, bytes);
    }

    #[test]
    fn descriptions_and_padding_byte_for_byte() {
        let mut out = Vec::new();
        put_description(&mut out, system::SENDER, 1, "Hare");
        // 24 + 4 + 5 = 33 bytes, padded to 40.
        let bytes = hex("00000021 00000000 00000000 00000001 ffffffff 00000000
             00000005 48617265 00 00000000000000");
        assert_eq!(out, bytes);
        let (message, used) = split(&bytes).unwrap().unwrap();
        assert_eq!((message.kind, message.sender, used), (system::SENDER, 1, 40));
        assert_eq!(described_name(message.payload), Ok(&b"Hare"[..]));
        put_description(&mut out, system::TYPE, 0, type_name::PING);
        let (message, _) = split(&out[40..]).unwrap().unwrap();
        assert_eq!(described_name(message.payload), Ok(type_name::PING.as_bytes()));
    }

    #[test]
    fn greetings() {
        assert_eq!(COOKIE.to_vec(), hex("7672706e3a207665722e2030372e3338 202030 0000000000"));
        assert_eq!(check_cookie(&COOKIE), Ok(()));
        assert_eq!(check_cookie(b"vrpn: ver. 07.33  0\0\0\0\0\0"), Ok(()));
        assert!(matches!(check_cookie(b"vrpn: ver. 06.00  0\0\0\0\0\0"), Err(VrpnError::Version(_))));
        assert!(matches!(check_cookie(b"HTTP/1.1 400 Bad Request"), Err(VrpnError::NotVrpn(_))));
    }

    #[test]
    fn lies_about_length_are_refused_at_once() {
        assert_eq!(split(&hex("ffffffff")), Err(VrpnError::Length(u32::MAX)));
        assert_eq!(split(&hex("00000017 00")), Err(VrpnError::Length(23)));
        assert_eq!(split(&hex("00002019 00")), Err(VrpnError::Length(8217)));
        assert_eq!(split(&hex("000000")), Ok(None));
        assert_eq!(split(&hex("00000018 00000000")), Ok(None));
        assert!(decode_pos_quat(&[0; 63]).is_err() && decode_pos_quat(&[0; 65]).is_err());
        assert!(described_name(&[]).is_err() && described_name(&[0, 0, 0, 1, 0]).is_err());
        assert!(described_name(&hex("ffffffff 4100")).is_err());
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 1000, failure_persistence: None, ..ProptestConfig::default() })]

        #[test]
        fn any_bytes_are_survived(bytes in proptest::collection::vec(any::<u8>(), 0..300)) {
            if let Ok(Some((message, used))) = split(&bytes) {
                prop_assert!(used <= bytes.len() && message.payload.len() <= used);
                let _ = decode_pos_quat(message.payload);
                let _ = described_name(message.payload);
            }
        }

        #[test]
        fn messages_survive_the_way(
            words in any::<[u32; 5]>(),
            payload in proptest::collection::vec(any::<u8>(), 0..100),
        ) {
            let message = Message {
                seconds: words[0],
                microseconds: words[1],
                sender: words[2] as i32,
                kind: words[3] as i32,
                sequence: words[4],
                payload: &payload,
            };
            let mut out = Vec::new();
            put(&mut out, &message);
            prop_assert_eq!(out.len() % 8, 0);
            let length = out.len();
            for cut in 0..length {
                prop_assert_eq!(split(&out[..cut]), Ok(None));
            }
            prop_assert_eq!(split(&out), Ok(Some((message, length))));
        }
    }
}
