//! How a rig and a page prove to each other that they have the same secret, which crosses no connection.
//!
//! From the token of [`crate::token`] come two keys. With the one the rig signs what it answers, over a number that the
//! page has drawn; with the other the page signs what it asks for, over a challenge that the rig has drawn. A browser
//! keeps only the first, and only to verify: whoever serves its page the next time can sign nothing.
//!
//! A challenge holds for [`HOLDS`] and for one request, and only in the process that has drawn it. So a request that
//! somebody has caught is worth nothing later, nor after a restart.
//!
//! HMAC: RFC 2104, with SHA-256; the keys are derived by HMAC over a text each.

use crate::hex::{hex, unhex};
use crate::token::Token;
use hmac::{Hmac, KeyInit, Mac};
use sha2::Sha256;
use std::collections::VecDeque;
use std::fmt;
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

/// How long a challenge holds.
pub const HOLDS: Duration = Duration::from_secs(10);
/// Bytes of a key and of a signature.
const BYTES: usize = 32;
/// Letters of a number that a page draws.
const NUMBER_LETTERS: std::ops::RangeInclusive<usize> = 32..=64;
/// Requests whose challenges are remembered as used; those that know the secret are few.
const USED: usize = 4096;

/// A key. Its value is not printed by `{:?}`.
#[derive(Clone)]
pub struct Key([u8; BYTES]);

impl fmt::Debug for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Key(secret)")
    }
}

impl Key {
    /// The key with which a rig signs its answers.
    pub fn of_rig(token: &Token) -> Self {
        Self(Self(token.bytes()).mac(&[b"dpm page: rig"]))
    }

    /// The key with which a page signs what it asks for.
    pub fn of_orders(token: &Token) -> Self {
        Self(Self(token.bytes()).mac(&[b"dpm page: orders"]))
    }

    fn random() -> Result<Self, getrandom::Error> {
        let mut bytes = [0; BYTES];
        getrandom::fill(&mut bytes)?;
        Ok(Self(bytes))
    }

    fn begun(&self, parts: &[&[u8]]) -> Hmac<Sha256> {
        let mut mac = Hmac::<Sha256>::new_from_slice(&self.0).expect("HMAC takes keys of any length");
        parts.iter().for_each(|part| mac.update(part));
        mac
    }

    fn mac(&self, parts: &[&[u8]]) -> [u8; BYTES] {
        self.begun(parts).finalize().into_bytes().into()
    }

    /// The signature of a text in parts, as hexadecimal digits.
    pub fn sign(&self, parts: &[&[u8]]) -> String {
        hex(&self.mac(parts))
    }

    /// True if `told` is the signature of a text in parts. The time that this takes does not depend on where they differ.
    pub fn verifies(&self, parts: &[&[u8]], told: &str) -> bool {
        unhex(told).is_some_and(|told| self.begun(parts).verify_slice(&told).is_ok())
    }
}

/// What a page signs: a method, a path with its query, and the rig's challenge. Such a request has no body.
pub fn sign_request(key: &Key, method: &str, path: &str, challenge: &str) -> String {
    key.sign(&request_parts(method, path, challenge))
}

fn request_parts<'a>(method: &'a str, path: &'a str, challenge: &'a str) -> [&'a [u8]; 6] {
    [method.as_bytes(), b"\n", path.as_bytes(), b"\n", challenge.as_bytes(), b"\n"]
}

/// What a rig signs of an answer: method and path of the request, the number of the page, the status, and the body.
pub fn verifies_answer(
    key: &Key,
    (method, path, number): (&str, &str, &str),
    (status, body): (u16, &[u8]),
    told: &str,
) -> bool {
    let head = answer_head(method, path, number, status);
    key.verifies(&[head.as_bytes(), body], told)
}

fn answer_head(method: &str, path: &str, number: &str, status: u16) -> String {
    format!("answer\n{method}\n{path}\n{number}\n{status}\n")
}

/// What a page draws for each request: hexadecimal digits.
pub(crate) fn is_number(text: &str) -> bool {
    NUMBER_LETTERS.contains(&text.len()) && unhex(text).is_some()
}

/// Why a signed request is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum ProofError {
    /// It is not of the form `CHALLENGE SIGNATURE`.
    Form,
    /// The challenge is not of this process, too old, or used.
    Challenge,
    /// The signature is not by this rig's secret, or of another request.
    Signature,
}

/// The rig's side.
pub(crate) struct Prover {
    rig: Key,
    orders: Key,
    /// Of this process alone.
    challenges: Key,
    began: Instant,
    used: Mutex<VecDeque<(u64, String)>>,
}

impl fmt::Debug for Prover {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Prover(secret)")
    }
}

impl Prover {
    /// For a rig with `token`; `None` if the operating system gives no random bytes.
    pub(crate) fn new(token: &Token) -> Option<Self> {
        Some(Self {
            rig: Key::of_rig(token),
            orders: Key::of_orders(token),
            challenges: Key::random().ok()?,
            began: Instant::now(),
            used: Mutex::default(),
        })
    }

    fn now_ms(&self) -> u64 {
        u64::try_from(self.began.elapsed().as_millis()).unwrap_or(u64::MAX)
    }

    /// A new challenge: the time, a random number, and a signature by which it is known again. Nothing is kept of it.
    pub(crate) fn challenge(&self) -> Option<String> {
        self.challenge_at(self.now_ms())
    }

    fn challenge_at(&self, ms: u64) -> Option<String> {
        let mut bytes = [0u8; 16];
        getrandom::fill(&mut bytes).ok()?;
        let head = format!("{ms:016x}{}", hex(&bytes));
        let mark = self.challenges.mac(&[head.as_bytes()]);
        Some(head + &hex(&mark[..16]))
    }

    /// When a challenge of this process was drawn.
    fn drawn_at(&self, challenge: &str) -> Option<u64> {
        let (head, mark) = challenge.split_at_checked(48)?;
        let right = self.challenges.mac(&[head.as_bytes()]);
        let differs = hex(&right[..16]).bytes().zip(mark.bytes()).fold(0, |all, (a, b)| all | (a ^ b));
        let is_right = mark.len() == 32 && std::hint::black_box(differs) == 0;
        is_right.then(|| u64::from_str_radix(&head[..16], 16).ok()).flatten()
    }

    /// Checks a request that has `told` as its proof: `CHALLENGE SIGNATURE`. A right one is used up.
    pub(crate) fn check(&self, method: &str, path: &str, told: &str) -> Result<(), ProofError> {
        self.check_at(self.now_ms(), method, path, told)
    }

    fn check_at(&self, now_ms: u64, method: &str, path: &str, told: &str) -> Result<(), ProofError> {
        let (challenge, signature) = told.split_once(' ').ok_or(ProofError::Form)?;
        let holds_ms = HOLDS.as_millis() as u64;
        let is_fresh = |at: u64| at <= now_ms && now_ms - at <= holds_ms;
        let drawn_at = self.drawn_at(challenge).filter(|at| is_fresh(*at)).ok_or(ProofError::Challenge)?;
        if !self.orders.verifies(&request_parts(method, path, challenge), signature) {
            return Err(ProofError::Signature);
        }
        let mut used = self.used.lock().unwrap_or_else(PoisonError::into_inner);
        while used.front().is_some_and(|(at, _)| !is_fresh(*at)) {
            used.pop_front();
        }
        if used.len() >= USED || used.iter().any(|(_, other)| other == challenge) {
            return Err(ProofError::Challenge);
        }
        used.push_back((drawn_at, challenge.to_owned()));
        Ok(())
    }

    /// The signature of an answer, for a page that has drawn `number`.
    pub(crate) fn sign_answer(
        &self,
        (method, path, number): (&str, &str, &str),
        status: u16,
        body: &[u8],
    ) -> String {
        self.rig.sign(&[answer_head(method, path, number, status).as_bytes(), body])
    }

    /// The signature of the `count`-th event of a viewer that has drawn `number`.
    pub(crate) fn sign_event(&self, number: &str, count: u64, name: &str, data: &str) -> String {
        self.rig.sign(&[format!("event\n{number}\n{count}\n{name}\n").as_bytes(), data.as_bytes()])
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn prover() -> (Prover, Token) {
        let token = Token::random().unwrap();
        (Prover::new(&token).unwrap(), token)
    }

    /// RFC 4231, test case 2, whose key is shorter than a block, and case 1 of 20 bytes.
    #[test]
    fn signatures_are_those_of_the_standard() {
        let mac = |key: &[u8], text: &[u8]| {
            let mut mac = Hmac::<Sha256>::new_from_slice(key).unwrap();
            mac.update(text);
            hex(&mac.finalize().into_bytes())
        };
        let two = "5bdcc146bf60754e6a042426089575c75a003f089d2739839dec58b964ec3843";
        assert_eq!(mac(b"Jefe", b"what do ya want for nothing?"), two);
        let one = "b0344c61d8db38535ca8afceaf0bf12b881dc200c9833da726e9376c2e32cff7";
        assert_eq!(mac(&[0x0b; 20], b"Hi There"), one);
    }

    #[test]
    fn a_request_is_taken_once_in_its_time_by_its_process_and_as_it_was_signed() {
        let (rig, token) = prover();
        let key = Key::of_orders(&token);
        let path = "/api/orders/arm";
        let signed = |challenge: &str| format!("{challenge} {}", sign_request(&key, "POST", path, challenge));
        let challenge = rig.challenge_at(1_000).unwrap();
        let told = signed(&challenge);
        assert_eq!(rig.check_at(2_000, "POST", "/api/orders/black", &told), Err(ProofError::Signature));
        assert_eq!(rig.check_at(2_000, "POST", "/api/orders/arm?x", &told), Err(ProofError::Signature));
        assert_eq!(rig.check_at(2_000, "GET", path, &told), Err(ProofError::Signature));
        assert_eq!(rig.check_at(2_000, "POST", path, &told), Ok(()));
        assert_eq!(rig.check_at(2_001, "POST", path, &told), Err(ProofError::Challenge), "a second time");
        // Too late, and from the future.
        let late = signed(&rig.challenge_at(3_000).unwrap());
        assert_eq!(rig.check_at(13_001, "POST", path, &late), Err(ProofError::Challenge));
        assert_eq!(rig.check_at(2_999, "POST", path, &late), Err(ProofError::Challenge));
        assert_eq!(rig.check_at(13_000, "POST", path, &late), Ok(()));
        // What another process has drawn, with the same secret: an impostor's number, or that of the run before.
        let before = Prover::new(&token).unwrap();
        let drawn = signed(&before.challenge_at(13_000).unwrap());
        assert_eq!(rig.check_at(13_000, "POST", path, &drawn), Err(ProofError::Challenge));
        assert_eq!(before.check_at(13_000, "POST", path, &drawn), Ok(()));
        // Another secret.
        let (_, other) = prover();
        let challenge = rig.challenge_at(13_000).unwrap();
        let foreign = sign_request(&Key::of_orders(&other), "POST", path, &challenge);
        let told = format!("{challenge} {foreign}");
        assert_eq!(rig.check_at(13_000, "POST", path, &told), Err(ProofError::Signature));
        // The key that a browser keeps signs nothing.
        let told = format!("{challenge} {}", sign_request(&Key::of_rig(&token), "POST", path, &challenge));
        assert_eq!(rig.check_at(13_000, "POST", path, &told), Err(ProofError::Signature));
        for bad in ["", " ", "x y", &challenge, &format!("{challenge} "), &format!("é{challenge} 00")] {
            assert!(rig.check_at(13_000, "POST", path, bad).is_err(), "{bad}");
        }
        // Any letter of a challenge counts.
        for k in 0..challenge.len() {
            let mut other = challenge.clone().into_bytes();
            other[k] = if other[k] == b'0' { b'1' } else { b'0' };
            let other = String::from_utf8(other).unwrap();
            assert_eq!(
                rig.check_at(13_000, "POST", path, &signed(&other)),
                Err(ProofError::Challenge),
                "{k}"
            );
        }
    }

    #[test]
    fn an_answer_is_proven_for_its_request_and_number_only() {
        let (rig, token) = prover();
        let key = Key::of_rig(&token);
        let asked = ("GET", "/api/challenge", "00112233445566778899aabbccddeeff");
        let told = rig.sign_answer(asked, 200, b"body");
        assert!(verifies_answer(&key, asked, (200, b"body"), &told));
        assert!(!verifies_answer(&key, asked, (403, b"body"), &told));
        assert!(!verifies_answer(&key, asked, (200, b"bodz"), &told));
        assert!(!verifies_answer(&key, ("POST", asked.1, asked.2), (200, b"body"), &told));
        assert!(!verifies_answer(&Key::of_orders(&token), asked, (200, b"body"), &told));
        assert!(
            is_number(asked.2)
                && !is_number("00")
                && !is_number(&"g".repeat(32))
                && !is_number(&"0".repeat(66))
        );
        // An event is no answer, and its place counts.
        assert_ne!(rig.sign_event(asked.2, 0, "state", "{}"), rig.sign_event(asked.2, 1, "state", "{}"));
    }
}
