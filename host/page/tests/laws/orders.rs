//! Orders over HTTP: from a request to the light of the mock projector, and who may not give them.

use crate::common::{ask, signed_by, HttpAnswer, RunWithPage, PATIENCE};
use dpm_page::probe::is_rig;
use dpm_page::proof::{verifies_answer, Key};
use dpm_page::token::Token;
use dpm_rig::telemetry::live::SeenLight;
use dpm_rig::telemetry::monitor::ProjectorHealth;
use std::io::{BufRead, BufReader, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::time::Instant;

/// The frame on the mirrors of the mock projector; `None` while it is dark.
fn lit(rig: &RunWithPage) -> Option<u32> {
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
    let rig = RunWithPage::start("orders");
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
    let rig = RunWithPage::start("refused");
    let host = rig.address.to_string();
    let path = "/api/orders/black";
    let challenge = || rig.ask("GET", "/api/challenge", &[]).body;
    let wrong = format!("{} {}", challenge(), "0".repeat(64));
    let other_key = signed_by(&Token::random().unwrap(), "POST", path, &challenge());
    let other_order = signed_by(&rig.token, "POST", "/api/orders/arm", &challenge());
    // What anybody can draw without the rig, as an impostor does.
    let drawn = signed_by(&rig.token, "POST", path, &"0".repeat(80));
    let [one, two, three, four, five] = [(); 5].map(|()| rig.signed("POST", path));
    let get = rig.signed("GET", path);
    let own = format!("http://{host}");
    type Case<'a> = (&'a str, u16, Vec<(&'a str, &'a str)>);
    let refused: [Case<'_>; 15] = [
        ("POST", 401, vec![("Host", &host)]),
        ("POST", 401, vec![("Host", &host), ("X-Dpm-Token", rig.token.as_str())]),
        ("POST", 403, vec![("Host", &host), ("X-Dpm-Order", rig.token.as_str())]),
        ("POST", 403, vec![("Host", &host), ("X-Dpm-Order", &wrong)]),
        ("POST", 403, vec![("Host", &host), ("X-Dpm-Order", &other_key)]),
        ("POST", 403, vec![("Host", &host), ("X-Dpm-Order", &other_order)]),
        ("POST", 403, vec![("Host", &host), ("X-Dpm-Order", &drawn)]),
        ("POST", 421, vec![("Host", "evil.example"), ("X-Dpm-Order", &one)]),
        ("POST", 421, vec![("X-Dpm-Order", &two)]),
        ("POST", 403, vec![("Host", &host), ("X-Dpm-Order", &three), ("Origin", "https://evil.example")]),
        ("POST", 403, vec![("Host", &host), ("X-Dpm-Order", &four), ("Origin", "null")]),
        ("POST", 403, vec![("Host", &host), ("X-Dpm-Order", &five), ("Sec-Fetch-Site", "cross-site")]),
        ("GET", 405, vec![("Host", &host), ("X-Dpm-Order", &get)]),
        ("OPTIONS", 403, vec![("Host", &host), ("Origin", "https://evil.example")]),
        ("OPTIONS", 401, vec![("Host", &host), ("Origin", &own)]),
    ];
    for (method, status, headers) in refused {
        let answer = ask(rig.address, method, path, &headers);
        assert_eq!(answer.status, status, "{method} {headers:?}: {}", answer.body);
        assert!(!answer.head.to_ascii_lowercase().contains("access-control"), "{}", answer.head);
    }
    assert_eq!(rig.ask_signed("POST", "/api/orders/light").status, 404);
    // None of them did anything.
    let before = rig.monitor.counts().frames_lit;
    rig.wait("further light", || rig.monitor.counts().frames_lit > before + 3);
    assert_eq!(rig.monitor.projector(), ProjectorHealth::Up);
    // A proxy with TLS may pass an order on.
    let answer = ask(
        rig.address,
        "POST",
        "/api/orders/black",
        &[("Host", "rig.example.org"), ("Origin", "https://rig.example.org"), ("X-Dpm-Order", &one)],
    );
    assert_eq!((answer.status, rig.monitor.projector()), (200, ProjectorHealth::Black));
    // Whoever has caught it can do nothing with it.
    rig.order("arm");
    let again = rig.ask("POST", path, &[("X-Dpm-Order", &one)]);
    assert_eq!((again.status, rig.monitor.projector()), (403, ProjectorHealth::Up), "{}", again.body);
}

#[test]
fn the_page_allows_no_foreign_script_and_tells_the_token_to_nobody() {
    let rig = RunWithPage::start("secret");
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
    for path in ["/", "/metrics", "/api/state", "/api/key", "/api/challenge", "/none"] {
        let answer = rig.ask("GET", path, &[]);
        let whole = format!("{}{}", answer.head, answer.body);
        assert!(!whole.contains(rig.token.as_str()), "{path}");
        assert!(
            answer.head.contains("nosniff") && answer.head.contains("no-store"),
            "{path}: {}",
            answer.head
        );
    }
    assert_eq!(rig.ask("GET", "/api/key", &[]).status, 401);
    assert_eq!(rig.ask_signed("GET", "/api/key").status, 200);
}

/// Found in use, R5: an impostor on the port answered "ok: projector dark", and the page showed it in green.
#[test]
fn what_the_rig_answers_and_tells_is_proven_and_nobody_else_can() {
    let rig = RunWithPage::start("proven");
    let (key, number) = (Key::of_rig(&rig.token), "0123456789abcdef0123456789abcdef");
    let proof = |answer: &HttpAnswer| {
        let line = answer
            .head
            .lines()
            .find_map(|line| line.to_ascii_lowercase().strip_prefix("x-dpm-proof: ").map(str::to_owned));
        line.unwrap_or_default()
    };
    let order = rig.signed("POST", "/api/orders/black");
    for (method, path, more) in [
        ("GET", "/api/challenge", None),
        ("GET", "/api/state?x=1", None),
        ("GET", "/none", None),
        ("POST", "/api/orders/black", None),
        ("POST", "/api/orders/black", Some(("X-Dpm-Order", order.as_str()))),
    ] {
        let headers: Vec<_> = [("X-Dpm-Number", number)].into_iter().chain(more).collect();
        let answer = rig.ask(method, path, &headers);
        let told = proof(&answer);
        let holds = |number: &str, status: u16, key: &Key| {
            verifies_answer(key, (method, path, number), (status, answer.body.as_bytes()), &told)
        };
        assert!(holds(number, answer.status, &key), "{method} {path}: {answer:?}");
        assert!(
            !holds(number, answer.status + 1, &key) && !holds(&number.replace('0', "1"), answer.status, &key)
        );
        assert!(!holds(number, answer.status, &Key::of_rig(&Token::random().unwrap())));
    }
    assert_eq!(proof(&rig.ask("GET", "/api/state", &[("X-Dpm-Number", "0")])), "", "no number");
    assert!(
        is_rig(rig.address, &rig.token).unwrap() && !is_rig(rig.address, &Token::random().unwrap()).unwrap()
    );
    // Events, one after the other.
    let mut stream = TcpStream::connect(rig.address).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let request = format!("GET /api/events?number={number} HTTP/1.1\r\nHost: {}\r\n\r\n", rig.address);
    stream.write_all(request.as_bytes()).unwrap();
    let (mut count, mut name, mut data) = (0, String::new(), String::new());
    for line in BufReader::new(stream).lines().map(Result::unwrap) {
        if let Some(told) = line.strip_prefix("event: ") {
            name = told.to_owned();
        } else if let Some(told) = line.strip_prefix("data: ") {
            data = told.to_owned();
        } else if let Some(told) = line.strip_prefix("id: ") {
            let head = format!("event\n{number}\n{count}\n{name}\n");
            assert!(key.verifies(&[head.as_bytes(), data.as_bytes()], told), "event {count}, {name}");
            count += 1;
        }
        if count == 12 {
            return;
        }
    }
    panic!("the events ended after {count}");
}

/// An impostor may listen, and knows no key.
#[test]
fn an_impostor_on_a_port_is_no_rig() {
    let listener = TcpListener::bind("127.0.0.1:0").unwrap();
    let address = listener.local_addr().unwrap();
    let proof = "0".repeat(64);
    let thread = std::thread::spawn(move || {
        for answer in [
            "",
            "HTTP/1.1 200 OK\r\n\r\nchallenge",
            &format!("HTTP/1.1 200 OK\r\nX-Dpm-Proof: {proof}\r\n\r\nx"),
        ] {
            let (mut stream, _) = listener.accept().unwrap();
            let _ = stream.read(&mut [0; 1024]);
            stream.write_all(answer.as_bytes()).unwrap();
        }
    });
    let token = Token::random().unwrap();
    for _ in 0..3 {
        assert!(!is_rig(address, &token).unwrap());
    }
    thread.join().unwrap();
    assert!(is_rig(address, &token).is_err(), "nobody listens");
}
