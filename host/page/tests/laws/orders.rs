//! Orders over HTTP: from a request to the light of the mock projector, and who may not give them.

use crate::common::{ask, Running, PATIENCE};
use dpm_rig::telemetry::live::SeenLight;
use dpm_rig::telemetry::monitor::ProjectorHealth;
use std::time::Instant;

/// The frame on the mirrors of the mock projector; `None` while it is dark.
fn lit(rig: &Running) -> Option<u32> {
    let mut light = SeenLight::default();
    rig.monitor.live().want_light();
    let begin = Instant::now();
    while !rig.monitor.live().take_light(&mut light) {
        assert!(begin.elapsed() < PATIENCE, "the mock shows nothing");
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
    assert_eq!(light.frame.is_some(), !light.planes.is_empty());
    light.frame
}

#[test]
fn an_order_is_answered_when_the_light_has_obeyed() {
    let rig = Running::start("orders");
    for (word, health, is_lit) in [
        ("black", "BLACK", false),
        ("arm", "up", true),
        ("freeze", "FROZEN", true),
        ("safe", "FAULTED", false),
        ("arm", "up", true),
    ] {
        let told = rig.order(word);
        // The answer is the state: nothing has to be waited for after it.
        assert_eq!((rig.monitor.projector().word(), told["done"].as_bool()), (health, Some(true)), "{told}");
        assert!(told["obeyed_ms"].as_f64().is_some_and(|ms| ms < 2000.0), "{told}");
        if is_lit {
            rig.wait("light", || lit(&rig).is_some());
        } else {
            assert_eq!(lit(&rig), None, "{word}");
        }
    }
    // FREEZE holds the frame.
    rig.order("freeze");
    let held = lit(&rig);
    std::thread::sleep(std::time::Duration::from_millis(100));
    assert_eq!((lit(&rig), held.is_some()), (held, true));
    let told = rig.order("black");
    assert!(told["text"].as_str().is_some_and(|t| t.starts_with("ok: projector black")), "{told}");
    // A weaker order changes nothing, and the answer does not say that it did.
    let told = rig.order("freeze");
    assert_eq!((told["done"].as_bool(), told["obeyed_ms"].is_null()), (Some(false), true), "{told}");
    assert_eq!(rig.monitor.projector(), ProjectorHealth::Black);
}

#[test]
fn nobody_gives_an_order_without_the_token_under_another_name_or_from_another_site() {
    let rig = Running::start("refused");
    let (host, token) = (rig.address.to_string(), rig.token.as_str().to_owned());
    let wrong = "0".repeat(64);
    let own = format!("http://{host}");
    type Case<'a> = (&'a str, u16, Vec<(&'a str, &'a str)>);
    let refused: [Case<'_>; 11] = [
        ("POST", 401, vec![("Host", &host)]),
        ("POST", 403, vec![("Host", &host), ("X-Dpm-Token", &wrong)]),
        ("POST", 403, vec![("Host", &host), ("X-Dpm-Token", "")]),
        ("POST", 421, vec![("Host", "evil.example"), ("X-Dpm-Token", &token)]),
        ("POST", 421, vec![("X-Dpm-Token", &token)]),
        ("POST", 403, vec![("Host", &host), ("X-Dpm-Token", &token), ("Origin", "https://evil.example")]),
        ("POST", 403, vec![("Host", &host), ("X-Dpm-Token", &token), ("Origin", "null")]),
        ("POST", 403, vec![("Host", &host), ("X-Dpm-Token", &token), ("Sec-Fetch-Site", "cross-site")]),
        ("GET", 405, vec![("Host", &host), ("X-Dpm-Token", &token)]),
        ("OPTIONS", 403, vec![("Host", &host), ("Origin", "https://evil.example")]),
        ("OPTIONS", 401, vec![("Host", &host), ("Origin", &own)]),
    ];
    for (method, status, headers) in refused {
        let answer = ask(rig.address, method, "/api/orders/black", &headers);
        assert_eq!(answer.status, status, "{method} {headers:?}: {}", answer.body);
        assert!(!answer.head.to_ascii_lowercase().contains("access-control"), "{}", answer.head);
    }
    let answer = rig.ask("POST", "/api/orders/light", &[("X-Dpm-Token", &token)]);
    assert_eq!(answer.status, 404);
    // None of them did anything.
    let before = rig.monitor.counts().frames_lit;
    rig.wait("further light", || rig.monitor.counts().frames_lit > before + 3);
    assert_eq!(rig.monitor.projector(), ProjectorHealth::Up);
    // A proxy with TLS may pass an order on.
    let answer = ask(
        rig.address,
        "POST",
        "/api/orders/black",
        &[("Host", "rig.example.org"), ("Origin", "https://rig.example.org"), ("X-Dpm-Token", &token)],
    );
    assert_eq!((answer.status, rig.monitor.projector()), (200, ProjectorHealth::Black));
}

#[test]
fn the_page_allows_no_foreign_script_and_tells_the_token_to_nobody() {
    let rig = Running::start("secret");
    let first = rig.ask("GET", "/", &[]);
    let second = rig.ask("GET", "/", &[]);
    assert_eq!(first.status, 200);
    let nonce = |body: &str| body.split("nonce=\"").nth(1).unwrap().split('"').next().unwrap().to_owned();
    assert_ne!(nonce(&first.body), nonce(&second.body));
    let policy = first.head.lines().find(|l| l.to_ascii_lowercase().starts_with("content-security-policy"));
    let policy = policy.expect("a policy");
    assert!(policy.contains("default-src 'none'") && policy.contains(&nonce(&first.body)), "{policy}");
    assert!(!policy.contains("unsafe"), "{policy}");
    // No resource of any other place, and no script or style beside the marked ones.
    assert!(
        !first.body.contains("{{") && !first.body.contains(" style=") && !first.body.contains(" onclick")
    );
    let foreign =
        first.body.matches("://").count() - first.body.matches("\"http://www.w3.org/2000/svg\"").count();
    assert_eq!(foreign, 0, "addresses in the page");
    rig.order("black");
    for path in ["/", "/metrics", "/api/state", "/api/token", "/none"] {
        let answer = rig.ask("GET", path, &[]);
        let whole = format!("{}{}", answer.head, answer.body);
        assert!(!whole.contains(rig.token.as_str()), "{path}");
        assert!(
            answer.head.contains("nosniff") && answer.head.contains("no-store"),
            "{path}: {}",
            answer.head
        );
    }
    assert_eq!(rig.ask("GET", "/api/token", &[]).status, 401);
    assert_eq!(rig.ask("GET", "/api/token", &[("X-Dpm-Token", rig.token.as_str())]).status, 200);
}
