//! Describes the state of a NatNet client in one line for people: what works, or why no pose arrives and what to try.

use super::client::{NatNetClient, Silence};
use std::fmt::Write;
use std::net::Ipv4Addr;

/// The text of [`crate::tracker::Tracker::status`].
pub(super) fn status(client: &NatNetClient) -> String {
    let inside = client.inside();
    let mut text = match client.server() {
        Some(s) => match client.contradicted() {
            None => format!("{} speaks NatNet {}", quoted(&s.name), client.version()),
            Some(announced) => format!(
                "{} announces NatNet {announced} and sends frames in the layout of {}, which is followed",
                quoted(&s.name),
                if client.version().has_section_sizes() { "4.1 and later" } else { "3.0 to 4.0" }
            ),
        },
        None => "no server".into(),
    };
    if let Some(reason) = client.silence() {
        text.push_str("; ");
        explain(&mut text, client, &reason);
    }
    match client.clock_map() {
        Some(map) => {
            let (ppb, _) = map.skew_ppb();
            let rtt_us = map.min_round_trip_ns().unwrap_or(0) as f64 / 1e3;
            let _ = write!(
                text,
                "; clock by {} echoes, round trip {rtt_us:.0} us, skew {:.1} ppm",
                inside.echoes,
                ppb as f64 / 1e3
            );
        }
        None if client.server().is_some() => {
            text.push_str("; no echo answered: capture times are arrival less the server's own latency");
        }
        None => {}
    }
    let _ = write!(text, "; {}", client.counters());
    for (name, count) in [("version changes", inside.version_changes), ("clock doubts", inside.clock_doubts)]
    {
        if count > 0 {
            let _ = write!(text, ", {name} {count}");
        }
    }
    if let Some(refused) = refused_ports(client) {
        let _ = write!(text, "; WARNING: {refused}");
    }
    if inside.is_filtered {
        text.push_str("; strangers flooded the port and are dropped by the kernel, uncounted");
    }
    text
}

fn refused_ports(client: &NatNetClient) -> Option<String> {
    let (refused, inside) = (client.counters().packets.foreign_port, client.inside());
    (refused > 0).then(|| {
        format!(
            "{refused} packets came from {} but from ports {:?}, which are not the server's, and were refused: another program there \
             sends tracker data, or tracker.command_port and tracker.data_port are not those of the server",
            inside.config.server, inside.strange_ports
        )
    })
}

/// The text of [`crate::tracker::Tracker::warning`].
pub(super) fn warning(client: &NatNetClient) -> Option<String> {
    let mut all: Vec<String> = refused_ports(client).into_iter().collect();
    let elsewhere = client.counters().packets.foreign_source;
    if elsewhere > 0 {
        let server = client.inside().config.server;
        all.push(format!("{elsewhere} packets came from other addresses than {server} and were refused"));
    }
    if let Some(announced) = client.contradicted() {
        all.push(format!(
            "the server announces NatNet {announced}, and its frames have another layout, which is followed: update the tracking \
             software, or choose its bit stream anew"
        ));
    }
    (!all.is_empty()).then(|| format!("natnet tracker: {}", all.join("; ")))
}

fn explain(text: &mut String, client: &NatNetClient, reason: &Silence) {
    let inside = client.inside();
    let config = inside.config;
    let _ = match reason {
        Silence::NoAnswer => write!(
            text,
            "{}:{} did not answer {} attempts to connect: check the address, the firewall and that streaming is switched on",
            config.server, config.command_port, inside.connects_sent
        ),
        Silence::Version(version) => write!(
            text,
            "the server speaks NatNet {version}; 3.0 to 4.2 are understood: update the tracking software"
        ),
        Silence::WentSilent => {
            write!(text, "{} has fallen silent: is its program still running, the cable still in?", config.server)
        }
        Silence::NoFrames => explain_no_frames(text, client),
        Silence::Unreadable => {
            write!(
                text,
                "no frame can be read: they have the layout neither of NatNet 3.0 to 4.0 nor of 4.1 to 4.2, whatever the server announces; \
                 choose a bit stream from 3.0 to 4.2 in the tracking software, and see whether something else sends to port {}",
                config.data_port
            )
        }
        Silence::NoKnownBody => {
            let names: Vec<String> =
                client.models().iter().take(16).map(|m| format!("{} = {}", quoted(&m.name), m.id)).collect();
            let wanted: Vec<String> = config.bodies.iter().take(16).map(|b| quoted(&b.name)).collect();
            write!(
                text,
                "none of the rig's bodies ({}) is in the frames: numbers seen {:?}, names known to the server {}",
                wanted.join(", "),
                inside.strangers,
                if names.is_empty() { "none".into() } else { names.join(", ") }
            )
        }
        Silence::NotTracked => write!(text, "the server sees none of the rig's bodies: occluded, or outside the volume?"),
    };
}

fn explain_no_frames(text: &mut String, client: &NatNetClient) -> std::fmt::Result {
    let inside = client.inside();
    let config = inside.config;
    let theirs = client.server().and_then(|s| s.multicast).map(Ipv4Addr::from);
    match (config.multicast, theirs) {
        (Some(group), None) => {
            write!(text, "the server streams unicast, this client waits for group {group}: leave `multicast` out")
        }
        (None, Some(theirs)) => {
            write!(text, "the server streams to group {theirs}, this client asked for unicast: set `multicast = \"{theirs}\"`")
        }
        (Some(ours), Some(theirs)) if ours != theirs => {
            write!(text, "the server streams to group {theirs}, this client listens to {ours}")
        }
        (Some(group), _) => write!(
            text,
            "nothing arrives for group {group} on interface {}: wrong interface, firewall, or a network without multicast (Wi-Fi)",
            config.local
        ),
        (None, None) => write!(
            text,
            "no frame arrives: is the server live, does a firewall drop UDP?{}",
            inside.data_problem.map(|p| format!(" {p}")).unwrap_or_default()
        ),
    }
}

fn quoted(name: &str) -> String {
    format!("{name:?}")
}
