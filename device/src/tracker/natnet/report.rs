//! Describes the state of a NatNet client in one line for people: what works, or why no pose arrives and what to try.

use super::client::{NatNetClient, Silence};
use super::wire::Version;
use crate::tracker::BodyKey;
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
        None if matches!(client.silence(), Some(Silence::Version(_))) => "a server answers".into(),
        None => "no server".into(),
    };
    if let Some(reason) = client.silence() {
        text.push_str("; ");
        explain(&mut text, client, &reason);
        // That none is there is explained with all names.
        if !matches!(reason, Silence::NoKnownBody) {
            text.extend(missing(client).map(|told| format!("; {told}")));
        }
    } else {
        text.extend(missing(client).map(|told| format!("; {told}")));
    }
    text.extend(doubles(client).into_iter().map(|told| format!("; {told}")));
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

/// The server's names with their numbers.
fn names(client: &NatNetClient) -> String {
    let names: Vec<String> =
        client.models().iter().take(16).map(|m| format!("{} = {}", quoted(&m.name), m.id)).collect();
    if names.is_empty() {
        "none".into()
    } else {
        names.join(", ")
    }
}

/// A name without what a reader does not see: case, and blanks at its ends or doubled.
fn folded(name: &str) -> String {
    name.split(|c: char| c.is_whitespace() || matches!(c, '_' | '-'))
        .filter(|p| !p.is_empty())
        .fold(String::new(), |all, part| all + " " + &part.to_lowercase())
}

/// The rig's bodies that the server does not have, and what it has; `None` if it has all, or has told nothing yet.
fn missing(client: &NatNetClient) -> Option<String> {
    let models = client.models();
    let is_known = |body: &&BodyKey| body.id.is_some() || models.iter().any(|m| m.name == body.name);
    let bodies = &client.inside().config.bodies;
    let missing: Vec<&BodyKey> = bodies.iter().filter(|body| !is_known(body)).take(16).collect();
    if models.is_empty() || missing.is_empty() {
        return None;
    }
    let told = missing.iter().map(|body| {
        let near = models.iter().find(|m| folded(&m.name) == folded(&body.name));
        let near = near.map_or(String::new(), |m| format!(" (did you mean {}?)", quoted(&m.name)));
        format!("{}{near}", quoted(&body.name))
    });
    let told: Vec<String> = told.collect();
    Some(format!("{} is not there; the server has {}", told.join(", "), names(client)))
}

/// Bodies of the rig that the server has twice, by name or by number.
fn doubles(client: &NatNetClient) -> Vec<String> {
    let mut told = Vec::new();
    let models = client.models();
    for body in client.inside().config.bodies.iter().take(64) {
        let of_name: Vec<i32> = models.iter().filter(|m| m.name == body.name).map(|m| m.id).collect();
        if of_name.len() > 1 {
            let ids: Vec<String> = of_name.iter().take(8).map(i32::to_string).collect();
            told.push(format!(
                "{} bodies of the server are named {} ({}): which one moves it is chance, rename the others",
                of_name.len(),
                quoted(&body.name),
                ids.join(", ")
            ));
        }
        let Some(id) = of_name.first() else { continue };
        let of_id: Vec<String> =
            models.iter().filter(|m| m.id == *id).map(|m| quoted(&m.name)).take(8).collect();
        let is_told = told.iter().any(|t| t.contains(&format!("have number {id}:")));
        if of_id.len() > 1 && of_name.len() == 1 && !is_told {
            told.push(format!(
                "{} bodies of the server have number {id}: {}, of which only one can be followed; give each a number of its own",
                of_id.len(),
                of_id.join(", ")
            ));
        }
    }
    told
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
    all.extend(doubles(client));
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
        Silence::Version(version) if *version > Version::V4_2 => write!(
            text,
            "the server speaks NatNet {version}, which is newer than this program; 3.0 to 4.2 are understood: choose bit stream 4.1 in \
             the tracking software"
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
            let wanted: Vec<String> = config.bodies.iter().take(16).map(|b| quoted(&b.name)).collect();
            write!(
                text,
                "none of the rig's bodies ({}) is in the frames: numbers seen {:?}, names known to the server {}",
                wanted.join(", "),
                inside.strangers,
                names(client)
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
