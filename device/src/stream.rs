//! What bytes come over without waiting.

use std::io::{Read, Write};

/// What a device's bytes come over: a socket, a port, or a conversation in memory. Reads and writes MUST NOT block;
/// what is not there yet is [`std::io::ErrorKind::WouldBlock`].
pub trait Stream: Read + Write + Send {}

impl<T: Read + Write + Send> Stream for T {}
