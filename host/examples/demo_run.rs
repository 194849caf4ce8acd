//! scratch
use std::sync::Arc;
fn main() {
    let flags: Vec<String> = std::env::args().skip(1).collect();
    let c = dpm_host::config::RigConfig::demo(&dpm_host::config::Overrides { variables: vec![], flags });
    let c = match c { Ok(c) => c, Err(e) => { eprintln!("{e}"); return } };
    match dpm_host::experiments::run_rig::run_rig(&c, &Arc::new(Default::default())) { Ok(r) => println!("{}\n{}", r.to_table(), r.to_json()), Err(e) => eprintln!("{e}") }
}
