//! The overview of several rigs in a real browser: two rigs with mocks and an address where nobody listens.
//!
//! Without a Chromium this fails. `./x test --all` installs one, and leaves this out by name where none can be had.

use crate::browser;
use crate::browser::{Browser, PATIENCE};
use crate::cli_common::{code, dpm, err, own_folder, start, start_with, ChildProgram};
use std::net::TcpListener;
use std::path::PathBuf;

/// Addresses that were free a moment ago.
fn addresses<const N: usize>() -> [String; N] {
    let all = [(); N].map(|()| TcpListener::bind("127.0.0.1:0").unwrap());
    all.map(|listener| listener.local_addr().unwrap().to_string())
}

/// A rig on software Vulkan, with its page at `address` and a state folder of its own.
fn rig(address: &str, state: &str) -> ChildProgram {
    let page = format!("--page={address}");
    let args = ["demo", "--raster", "64x48", "--pace", "real", "--set", "run.frames=0", "--set"];
    let state = own_folder(state);
    let mut rig = start_with(
        &[args.as_slice(), &["output.images=false", &page]].concat(),
        &[("DPM_STATE_DIR", state.to_str().unwrap())],
    );
    rig.wait_for_line(PATIENCE, |line| line.contains("page: http"));
    rig
}

/// What stands in the part `of` of the card of the rig that was named as the `k`th, from 0.
fn part(k: usize, of: &str) -> String {
    format!("(document.querySelectorAll('article')[{k}]?.querySelector('{of}')?.textContent ?? '')")
}

fn is_summary(text: &str) -> String {
    format!("document.getElementById('summary')?.textContent === '{text}'")
}

fn check_layout(browser: &mut Browser, width: u32) {
    let wide = browser.value("document.documentElement.scrollWidth").as_f64().unwrap();
    assert!(wide <= f64::from(width), "{wide} of {width}: something sticks out sideways");
    let word = browser.value("parseFloat(getComputedStyle(document.querySelector('.word')).fontSize)");
    assert!(word.as_f64().unwrap() >= 32.0, "the state cannot be read from two metres: {word}");
    let link = browser.value("document.querySelector('article a').getBoundingClientRect().height");
    assert!(link.as_f64().unwrap() >= 44.0, "a link is too small for a finger: {link}");
}

#[test]
fn the_overview_shows_every_rig_and_says_which_one_is_gone() {
    let program = &browser::installed();
    let [left, right, nobody, own] = addresses();
    let pictures = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("rigs");
    std::fs::create_dir_all(&pictures).unwrap();
    let (first, second) = (rig(&left, "left"), rig(&right, "right"));
    let names = [format!("Left wall={left}"), format!("Right wall={right}"), format!("Floor={nobody}")];
    let args = ["rigs", &names[0], &names[1], &names[2], "--listen", &own];
    let mut overview = start(&args);
    overview.wait_for_line(PATIENCE, |line| line.contains("shows 3 rigs"));
    let mut browser = Browser::open(program, &own_folder("browser"), &format!("http://{own}/"));
    browser.screen(1280, 800, false);
    browser.wait("summary", &is_summary("3 rigs, 2 lit, 1 without contact"));
    for k in 0..2 {
        browser.wait("state", &format!("{} === 'LIT'", part(k, ".word")));
        browser.wait("rate", &format!("parseFloat({}) > 0", part(k, ".v")));
        browser.wait("bodies", &format!("{}.includes('all 2 bodies lit')", part(k, "ul")));
    }
    browser.wait("no contact", &format!("{} === 'NO CONTACT'", part(2, ".word")));
    browser.wait("reason", &format!("{}.includes('nobody listens there')", part(2, ".said")));
    check_layout(&mut browser, 1280);
    browser.picture(&pictures.join("desktop.png"), false);

    // A phone, while one rig is black.
    let black = dpm(&["black", "--pid", &first.id().to_string()], &[]);
    assert_eq!(code(&black), 0, "{}", err(&black));
    browser.wait("black", &format!("{} === 'DARK BY ORDER'", part(0, ".word")));
    browser.wait("summary", &is_summary("3 rigs, 1 lit, 1 without contact"));
    browser
        .wait("no light", &format!("{}.includes('no light; the tracker sees all 2 bodies')", part(0, "ul")));
    browser.screen(390, 844, true);
    browser.wait("narrow page", "innerWidth === 390");
    check_layout(&mut browser, 390);
    browser.picture(&pictures.join("phone.png"), true);

    // A rig goes: what it told last stays, dimmed.
    drop(second);
    browser.wait("silence", &format!("{} === 'NO CONTACT'", part(1, ".word")));
    browser.wait("summary", &is_summary("3 rigs, 0 lit, 2 without contact"));
    browser.wait("old bodies", &format!("{}.includes('when last heard: all 2 bodies lit')", part(1, "ul")));
    browser.wait("age", &format!("/heard \\d+ s ago/.test({})", part(1, ".about")));
    assert_eq!(browser.value("document.querySelectorAll('article')[1].className"), "no");
    browser.picture(&pictures.join("phone-gone.png"), true);

    // The key 1 goes to the first rig's link, and Enter follows it. The rig takes a link of this machine.
    assert_eq!(browser.complaints, Vec::<String>::new());
    browser.value("document.querySelector('article a').removeAttribute('target')");
    browser.press("1");
    browser.wait("focus", "document.activeElement === document.querySelector('article a')");
    browser.press("Enter");
    let is_rig = format!("location.host === '{left}' && document.getElementById('state')?.textContent");
    browser.wait("page of the rig", &format!("({is_rig}) === 'DARK BY ORDER'"));
    // Not at once: a page that is left answers nothing.
    browser.value("void setTimeout(() => history.back(), 50)");
    browser.wait("overview", &is_summary("3 rigs, 0 lit, 2 without contact"));

    // The overview itself goes.
    drop(overview);
    browser.wait("word that the overview is gone", "document.body.classList.contains('stale')");
    browser.wait("summary", &is_summary("NO CONTACT with the overview"));
    browser.picture(&pictures.join("phone-stale.png"), false);
    let mut overview = start(&args);
    overview.wait_for_line(PATIENCE, |line| line.contains("shows 3 rigs"));
    browser.wait("return", &is_summary("3 rigs, 0 lit, 2 without contact"));
    drop((first, overview));
}
