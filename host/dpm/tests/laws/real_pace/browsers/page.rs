//! The live page in a real browser: it shows the rig, its buttons and keys act on the mock's light, and it comes back
//! when the rig does.
//!
//! Without a Chromium this fails. `./x test --all` installs one, and leaves this out by name where none can be had.

use crate::browser;
use crate::browser::{Browser, PATIENCE};
use crate::cli_common;
use crate::cli_common::{code, dpm, err, out, own_folder, start_with};
use std::net::TcpListener;
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// A rig on software Vulkan, with its page at `address`.
fn rig(address: &str) -> cli_common::ChildProgram {
    let page = format!("--page={address}");
    let args = ["demo", "--raster", "160x120", "--pace", "real", "--set", "run.frames=0", "--set"];
    start_with(&[args.as_slice(), &["output.images=false", &page]].concat(), &[])
}

/// The mean brightness of the picture of the light, 0 to 255, as the browser draws it; -1 if there is none, or the next
/// one came while this one was read.
const BRIGHTNESS: &str = "(async () => {
    const image = document.getElementById('light');
    if (image.hidden || !image.src) return -1;
    try { await image.decode(); } catch { return -1; }
    const canvas = document.createElement('canvas');
    [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
    const context = canvas.getContext('2d');
    context.drawImage(image, 0, 0);
    const all = context.getImageData(0, 0, canvas.width, canvas.height).data;
    let sum = 0;
    for (let k = 0; k < all.length; k += 4) sum += all[k] + all[k + 1] + all[k + 2];
    return sum / (all.length / 4 * 3);
})()";

/// Waits until the brightness is as `is` says, and returns it.
fn wait_for_light(browser: &mut Browser, what: &str, is: impl Fn(f64) -> bool) -> f64 {
    let begin = Instant::now();
    loop {
        let mean = browser.value(BRIGHTNESS).as_f64().unwrap();
        if is(mean) {
            return mean;
        }
        assert!(begin.elapsed() < PATIENCE, "no {what}: the light is {mean}");
        std::thread::sleep(Duration::from_millis(100));
    }
}

/// What must hold of the page at any size.
fn check_layout(browser: &mut Browser, width: u32) {
    let wide = browser.value("document.documentElement.scrollWidth").as_f64().unwrap();
    assert!(wide <= f64::from(width), "{wide} of {width}: something sticks out sideways");
    for id in ["black", "freeze", "safe", "arm"] {
        let r = browser.value(&format!("document.getElementById('{id}').getBoundingClientRect().toJSON()"));
        let of = |key: &str| r[key].as_f64().unwrap();
        assert!(of("height") >= 44.0 && of("width") >= 44.0, "{id} is too small for a finger: {r}");
        assert!(of("left") >= 0.0 && of("right") <= f64::from(width), "{id}: {r}");
    }
    let state = browser.value("parseFloat(getComputedStyle(document.getElementById('state')).fontSize)");
    assert!(state.as_f64().unwrap() >= 32.0, "the state cannot be read from two metres: {state}");
}

/// Exposure by the keyboard alone: the picture follows, keys of orders act inside the field, and undo takes it back.
fn change_exposure(browser: &mut Browser) {
    let field = "document.getElementById('field-exposure-0')";
    let told = "document.getElementById('changed').textContent";
    browser.wait("parameters", &format!("{field}.value === '1' && !{field}.disabled"));
    let before = wait_for_light(browser, "light", |mean| mean > 1.0);
    browser.value(&format!("{field}.focus(), {field}.select()"));
    browser.type_in("0.1");
    browser.press("Enter");
    browser.wait("answer", &format!("{told}.startsWith('ok: exposure is 0.1, from frame ')"));
    browser.wait("use", "document.getElementById('used').textContent === 'in use, not saved'");
    wait_for_light(browser, "darker light", |mean| mean > 0.0 && mean < 0.5 * before);
    browser.press("b");
    browser.wait("state", "document.getElementById('state').textContent === 'DARK BY ORDER'");
    browser.press("a");
    browser.wait("state", "document.getElementById('state').textContent === 'LIT'");
    browser.value("document.getElementById('save').click()");
    browser.wait("refusal", &format!("{told}.includes('has no rig file')"));
    browser.press("u");
    browser.wait(
        "undo",
        &format!("{told}.startsWith('ok: exposure is 1, from frame ') && {field}.value === '1'"),
    );
    wait_for_light(browser, "light as before", |mean| mean > 0.7 * before);
    // The slider, by its keys.
    browser.value("document.getElementById('slide-exposure-0').focus()");
    browser.press("ArrowRight");
    browser.wait("slider", &format!("Number({field}.value) > 1 && {told}.includes('from frame')"));
    browser.press("u");
    browser.wait("undo", &format!("{field}.value === '1'"));
    browser.value("document.activeElement.blur()");
}

#[test]
fn the_page_shows_the_rig_obeys_its_operator_and_comes_back() {
    let program = &browser::installed();
    // A free port that stays the same over the restart.
    let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    let pictures = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("page");
    std::fs::create_dir_all(&pictures).unwrap();
    let mut first = rig(&address);
    first.wait_for_line(PATIENCE, |line| {
        assert!(!line.contains("key="), "a log is no place for the key: {line}");
        line.contains("page: http")
    });
    let link = dpm(&["page", &address], &[]);
    assert_eq!(code(&link), 0, "{}", err(&link));
    let link = out(&link).trim().to_owned();
    let mut browser = Browser::open(program, &own_folder("browser"), &link);
    browser.screen(1280, 900, false);
    browser.wait("state", "document.getElementById('state').textContent === 'LIT'");
    assert_eq!(browser.value("location.hash"), "", "the key stays in the address");
    browser.wait("buttons", "!document.getElementById('black').disabled");
    wait_for_light(&mut browser, "light", |mean| mean > 1.0);
    browser.wait("bodies", "document.querySelectorAll('#bodies tr').length === 2");
    browser.wait("latency", "parseFloat(document.getElementById('p50').textContent) > 0");
    browser.wait("picture of the observer", "!document.getElementById('viewer').hidden");
    check_layout(&mut browser, 1280);
    assert_eq!(browser.value("document.getElementById('guide').pathname"), "/calibration");
    browser.picture(&pictures.join("desktop.png"), false);

    // A click and a key, each answered after the light had obeyed.
    browser.click("black");
    browser.wait(
        "answer",
        "document.getElementById('answer').textContent.startsWith('BLACK: ok: projector black')",
    );
    browser.wait("state", "document.getElementById('state').textContent === 'DARK BY ORDER'");
    wait_for_light(&mut browser, "dark", |mean| mean == 0.0);
    browser.picture(&pictures.join("desktop-black.png"), false);
    browser.press("a");
    browser
        .wait("answer", "document.getElementById('answer').textContent.startsWith('ARM: ok: projector up')");
    wait_for_light(&mut browser, "light again", |mean| mean > 1.0);

    change_exposure(&mut browser);
    browser.picture(&pictures.join("desktop-whole.png"), true);

    // A phone.
    browser.screen(390, 844, true);
    browser.wait("narrow page", "innerWidth === 390");
    check_layout(&mut browser, 390);
    browser.picture(&pictures.join("phone.png"), false);
    browser.picture(&pictures.join("phone-whole.png"), true);
    browser.click("safe");
    browser.wait("answer", "document.getElementById('answer').textContent.startsWith('SAFE: ok: ')");
    browser.wait("state", "document.getElementById('state').textContent === 'DARK BY ORDER'");
    wait_for_light(&mut browser, "dark", |mean| mean == 0.0);
    assert_eq!(browser.complaints, Vec::<String>::new());

    // The rig dies and comes back. SAFE stands, and the same page arms it.
    drop(first);
    browser.wait("word that the rig is gone", "document.body.classList.contains('stale')");
    assert_eq!(browser.value("document.getElementById('state').textContent"), "NO CONTACT");
    browser.picture(&pictures.join("phone-gone.png"), false);
    let mut second = rig(&address);
    second.wait_for_line(PATIENCE, |line| line.contains("page: http"));
    browser.wait("return", "!document.body.classList.contains('stale')");
    browser.wait("state", "document.getElementById('state').textContent === 'DARK BY ORDER'");
    browser.wait("buttons", "!document.getElementById('arm').disabled");
    browser.click("arm");
    browser
        .wait("answer", "document.getElementById('answer').textContent.startsWith('ARM: ok: projector up')");
    wait_for_light(&mut browser, "light of the second run", |mean| mean > 1.0);
    drop(second);
}
