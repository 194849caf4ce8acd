//! Where a rig's page is, as the operator writes it: `HOST:PORT` or `NAME=HOST:PORT`.

use std::net::{Ipv4Addr, SocketAddr};
use std::str::FromStr;

/// Longest name of a rig, characters.
const MAX_NAME: usize = 40;

/// The address of a rig's page on this machine, or of the tunnel that leads to it, with a name for the operator.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RigAddress {
    name: String,
    address: SocketAddr,
}

/// What is wrong with the address of a rig.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum BadAddress {
    /// It has another form.
    #[error(
        "write HOST:PORT or NAME=HOST:PORT with ports from 1 to 65535, for example stage=127.0.0.1:8947"
    )]
    Form,
    /// The name is empty, too long, or cannot be shown.
    #[error("a name has 1 to {MAX_NAME} characters and no control characters")]
    Name,
    /// The host is not this machine.
    #[error("{0} is not an address of this machine, and pages have no encryption of their own; open a tunnel, for example ssh -N -L 8948:127.0.0.1:8948 {0}, and name 127.0.0.1:8948")]
    NotLoopback(String),
}

impl RigAddress {
    /// The rig's name; its address where it was given none.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Where to ask.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// The name under which a rig's page answers, with the port of a tunnel where there is one.
    pub(super) fn host(&self) -> String {
        format!("localhost:{}", self.address.port())
    }
}

impl FromStr for RigAddress {
    type Err = BadAddress;

    fn from_str(text: &str) -> Result<Self, BadAddress> {
        let (name, place) = text.rsplit_once('=').map_or((None, text), |(name, place)| (Some(name), place));
        let (host, port) = place.rsplit_once(':').ok_or(BadAddress::Form)?;
        let address = match host {
            "localhost" => SocketAddr::from((Ipv4Addr::LOCALHOST, self::port(port)?)),
            _ => match place.parse() {
                Ok(address) => address,
                // A name of another machine, or no address at all.
                Err(_) if self::port(port).is_ok() && is_name(host) => {
                    return Err(BadAddress::NotLoopback(host.to_owned()))
                }
                Err(_) => return Err(BadAddress::Form),
            },
        };
        if address.port() == 0 {
            return Err(BadAddress::Form);
        }
        if !address.ip().is_loopback() {
            return Err(BadAddress::NotLoopback(address.ip().to_string()));
        }
        let name = name.map_or_else(|| address.to_string(), str::to_owned);
        if name.is_empty() || name.chars().count() > MAX_NAME || name.contains(char::is_control) {
            return Err(BadAddress::Name);
        }
        Ok(Self { name, address })
    }
}

/// A port that can be connected to.
fn port(text: &str) -> Result<u16, BadAddress> {
    text.parse().ok().filter(|port| *port > 0).ok_or(BadAddress::Form)
}

/// The form of a host's name.
fn is_name(host: &str) -> bool {
    host.starts_with(|c: char| c.is_ascii_alphabetic())
        && host.chars().all(|c| c.is_ascii_alphanumeric() || "-.".contains(c))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_address_is_what_it_says() {
        for (text, name, address, host) in [
            ("127.0.0.1:8947", "127.0.0.1:8947", "127.0.0.1:8947", "localhost:8947"),
            ("localhost:8947", "127.0.0.1:8947", "127.0.0.1:8947", "localhost:8947"),
            ("Left wall=127.0.0.1:8948", "Left wall", "127.0.0.1:8948", "localhost:8948"),
            ("a=b=[::1]:9", "a=b", "[::1]:9", "localhost:9"),
        ] {
            let rig: RigAddress = text.parse().unwrap_or_else(|e| panic!("{text}: {e}"));
            assert_eq!((rig.name(), rig.address().to_string().as_str()), (name, address), "{text}");
            assert_eq!(rig.host(), host, "{text}");
        }
    }

    #[test]
    fn a_bad_address_is_refused_for_what_is_wrong_with_it() {
        let told = |text: &str| text.parse::<RigAddress>().unwrap_err();
        let forms = ["", "8947", "127.0.0.1", "127.0.0.1:0", "127.0.0.1:65536", "a=localhost:0", "a=:1"];
        let more =
            ["127.0.0.1:1/", "127.0.0.1:1/0", "127.0.0.1:1/8947", "http://127.0.0.1:1", "a=", "::1:1:x"];
        for text in forms.iter().chain(&more) {
            assert_eq!(told(text), BadAddress::Form, "{text}");
        }
        for text in ["=127.0.0.1:1", "a\n=127.0.0.1:1", &format!("{}=127.0.0.1:1", "x".repeat(41))] {
            assert_eq!(told(text), BadAddress::Name, "{text}");
        }
        for (text, host) in
            [("a=192.168.1.5:8947", "192.168.1.5"), ("rig2:8947", "rig2"), ("[fe80::1]:1", "fe80::1")]
        {
            assert_eq!(told(text), BadAddress::NotLoopback(host.into()), "{text}");
        }
    }
}
