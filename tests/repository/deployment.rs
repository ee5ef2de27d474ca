//! The installed files match the binary: units call existing commands, shipped configurations are accepted, the
//! package contains every file, and the pause before a restart grows.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Command;

use semidense::capture::rig::Rig;
use semidense::command::command_line;
use semidense::service::config::Config;

const PROCESSES: [&str; 3] = ["capture", "tracker", "mapper"];

fn root() -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR"))
}

fn unit(process: &str) -> String {
    let path = root().join(format!("deploy/systemd/semidense-{process}@.service"));
    fs::read_to_string(path).unwrap()
}

#[test]
fn units_call_commands_that_exist() {
    for process in PROCESSES {
        let text = unit(process).replace("\\\n", " ");
        let line = text.lines().find_map(|line| line.strip_prefix("ExecStart=/usr/bin/")).unwrap();
        let line = line.replace("%i", "front").replace("${SEMIDENSE_LOG}", "warn");
        let words: Vec<&str> = line.split_whitespace().collect();
        let matches = command_line().try_get_matches_from(&words).unwrap();
        assert_eq!(matches.subcommand_name(), Some(process));
        let of_unit = matches.subcommand().unwrap().1;
        let settings = of_unit.get_many::<String>("set").unwrap_or_default().cloned();
        Config::load(None, &settings.collect::<Vec<_>>()).unwrap();
    }
}

/// A booted machine takes minutes to report that its services refuse their configuration.
#[test]
fn the_configuration_of_the_test_robot_is_accepted() {
    let rig = root().join("deploy/robot-test/guest/robot.toml");
    Config::load(Some(&rig), &[]).unwrap();
}

#[test]
fn units_have_the_same_sandbox() {
    let closed = |process: &str| -> BTreeSet<String> {
        let text = unit(process);
        let (_, section) = text.split_once("# Everything else is closed.").unwrap();
        let is_setting = |line: &&str| line.contains('=') && !line.starts_with('#');
        let is_own = |line: &str| line.starts_with("DeviceAllow") || line.starts_with("PrivateDev");
        let settings = section.lines().filter(is_setting).filter(|line| !is_own(line));
        settings.map(str::to_owned).collect()
    };
    assert!(closed("tracker").len() > 20);
    for process in PROCESSES {
        assert_eq!(closed(process), closed("tracker"), "{process}");
    }
}

/// Units of the outputs, and the addresses that each may use.
const WAYS_OUT: [(&str, &[&str]); 5] = [
    ("view", &["localhost"]),
    ("record", &[]),
    ("ros2", &["localhost", "239.255.0.1"]),
    ("ros2-camera", &["localhost", "239.255.0.1"]),
    ("zenoh", &["localhost"]),
];

fn bridge_unit(name: &str) -> String {
    let path = root().join(format!("deploy/systemd/bridge/semidense-{name}@.service"));
    fs::read_to_string(path).unwrap()
}

#[test]
fn outputs_are_disabled_sandboxed_and_have_less_cpu_weight_than_the_rig() {
    let target = fs::read_to_string(root().join("deploy/systemd/semidense@.target")).unwrap();
    let tracker = unit("tracker");
    let (_, closed) = tracker.split_once("# Everything else is closed.").unwrap();
    for (name, addresses) in WAYS_OUT {
        let text = bridge_unit(name);
        assert!(!target.contains(name), "{name} must be asked for");
        let has = |line: &str| text.lines().any(|own| own == line);
        assert!(has("PartOf=semidense@%i.target") && has("WantedBy=semidense@%i.target"), "{name}");
        assert!(has("User=semidense") && has("IPAddressDeny=any"), "{name}");
        let allowed = addresses.join(" ");
        let is_allowed = |line: &&str| line.starts_with("IPAddressAllow=");
        let found = text.lines().find(is_allowed).unwrap_or("IPAddressAllow=");
        assert_eq!(found, format!("IPAddressAllow={allowed}"), "{name}");
        // They differ only in network settings, and only where the unit uses the network.
        for line in closed.lines().filter(|line| line.contains('=') && !line.starts_with('#')) {
            let is_network =
                line.starts_with("PrivateNetwork") || line.starts_with("RestrictAddressFamilies");
            assert!(has(line) || is_network && !addresses.is_empty(), "{name} lacks {line}");
        }
        // A camera feeds the rig; all other outputs have a lower priority.
        let weight = text.lines().find_map(|line| line.strip_prefix("CPUWeight=")).unwrap();
        let weight: u32 = weight.parse().unwrap();
        assert_eq!(weight > 100, name == "ros2-camera", "{name}: the usual weight is 100");
    }
}

#[test]
fn systemd_accepts_every_unit() {
    let is_there = Command::new("systemd-analyze").arg("--version").output().is_ok();
    if !is_there {
        eprintln!("left out: there is no systemd-analyze");
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let named = |name: &str| format!("semidense-{name}@.service");
    let units = PROCESSES.iter().map(|name| (named(name), unit(name)));
    let units: Vec<_> =
        units.chain(WAYS_OUT.iter().map(|(name, _)| (named(name), bridge_unit(name)))).collect();
    for (name, text) in &units {
        // systemd only checks that programs exist: any program will do.
        let text = text
            .replace("/usr/bin/semidense-bridge", "/bin/true")
            .replace("/usr/bin/semidense", "/bin/true")
            .replace("-/usr/lib/semidense/back-off", "-/bin/true");
        fs::write(folder.path().join(name), text).unwrap();
    }
    for target in ["semidense.target", "semidense@.target"] {
        fs::copy(root().join("deploy/systemd").join(target), folder.path().join(target)).unwrap();
    }
    for (name, _) in &units {
        let instance = name.replace('@', "@front");
        fs::copy(folder.path().join(name), folder.path().join(&instance)).unwrap();
        let output = Command::new("systemd-analyze")
            .args(["verify", "--man=no"])
            .arg(folder.path().join(&instance))
            .env("SYSTEMD_UNIT_PATH", format!("{}:", folder.path().display()))
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr);
        assert!(output.status.success() && !said.contains(&instance), "{name}: {said}");
    }
}

#[test]
fn the_rig_file_of_the_package_is_accepted() {
    let file = root().join("deploy/debian/webcam.toml");
    let config = Config::load(Some(&file), &[]).unwrap();
    assert!(config.capture.source.starts_with("v4l:"));
    let installed = Path::new("/usr/share/semidense/rigs");
    let name = Path::new(&config.capture.rig).strip_prefix(installed).unwrap();
    Rig::read(&root().join("config/rigs").join(name)).unwrap();
}

#[test]
fn the_package_contains_every_file() {
    let text = fs::read_to_string(root().join("Cargo.toml")).unwrap();
    let manifest: toml::Table = text.parse().unwrap();
    let deb = &manifest["package"]["metadata"]["deb"];
    let assets: Vec<(String, String)> = deb["assets"]
        .as_array()
        .unwrap()
        .iter()
        .map(|asset| {
            let word = |index: usize| asset[index].as_str().unwrap().to_owned();
            (word(0), word(1))
        })
        .collect();
    for (source, _) in assets.iter().filter(|(source, _)| !source.starts_with("target/")) {
        let folder = root().join(Path::new(source).parent().unwrap());
        let is_there =
            if source.contains('*') { folder.is_dir() } else { root().join(source).is_file() };
        assert!(is_there, "{source} is not there");
    }
    let rigs: Vec<_> =
        assets.iter().filter(|(_, place)| place == "usr/share/semidense/rigs/").collect();
    assert_eq!(rigs.len(), 1, "the folder that webcam.toml names");
    for file in deb["conf-files"].as_array().unwrap() {
        let (folder, name) = file.as_str().unwrap()[1..].rsplit_once('/').unwrap();
        let is_installed = |(source, place): &(String, String)| {
            place.trim_end_matches('/') == folder && source.ends_with(&format!("/{name}"))
        };
        assert!(assets.iter().any(is_installed), "{file} is not installed");
    }
}

#[test]
fn the_pause_before_a_restart_grows_and_is_reset() {
    let folder = tempfile::tempdir().unwrap();
    let after = |result: &str| {
        let status = Command::new("sh")
            .arg(root().join("deploy/systemd/back-off"))
            .arg("unit")
            .env("RUNTIME_DIRECTORY", folder.path())
            .env("SERVICE_RESULT", result)
            .status();
        assert!(status.unwrap().success());
        fs::read_to_string(folder.path().join(".back-off.unit")).ok().map(|t| t.trim().to_owned())
    };
    // Tenths of a second: after its first death a process restarts without a pause.
    let pauses: Vec<_> = (0..4).map(|_| after("signal").unwrap()).collect();
    assert_eq!(pauses, ["0", "2", "4", "8"]);
    assert_eq!(after("success"), None);
    assert_eq!(after("watchdog").as_deref(), Some("0"));
    // A life that was long enough to reset the pause.
    let file = fs::File::options().write(true).open(folder.path().join(".back-off.unit")).unwrap();
    file.set_modified(std::time::UNIX_EPOCH).unwrap();
    assert_eq!(after("signal").as_deref(), Some("0"));
}

#[test]
fn the_package_of_the_bridge_belongs_to_this_version_and_handles_all_its_units() {
    let manifest = fs::read_to_string(root().join("bridge/Cargo.toml")).unwrap();
    let depends = format!("semidense (= {}-1)", env!("CARGO_PKG_VERSION"));
    assert!(manifest.contains(&depends), "bridge/Cargo.toml does not depend on {depends}");
    let units = fs::read_dir(root().join("deploy/systemd/bridge")).unwrap().map(|entry| {
        let name = entry.unwrap().file_name().into_string().unwrap();
        name.strip_suffix("@.service").unwrap().to_owned()
    });
    let units: Vec<String> = units.collect();
    assert!(units.len() >= 5, "{units:?}");
    for (script, ending) in [("prerm", "@*"), ("postinst", "@*"), ("postrm", "")] {
        let text = fs::read_to_string(root().join("deploy/debian/bridge").join(script)).unwrap();
        let words: Vec<&str> = text.split([' ', '\n', ';', '\'']).collect();
        for unit in &units {
            let name = format!("{unit}{ending}");
            assert!(words.contains(&name.as_str()), "{script} leaves out {name}");
        }
    }
}
