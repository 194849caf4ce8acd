//! The server under attack: its connections and its memory are bounded, and an order still gets through.

use crate::common::{send, RunWithPage, PATIENCE};
use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};
use std::time::{Duration, Instant};

/// Descriptors that this process has open.
fn descriptors() -> usize {
    std::fs::read_dir("/proc/self/fd").unwrap().count()
}

/// Memory of this process, KiB.
fn resident_kib() -> u64 {
    let text = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = text.lines().find(|l| l.starts_with("VmRSS:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse().unwrap()
}

fn connect(address: SocketAddr) -> Option<TcpStream> {
    let stream = TcpStream::connect_timeout(&address, Duration::from_secs(5)).ok()?;
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    Some(stream)
}

/// True if the server has ended the connection, or ends it within our patience.
fn is_ended(mut stream: &TcpStream) -> bool {
    let mut bytes = [0; 4096];
    loop {
        match stream.read(&mut bytes) {
            Ok(0) => return true,
            Ok(_) => {}
            Err(e) => return e.kind() != std::io::ErrorKind::WouldBlock,
        }
    }
}

#[test]
fn a_thousand_connections_hold_no_order_up_and_take_no_memory() {
    let rig = RunWithPage::start("thousand");
    rig.order("arm");
    let (files, memory) = (descriptors(), resident_kib());
    let host = format!("Host: {}\r\n", rig.address);
    let mut held = Vec::new();
    for k in 0..1000 {
        let Some(mut stream) = connect(rig.address) else { continue };
        // Silent ones, half a head, a whole request without an end of reading, viewers that never read, nonsense.
        let text = match k % 5 {
            0 => String::new(),
            1 => format!("GET / HTTP/1.1\r\n{host}X-"),
            2 => format!("GET / HTTP/1.1\r\n{host}\r\n"),
            3 => format!("GET /api/events HTTP/1.1\r\n{host}\r\n"),
            _ => "\u{0}\u{1}nonsense\r\n\r\n".into(),
        };
        let _ = stream.write_all(text.as_bytes());
        // Half of them close their end and go on reading.
        if k % 2 == 0 {
            let _ = stream.shutdown(Shutdown::Write);
        }
        held.push(stream);
        if k % 250 == 249 {
            let word = if k % 500 == 249 { "black" } else { "arm" };
            let begin = Instant::now();
            let told = rig.order(word);
            assert_eq!(told["done"].as_bool(), Some(true), "{told}");
            assert!(begin.elapsed() < Duration::from_secs(10), "{:?}", begin.elapsed());
        }
    }
    assert!(held.len() > 800, "{}", held.len());
    // Our own ends are open; the server's are few.
    let theirs = descriptors().saturating_sub(files + held.len());
    assert!(theirs <= 64 + 8, "{theirs} connections are held");
    let grown = resident_kib().saturating_sub(memory);
    assert!(grown < 64 << 10, "{grown} KiB more");
    drop(held);
    rig.wait("an end of the connections", || descriptors() <= files + 8);
    assert_eq!(rig.ask("GET", "/", &[]).status, 200);
}

#[test]
fn a_client_that_sends_its_request_byte_by_byte_is_cut_off() {
    let rig = RunWithPage::start("slow");
    let begin = Instant::now();
    let mut slow = connect(rig.address).unwrap();
    slow.set_read_timeout(Some(Duration::from_millis(100))).unwrap();
    let endless = format!("GET / HTTP/1.1\r\nHost: {}\r\nX-Slow: ", rig.address) + &"a".repeat(10_000);
    let ended = endless.bytes().any(|byte| {
        let sent = slow.write_all(&[byte]);
        let mut answer = [0; 512];
        let read = slow.read(&mut answer);
        assert!(begin.elapsed() < PATIENCE, "the server waits for it without end");
        sent.is_err() || read.is_ok() || read.is_err_and(|e| e.kind() != std::io::ErrorKind::WouldBlock)
    });
    assert!(ended);
}

#[test]
fn large_heads_and_bodies_and_any_bytes_are_refused() {
    let rig = RunWithPage::start("large");
    let host = rig.address.to_string();
    let [black, arm] = ["black", "arm"].map(|word| rig.signed("POST", &format!("/api/orders/{word}")));
    let status = |bytes: &[u8]| send(rig.address, bytes).map_or(0, |a| a.status);
    // A head that is too long or has too many lines. The server may end the connection before it is all sent.
    let long = format!("GET / HTTP/1.1\r\nHost: {host}\r\nX-Long: {}\r\n\r\n", "a".repeat(1 << 20));
    assert!([0, 431].contains(&status(long.as_bytes())));
    let many: String = (0..200).map(|k| format!("X-{k}: 1\r\n")).collect();
    assert!([0, 431].contains(&status(format!("GET / HTTP/1.1\r\nHost: {host}\r\n{many}\r\n").as_bytes())));
    // A body that is announced and never comes, or comes without end, holds nothing up: an order has none.
    let announced = format!(
        "POST /api/orders/black HTTP/1.1\r\nHost: {host}\r\nX-Dpm-Order: {black}\r\nContent-Length: 99999999999\r\n\r\n"
    );
    assert_eq!(status(announced.as_bytes()), 400);
    let chunked = format!(
        "POST /api/orders/arm HTTP/1.1\r\nHost: {host}\r\nX-Dpm-Order: {arm}\r\nTransfer-Encoding: chunked\r\n\r\nfffffff\r\n{}",
        "b".repeat(1 << 16)
    );
    assert!([0, 400].contains(&status(chunked.as_bytes())));
    for bytes in [
        b"\r\n\r\n\r\n".as_slice(),
        b"GET / HTTP/9.9\r\n\r\n",
        b"GET http://evil.example/ HTTP/1.1\r\nHost: evil.example\r\n\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03",
        b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
        b"GET / HTTP/1.1\r\nHost: a\r\nContent-Length: 1\r\nTransfer-Encoding: chunked\r\n\r\n",
    ] {
        let mut stream = connect(rig.address).unwrap();
        let _ = stream.write_all(bytes);
        let _ = stream.shutdown(Shutdown::Write);
        assert!(is_ended(&stream), "{bytes:?}");
    }
    assert_eq!(rig.ask("GET", "/", &[]).status, 200);
}

#[test]
fn viewers_are_few_and_a_place_becomes_free_when_one_goes() {
    let rig = RunWithPage::start("viewers");
    let request = format!("GET /api/events HTTP/1.1\r\nHost: {}\r\n\r\n", rig.address);
    let view = || {
        let mut stream = connect(rig.address).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut head = [0; 12];
        stream.read_exact(&mut head).unwrap();
        (String::from_utf8_lossy(&head[9..12]).into_owned(), stream)
    };
    let mut all: Vec<_> = (0..8).map(|_| view()).collect();
    assert!(all.iter().all(|(status, _)| status == "200"));
    assert_eq!(view().0, "503");
    all.remove(3);
    let begin = Instant::now();
    while view().0 != "200" {
        assert!(begin.elapsed() < PATIENCE, "the place does not become free");
        std::thread::sleep(Duration::from_millis(50));
    }
}

#[test]
fn a_flood_of_requests_is_slowed_down_but_no_order_is() {
    let rig = RunWithPage::start("flood");
    let request = format!("GET /api/state HTTP/1.1\r\nHost: {}\r\n\r\n", rig.address);
    let stop = std::sync::atomic::AtomicBool::new(false);
    let address = rig.address;
    std::thread::scope(|scope| {
        for _ in 0..8 {
            scope.spawn(|| {
                while !stop.load(std::sync::atomic::Ordering::Relaxed) {
                    let Some(mut stream) = connect(address) else { continue };
                    for _ in 0..50 {
                        if stream.write_all(request.as_bytes()).is_err()
                            || stream.read(&mut [0; 65536]).is_err()
                        {
                            break;
                        }
                    }
                }
            });
        }
        std::thread::sleep(Duration::from_millis(300));
        for word in ["black", "arm", "safe", "arm"] {
            let begin = Instant::now();
            let told = rig.order(word);
            assert_eq!(told["done"].as_bool(), Some(true), "{told}");
            assert!(begin.elapsed() < Duration::from_secs(10), "{:?}", begin.elapsed());
        }
        stop.store(true, std::sync::atomic::Ordering::Relaxed);
    });
}
