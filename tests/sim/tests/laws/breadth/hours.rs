//! Hours of the simulated world, with every fault in every state. `./x test --all` adds seeds that nobody has chosen.

use std::process::Command;

/// Lives of a minute from `seed` on keep every law. The program says how a seed that does not is repeated.
fn keep_every_law(seed: u64, lives: u32) {
    let hours = f64::from(lives) / 60.0;
    let done = Command::new(env!("CARGO_BIN_EXE_dpm-sim"))
        .args(["--life", "60", "--seed", &seed.to_string(), "--hours", &hours.to_string()])
        .output()
        .expect("the simulator starts");
    let told = String::from_utf8_lossy(&done.stdout) + String::from_utf8_lossy(&done.stderr);
    println!("{told}");
    assert!(done.status.success(), "{:?}", done.status);
}

#[test]
fn the_first_hundred_lives_keep_every_law() {
    keep_every_law(1, 100);
}

#[test]
fn the_second_hundred_lives_keep_every_law() {
    keep_every_law(101, 100);
}

#[test]
fn the_next_seventy_lives_keep_every_law() {
    keep_every_law(201, 70);
}
