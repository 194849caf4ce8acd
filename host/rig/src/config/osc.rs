//! `[osc]`: Open Sound Control, over which other programs take light away, and change parameters if they know the token.

use super::{Origin, RigConfig};
use dpm_common::keys::read::{Any, KeyReader, NotEmpty};
use dpm_common::section;
use std::net::{IpAddr, SocketAddr};

/// Longest token, bytes.
pub const MOST_OSC_TOKEN: usize = 64;
/// Lengths that `osc.token` may have.
const TOKEN_LENGTHS: std::ops::RangeInclusive<usize> = 12..=MOST_OSC_TOKEN;
/// The largest number of addresses in `osc.from`.
const MAX_SENDERS: usize = 64;

section! {
    /// Open Sound Control over UDP, for BLACK and SAFE, and with a token for FREEZE and parameters; see docs/PAGE.md. Off
    /// unless `listen` is set.
    pub struct OscConfig {
        /// Address and port on which datagrams are taken, for example `"127.0.0.1:9000"`; port 0 takes a free one.
        listen: Option<String> = None, "", NotEmpty;
        /// Addresses of the machines that may send, for example `["192.168.1.20"]`. Without any, programs on this
        /// machine may; with any, they may only if `"127.0.0.1"` is among them.
        from: Vec<String> = Vec::new(), "", Any;
        /// What a message must contain to change a parameter or to freeze: 12 to 64 letters, digits, `-` and `_`.
        /// Without a token in the rig file OSC only makes dark.
        token: Option<String> = None, "", NotEmpty;
    }
}

impl OscConfig {
    /// Where to listen; `None` if OSC is off.
    pub fn address(&self) -> Option<SocketAddr> {
        self.listen.as_ref()?.parse().ok()
    }

    /// The machines that may send; none: this one.
    pub fn senders(&self) -> Vec<IpAddr> {
        self.from.iter().filter_map(|ip| ip.parse().ok()).collect()
    }
}

/// Checks for contradictions in `[osc]`.
pub(super) fn check(rig: &RigConfig, reader: &mut KeyReader) {
    let mut refuse = |key: &str, problem: &str, remedy: &str| {
        let origin: Origin = reader.origin_of(key);
        reader.refuse(&origin, key, problem.to_owned(), remedy.to_owned());
    };
    let osc = &rig.osc;
    match osc.listen.as_deref().map(str::parse::<SocketAddr>) {
        Some(Err(_)) => {
            refuse("osc.listen", "is no address with a port", "for example \"127.0.0.1:9000\"");
        }
        Some(Ok(address)) if !address.ip().is_loopback() && osc.from.is_empty() => refuse(
            "osc.listen",
            "can be reached from other machines, but none may send",
            "name the machines that may send in osc.from, or listen on 127.0.0.1",
        ),
        _ => {}
    }
    if let Some(token) = &osc.token {
        let is_known = |b: u8| b.is_ascii_alphanumeric() || b == b'-' || b == b'_';
        if !TOKEN_LENGTHS.contains(&token.len()) || !token.bytes().all(is_known) {
            refuse(
                "osc.token",
                "is not 12 to 64 letters, digits, - and _",
                "draw one, for example with `openssl rand -hex 12`",
            );
        }
        if osc.listen.is_none() {
            refuse("osc.token", "has no effect, because OSC is off", "set osc.listen as well");
        }
    }
    if osc.from.len() > MAX_SENDERS {
        refuse("osc.from", "has more than 64 addresses", "name those that send");
    }
    if osc.from.iter().any(|ip| ip.parse::<IpAddr>().is_err()) {
        refuse("osc.from", "has an entry that is no address", "for example \"192.168.1.20\"");
    }
    if !osc.from.is_empty() && osc.listen.is_none() {
        refuse("osc.from", "has no effect, because OSC is off", "set osc.listen as well");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Overrides;

    fn told(flags: &[&str]) -> Result<OscConfig, String> {
        let flags = flags.iter().map(|f| (*f).to_owned()).collect();
        let overrides = Overrides { flags, ..Overrides::default() };
        RigConfig::demo(&overrides).map(|rig| rig.osc).map_err(|e| e.to_string())
    }

    #[test]
    fn osc_is_off_and_beyond_this_machine_its_senders_are_named() {
        assert_eq!(told(&[]).unwrap().address(), None);
        let near = told(&["osc.listen=\"127.0.0.1:9000\""]).unwrap();
        assert_eq!((near.address().unwrap().port(), near.senders().len()), (9000, 0));
        let token = ["osc.listen=\"127.0.0.1:9000\"", "osc.token=\"abc_DEF-012345\""];
        assert_eq!(told(&token).unwrap().token.as_deref(), Some("abc_DEF-012345"));
        let far = ["osc.listen=\"0.0.0.0:9000\"", "osc.from=[\"192.168.1.20\", \"fe80::1\"]"];
        assert_eq!(told(&far).unwrap().senders().len(), 2);
        for (flags, word) in [
            (vec![far[0]], "none may send"),
            (vec![far[1]], "OSC is off"),
            (vec!["osc.listen=\"9000\""], "no address with a port"),
            (vec![far[0], "osc.from=[\"desk\"]"], "no address"),
            (vec!["osc.token=\"abcdef-012345\""], "OSC is off"),
            (vec!["osc.listen=\"127.0.0.1:9000\"", "osc.token=\"short\""], "12 to 64"),
            (vec!["osc.listen=\"127.0.0.1:9000\"", "osc.token=\"a/b c d e f g h\""], "12 to 64"),
        ] {
            let told = told(&flags).unwrap_err();
            assert!(told.contains(word), "{told}");
        }
    }
}
