//! `hil-mock serve` as a program: what a second one on the same port is told.

use std::io::{BufRead, BufReader};
use std::net::{TcpListener, UdpSocket};
use std::process::{Child, ChildStdout, Command, Stdio};

/// The program, ended with the test, and its output, which must stay open as long as it speaks.
struct Served(Child, Option<BufReader<ChildStdout>>);

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

fn command(words: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_hil-mock"));
    command.arg("serve").args(words).args(["--seconds", "60"]);
    command
}

/// Starts it and waits for its first line, which it prints once it serves.
fn serve(words: &[&str]) -> Served {
    let mut served = Served(command(words).stdout(Stdio::piped()).spawn().expect("starts"), None);
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
