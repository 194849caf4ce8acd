//! A display of the kernel's own (vkms): what is scanned out is what was packed, by the pixels that the kernel writes back
//! and by its checksum of every frame.
//!
//! `./x hil` runs this in a virtual machine with `DPM_VKMS=1`. The program is also the guardian of its own runs.

mod checksum;
#[path = "../laws/common/mod.rs"]
mod common;
// Its bad manners are for the tests of the client (`host/display/src/lease/wayland/tests.rs`).
#[allow(dead_code)]
#[path = "../laws/common/compositor.rs"]
mod compositor;
mod demo;
mod lease;
mod oracle;
mod rig;
mod stepped;
mod ways_out;
mod witness;
mod writeback;

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use std::sync::atomic::Ordering;

use dpm_display::card::{cards, open_for, Card};
use dpm_display::encoding::Encoding;
use dpm_display::scan_out::DisplayError;
use dpm_display::set_up::DisplaySettings;
use dpm_display::transport::{on_card, DisplayTransport};
use dpm_handoff::wake::WaitPolicy;

use checksum::{checksum, checksums};
use rig::{open_by, opener, pixels, settings, stream, CONNECTOR};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    match arguments.first().map(String::as_str) {
        Some("guard") => ways_out::guard(&arguments),
        Some("run") => ways_out::run_for_ever(),
        Some("run-on-lease") => lease::run_for_ever(),
        _ if std::env::var_os("DPM_VKMS").is_none() => {
            println!("not in the machine of `./x hil`: nothing is tested");
        }
        _ => {
            for (name, test) in [
                ("what_is_there_is_listed_and_refused_by_name", refusals as fn()),
                ("every_frame_is_scanned_out_bit_for_bit", bits),
                (
                    "frames_of_the_demo_are_read_back_one_by_one_and_missed_flips_are_counted",
                    stepped::demo_frames,
                ),
                ("an_unplugged_display_is_black_and_comes_back", ways_out::unplugged),
                ("a_killed_run_is_black", ways_out::killed),
                ("what_a_desktop_lends_is_shown_lost_and_taken_up_again", lease::all),
            ] {
                println!("test {name} ...");
                test();
                println!("test {name} ... ok");
            }
            println!("HIL-VKMS-OK");
        }
    }
}

fn refusals() {
    let paths = cards();
    println!("  cards: {paths:?}");
    let mine = Card::open(&paths[0]).expect("a card that nobody drives");
    assert!(matches!(Card::open(&paths[0]), Err(DisplayError::InUse(_))), "one program at a time");
    drop(mine);
    let refused = |change: &dyn Fn(&mut DisplaySettings)| {
        let mut settings = settings(Encoding::Planes24);
        change(&mut settings);
        let opener = on_card(|| open_for(None, Some(CONNECTOR)), settings);
        DisplayTransport::open(opener, WaitPolicy::Park, 0).err().expect("refused").to_string()
    };
    let told = refused(&|s| s.mode = "1024x768@200".parse().unwrap());
    println!("  {told}");
    assert!(told.contains("1024x768@60"), "{told}");
    let told = refused(&|s| s.mode = "1024x768@60".parse().unwrap());
    assert!(told.contains("projector.width = 160"), "{told}");
    assert!(refused(&|s| s.connector = Some("DP-1".into())).contains(CONNECTOR));
    let nowhere = Card::open(Path::new("/dev/dri/card9"));
    assert!(matches!(nowhere, Err(DisplayError::NoCard(_))));
}

/// A run at its own pace, without a stop: the kernel's checksum of every frame.
fn bits() {
    for encoding in [Encoding::Rgb8, Encoding::Planes24] {
        let (mut display, clock) = open_by(opener(encoding));
        let told = checksums();
        let sent = stream(&mut display, clock.as_ref(), encoding, |sent, _| sent >= 120);
        let counts = display.counts().unwrap();
        let missed = counts.missed.load(Ordering::Relaxed);
        let taken = counts.taken.load(Ordering::Relaxed);
        println!("  {taken} pictures taken, {missed} blanks missed");
        let black = checksum(&vec![0; pixels(encoding, 0).len()]);
        let known: BTreeMap<u32, u64> =
            sent.iter().map(|(id, _)| (checksum(&pixels(encoding, *id)), *id)).collect();
        let (mut seen, mut blacks, mut newest) = (BTreeSet::new(), 0, 0);
        for (blank, sum) in told.try_iter() {
            if sum == black {
                blacks += 1;
                continue;
            }
            let id = *known
                .get(&sum)
                .unwrap_or_else(|| panic!("blank {blank}: {sum:08x} is no frame that was sent"));
            assert!(id >= newest, "frame {id} behind {newest}");
            newest = id;
            seen.insert(id);
        }
        println!("  {} of {} frames seen by the kernel's checksum, {blacks} black", seen.len(), sent.len());
        assert!(seen.len() * 2 >= sent.len(), "most frames were scanned out");
        drop(display);
    }
}
