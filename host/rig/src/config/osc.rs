//! `[osc]`: Open Sound Control, over which other programs change parameters and take light away.

use super::{Origin, RigConfig};
use dpm_common::keys::read::{Any, NotEmpty, Reader};
use dpm_common::section;
use std::net::{IpAddr, SocketAddr};

/// The largest number of addresses in `osc.from`.
const MAX_SENDERS: usize = 64;

section! {
    /// Open Sound Control over UDP, for parameters and for BLACK, FREEZE and SAFE; see docs/PAGE.md. Off unless
    /// `listen` is set.
    pub struct OscConfig {
        /// Address and port on which datagrams are taken, for example `"127.0.0.1:9000"`; port 0 takes a free one.
        listen: Option<String> = None, "", NotEmpty;
        /// Addresses of other machines that may send, for example `["192.168.1.20"]`. Programs on this machine always
        /// may. OSC has no secret and UDP addresses can be forged, so name a network that you trust.
        from: Vec<String> = Vec::new(), "", Any;
    }
}

impl OscConfig {
    /// Where to listen; `None` if OSC is off.
    pub fn address(&self) -> Option<SocketAddr> {
        self.listen.as_ref()?.parse().ok()
    }

    /// The other machines that may send.
    pub fn senders(&self) -> Vec<IpAddr> {
        self.from.iter().filter_map(|ip| ip.parse().ok()).collect()
    }
}

/// Checks for contradictions in `[osc]`.
pub(super) fn check(rig: &RigConfig, reader: &mut Reader) {
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
        let far = ["osc.listen=\"0.0.0.0:9000\"", "osc.from=[\"192.168.1.20\", \"fe80::1\"]"];
        assert_eq!(told(&far).unwrap().senders().len(), 2);
        for (flags, word) in [
            (vec![far[0]], "none may send"),
            (vec![far[1]], "OSC is off"),
            (vec!["osc.listen=\"9000\""], "no address with a port"),
            (vec![far[0], "osc.from=[\"desk\"]"], "no address"),
        ] {
            let told = told(&flags).unwrap_err();
            assert!(told.contains(word), "{told}");
        }
    }
}
