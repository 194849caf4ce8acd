use super::*;
use std::os::unix::net::UnixListener;
use std::thread::JoinHandle;

fn place(name: &str) -> PathBuf {
    let path = std::env::temp_dir().join(format!("dpm-client-{}-{name}", std::process::id()));
    let _ = fs::remove_dir_all(&path);
    fs::create_dir_all(&path).unwrap();
    path
}

/// A rig that gives `answer` to `clients` clients, and returns what they sent.
fn rig(folder: &Path, pid: u32, clients: usize, answer: &'static str) -> JoinHandle<String> {
    let listener = UnixListener::bind(folder.join(socket_name(pid))).unwrap();
    std::thread::spawn(move || {
        let mut heard = String::new();
        for _ in 0..clients {
            let (mut stream, _) = listener.accept().unwrap();
            let mut word = [0; 8];
            let n = stream.read(&mut word).unwrap();
            heard += &String::from_utf8_lossy(&word[..n]);
            let _ = stream.write_all(answer.as_bytes());
        }
        heard
    })
}

#[test]
fn with_several_rigs_only_the_dark_is_for_all_and_dead_sockets_go() {
    let dir = place("several");
    // A killed process leaves its socket.
    drop(UnixListener::bind(dir.join(socket_name(7))).unwrap());
    // The search for running rigs, then the order.
    let rigs = [8, 9].map(|pid| rig(&dir, pid, 2, "heard /x/rig.toml\nok: projector black\n"));
    let folders = [dir.clone()];
    let error = tell_in(&folders, None, Order::Arm).unwrap_err().to_string();
    assert!(error.contains("2 rigs are running (processes 8, 9)"), "{error}");
    let told = tell_in(&folders, None, Order::Black).unwrap();
    assert!(told.is_done(), "{told:?}");
    let seen: Vec<_> = told.answers.iter().map(|a| (a.pid, a.rig.as_str(), a.text.as_str())).collect();
    assert_eq!(seen, [(8, "/x/rig.toml", "ok: projector black"), (9, "/x/rig.toml", "ok: projector black")]);
    assert!(rigs.into_iter().all(|rig| rig.join().unwrap() == "black\n"));
    assert!(!dir.join(socket_name(7)).exists());
    fs::remove_dir_all(dir).unwrap();
}

/// Found in use, R8: any process that could listen in the folder was trusted.
#[test]
fn r8_only_the_folders_own_user_is_believed() {
    let dir = place("impostor");
    let folder = Arc::new(Folder::open(&dir, Owner::Own).unwrap());
    let own = RigSocket { folder, pid: 4242, uid: user(), is_vouched_for: true };
    check_listener(SocketPeer { pid: 4242, uid: user() }, &own).unwrap();
    let told = check_listener(SocketPeer { pid: 4242, uid: user() + 1 }, &own).unwrap_err().to_string();
    assert!(told.contains("in a folder of") && told.contains("is served by process 4242"), "{told}");
    // The answer of another user's process proves nothing, whatever it says.
    let answer = RigAnswer {
        pid: 1,
        uid: user() + 1,
        rig: String::new(),
        text: "ok: projector black".into(),
        done: true,
        is_vouched_for: false,
    };
    let told = |answers: Vec<RigAnswer>| OrderResult { answers, refused: vec![], closed: vec![] };
    assert!(!told(vec![]).is_done() && !told(vec![answer.clone()]).is_done());
    let mine = RigAnswer { is_vouched_for: true, ..answer.clone() };
    assert!(told(vec![answer.clone(), mine.clone()]).is_done());
    assert!(!told(vec![RigAnswer { done: false, ..answer }, mine]).is_done());
    fs::remove_dir_all(dir).unwrap();
}

/// Found in use, R9: the message "the order was delivered" was printed for an order that nobody had read.
#[test]
fn r9_what_is_not_confirmed_is_not_done() {
    let dir = place("silent");
    let folders = [dir.clone()];
    // FREEZE is not sent as a signal, which would kill this test's process.
    for (answer, wanted) in [
        ("", "perhaps not delivered, NOT confirmed"),
        ("heard /x\n", "delivered, NOT confirmed"),
        ("heard /x\nnot yet: projector lost\n", "not yet: projector lost"),
        ("heard /x\nok, but NOT kept over a restart: disk full\n", "NOT kept"),
        ("nonsense\n", "nonsense"),
        ("heard\n\x07", "\x07"),
    ] {
        let server = rig(&dir, 5, 1, answer);
        let told = tell_in(&folders, Some(5), Order::Freeze).unwrap();
        assert!(!told.is_done() && told.answers[0].text.contains(wanted), "{answer:?}: {told:?}");
        assert_eq!(server.join().unwrap(), "freeze\n");
        fs::remove_file(dir.join(socket_name(5))).unwrap();
    }
    fs::remove_dir_all(dir).unwrap();
}

/// Found in use, R7: a runtime folder that belongs to another user is reported, not used.
#[test]
fn r7_a_folder_that_others_can_write_to_is_named_and_not_used() {
    use std::os::unix::fs::PermissionsExt;
    let dir = place("open");
    let server = rig(&dir, 5, 1, "heard /x\nok: projector black\n");
    fs::set_permissions(&dir, fs::Permissions::from_mode(0o777)).unwrap();
    let told = tell_in(std::slice::from_ref(&dir), None, Order::Black).unwrap();
    assert!(told.answers.is_empty() && !told.is_done(), "{told:?}");
    assert!(told.refused[0].contains("can be written by others"), "{told:?}");
    fs::set_permissions(&dir, fs::Permissions::from_mode(0o700)).unwrap();
    assert!(tell_in(std::slice::from_ref(&dir), None, Order::Black).unwrap().is_done());
    assert_eq!(server.join().unwrap(), "black\n");
    fs::remove_dir_all(dir).unwrap();
}
