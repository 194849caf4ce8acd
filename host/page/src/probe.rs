//! Whether what listens at an address is the rig whose token is here.

use crate::guard::{NUMBER, PROOF};
use crate::hex::hex;
use crate::proof::{verifies_answer, Key};
use crate::token::Token;
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpStream};
use std::time::Duration;

/// How long each part of the conversation may take.
const WITHIN: Duration = Duration::from_secs(5);
/// Longest answer that is read, bytes.
const LONGEST: u64 = 64 << 10;

/// Asks whoever listens at `address` for a challenge. True if the answer is proven by `token`.
///
/// # Errors
/// Nobody listens there or answers in time.
pub fn is_rig(address: SocketAddr, token: &Token) -> io::Result<bool> {
    let mut bytes = [0u8; 16];
    getrandom::fill(&mut bytes).map_err(|e| io::Error::other(e.to_string()))?;
    let (number, path) = (hex(&bytes), "/api/challenge");
    let mut stream = TcpStream::connect_timeout(&address, WITHIN)?;
    stream.set_read_timeout(Some(WITHIN))?;
    stream.set_write_timeout(Some(WITHIN))?;
    let ask =
        format!("GET {path} HTTP/1.1\r\nHost: {address}\r\n{NUMBER}: {number}\r\nConnection: close\r\n\r\n");
    stream.write_all(ask.as_bytes())?;
    let mut answer = Vec::new();
    // Whoever answers and does not end the connection has answered.
    match stream.take(LONGEST).read_to_end(&mut answer) {
        Err(e) if answer.is_empty() => return Err(e),
        _ => {}
    }
    Ok(is_proven(&answer, &Key::of_rig(token), ("GET", path, &number)))
}

/// True if `answer`, head and body, is proven by `key`.
fn is_proven(answer: &[u8], key: &Key, asked: (&str, &str, &str)) -> bool {
    let Some(end) = answer.windows(4).position(|four| four == b"\r\n\r\n") else { return false };
    let head = String::from_utf8_lossy(&answer[..end]);
    let mut lines = head.split("\r\n");
    let status = lines.next().and_then(|line| line.split(' ').nth(1)?.parse().ok());
    let proof = lines.find_map(|line| {
        let (name, value) = line.split_once(':')?;
        name.eq_ignore_ascii_case(PROOF.as_str()).then(|| value.trim())
    });
    let (Some(status), Some(proof)) = (status, proof) else { return false };
    verifies_answer(key, asked, (status, &answer[end + 4..]), proof)
}
