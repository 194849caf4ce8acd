//! `dpm completions` and `dpm man`: what the command line says of itself, for shells and for `man`.

use super::completion;
use super::watch::print;
use clap::builder::PossibleValuesParser;
use clap_mangen::roff::{bold, roman, Roff};
use dpm_rig::config::RigConfig;
use dpm_rig::failure::{Failure, FailureKind};
use std::path::{Path, PathBuf};

/// Arguments of `dpm completions`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct CompletionsArgs {
    /// The shell that reads them
    #[arg(value_name = "SHELL", value_parser = PossibleValuesParser::new(completion::shells()))]
    shell: String,
}

/// Arguments of `dpm man`.
#[derive(clap::Args, Clone, Debug)]
pub(crate) struct ManArgs {
    /// Folder for the pages; made if it does not exist
    #[arg(value_name = "DIR")]
    dir: PathBuf,
}

/// Prints the completions of a shell.
///
/// # Errors
/// There is no such shell; a reader that goes away is no error.
pub(super) fn completions(args: &CompletionsArgs) -> Result<(), Failure> {
    let script = completion::script(&args.shell).map_err(|e| Failure::new(FailureKind::BadInput, e))?;
    print(&String::from_utf8_lossy(&script));
    Ok(())
}

/// Writes a page for the program, one for each of its commands, and one for the rig file.
///
/// # Errors
/// The folder or a page cannot be written.
pub(super) fn man(args: &ManArgs) -> Result<(), Failure> {
    let failed = |path: &Path, e: &std::io::Error| {
        let told = format!("cannot write the man pages to {}: {e}", path.display());
        Failure::new(FailureKind::BadInput, told)
    };
    std::fs::create_dir_all(&args.dir).map_err(|e| failed(&args.dir, &e))?;
    // `dpm help run` needs no page of its own.
    let mut command = super::command().disable_help_subcommand(true);
    command.build();
    write_pages(command, &args.dir).map_err(|e| failed(&args.dir, &e))?;
    let path = args.dir.join("dpm-rig.5");
    std::fs::write(&path, rig_page()).map_err(|e| failed(&path, &e))
}

/// The page of `command` and those of its commands.
fn write_pages(command: clap::Command, dir: &Path) -> std::io::Result<()> {
    for sub in command.get_subcommands().filter(|sub| !sub.is_hide_set()) {
        write_pages(sub.clone(), dir)?;
    }
    let name = command.get_display_name().unwrap_or(command.get_name()).to_owned();
    let page = clap_mangen::Man::new(command);
    let mut out = Vec::new();
    page.render_title(&mut out)?;
    page.render_name_section(&mut out)?;
    page.render_synopsis_section(&mut out)?;
    page.render_description_section(&mut out)?;
    page.render_options_section(&mut out)?;
    page.render_subcommands_section(&mut out)?;
    sections(&name).to_writer(&mut out)?;
    std::fs::write(dir.join(format!("{name}.1")), out)
}

/// What the process says by its end.
const EXIT_STATUS: [(&str, &str); 5] = [
    ("0", "The command did what it was asked for."),
    ("1", "A check failed, or a run lit nothing."),
    ("2", "A flag, a rig file or another file is wrong; the message names the place."),
    ("3", "A device is missing or failed, or an order was not confirmed."),
    ("4", "There is no GPU with Vulkan, or it failed."),
];

const FILES: [(&str, &str); 5] = [
    ("/etc/dpm/rig.toml", "The rig file that the service runs. dpm-rig(5) explains its keys."),
    ("/usr/share/dpm/rigs/", "Rig files to begin with."),
    ("/run/dpm/, $XDG_RUNTIME_DIR/dpm/", "Sockets, status and locks of rigs that run."),
    ("/var/lib/dpm/, $XDG_STATE_HOME/dpm/", "Orders that stand (SAFE, BLACK), and horizons of scenes."),
    ("/usr/share/doc/dpm/docs/", "The documentation."),
];

const ENVIRONMENT: [(&str, &str); 4] = [
    (
        "DPM_SET_A__B",
        "Sets the key a.b of the rig file; two underscores separate the levels. --set overrides it.",
    ),
    ("DPM_RUNTIME_DIR", "The folder for sockets, status and locks."),
    (
        "STATE_DIRECTORY, XDG_STATE_HOME",
        "The folder for orders that stand, methods that were measured and horizons.",
    ),
    ("NO_COLOR", "If it is set and not empty, nothing is coloured."),
];

/// Examples by the name of a page; other pages refer to that of dpm(1).
const EXAMPLES: [(&str, &[(&str, &str)]); 10] = [
    (
        "dpm",
        &[
            ("dpm demo", "The built-in scene, with everything outside the computer made of software."),
            ("dpm doctor rig.toml", "What the machine and the rig lack, and what to do about it."),
            ("dpm run rig.toml --simulate", "The rig against the mocks, before anything is plugged in."),
            ("dpm run rig.toml", "Light."),
        ],
    ),
    (
        "dpm-demo",
        &[
            ("dpm demo --film film.gif", "A film of the room and of what the observer sees."),
            (
                "dpm demo --film hare.png --scene hare.glb",
                "The same of an object of your own, as an animated PNG.",
            ),
        ],
    ),
    (
        "dpm-run",
        &[
            ("dpm run rig.toml --page", "Shows the rig at http://127.0.0.1:8947 in a browser."),
            ("dpm run rig.toml --set render.spp=4 --seconds 60", "With four samples a pixel, for a minute."),
        ],
    ),
    ("dpm-black", &[("dpm black", "Makes the projectors of all running rigs dark.")]),
    ("dpm-safe", &[("dpm safe --pid 4711", "Makes one rig dark, also after a restart, until it is armed.")]),
    ("dpm-arm", &[("dpm arm", "Permits light again.")]),
    (
        "dpm-set",
        &[
            ("dpm set exposure=1.5", "Shows everything one and a half times as bright."),
            ("dpm set --save", "Keeps the values for the next run."),
        ],
    ),
    (
        "dpm-doctor",
        &[(
            "dpm doctor rig.toml",
            "Judges machine, scene, calibration, tracker and projector, which stays dark.",
        )],
    ),
    ("dpm-snapshot", &[("dpm snapshot hare.glb --what radiance", "A picture of an object by itself.")]),
    (
        "dpm-completions",
        &[("dpm completions bash > ~/.local/share/bash-completion/completions/dpm", "For bash.")],
    ),
];

/// The sections that no command line declares.
fn sections(name: &str) -> Roff {
    let mut roff = Roff::new();
    let list = |roff: &mut Roff, title: &str, entries: &[(&str, &str)]| {
        roff.control("SH", [title]);
        for (term, text) in entries {
            roff.control("TP", []);
            roff.text([bold(*term)]);
            roff.text([roman(*text)]);
        }
    };
    list(&mut roff, "EXIT STATUS", &EXIT_STATUS);
    list(&mut roff, "ENVIRONMENT", &ENVIRONMENT);
    list(&mut roff, "FILES", &FILES);
    if let Some((_, examples)) = EXAMPLES.iter().find(|(of, _)| *of == name) {
        list(&mut roff, "EXAMPLES", examples);
    }
    roff.control("SH", ["SEE ALSO"]);
    let others =
        ["dpm", "dpm-run", "dpm-doctor", "dpm-demo", "dpm-arm"].into_iter().filter(|other| *other != name);
    let others: Vec<String> =
        others.map(|other| format!("{other}(1)")).chain(["dpm-rig(5)".to_owned()]).collect();
    roff.text([roman(others.join(", "))]);
    roff
}

/// The page of the rig file, of section 5.
fn rig_page() -> String {
    let mut roff = Roff::new();
    roff.control("TH", ["dpm-rig", "5"]);
    roff.control("SH", ["NAME"]);
    roff.text([roman("dpm-rig - the rig file of dpm")]);
    roff.control("SH", ["DESCRIPTION"]);
    roff.text([roman(
        "A rig file is TOML. Keys that it leaves out have their defaults. The environment variable DPM_SET_A__B sets the key \
         a.b, and the flag --set a.b=VALUE overrides both; a number is an index into a list. All mistakes in a file are \
         reported at once, each with line and column. Paths in a rig file are relative to its folder.",
    )]);
    roff.control("SH", ["KEYS"]);
    let mut table = None;
    for key in RigConfig::key_docs() {
        let (of, name) = key.key.rsplit_once('.').unwrap_or(("", &key.key));
        if table.as_deref() != Some(of) {
            roff.control("SS", [format!("[{of}]").as_str()]);
            table = Some(of.to_owned());
        }
        roff.control("TP", []);
        roff.text([bold(name.to_owned())]);
        let range = [key.range.as_str(), key.unit].join(" ");
        let range = if range.trim().is_empty() { String::new() } else { format!(", {}", range.trim()) };
        roff.text([roman(format!("{} ({}{range}; default {})", key.doc, key.kind, key.default))]);
    }
    roff.control("SH", ["EXAMPLES"]);
    roff.text([roman("/usr/share/dpm/rigs/ has a file for each kind of projector and tracker; usb-natnet.toml is a template.")]);
    roff.control("SH", ["FILES"]);
    roff.text([roman("/etc/dpm/rig.toml is the file that the service runs.")]);
    roff.control("SH", ["SEE ALSO"]);
    roff.text([roman("dpm(1), dpm-run(1), dpm-doctor(1)")]);
    roff.to_roff()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Found in use (O11): pages without exit status, files and examples, and none of the rig file.
    #[test]
    fn every_page_has_the_sections_that_a_reader_looks_for() {
        let text = sections("dpm-run").to_roff();
        for title in ["EXIT STATUS", "ENVIRONMENT", "FILES", "EXAMPLES", "SEE ALSO"] {
            assert!(
                text.contains(&format!(".SH \"{title}\"")) || text.contains(&format!(".SH {title}")),
                "{title}: {text}"
            );
        }
        // Every example is of a command that exists.
        let command = crate::cli::command();
        for (page, examples) in EXAMPLES {
            for (line, _) in examples {
                let words: Vec<&str> = line.split_whitespace().take_while(|word| *word != ">").collect();
                let parsed = command.clone().try_get_matches_from(&words);
                assert!(
                    parsed.is_ok(),
                    "{page}: {line}: {}",
                    parsed.err().map_or(String::new(), |e| e.to_string())
                );
            }
        }
    }

    #[test]
    fn the_page_of_the_rig_file_has_every_key() {
        let page = rig_page();
        let bold_names = page.matches("\\fB").count();
        assert_eq!(bold_names, RigConfig::key_docs().len());
    }
}
