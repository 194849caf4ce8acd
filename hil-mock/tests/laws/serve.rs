//! `hil-mock serve` as a program: what a second one on the same port is told, and what becomes of one that nobody listens to.

use std::io::{BufRead, BufReader};
use std::net::{TcpListener, UdpSocket};
use std::process::{Child, ChildStdout, Command, Stdio};
use std::time::{Duration, Instant};

/// The program, ended with the test, and its output, which must stay open as long as it speaks.
struct ServingProgram(Child, Option<BufReader<ChildStdout>>);

impl Drop for ServingProgram {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn command(words: &[&str]) -> Command {
    command_for(words, "60")
}

fn command_for(words: &[&str], seconds: &str) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_hil-mock"));
    command.arg("serve").args(words).args(["--seconds", seconds]);
    command
}

/// Starts it and waits for its first line, which it prints once it serves.
fn serve(words: &[&str]) -> ServingProgram {
    let mut served = ServingProgram(command(words).stdout(Stdio::piped()).spawn().expect("starts"), None);
    let mut line = String::new();
    let output = BufReader::new(served.0.stdout.take().expect("piped"));
    served.1.insert(output).read_line(&mut line).expect("a line");
    assert!(line.contains(" on "), "{words:?}: {line}");
    served
}

fn free_udp() -> String {
    UdpSocket::bind("127.0.0.1:0").expect("a port").local_addr().expect("bound").port().to_string()
}

fn free_tcp() -> String {
    TcpListener::bind("127.0.0.1:0").expect("a port").local_addr().expect("bound").port().to_string()
}

/// Noticed in use: a second NatNet server bound the same port without a word, and commands went to either of the two.
#[test]
fn a_second_server_on_the_same_port_is_refused_by_name() {
    let (natnet, vrpn, usb) = (free_udp(), free_tcp(), format!("127.0.0.1:{}", free_tcp()));
    for (words, flag) in [
        (vec!["natnet", "--command-port", &natnet], "--command-port"),
        (vec!["natnet", "--command-port", &natnet, "--multicast"], "--command-port"),
        (vec!["vrpn", "--port", &vrpn], "--port"),
        (vec!["projector", "--usbip", &usb], "--usbip"),
        (vec!["dlpc900", "--usbip", &usb], "--usbip"),
    ] {
        let mut first = serve(&words);
        let second = command(&words).output().expect("runs");
        let told = String::from_utf8_lossy(&second.stderr);
        assert_eq!(second.status.code(), Some(1), "{words:?}: {told}");
        let port = words[2].rsplit(':').next().expect("a port");
        assert!(first.0.try_wait().expect("asked").is_none(), "{words:?}: the first one ended");
        assert!(told.contains("another program") && told.contains(flag) && told.contains(port), "{told}");
    }
}

/// Noticed in use: `hil-mock serve ... | head` ended the device with a panic.
#[test]
fn a_reader_that_goes_away_does_not_end_the_device() {
    let (natnet, data, vrpn) = (free_udp(), free_udp(), free_tcp());
    for words in [
        vec!["natnet", "--command-port", &natnet, "--data-port", &data],
        vec!["vrpn", "--port", &vrpn],
        vec!["serial"],
        vec!["projector", "--port", "pty"],
        vec!["projector", "--usbip", "127.0.0.1:0", "--faults", "unplug@0.2s+0.1s"],
        vec!["dlpc900", "--usbip", "127.0.0.1:0"],
    ] {
        let (reader, writer) = std::io::pipe().expect("a pipe");
        drop(reader);
        let started = Instant::now();
        let output = command_for(&words, "1").stdout(writer).stderr(Stdio::piped()).output().expect("runs");
        let told = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && told.is_empty(), "{words:?}: {} {told}", output.status);
        assert!(started.elapsed() >= Duration::from_secs(1), "{words:?}: it served to the end of its time");
    }
}

/// Its sibling: an address that is another machine's is told apart from one that is taken.
#[test]
fn an_address_of_another_machine_is_named_as_such() {
    for words in [["natnet", "--bind", "192.0.2.1"], ["vrpn", "--bind", "192.0.2.1"]] {
        let output = command(&words).output().expect("runs");
        let told = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(1), "{told}");
        assert!(told.contains("192.0.2.1") && told.contains("not one of this machine's"), "{told}");
    }
}
