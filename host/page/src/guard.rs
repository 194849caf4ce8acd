//! Who may ask: the checks of a request before anything is done for it.
//!
//! A browser runs scripts of other sites on this machine. The header `Host` tells a page that was reached under a
//! foreign name (DNS rebinding), `Origin` and `Sec-Fetch-Site` tell a request that another site caused.

use crate::proof::{is_number, ProofError, Prover};
use crate::token::Token;
use hyper::header::{HeaderMap, HeaderName, HOST, ORIGIN};
use hyper::Request;
use std::net::SocketAddr;

/// The header that proves an order: a challenge of the rig, a space, and the signature ([`crate::proof`]).
pub const ORDER: HeaderName = HeaderName::from_static("x-dpm-order");
/// The header with the number for which the answer is to be proven.
pub const NUMBER: HeaderName = HeaderName::from_static("x-dpm-number");
/// The header with that proof.
pub const PROOF: HeaderName = HeaderName::from_static("x-dpm-proof");
const FETCH_SITE: HeaderName = HeaderName::from_static("sec-fetch-site");
const FETCH_MODE: HeaderName = HeaderName::from_static("sec-fetch-mode");
const FETCH_DEST: HeaderName = HeaderName::from_static("sec-fetch-dest");

/// What a request is refused for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct RequestRefusal {
    /// The HTTP status.
    pub status: u16,
    /// What to tell.
    pub told: String,
}

fn refused(status: u16, told: impl Into<String>) -> RequestRefusal {
    RequestRefusal { status, told: told.into() }
}

/// The names under which the page may be asked for.
#[derive(Debug)]
pub(crate) struct Guard {
    hosts: Vec<String>,
    origins: Vec<String>,
    prover: Option<Prover>,
    /// What to do about a request that named another host.
    remedy: &'static str,
}

impl Guard {
    /// For a page at `address` that a proxy serves as `names`. Without a token there are no orders.
    pub(crate) fn new(address: SocketAddr, names: &[String], token: Option<Token>) -> Self {
        let port = address.port();
        let mut hosts = vec![address.to_string(), format!("localhost:{port}")];
        if port == 80 {
            hosts.extend([address.ip().to_string(), "localhost".into()]);
        }
        let mut origins: Vec<String> = hosts.iter().map(|host| format!("http://{host}")).collect();
        // Beyond this machine there is TLS only.
        origins.extend(names.iter().map(|name| format!("https://{}", name.to_ascii_lowercase())));
        hosts.extend(names.iter().map(|name| name.to_ascii_lowercase()));
        let prover = token.as_ref().and_then(Prover::new);
        Self { hosts, origins, prover, remedy: "; add a proxy's name to page.hosts" }
    }

    /// For an overview of several rigs at `address`, which has no rig file and no orders.
    pub(crate) fn of_overview(address: SocketAddr) -> Self {
        Self { remedy: "", ..Self::new(address, &[], None) }
    }

    /// Any request: it was sent to this page by name, and not by another site.
    pub(crate) fn check(&self, headers: &HeaderMap) -> Result<(), RequestRefusal> {
        let named = single(headers, &HOST).filter(|host| self.is_mine(host));
        let Some(host) = named else {
            let names = self.hosts.join(", ");
            return Err(refused(421, format!("this page answers to {names} only{}", self.remedy)));
        };
        if headers.contains_key(FETCH_SITE)
            && !single(headers, &FETCH_SITE).is_some_and(|site| ["same-origin", "none"].contains(&site))
            && !is_link_on_this_machine(headers)
        {
            return Err(refused(403, "refused: another site asks"));
        }
        if headers.contains_key(ORIGIN)
            && !single(headers, &ORIGIN).is_some_and(|origin| self.is_from_here(origin, host))
        {
            return Err(refused(403, "refused: another site asks"));
        }
        Ok(())
    }

    /// A name of this page, or of this machine: through a tunnel the page has whatever port the tunnel has. A name that was rebound to
    /// this address is neither.
    fn is_mine(&self, host: &str) -> bool {
        self.hosts.iter().any(|h| h.eq_ignore_ascii_case(host)) || is_loopback(host)
    }

    /// A page of this server has caused the request, which was sent to `host`. Other ports of this machine are other pages.
    fn is_from_here(&self, origin: &str, host: &str) -> bool {
        let through_tunnel = || {
            let asked = origin.strip_prefix("http://").filter(|asked| asked.eq_ignore_ascii_case(host));
            is_loopback(host) && asked.is_some()
        };
        self.origins.iter().any(|o| o.eq_ignore_ascii_case(origin)) || through_tunnel()
    }

    /// A new challenge for a page that wants to ask for something.
    pub(crate) fn challenge(&self) -> Result<String, RequestRefusal> {
        self.prover()?.challenge().ok_or_else(|| refused(503, "the operating system gave no random bytes"))
    }

    /// A request that does something: it is signed by the secret over a challenge of this process, and has no body.
    pub(crate) fn check_order<B: hyper::body::Body>(
        &self,
        request: &Request<B>,
    ) -> Result<(), RequestRefusal> {
        let prover = self.prover()?;
        let told = single(request.headers(), &ORDER);
        let told = match (told, request.headers().contains_key(ORDER)) {
            (Some(told), _) => told,
            (None, false) => {
                return Err(refused(401, "not signed: open the page by the link that `dpm page` prints"))
            }
            (None, true) => return Err(refused(403, "not signed as docs/PAGE.md says")),
        };
        if !request.body().is_end_stream() {
            return Err(refused(400, "a signed request has no body"));
        }
        prover.check(request.method().as_str(), path_of(request), told).map_err(|unproven| match unproven {
            ProofError::Form => refused(403, "not signed as docs/PAGE.md says"),
            ProofError::Challenge => refused(403, "the challenge is old, used, or of another run: ask again"),
            ProofError::Signature => {
                refused(403, "signed by another key: open the page by the link that `dpm page` prints")
            }
        })
    }

    /// The proof of an answer, if the request asks for one.
    pub(crate) fn proof<B>(&self, request: &Request<B>, status: u16, body: &[u8]) -> Option<String> {
        let number = single(request.headers(), &NUMBER).filter(|number| is_number(number))?;
        let asked = (request.method().as_str(), path_of(request), number);
        Some(self.prover.as_ref()?.sign_answer(asked, status, body))
    }

    /// The proof of an event of a viewer that has drawn `number`.
    pub(crate) fn event_proof(&self, number: &str, count: u64, name: &str, data: &str) -> Option<String> {
        Some(self.prover.as_ref()?.sign_event(number, count, name, data))
    }

    fn prover(&self) -> Result<&Prover, RequestRefusal> {
        self.prover.as_ref().ok_or_else(|| {
            refused(503, "this page gives no orders, because it has no token; use `dpm black`")
        })
    }
}

/// Path and query of a request, as they are signed.
fn path_of<B>(request: &Request<B>) -> &str {
    request.uri().path_and_query().map_or("", |path| path.as_str())
}

/// Whether a host is this machine by a name that no name server decides, with any port or none.
fn is_loopback(host: &str) -> bool {
    let (name, port) = match host.rsplit_once(':') {
        Some((name, port)) if !port.is_empty() && port.bytes().all(|b| b.is_ascii_digit()) => {
            (name, Some(port))
        }
        _ => (host, None),
    };
    let is_port = port.is_none_or(|port| port.parse::<u16>().is_ok());
    is_port && ["127.0.0.1", "[::1]", "localhost"].iter().any(|known| known.eq_ignore_ascii_case(name))
}

/// A link on a page of this machine was followed, as those of the overview of several rigs. To a browser all ports of
/// one address are one site. The page that has the link can read nothing of this one and cannot show it in a frame.
fn is_link_on_this_machine(headers: &HeaderMap) -> bool {
    [(FETCH_SITE, "same-site"), (FETCH_MODE, "navigate"), (FETCH_DEST, "document")]
        .iter()
        .all(|(name, value)| single(headers, name) == Some(*value))
}

/// The value of a header that occurs exactly once.
fn single<'a>(headers: &'a HeaderMap, name: &HeaderName) -> Option<&'a str> {
    let mut all = headers.get_all(name).iter();
    let first = all.next()?;
    if all.next().is_some() {
        return None;
    }
    first.to_str().ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::proof::{sign_request, Key};

    fn headers(all: &[(&str, &str)]) -> HeaderMap {
        let mut map = HeaderMap::new();
        for (name, value) in all {
            let name: HeaderName = name.parse().unwrap();
            map.append(name, value.parse().unwrap());
        }
        map
    }

    fn guard() -> Guard {
        Guard::new("127.0.0.1:8947".parse().unwrap(), &["Rig.example.org".into()], Some(token()))
    }

    fn token() -> Token {
        static TOKEN: std::sync::OnceLock<Token> = std::sync::OnceLock::new();
        TOKEN.get_or_init(|| Token::random().unwrap()).clone()
    }

    #[test]
    fn only_the_pages_own_names_are_answered() {
        let tunnels = ["127.0.0.1:9000", "localhost:9000", "[::1]:9000", "127.0.0.1", "localhost", "[::1]"];
        let names = ["127.0.0.1:8947", "localhost:8947", "LOCALHOST:8947", "rig.example.org"];
        for good in names.into_iter().chain(tunnels) {
            assert_eq!(guard().check(&headers(&[("host", good)])), Ok(()), "{good}");
        }
        for bad in [
            "evil.example:8947",
            "127.0.0.2:8947",
            "127.0.0.1.evil.example",
            "localhost.evil.example:8947",
            "localhost:",
            "localhost:99999",
            "evil@localhost:80",
            "[::1",
            "",
            "rig.example.org:443",
        ] {
            let told = guard().check(&headers(&[("host", bad)])).unwrap_err();
            assert_eq!(told.status, 421, "{bad}");
        }
        assert!(guard().check(&headers(&[])).is_err());
        let two = [("host", "127.0.0.1:8947"), ("host", "127.0.0.1:8947")];
        assert!(guard().check(&headers(&two)).is_err());
    }

    #[test]
    fn another_site_is_refused_whatever_it_says() {
        let host = ("host", "127.0.0.1:8947");
        for good in ["http://127.0.0.1:8947", "http://localhost:8947", "https://rig.example.org"] {
            assert_eq!(guard().check(&headers(&[host, ("origin", good)])), Ok(()), "{good}");
        }
        for bad in [
            "null",
            "",
            "https://evil.example",
            "http://127.0.0.1:80",
            "https://127.0.0.1:8947",
            "http://rig.example.org",
            "http://localhost:8947.evil.example",
        ] {
            assert!(guard().check(&headers(&[host, ("origin", bad)])).is_err(), "{bad}");
        }
        // Through a tunnel only its own pages may ask, and not those of other servers of this machine.
        let tunnel = ("host", "localhost:9000");
        assert_eq!(guard().check(&headers(&[tunnel, ("origin", "http://localhost:9000")])), Ok(()));
        for bad in
            ["http://localhost:9001", "http://127.0.0.1:9000", "https://localhost:9000", "http://localhost"]
        {
            assert!(guard().check(&headers(&[tunnel, ("origin", bad)])).is_err(), "{bad}");
        }
        for (site, may) in
            [("same-origin", true), ("none", true), ("cross-site", false), ("same-site", false)]
        {
            assert_eq!(guard().check(&headers(&[host, ("sec-fetch-site", site)])).is_ok(), may, "{site}");
        }
    }

    #[test]
    fn a_link_on_this_machine_may_be_followed_and_nothing_else_of_another_page() {
        let asked = |site, mode, dest, more: &[(&str, &str)]| {
            let all = [
                ("host", "127.0.0.1:8947"),
                ("sec-fetch-site", site),
                ("sec-fetch-mode", mode),
                ("sec-fetch-dest", dest),
            ];
            guard().check(&headers(&[&all, more].concat())).is_ok()
        };
        assert!(asked("same-site", "navigate", "document", &[]));
        assert!(!asked("cross-site", "navigate", "document", &[]), "from the network");
        assert!(!asked("same-site", "navigate", "iframe", &[]), "in a frame");
        assert!(!asked("same-site", "cors", "empty", &[]), "by a script");
        assert!(!asked("same-site", "no-cors", "image", &[]), "as a picture");
        let form = [("origin", "http://127.0.0.1:8940")];
        assert!(!asked("same-site", "navigate", "document", &form), "a form");
        assert!(!asked("same-site", "navigate", "document", &[("sec-fetch-site", "same-site")]), "twice");
    }

    #[test]
    fn an_order_needs_exactly_one_right_signature() {
        let guard = guard();
        let key = Key::of_orders(&token());
        let path = "/api/orders/black?x=1";
        let request = |all: &[(&str, &str)], body: &str| {
            let mut request = Request::post(path).body(body.to_owned()).unwrap();
            *request.headers_mut() = headers(all);
            request
        };
        let told = |all: &[(&str, &str)]| guard.check_order(&request(all, "")).map_err(|r| r.status);
        let signed = || {
            let challenge = guard.challenge().unwrap();
            format!("{challenge} {}", sign_request(&key, "POST", path, &challenge))
        };
        assert_eq!(told(&[("x-dpm-order", &signed())]), Ok(()));
        assert_eq!(told(&[]), Err(401));
        assert_eq!(told(&[("x-dpm-order", "")]), Err(403));
        assert_eq!(told(&[("x-dpm-order", token().as_str())]), Err(403));
        assert_eq!(told(&[("x-dpm-token", token().as_str())]), Err(401));
        assert_eq!(told(&[("x-dpm-order", &signed()), ("x-dpm-order", &signed())]), Err(403));
        let whole = guard.check_order(&request(&[("x-dpm-order", &signed())], "body"));
        assert_eq!(whole.map_err(|r| r.status), Err(400));
        let none = Guard::new("127.0.0.1:1".parse().unwrap(), &[], None);
        let right = request(&[("x-dpm-order", &signed())], "");
        assert_eq!(none.check_order(&right).unwrap_err().status, 503);
        assert_eq!(none.challenge().unwrap_err().status, 503);
    }
}
