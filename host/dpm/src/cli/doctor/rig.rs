//! What `dpm doctor RIG.toml` says of the rig: its parts one by one, those without devices here, the tracker and the
//! projector in [`super::devices`]. Nothing is lit.

use super::super::os;
use super::devices;
use super::{Finding, Severity};
use dpm_calibration_file as file;
#[cfg(feature = "lab")]
use dpm_lab::temporal_light::{mend, TemporalLight, NO_MEND};
use dpm_rig::calibration_steps::age::{aged, days_since, OLD_DAYS};
use dpm_rig::calibration_steps::is_simulated;
use dpm_rig::config::{BodyConfig, LiveSource, PictureSource, RigConfig};
use dpm_rig::picture_stream::look_at;
use dpm_rig::presence;
use dpm_rig::rig::{affine, plausible, Rig, RigError};
use dpm_rig::run_rig::{open_gpu, ray_walk};
use dpm_rig::standing::{standing, Identity};
use std::net::{SocketAddr, TcpListener};
use std::path::Path;
use std::time::SystemTime;

/// Less free space than this, bytes, is soon used up by pictures and traces.
const LITTLE_SPACE: u64 = 1 << 30;
/// Most warnings of a scene that are told.
const MOST_WARNINGS: usize = 16;

/// Everything that can be said of the rig of `config`. `loads`: the code of libraries that it names may run. `with` reads the
/// same rig file with other keys.
pub(super) fn findings(
    config: &RigConfig,
    loads: bool,
    with: &dyn Fn(&[&str]) -> Option<RigConfig>,
) -> Vec<Finding> {
    let mut all = vec![set_up(config)];
    let rig = Rig::build(config, None);
    match &rig {
        Err(e) => {
            all.push(faulty(e));
            // The camera is built after the scene, and a mistake in either hides none in the other.
            let camera =
                matches!(e, RigError::Scene(_) | RigError::Picture { .. }).then(|| Rig::check_camera(config));
            all.extend(camera.and_then(Result::err).as_ref().map(faulty));
        }
        Ok(rig) => all.push(scene(rig)),
    }
    #[cfg(feature = "camera")]
    all.extend(devices::cameras(config));
    let (tracker, heard) = devices::tracker(config, rig.as_ref().ok());
    all.push(tracker);
    all.extend(devices::beat(config, heard.as_ref()));
    all.push(observer(config, heard.as_ref()));
    all.extend(devices::gaze(config));
    all.extend(rig.as_ref().ok().and_then(|rig| reach(rig, heard.as_ref())));
    all.extend(pictures(config));
    all.push(calibration(config));
    all.extend(standing_order(config));
    all.push(devices::projector(config, loads));
    all.extend(light_for_eyes(config, with));
    all.extend(gpu(config));
    all.extend(rig.as_ref().ok().and_then(rays));
    all.extend(page(config));
    all.push(output(&config.output.dir));
    all
}

/// The keys that change from projector to projector.
fn set_up(config: &RigConfig) -> Finding {
    let p = &config.projector;
    let found = format!(
        "projector.width = {}, height = {}, frame_rate = {}, planes = {}, for {}; another one may need other numbers",
        p.width,
        p.height,
        p.frame_rate.hz(),
        p.planes,
        Identity::of(&p.backend)
    );
    Finding::new("rig", Severity::Info, found, "")
}

/// A part of the rig that cannot be built.
fn faulty(error: &RigError) -> Finding {
    let (part, remedy) = error.part_and_remedy();
    Finding::new(part, Severity::Missing, error.to_string(), remedy)
}

/// The GPU that a run would take, if there is none or the rig file asks for a certain one.
fn gpu(config: &RigConfig) -> Option<Finding> {
    let part = presence::GPU;
    match (part.look(config), &config.render.gpu) {
        (Err(missing), _) => {
            let remedy = "render.gpu names a part of one of the devices above; without it the best is taken";
            Some(Finding::new(part.name, Severity::Missing, missing.message, remedy))
        }
        (Ok(()), Some(name)) => {
            Some(Finding::new(part.name, Severity::Ok, format!("there is one named {name:?}"), ""))
        }
        (Ok(()), None) => None,
    }
}

/// Who walks the rays on the GPU that a run would take.
fn rays(rig: &Rig) -> Option<Finding> {
    let gpu = open_gpu(&rig.config).ok()?;
    Some(match ray_walk(rig, &gpu) {
        Ok(walk) => Finding::new("rays", Severity::Info, walk.told(), ""),
        Err(e) => Finding::new("rays", Severity::Missing, e.to_string(), ""),
    })
}

fn scene(rig: &Rig) -> Finding {
    let scene = &rig.scene;
    let found = format!(
        "{} triangles of {} bodies, {} of which are tracked",
        dpm_scene::SceneFeatures::of(scene).triangles,
        scene.bodies.len(),
        rig.bodies.len()
    );
    if scene.warnings.is_empty() {
        return Finding::new("scene", Severity::Ok, found, "");
    }
    let told: Vec<&str> = scene.warnings.iter().take(MOST_WARNINGS).map(String::as_str).collect();
    let more = scene.warnings.len() - told.len();
    let more = if more > 0 { format!("; and {more} more") } else { String::new() };
    let remedy = "`dpm plan` of this rig file lists every note, docs/SCENES.md says what is read";
    Finding::new("scene", Severity::Warning, format!("{found}; {}{more}", told.join("; ")), remedy)
}

/// Where the bodies are in the projector's light: by what was `heard` of the tracker, or by the motions of a mock.
fn reach(rig: &Rig, heard: Option<&devices::Heard>) -> Option<Finding> {
    let name = "reach";
    let Some(heard) = heard else {
        // Doubts about known motions are among the scene's notes.
        let told = plausible::coverage(rig, &rig.true_poses(0)?);
        return (!told.is_empty()).then(|| Finding::new(name, Severity::Info, told.join(", "), ""));
    };
    let poses: Vec<_> = heard.iter().map(|body| body.last.as_ref().map(affine)).collect();
    // A body that is not seen is judged by the tracker's finding: it lies nowhere.
    let mut doubts = Vec::new();
    let mut covered = Vec::new();
    for (tracked, pose) in poses.iter().enumerate() {
        let Some(pose) = pose else { continue };
        let mut places = vec![*pose; tracked + 1];
        places[tracked] = *pose;
        let of_body = format!("\"{}\"", heard[tracked].name);
        let is_of = |told: &str| told.contains(&of_body);
        covered.extend(plausible::coverage(rig, &places).into_iter().filter(|told| is_of(told)));
        let all = plausible::of_places(rig, &[places]);
        doubts.extend(all.into_iter().filter(|d| is_of(&d.about) || d.about == "projector"));
    }
    doubts.dedup();
    if covered.is_empty() {
        return None;
    }
    let Some(first) = doubts.first() else {
        return Some(Finding::new(name, Severity::Ok, covered.join(", "), ""));
    };
    let remedy = first.remedy.clone();
    let told: Vec<String> = doubts.iter().map(|d| format!("{}: {}", d.about, d.told)).collect();
    Some(Finding::new(name, Severity::Warning, told.join("; "), remedy))
}

/// Whose eyes the rig follows and spares, and whether the tracker tells of them, if it was `heard`.
fn observer(config: &RigConfig, heard: Option<&devices::Heard>) -> Finding {
    let name = "observer";
    let (eyes, observer, heads) = (&config.safety.eyes, &config.observer, config.heads());
    let carrier = observer.tracked.as_ref().map(|t| &t.0.name).or(observer.body.as_ref());
    let eye = match carrier {
        Some(carrier) => format!("the eye is carried by {carrier:?}"),
        None => format!("the eye is at {:?} m and is not tracked", observer.position),
    };
    let named = |heads: Vec<&str>| heads.iter().map(|h| format!("{h:?}")).collect::<Vec<_>>().join(", ");
    let is_unheard =
        |head: &&str| heard.is_some_and(|heard| !heard.iter().any(|h| h.name == *head && h.count > 0));
    let missing: Vec<&str> = heads.iter().copied().filter(is_unheard).collect();
    let spared = format!("the eye guard spares {} by {} m", named(heads.clone()), eyes.radius);
    if !missing.is_empty() {
        let found = format!("{eye}; {spared}; the tracker does not tell of {}", named(missing));
        let remedy = "the rig stays dark until it does: give the rigid body this name in the tracking software and bring it into \
                      view, or take it out of observer.tracked and safety.eyes.heads";
        return Finding::new(name, Severity::Warning, found, remedy);
    }
    if !heads.is_empty() {
        let found = format!("{eye}; {spared}, and the rig goes dark {} ms after one is lost", eyes.lost_ms);
        return Finding::new(name, Severity::Ok, found, "");
    }
    if carrier.is_some() || !eyes.heads.is_empty() {
        let found = format!("{eye}; the eye guard is off: light falls on heads");
        return Finding::new(name, Severity::Warning, found, "set safety.eyes.guard = true");
    }
    Finding::new(name, Severity::Info, eye, "")
}

/// What a person notices of the course of the projector's light, and the keys that mend it.
#[cfg(feature = "lab")]
fn light_for_eyes(config: &RigConfig, with: &dyn Fn(&[&str]) -> Option<RigConfig>) -> Option<Finding> {
    let light = TemporalLight::of(&config.projector)?;
    let found = light.told();
    let name = "light for eyes";
    if light.noticed().is_empty() {
        return Some(Finding::new(name, Severity::Ok, found, ""));
    }
    let remedy = mend(&light, with).map_or(NO_MEND.to_owned(), |mend| mend.told());
    Some(Finding::new(name, Severity::Warning, found, remedy))
}

/// The laboratory judges that; without it nothing is said.
#[cfg(not(feature = "lab"))]
fn light_for_eyes(_: &RigConfig, _: &dyn Fn(&[&str]) -> Option<RigConfig>) -> Option<Finding> {
    None
}

/// The bodies that show what another program makes. Without it they are black, and all else works.
fn pictures(config: &RigConfig) -> Vec<Finding> {
    let finding = |body: &str, source: &LiveSource| {
        let name = format!("pictures of {body}");
        match look_at(source) {
            Ok(()) => Finding::new(&name, Severity::Ok, source.to_string(), ""),
            Err(why) => {
                Finding::new(&name, Severity::Warning, format!("{source}: {why}"), "it is black until then")
            }
        }
    };
    let live = |body: &BodyConfig| match &body.texture {
        Some(PictureSource::Live(source)) => Some(finding(&body.name, source)),
        _ => None,
    };
    config.scene.bodies.iter().filter_map(live).collect()
}

/// Whether the rig was measured, what of it, and how long ago.
fn calibration(config: &RigConfig) -> Finding {
    let name = "calibration";
    let is_simulated = is_simulated(config);
    let Some(path) = &config.calibration.file else {
        let known = match (is_simulated, &config.projector.calibration) {
            (true, _) => return Finding::new(name, Severity::Info, "none; a mock needs none", ""),
            (false, Some(file)) => format!("lens and pose of {}; nothing else was measured", file.display()),
            (false, None) => "none: light falls where projector.position and projector.look_at say".into(),
        };
        return Finding::new(
            name,
            Severity::Warning,
            known,
            "measure with `dpm calibrate` (docs/CALIBRATION.md)",
        );
    };
    let measured = match file::load(path) {
        Ok(measured) => measured,
        Err(e) => {
            return Finding::new(name, Severity::Missing, e.to_string(), "measure again with `dpm calibrate`")
        }
    };
    let mut parts = Vec::new();
    if let Some(p) = &measured.projector {
        let [width, height] = p.size;
        let told = format!("projector, {width} x {height}, light within {:.2} px", p.predicted_p99_px);
        parts.push((told, &p.provenance.date));
    }
    parts.extend(measured.bodies.iter().map(|(body, b)| (format!("body \"{body}\""), &b.provenance.date)));
    parts.extend(measured.latency.as_ref().map(|l| ("latency".to_owned(), &l.provenance.date)));
    parts.extend(measured.light.as_ref().map(|l| ("light".to_owned(), &l.provenance.date)));
    let ages: Vec<Option<u64>> = parts.iter().map(|(_, date)| days_since(date, SystemTime::now())).collect();
    let told: Vec<String> =
        parts.iter().zip(&ages).map(|((part, _), age)| format!("{part} ({})", aged(*age))).collect();
    let found =
        format!("{}: {}", path.display(), if told.is_empty() { "empty".into() } else { told.join("; ") });
    if measured.projector.is_none() {
        return Finding::new(
            name,
            Severity::Warning,
            found,
            "the projector was not measured: `dpm calibrate projector`",
        );
    }
    if ages.iter().any(|age| age.is_none_or(|days| days > OLD_DAYS)) {
        return Finding::new(
            name,
            Severity::Warning,
            found,
            "see by `dpm calibrate check` whether it still holds",
        );
    }
    Finding::new(name, Severity::Ok, found, "")
}

/// An order that outlived the run in which it was given.
fn standing_order(config: &RigConfig) -> Option<Finding> {
    let identity = Identity::of(&config.projector.backend);
    let stands = standing(&identity)?;
    let found =
        format!("the projector stays dark: {} stands {}", stands.order.word().to_uppercase(), stands.told);
    Some(Finding::new("standing order", Severity::Warning, found, "run the rig and say `dpm arm`"))
}

/// Whether the page can listen.
fn page(config: &RigConfig) -> Option<Finding> {
    let text = config.page.listen.as_ref()?;
    let address: SocketAddr = text.parse().ok()?;
    Some(match TcpListener::bind(address) {
        Ok(_) => Finding::new("page", Severity::Ok, format!("http://{address} is free"), ""),
        Err(e) => {
            let remedy =
                "a dpm that runs, or another program, has the port: stop it, or change page.listen (which must be an address of this machine)";
            Finding::new("page", Severity::Missing, format!("cannot listen on {address}: {e}"), remedy)
        }
    })
}

/// Whether reports and pictures can be written. A folder that is not there yet is judged by the one above it.
fn output(dir: &Path) -> Finding {
    let name = "output folder";
    let there = dir
        .ancestors()
        .map(|d| if d.as_os_str().is_empty() { Path::new(".") } else { d })
        .find(|d| d.exists());
    let there = there.unwrap_or(Path::new("/"));
    if !there.is_dir() || !os::may_read_and_write(there) {
        let found =
            format!("{} cannot be written: {} is no folder that may be", dir.display(), there.display());
        return Finding::new(name, Severity::Missing, found, "set output.dir, or give --out");
    }
    match os::free_bytes(there) {
        None => Finding::new(name, Severity::Ok, format!("{}", dir.display()), ""),
        Some(free) => {
            let found = format!("{}, {:.1} GB free", dir.display(), free as f64 / 1e9);
            match free < LITTLE_SPACE {
                true => {
                    Finding::new(name, Severity::Warning, found, "make room, or set output.dir elsewhere")
                }
                false => Finding::new(name, Severity::Ok, found, ""),
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use dpm_rig::config::Overrides;

    fn demo(flags: &[String]) -> RigConfig {
        RigConfig::demo(&Overrides { variables: vec![], flags: flags.to_vec() }).unwrap()
    }

    #[test]
    fn a_port_that_is_taken_is_missing() {
        let taken = TcpListener::bind("127.0.0.1:0").unwrap();
        let address = taken.local_addr().unwrap();
        let config = demo(&[format!("page.listen=\"{address}\"")]);
        assert_eq!(page(&config).unwrap().state, Severity::Missing);
        drop(taken);
        assert_eq!(page(&config).unwrap().state, Severity::Ok);
        assert!(page(&demo(&[])).is_none());
    }

    #[test]
    fn a_body_without_its_pipe_is_a_warning() {
        let of = |texture: &str| {
            let body = format!("scene.bodies=[{{ name = \"bunny\", texture = \"{texture}\" }}]");
            pictures(&demo(&[body]))
        };
        let missing = &of("pipe:/nowhere/bunny")[0];
        assert_eq!((missing.state, &missing.name[..]), (Severity::Warning, "pictures of bunny"));
        assert!(
            missing.found.contains("pipe:/nowhere/bunny: there is no such pipe; `mkfifo`"),
            "{missing:?}"
        );
        assert!(of("pipe:/etc/passwd")[0].found.contains("it is no named pipe"));
        assert!(pictures(&demo(&[])).is_empty());
    }

    #[test]
    fn a_folder_that_comes_later_is_judged_by_the_one_above_it() {
        let below = std::env::temp_dir().join("dpm-doctor-none/of/these");
        assert_ne!(output(&below).state, Severity::Missing);
        let file = std::env::temp_dir().join(format!("dpm-doctor-file-{}", std::process::id()));
        std::fs::write(&file, "").unwrap();
        assert_eq!(output(&file.join("x")).state, Severity::Missing);
        std::fs::remove_file(file).unwrap();
        assert_ne!(output(Path::new("out")).state, Severity::Missing);
    }
}
