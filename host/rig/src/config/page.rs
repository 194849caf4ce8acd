//! `[page]`: the live page and the metrics.

use super::{Origin, RigConfig};
use dpm_common::keys::read::{Any, KeyReader, NotEmpty};
use dpm_common::section;
use std::net::SocketAddr;

/// The address of the page where `--page` names none.
pub const DEFAULT_PAGE: &str = "127.0.0.1:8947";
/// The largest number of names in `page.hosts`.
const MAX_HOSTS: usize = 16;

section! {
    /// The live page of a running rig, and its metrics under `/metrics`; see docs/PAGE.md. Off unless `listen` is set.
    pub struct PageConfig {
        /// Address and port on which the page is served, for example `"127.0.0.1:8947"`; port 0 takes a free one. It
        /// must be an address of this machine alone. `--page` sets it.
        listen: Option<String> = None, "", NotEmpty;
        /// Names under which a proxy with TLS on this machine serves the page, for example `["rig.example.org"]`;
        /// with the port where it is not 443. Requests that name another host are refused.
        hosts: Vec<String> = Vec::new(), "", Any;
    }
}

impl PageConfig {
    /// Where to listen; `None` if the page is off.
    pub fn address(&self) -> Option<SocketAddr> {
        self.listen.as_ref()?.parse().ok()
    }
}

/// True for a host name or address with an optional port, as it stands in the header `Host`.
fn is_host(name: &str) -> bool {
    let host = match name.rsplit_once(':') {
        Some((host, port)) if port.parse::<u16>().is_ok_and(|p| p > 0) => host,
        Some(_) => return false,
        None => name,
    };
    let is_part = |part: &str| {
        !part.is_empty() && part.bytes().all(|b| b.is_ascii_alphanumeric() || b == b'-' || b == b'_')
    };
    host.len() <= 253 && host.split('.').all(is_part)
}

/// Checks for contradictions in `[page]`.
pub(super) fn check(rig: &RigConfig, reader: &mut KeyReader) {
    let mut refuse = |key: &str, problem: &str, remedy: &str| {
        let origin: Origin = reader.origin_of(key);
        reader.refuse(&origin, key, problem.to_owned(), remedy.to_owned());
    };
    let page = &rig.page;
    match page.listen.as_deref().map(str::parse::<SocketAddr>) {
        Some(Err(_)) => {
            refuse("page.listen", "is no address with a port", "for example \"127.0.0.1:8947\"");
        }
        Some(Ok(address)) if !address.ip().is_loopback() => refuse(
            "page.listen",
            "can be reached from other machines, and the page has no encryption of its own",
            "listen on 127.0.0.1 and let a proxy with TLS, or ssh -L, lead there (docs/PAGE.md)",
        ),
        _ => {}
    }
    if page.hosts.len() > MAX_HOSTS {
        refuse("page.hosts", "has more than 16 names", "name those that the proxy serves");
    }
    if page.hosts.iter().any(|name| !is_host(name)) {
        refuse(
            "page.hosts",
            "has an entry that is no host name",
            "write names without a scheme and path, for example \"rig.example.org\"",
        );
    }
    if !page.hosts.is_empty() && page.listen.is_none() {
        refuse("page.hosts", "has no effect, because the page is off", "set page.listen as well");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Overrides;

    fn told(flags: &[&str]) -> Result<PageConfig, String> {
        let flags = flags.iter().map(|f| (*f).to_owned()).collect();
        let overrides = Overrides { flags, ..Overrides::default() };
        RigConfig::demo(&overrides).map(|rig| rig.page).map_err(|e| e.to_string())
    }

    #[test]
    fn the_page_is_off_and_listens_on_this_machine_alone() {
        assert_eq!(told(&[]).unwrap().address(), None);
        for good in [DEFAULT_PAGE, "127.0.0.1:0", "[::1]:8947", "127.3.4.5:80"] {
            let flag = format!("page.listen=\"{good}\"");
            assert_eq!(told(&[&flag]).unwrap().address(), Some(good.parse().unwrap()));
        }
        for far in ["0.0.0.0:8947", "192.168.1.7:8947", "[::]:8947", "[fe80::1]:8947"] {
            let told = told(&[&format!("page.listen=\"{far}\"")]).unwrap_err();
            assert!(told.contains("page.listen") && told.contains("TLS"), "{told}");
        }
        for bad in ["localhost:8947", "127.0.0.1", "8947", "127.0.0.1:99999"] {
            let told = told(&[&format!("page.listen=\"{bad}\"")]).unwrap_err();
            assert!(told.contains("no address with a port"), "{told}");
        }
    }

    #[test]
    fn names_of_a_proxy_are_host_names() {
        let with = |hosts: &str| told(&["page.listen=\"127.0.0.1:0\"", &format!("page.hosts={hosts}")]);
        assert_eq!(with("[\"rig.example.org\", \"rig:8443\"]").unwrap().hosts.len(), 2);
        for bad in ["[\"https://rig\"]", "[\"\"]", "[\"a/b\"]", "[\"a:0\"]", "[\"a b\"]", "[\"*\"]"] {
            assert!(with(bad).unwrap_err().contains("host name"), "{bad}");
        }
        assert!(told(&["page.hosts=[\"a\"]"]).unwrap_err().contains("page is off"));
    }
}
