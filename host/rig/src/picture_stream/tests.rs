use super::*;
use crate::config::{Overrides, RigConfig};
use dpm_device::planes::Raster;
use std::fs::{File, Permissions};
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

/// A folder that goes with the test.
struct StreamFolder(PathBuf);

impl StreamFolder {
    fn new(name: &str) -> Self {
        let path = std::env::temp_dir().join(format!("dpm-pictures-{name}-{}", std::process::id()));
        let _ = std::fs::remove_dir_all(&path);
        std::fs::create_dir_all(&path).unwrap();
        Self(path)
    }

    fn pipe(&self, name: &str) -> PathBuf {
        let path = self.0.join(name);
        assert!(Command::new("mkfifo").arg(&path).status().unwrap().success());
        path
    }
}

impl Drop for StreamFolder {
    fn drop(&mut self) {
        let _ = std::fs::remove_dir_all(&self.0);
    }
}

/// The demo's rig, whose bunny shows `source` with 3 x 2 texels.
fn rig_of(source: &str) -> Rig {
    let bodies = format!(
        "scene.bodies=[{{ name = \"bunny\", texture = \"{source}\", texture_size = [3, 2] }}, {{ name = \"venus\" }}]"
    );
    let config = RigConfig::demo(&Overrides { flags: vec![bodies], ..Default::default() }).unwrap();
    Rig::build(&config, Raster::new(64, 48)).unwrap()
}

fn even(value: u8) -> Vec<u8> {
    [&b"P6 3 2 255 "[..], &[value; 18]].concat()
}

/// Waits until the bunny shows an even picture of this value, or fails.
fn wait_for(rig: &Rig, value: u8) {
    let begin = Instant::now();
    while rig.scene.live[0].pictures.newest() != [[value, value, value, 255]; 6] {
        assert!(begin.elapsed() < Duration::from_secs(20), "{value} is not shown");
        sleep(Duration::from_millis(2));
    }
}

fn wait_for_note(monitor: &RunMonitor, notes: &mut Vec<String>, part: &str) {
    let begin = Instant::now();
    loop {
        notes.extend(monitor.take_notes());
        if notes.iter().any(|note| note.contains(part)) {
            return;
        }
        assert!(begin.elapsed() < Duration::from_secs(20), "no note says {part:?}: {notes:?}");
        sleep(Duration::from_millis(2));
    }
}

/// What cannot be opened is told once, and tried again.
#[test]
fn a_pipe_that_is_made_later_is_found() {
    let folder = StreamFolder::new("later");
    let path = folder.0.join("pictures");
    let rig = rig_of(&format!("pipe:{}", path.display()));
    let monitor = Arc::new(RunMonitor::default());
    let _streams = PictureStreams::start(&rig, &monitor);
    let mut notes = vec![];
    wait_for_note(&monitor, &mut notes, "there is no such pipe; `mkfifo` makes one; it is black until");
    folder.pipe("pictures");
    let writer = std::thread::spawn(move || {
        let mut writer = File::options().write(true).open(path).unwrap();
        writer.write_all(&even(5)).unwrap();
        writer
    });
    wait_for(&rig, 5);
    drop(writer.join().unwrap());
    notes.extend(monitor.take_notes());
    let told = notes.iter().filter(|note| note.contains("no such pipe")).count();
    assert_eq!(told, 1, "{notes:?}");
}

fn program(folder: &Path, text: &str) {
    let path = folder.join("gst-launch-1.0");
    std::fs::write(&path, format!("#!/bin/sh\n{text}")).unwrap();
    std::fs::set_permissions(&path, Permissions::from_mode(0o755)).unwrap();
}

/// A program in the place of GStreamer's gets the node and the size, sends raw texels, and is ended with the rig. One that fails is told
/// of by what it says.
#[test]
fn a_program_of_its_own_reads_pipewire() {
    let folder = StreamFolder::new("program");
    let said = folder.0.join("said");
    // 24 bytes are one picture of 3 x 2; `exec` so that the program itself is what is ended.
    let texels = "ABC\\377".repeat(6);
    program(&folder.0, &format!("echo $$ \"$@\" > {}\nprintf '{texels}'\nexec sleep 100\n", said.display()));
    // Found by the same rule as any command.
    let found = |name: &str| folder.0.join(name);
    // A process that another test is just starting may hold the new file open for a moment.
    let started = |node: &str| loop {
        match source::start(source::gstreamer_at(&found("gst-launch-1.0"), node, [3, 2])) {
            Ok(stream) => return stream,
            Err(why) => assert!(why.contains("Text file busy"), "{why}"),
        }
        sleep(Duration::from_millis(5));
    };
    let rig = rig_of("pipewire:camera.1");
    let mut stream = started("camera.1");
    let mut decoder = Decoder::new(stream.form(), [3, 2]);
    let (mut bytes, mut shown) = (vec![0; 100], vec![]);
    let begin = Instant::now();
    while shown.is_empty() && begin.elapsed() < Duration::from_secs(20) {
        let count = stream.read(&mut bytes, STEP).unwrap();
        decoder.push(&bytes[..count], |picture| shown.extend_from_slice(picture)).unwrap();
    }
    assert_eq!(shown, [[b'A', b'B', b'C', 255]; 6]);
    assert_eq!(rig.scene.live[0].pictures.size(), [3, 2]);
    let words = std::fs::read_to_string(&said).unwrap();
    for word in [
        "pipewiresrc target-object=camera.1 !",
        "video/x-raw,format=RGBA,width=3,height=2,pixel-aspect-ratio=1/1 ! fdsink fd=1",
    ] {
        assert!(words.contains(word), "{words}");
    }
    let process = Path::new("/proc").join(words.split_whitespace().next().unwrap());
    assert!(process.exists());
    drop(stream);
    assert!(!process.exists(), "the program is ended with the stream");
    program(&folder.0, "echo first\necho 'ERROR: no node of that name' >&2\necho last >&2\nexit 1\n");
    let mut stream = started("");
    let ended = loop {
        if let Err(ended) = stream.read(&mut bytes, STEP) {
            break ended.to_string();
        }
    };
    assert_eq!(ended, "gst-launch-1.0 has ended: ERROR: no node of that name");
    let missing = source::start(source::gstreamer_at(&found("nothing"), "", [3, 2])).err().unwrap();
    assert!(missing.contains("is not installed; on Debian: apt install"), "{missing}");
}

#[test]
fn sources_are_read_and_shown_alike() {
    use crate::config::PictureSource;
    use LiveSource::{Pipe, PipeWire};
    let read = |text: &str| {
        let bodies = format!("scene.bodies=[{{ name = \"bunny\", texture = \"{text}\" }}]");
        RigConfig::demo(&Overrides { flags: vec![bodies], ..Default::default() })
            .map(|config| config.scene.bodies[0].texture.clone().unwrap())
    };
    for (text, source) in [
        ("pipe:/run/dpm/a b", Pipe("/run/dpm/a b".into())),
        ("pipewire:", PipeWire(String::new())),
        ("pipewire:alsa_output.pci-0:1", PipeWire("alsa_output.pci-0:1".into())),
    ] {
        let found = read(text).unwrap();
        assert_eq!(found.to_string(), text);
        assert_eq!(found, PictureSource::Live(source));
    }
    for (text, reason) in [
        ("pipe:", "names no file"),
        ("", "names no file"),
        ("pipewire:a ! filesink", "is no node"),
        ("nothing.png", "nothing.png"),
    ] {
        let told = read(text).unwrap_err().to_string();
        assert!(told.contains("scene.bodies.0.texture") && told.contains(reason), "{told}");
    }
    assert_eq!(PictureSource::File("a.png".into()).to_string(), "a.png");
}

/// Programs that write as fast as a clock says.
mod real_pace {
    use super::*;

    /// Black at first; then what a program writes; black again when it has ended; and what the next one writes. A program that writes
    /// something else is told of, and does not stop the one after it.
    #[test]
    fn a_pipe_shows_one_program_after_another() {
        let folder = StreamFolder::new("pipe");
        let pipe = folder.pipe("pictures");
        let rig = rig_of(&format!("pipe:{}", pipe.display()));
        assert_eq!(rig.scene.live.len(), 1);
        let monitor = Arc::new(RunMonitor::default());
        let streams = PictureStreams::start(&rig, &monitor);
        assert!(!streams.wait_for_first(Duration::from_millis(30)));
        let without: Vec<_> = streams.without_pictures().collect();
        assert!(without.len() == 1 && without[0].starts_with("bunny: pipe:"), "{without:?}");
        wait_for(&rig, 0);
        let open = || File::options().write(true).open(&pipe).unwrap();
        let mut notes = vec![];
        let mut writer = open();
        // It has opened the pipe, and says nothing for long.
        wait_for_note(&monitor, &mut notes, "no picture has come for 3 s; it is black");
        for value in [10, 200] {
            // In two parts, of which the second comes later.
            let picture = even(value);
            writer.write_all(&picture[..9]).unwrap();
            sleep(Duration::from_millis(20));
            writer.write_all(&picture[9..]).unwrap();
            wait_for(&rig, value);
        }
        assert!(streams.wait_for_first(Duration::ZERO) && streams.without_pictures().next().is_none());
        wait_for_note(&monitor, &mut notes, "pictures of 3 x 2 have begun");
        assert!(notes.iter().all(|note| note.starts_with("bunny: pipe:")), "{notes:?}");
        // The last one stays while its program is there.
        wait_for_note(&monitor, &mut notes, "no picture has come for 3 s; the last one stays");
        wait_for(&rig, 200);
        drop(writer);
        wait_for(&rig, 0);
        while !notes.iter().any(|note: &String| note.contains("neither PPM (P6) nor PAM (P7)")) {
            // It is closed as soon as it is seen to be something else, which the writer need not live to see.
            let _ = open().write_all(b"YUV4MPEG2 W3 H2");
            sleep(STEP);
            notes.extend(monitor.take_notes());
        }
        let mut last = open();
        last.write_all(&even(77)).unwrap();
        wait_for(&rig, 77);
        let begin = Instant::now();
        drop(streams);
        assert!(begin.elapsed() < Duration::from_secs(2), "the threads end soon");
    }

    /// A program that sends one picture and ends at once: in the end the operator knows that the body is black.
    #[test]
    fn the_last_of_quick_changes_is_told() {
        let folder = StreamFolder::new("quick");
        let pipe = folder.pipe("pictures");
        let rig = rig_of(&format!("pipe:{}", pipe.display()));
        let monitor = Arc::new(RunMonitor::default());
        let _streams = PictureStreams::start(&rig, &monitor);
        let mut notes = vec![];
        let mut writer = File::options().write(true).open(&pipe).unwrap();
        writer.write_all(&even(9)).unwrap();
        wait_for_note(&monitor, &mut notes, "have begun");
        drop(writer);
        wait_for_note(&monitor, &mut notes, "has closed the pipe; it is black until pictures come again");
        // Nothing else is said while nothing changes.
        sleep(SILENT + NOTE_EVERY);
        notes.extend(monitor.take_notes());
        assert_eq!(notes.len(), 2, "{notes:?}");
    }
}
