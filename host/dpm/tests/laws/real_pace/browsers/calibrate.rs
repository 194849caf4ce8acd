//! The guided page of a calibration in a real browser: it names the next step and its command, starts and stops light,
//! takes what was measured only when the operator says so, and shows nobody's step without the token.
//!
//! Without a Chromium this fails. `./x test --all` installs one, and leaves this out by name where none can be had.

use crate::browser;
use crate::browser::{Browser, PATIENCE};
use crate::cli_common::{code, dpm, err, out, own_folder, start, TestFolder};
use crate::link_common::{raster, served_time, Projector, PtyProjector};
use hil_mock::projector::MockConfig;
use std::net::TcpListener;
use std::path::{Path, PathBuf};

/// What a wand step would have measured.
const TRIAL: &str = "version = 1\n[wand]\ntip = [0.01, -0.005, 0.12]\ntip_sigma_m = 0.0001\n[wand.provenance]\n\
                     date = \"2026-03-04T05:06:07Z\"\ndevice = \"pen\"\ndata = \"900 poses\"\ncommit = \"0123456789ab\"\n";

/// A rig with the projector, a tracker that does not answer, and a body whose name needs quotes in a shell.
fn rig(folder: &TestFolder, projector: &PtyProjector) -> String {
    let text = format!(
        "[projector]\nwidth = {}\nheight = {}\nframe_rate = 20\nplanes = 8\nbackend = {}\n[safety]\nwatchdog_ms = 500\n\
         [tracker]\nkind = \"natnet\"\nserver = \"127.0.0.1\"\nlocal = \"127.0.0.1\"\ncommand_port = 9\n\
         [real_time]\npace = \"real\"\n[output]\ndir = {:?}\n[[scene.bodies]]\nname = \"the hare\"\n",
        raster().width(),
        raster().height(),
        projector.backend(""),
        folder.text(),
    );
    folder.write("rig.toml", &text)
}

/// What must hold of the page at any size.
fn check_layout(browser: &mut Browser, width: u32) {
    let wide = browser.value("document.documentElement.scrollWidth").as_f64().unwrap();
    assert!(wide <= f64::from(width), "{wide} of {width}: something sticks out sideways");
    let small = browser.value(
        "[...document.querySelectorAll('button')].filter(b => b.offsetParent && b.offsetHeight < 44).length",
    );
    assert_eq!(small, 0, "buttons are too small for a finger");
}

fn text_of(browser: &mut Browser, what: &str) -> String {
    browser.value(&format!("document.querySelector({what:?}).textContent")).as_str().unwrap().to_owned()
}

/// The steps as they stand there without a token, and by keys alone.
fn look(browser: &mut Browser, rig: &str) {
    browser.wait("steps", "document.querySelectorAll('#steps section').length === 9");
    browser.wait("refusal", "!document.getElementById('keyless').hidden");
    assert_eq!(browser.value("[...document.querySelectorAll('.run')].every(b => b.disabled)"), true);
    assert_eq!(text_of(browser, "section.next h3"), "Sharpen and aim the picture");
    assert_eq!(text_of(browser, "section.next code"), format!("dpm pattern focus-star {rig}"));
    let body =
        "[...document.querySelectorAll('code')].map(c => c.textContent).filter(c => c.includes(' body '))[0]";
    assert_eq!(browser.value(body), format!("dpm calibrate body {rig} --body 'the hare'"));
    browser.press("n");
    assert_eq!(browser.value("document.activeElement.id"), "step-pattern");
    // The port of the light sensor goes into the commands that need it.
    let sensor = "document.querySelector('#step-light code').textContent";
    assert_eq!(browser.value(sensor), format!("dpm calibrate light {rig} --sensor SENSOR"));
    browser.value("document.getElementById('port').focus()");
    browser.type_in("/dev/my sensor");
    let filled = format!("dpm calibrate light {rig} --sensor '/dev/my sensor'");
    assert_eq!(browser.value(sensor), filled);
    browser.value("document.activeElement.blur()");
}

/// Light begins with a button and ends with a key.
fn light_and_dark(browser: &mut Browser, projector: &PtyProjector) {
    assert!(!projector.is_lit(), "nothing is lit before it is asked for");
    browser.value("document.querySelector('#step-pattern .run').click()");
    browser.wait("step", "document.getElementById('going').textContent === 'runs'");
    served_time("light", || projector.is_lit());
    browser.wait("notes", "document.getElementById('output').textContent.includes('projector: up')");
    assert_eq!(browser.value("[...document.querySelectorAll('.run')].every(b => b.disabled)"), true);
    browser.value("document.getElementById('session').focus()");
    browser.press("Escape");
    browser.wait("end", "document.getElementById('stop').hidden");
    served_time("dark", || !projector.is_lit());
}

/// What is measured waits for a decision, and no step begins before it.
fn decide(browser: &mut Browser, folder: &TestFolder, pictures: &Path) {
    folder.write("calibration.toml.trial", TRIAL);
    browser.wait("question", "!document.getElementById('deciding').hidden");
    assert_eq!(text_of(browser, "#proposed dd"), "new: the tip is known to 0.10 mm");
    assert_eq!(browser.value("[...document.querySelectorAll('.run')].every(b => b.disabled)"), true);
    browser.picture(&pictures.join("phone-keep.png"), false);
    let file = folder.path("calibration.toml");
    assert!(!file.exists());
    browser.value("document.getElementById('keep').scrollIntoView({ block: 'center' })");
    browser.click("keep");
    browser.wait("kept", "document.querySelector('#step-wand .state').textContent === 'done'");
    assert!(std::fs::read_to_string(&file).unwrap().contains("900 poses"));
    assert!(!folder.path("calibration.toml.trial").exists());
    assert_eq!(text_of(browser, "section.next h3"), "Find the projector's lens and pose");
    browser
        .wait("name of the file", "document.getElementById('unnamed').textContent.includes('[calibration]')");
    assert!(text_of(browser, "section.next code").ends_with("--wand pen"));
}

#[test]
fn the_page_leads_through_a_calibration() {
    let program = &browser::installed();
    let pictures = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("calibration");
    std::fs::create_dir_all(&pictures).unwrap();
    let folder = TestFolder::new("calibration");
    let projector = PtyProjector::new("calibration", MockConfig::new(raster()));
    let rig = rig(&folder, &projector);
    let address = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().to_string();
    let mut page = start(&["calibrate", "page", &rig, "--listen", &address]);
    page.wait_for_line(PATIENCE, |line| {
        assert!(!line.contains("key="), "a log is no place for the key: {line}");
        line.contains("page: http")
    });
    let mut browser = Browser::open(program, &own_folder("browser"), &format!("http://{address}/"));
    browser.screen(1280, 900, false);
    look(&mut browser, &rig);
    check_layout(&mut browser, 1280);
    browser.picture(&pictures.join("desktop-whole.png"), true);
    let link = dpm(&["page", &address], &[]);
    assert_eq!(code(&link), 0, "{}", err(&link));
    browser.value(&format!("location.hash = '{}'", out(&link).trim().split_once('#').unwrap().1));
    browser.wait("buttons", "document.querySelector('.run') && !document.querySelector('.run').disabled");
    light_and_dark(&mut browser, &projector);
    // A tracker that does not answer is told as on a terminal.
    browser.value("document.querySelector('#step-wand .run').click()");
    browser.wait("failure", "document.getElementById('going').textContent.includes('exit code')");
    assert!(text_of(&mut browser, "#output").contains("error: "));
    browser.picture(&pictures.join("desktop-failed.png"), false);
    browser.screen(390, 844, true);
    browser.wait("narrow page", "innerWidth === 390");
    decide(&mut browser, &folder, &pictures);
    check_layout(&mut browser, 390);
    browser.picture(&pictures.join("phone-whole.png"), true);
    assert_eq!(browser.complaints, Vec::<String>::new());
    // The page may end while a step gives light; the step ends with it, in the dark.
    browser.value("document.querySelector('#step-pattern .run').click()");
    served_time("light", || projector.is_lit());
    drop(page);
    served_time("dark", || !projector.is_lit());
    browser.wait("word that it is gone", "!document.getElementById('gone').hidden");
}
