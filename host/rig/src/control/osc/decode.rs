//! Datagrams of OSC 1.0 into what a rig may be asked for: parameters, and the orders BLACK, FREEZE and SAFE, with the
//! token that the sender gives. There is no way to say ARM.
//!
//! The token is a text among the arguments, `/dpm/exposure 1.5 TOKEN`, or stands in the address for senders that have
//! numbers only: `/dpm/token/TOKEN/exposure 1.5`. It occurs in no fault that is named.
//!
//! Format: opensoundcontrol.org, "OSC 1.0 specification" (Wright, 2002). Everything is aligned to four bytes and big
//! endian. A time tag is read and ignored: what comes is meant for now.

use crate::config::MOST_OSC_TOKEN;
use crate::order::Order;
use std::fmt;

/// Bundles inside each other.
const DEEPEST: usize = 4;
/// Most numbers of a message that are read.
pub const MOST_NUMBERS: usize = 16;
/// First part of every address, and of one with a token.
const PREFIX: &str = "/dpm/";
const TOKEN: &str = "token/";

/// What a message asks for.
#[derive(Clone, Debug, PartialEq)]
pub enum OscRequest {
    /// An order that takes light away or holds it: never ARM.
    Order(Order),
    /// A parameter by its name, with its numbers.
    Set {
        /// Its name.
        name: String,
        /// Its numbers.
        numbers: Vec<f64>,
    },
    /// A button that was released.
    Nothing,
}

/// A message, with the token that its sender gave.
#[derive(Clone, PartialEq)]
pub struct Said {
    /// What it asks for.
    pub heard: OscRequest,
    /// The token, right or wrong.
    pub token: Option<String>,
}

impl fmt::Debug for Said {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let token = self.token.as_ref().map(|_| "secret");
        f.debug_struct("Said").field("heard", &self.heard).field("token", &token).finish()
    }
}

/// Why a datagram, or a message of it, means nothing.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum Wrong {
    /// It is no OSC.
    #[error("no OSC 1.0: {0}")]
    Form(&'static str),
    /// The address begins with another word.
    #[error("address {0:?}: those of this program begin with /dpm/")]
    Address(String),
    /// ARM was asked for.
    #[error("ARM is never taken over OSC; use `dpm arm`, the page or a key")]
    Arm,
    /// An argument is neither a number nor a token.
    #[error("address {0:?}: an argument is neither a number nor a token")]
    NoNumber(String),
}

/// Reads a datagram, and calls `hear` for each of its messages, in their order. What comes before a fault counts.
///
/// # Errors
/// The datagram is no OSC.
pub fn decode(bytes: &[u8], hear: &mut dyn FnMut(Result<Said, Wrong>)) -> Result<(), Wrong> {
    packet(bytes, 0, hear)
}

fn packet(bytes: &[u8], depth: usize, hear: &mut dyn FnMut(Result<Said, Wrong>)) -> Result<(), Wrong> {
    let Some(mut rest) = bytes.strip_prefix(b"#bundle\0") else {
        hear(message(bytes)?);
        return Ok(());
    };
    if depth >= DEEPEST {
        return Err(Wrong::Form("bundles are nested too deeply"));
    }
    rest = rest.get(8..).ok_or(Wrong::Form("a bundle ends in its time tag"))?;
    while !rest.is_empty() {
        let (length, after) =
            rest.split_first_chunk::<4>().ok_or(Wrong::Form("a bundle ends in the length of an element"))?;
        let length = u32::from_be_bytes(*length) as usize;
        if !length.is_multiple_of(4) || length > after.len() {
            return Err(Wrong::Form("an element is longer than its bundle, or is not aligned"));
        }
        let (element, after) = after.split_at(length);
        packet(element, depth + 1, hear)?;
        rest = after;
    }
    Ok(())
}

/// A text that ends with zero bytes up to a multiple of four, and what follows it.
fn text(bytes: &[u8]) -> Result<(&str, &[u8]), Wrong> {
    let end = bytes.iter().position(|b| *b == 0).ok_or(Wrong::Form("a text has no end"))?;
    let after = bytes.get((end / 4 + 1) * 4..).ok_or(Wrong::Form("a text is not aligned"))?;
    let text = std::str::from_utf8(&bytes[..end]).map_err(|_| Wrong::Form("a text is no UTF-8"))?;
    Ok((text, after))
}

/// One message. The outer error: it is no OSC; the inner one: it is none of this program's.
fn message(bytes: &[u8]) -> Result<Result<Said, Wrong>, Wrong> {
    let (address, rest) = text(bytes)?;
    if !address.starts_with('/') {
        return Err(Wrong::Form("an address does not begin with a slash"));
    }
    // Old senders leave the tags out if there are no arguments.
    let (tags, arguments) = if rest.is_empty() { (",", rest) } else { text(rest)? };
    let tags = tags.strip_prefix(',').ok_or(Wrong::Form("the type tags do not begin with a comma"))?;
    let (numbers, token) = arguments_of(tags, arguments)?;
    Ok(meaning(address, numbers, token))
}

/// The numbers of a message, `None` if an argument is none, and the one text that may be among them.
fn arguments_of<'a>(tags: &str, mut rest: &'a [u8]) -> Result<(Option<Vec<f64>>, Option<&'a str>), Wrong> {
    let short = Wrong::Form("an argument is cut off");
    let (mut all, mut is_sound, mut token) = (Vec::new(), true, None);
    for tag in tags.bytes() {
        let number = match tag {
            b'i' | b'f' => {
                let (word, after) = rest.split_first_chunk::<4>().ok_or(short.clone())?;
                rest = after;
                Some(if tag == b'i' { f64::from(i32::from_be_bytes(*word)) } else { of_float(*word) })
            }
            b'h' | b'd' => {
                let (word, after) = rest.split_first_chunk::<8>().ok_or(short.clone())?;
                rest = after;
                Some(if tag == b'h' { i64::from_be_bytes(*word) as f64 } else { f64::from_be_bytes(*word) })
            }
            b'T' => Some(1.0),
            b'F' => Some(0.0),
            b's' | b'S' => {
                let (told, after) = text(rest)?;
                rest = after;
                if token.is_none() && told.len() <= MOST_OSC_TOKEN {
                    token = Some(told);
                    continue;
                }
                None
            }
            _ => return Err(Wrong::Form("an argument is of a type that is not read")),
        };
        is_sound &= number.is_some() && all.len() < MOST_NUMBERS;
        if is_sound {
            all.extend(number);
        }
    }
    Ok((is_sound.then_some(all), token))
}

/// A single as the shortest decimal that it stands for: a slider at 1.1 means 1.1.
fn of_float(word: [u8; 4]) -> f64 {
    let single = f32::from_be_bytes(word);
    single.to_string().parse().unwrap_or(f64::from(single))
}

fn meaning(address: &str, numbers: Option<Vec<f64>>, token: Option<&str>) -> Result<Said, Wrong> {
    let short = |address: &str| address.chars().take(80).collect::<String>();
    let name = address.strip_prefix(PREFIX).ok_or_else(|| Wrong::Address(short(address)))?;
    let with_token = name.strip_prefix(TOKEN).and_then(|rest| rest.split_once('/'));
    let (token, name) = with_token.map_or((token, name), |(token, name)| (Some(token), name));
    let token = token.map(str::to_owned);
    let order = match name {
        "black" => Some(Order::Black),
        "freeze" => Some(Order::Freeze),
        "safe" => Some(Order::Safe),
        "arm" | "resume" => return Err(Wrong::Arm),
        _ => None,
    };
    if let Some(order) = order {
        // A button sends 0 when it is released. An order with arguments that are no numbers is still an order.
        let is_released = numbers.is_some_and(|all| all.first() == Some(&0.0));
        let heard = if is_released { OscRequest::Nothing } else { OscRequest::Order(order) };
        return Ok(Said { heard, token });
    }
    let numbers = numbers.ok_or_else(|| Wrong::NoNumber(short(name)))?;
    // The address /dpm/body/hare is the parameter body.hare.
    Ok(Said { heard: OscRequest::Set { name: name.replacen('/', ".", 1), numbers }, token })
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn padded(text: &str) -> Vec<u8> {
        let mut bytes = text.as_bytes().to_vec();
        bytes.resize((bytes.len() / 4 + 1) * 4, 0);
        bytes
    }

    fn sent(address: &str, tags: &str, arguments: &[u8]) -> Vec<u8> {
        [padded(address), padded(tags), arguments.to_vec()].concat()
    }

    fn bundle(elements: &[Vec<u8>]) -> Vec<u8> {
        let mut bytes = b"#bundle\0\0\0\0\0\0\0\0\x01".to_vec();
        for element in elements {
            bytes.extend((element.len() as u32).to_be_bytes());
            bytes.extend(element);
        }
        bytes
    }

    fn heard(bytes: &[u8]) -> (Vec<Result<OscRequest, Wrong>>, Result<(), Wrong>) {
        let mut all = Vec::new();
        let end = decode(bytes, &mut |one| all.push(one.map(|said| said.heard)));
        (all, end)
    }

    fn set(name: &str, numbers: &[f64]) -> OscRequest {
        OscRequest::Set { name: name.into(), numbers: numbers.into() }
    }

    #[test]
    fn messages_of_common_tools_are_read() {
        // The example of the specification, with another address.
        let float = sent("/dpm/exposure", ",f", &1.1f32.to_be_bytes());
        assert_eq!(heard(&float), (vec![Ok(set("exposure", &[1.1]))], Ok(())));
        let mixed = [3i32.to_be_bytes().to_vec(), 2.5f64.to_be_bytes().to_vec(), 7i64.to_be_bytes().to_vec()];
        let gaze = sent("/dpm/body/my hare", ",idhTF", &mixed.concat());
        assert_eq!(heard(&gaze).0, [Ok(set("body.my hare", &[3.0, 2.5, 7.0, 1.0, 0.0]))]);
        for bytes in [padded("/dpm/black"), sent("/dpm/black", ",", &[]), sent("/dpm/black", ",T", &[])] {
            assert_eq!(heard(&bytes), (vec![Ok(OscRequest::Order(Order::Black))], Ok(())));
        }
        assert_eq!(heard(&sent("/dpm/black", ",s", &padded("now"))).0, [Ok(OscRequest::Order(Order::Black))]);
        assert_eq!(heard(&sent("/dpm/safe", ",f", &0f32.to_be_bytes())).0, [Ok(OscRequest::Nothing)]);
        let all = bundle(&[padded("/dpm/freeze"), bundle(std::slice::from_ref(&float)), padded("/dpm/safe")]);
        let told = heard(&all);
        assert_eq!(told.0.len(), 3, "{told:?}");
        assert_eq!((told.0[2].clone(), told.1), (Ok(OscRequest::Order(Order::Safe)), Ok(())));
    }

    #[test]
    fn a_token_is_a_text_among_the_arguments_or_a_part_of_the_address_and_is_never_printed() {
        let token_of = |bytes: &[u8]| {
            let mut all = Vec::new();
            decode(bytes, &mut |one| all.push(one)).unwrap();
            let told = format!("{all:?}");
            assert!(!told.contains("abc-012345-XYZ"), "{told}");
            all.pop().unwrap().map(|said| (said.heard, said.token))
        };
        let number = 1.5f32.to_be_bytes().to_vec();
        let token = Some("abc-012345-XYZ".to_owned());
        let exposure = Ok((set("exposure", &[1.5]), token.clone()));
        let secret = padded("abc-012345-XYZ");
        assert_eq!(token_of(&sent("/dpm/exposure", ",fs", &[&number[..], &secret].concat())), exposure);
        assert_eq!(token_of(&sent("/dpm/exposure", ",sf", &[&secret, &number[..]].concat())), exposure);
        assert_eq!(token_of(&sent("/dpm/token/abc-012345-XYZ/exposure", ",f", &number)), exposure);
        let body = token_of(&sent("/dpm/token/abc-012345-XYZ/body/hare", ",f", &number));
        assert_eq!(body, Ok((set("body.hare", &[1.5]), token.clone())));
        let freeze = token_of(&sent("/dpm/token/abc-012345-XYZ/freeze", ",", &[]));
        assert_eq!(freeze, Ok((OscRequest::Order(Order::Freeze), token)));
        assert_eq!(token_of(&sent("/dpm/token/abc-012345-XYZ/arm", ",", &[])), Err(Wrong::Arm));
        assert_eq!(token_of(&sent("/dpm/exposure", ",f", &number)), Ok((set("exposure", &[1.5]), None)));
        // What is wrong is named without the token.
        let two = [&secret[..], &secret].concat();
        assert!(token_of(&sent("/dpm/token/abc-012345-XYZ/exposure", ",ss", &two)).is_err());
    }

    #[test]
    fn what_means_nothing_here_is_named_and_nothing_arms() {
        assert_eq!(heard(&padded("/dpm/arm")).0, [Err(Wrong::Arm)]);
        assert!(matches!(heard(&padded("/live/play")).0[..], [Err(Wrong::Address(_))]));
        let two = [padded("x"), padded("y")].concat();
        assert!(matches!(heard(&sent("/dpm/exposure", ",ss", &two)).0[..], [Err(Wrong::NoNumber(_))]));
        for bad in [
            &b""[..],
            b"/dpm/black",
            b"dpm\0",
            b"#bundle\0",
            b"/a\0\0,f\0\0\0",
            b"/a\0\0,b\0\0\0\0\0\0",
            b"/a\0\0f\0\0\0",
        ] {
            assert!(matches!(heard(bad).1, Err(Wrong::Form(_))), "{bad:?}");
        }
        // What comes before the fault counts.
        let mut cut = bundle(&[padded("/dpm/black"), padded("/dpm/exposure")]);
        cut.truncate(cut.len() - 4);
        let told = heard(&cut);
        assert_eq!(told.0, [Ok(OscRequest::Order(Order::Black))]);
        assert!(told.1.is_err());
        let deep = (0..6).fold(padded("/dpm/black"), |inner, _| bundle(&[inner]));
        assert!(heard(&deep).0.is_empty() && heard(&deep).1.is_err());
    }

    proptest! {
        /// Any bytes end in messages or a fault, and none of the messages is ARM.
        #[test]
        fn any_bytes(bytes in prop::collection::vec(any::<u8>(), 0..200), address in "/dpm/[a-z/]{0,12}", tags in ",[ifhdTFsb]{0,20}") {
            for bytes in [bytes.clone(), sent(&address, &tags, &bytes), bundle(&[sent(&address, &tags, &bytes)])] {
                for one in heard(&bytes).0 {
                    prop_assert!(one != Ok(OscRequest::Order(Order::Arm)));
                    if let Ok(OscRequest::Set { numbers, .. }) = one {
                        prop_assert!(numbers.len() <= MOST_NUMBERS);
                    }
                }
            }
        }
    }
}
