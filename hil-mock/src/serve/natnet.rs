//! `hil-mock serve natnet`: a running NatNet server.

use super::bodies::{clock_from_now, TrackerArguments};
use super::say;
use clap::{Args, ValueEnum};
use dpm_device::tracker::natnet::Version;
use hil_mock::natnet_host::NatNetHost;
use hil_mock::natnet_server::{NatNetServer, NatNetServerConfig, Streaming, UnicastTo};
use std::error::Error;
use std::net::{Ipv4Addr, SocketAddrV4};
use std::time::{Duration, Instant};

/// Arguments of `hil-mock serve natnet`.
#[derive(Args)]
pub(crate) struct NatNetArguments {
    /// Address to serve on; with --multicast also the interface that the group is sent through
    #[arg(long, default_value = "127.0.0.1")]
    bind: Ipv4Addr,
    /// UDP port for commands
    #[arg(long, default_value_t = 1510)]
    command_port: u16,
    /// UDP port for frames
    #[arg(long, default_value_t = 1511)]
    data_port: u16,
    /// Stream to a group instead of to each client
    #[arg(long, value_name = "GROUP", num_args = 0..=1, default_missing_value = "239.255.42.99")]
    multicast: Option<Ipv4Addr>,
    /// Where unicast frames go: to the socket that connected, to the data port of its host, or to both
    #[arg(long, value_enum, default_value_t = UnicastWord::Both)]
    unicast: UnicastWord,
    /// Version of the bit stream: 3.0, 3.1, 4.0, 4.1 or 4.2
    #[arg(long, default_value = "4.1")]
    natnet_version: String,
    /// Send frames and names in the layout of this version, whatever is announced: a server that announces one version and sends
    /// another
    #[arg(long, value_name = "VERSION")]
    sends: Option<String>,
    /// Send names in the layout of this version, where it differs from that of the frames
    #[arg(long, value_name = "VERSION")]
    sends_names: Option<String>,
    /// How much faster than this machine's the server's clock runs, parts per million
    #[arg(long, default_value_t = 0.0)]
    clock_skew_ppm: f64,
    #[command(flatten)]
    tracker: TrackerArguments,
}

#[derive(Clone, Copy, ValueEnum)]
enum UnicastWord {
    Command,
    Data,
    Both,
}

/// Serves until the time is over or the socket fails.
pub(super) fn run(arguments: &NatNetArguments) -> Result<(), Box<dyn Error>> {
    let (names, source) = arguments.tracker.source()?;
    let names: Vec<&str> = names.iter().map(String::as_str).collect();
    let mut config = NatNetServerConfig::new(&names);
    config.version = version_of("--natnet-version", &arguments.natnet_version)?;
    let layout = |flag, text: &Option<String>| text.as_deref().map(|t| version_of(flag, t)).transpose();
    config.frame_layout = layout("--sends", &arguments.sends)?;
    config.model_layout = layout("--sends-names", &arguments.sends_names)?.or(config.frame_layout);
    config.data_port = arguments.data_port;
    config.clock_skew_ppb = (arguments.clock_skew_ppm * 1e3) as i64;
    config.streaming = match (arguments.multicast, arguments.unicast) {
        (Some(group), _) if group.is_multicast() => Streaming::Multicast(group),
        (Some(group), _) => {
            return Err(format!("--multicast {group}: not a group (224.0.0.0 to 239.255.255.255)").into())
        }
        (None, UnicastWord::Command) => Streaming::Unicast(UnicastTo::CommandSocket),
        (None, UnicastWord::Data) => Streaming::Unicast(UnicastTo::DataPort),
        (None, UnicastWord::Both) => Streaming::Unicast(UnicastTo::Both),
    };
    let (version, streaming) = (config.version, config.streaming);
    let bodies = config.bodies.clone();
    let server = NatNetServer::new(config, source)?;
    let address = SocketAddrV4::new(arguments.bind, arguments.command_port);
    let host = NatNetHost::start(server, streaming, address, clock_from_now())
        .map_err(|e| super::cannot_serve("NatNet", address, &e, "--command-port"))?;
    say(format_args!(
        "NatNet {version} on {}, {streaming:?}, data port {}",
        host.address(),
        arguments.data_port
    ));
    for (name, id) in bodies {
        say(format_args!("  body {id}: {name}"));
    }
    let started = Instant::now();
    while host.is_running() {
        if arguments.tracker.seconds.is_some_and(|s| started.elapsed().as_secs_f64() >= s) {
            say(format_args!("{} frames sent", host.frames_sent()));
            return Ok(());
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Err("the network socket failed".into())
}

/// `4.1` as a version.
fn version_of(flag: &str, text: &str) -> Result<Version, String> {
    let parts = text.split_once('.');
    let version = parts.and_then(|(a, b)| Some(Version::new(a.parse().ok()?, b.parse().ok()?)));
    version.ok_or_else(|| format!("{flag} {text}: write it as 4.1"))
}
