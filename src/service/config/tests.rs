//! The configuration against its shipped file, and errors in one line.

use super::*;
use crate::slam::image::noise::ImageNoise;
use crate::slam::keyframe::DistanceWeights;

fn set(settings: &[&str]) -> Result<Config, String> {
    let settings: Vec<String> = settings.iter().map(|s| (*s).to_owned()).collect();
    Config::load(None, &settings).map_err(|e| e.to_string())
}

/// Every key with its value, dotted.
fn keys(table: &Table, prefix: &str, found: &mut Vec<(String, Value)>) {
    for (key, value) in table {
        let name = format!("{prefix}{key}");
        match value {
            Value::Table(inner) => keys(inner, &format!("{name}."), found),
            value => found.push((name, value.clone())),
        }
    }
    found.sort_by(|a, b| a.0.cmp(&b.0));
}

#[test]
fn the_shipped_file_lists_every_key_with_its_default() {
    let path = concat!(env!("CARGO_MANIFEST_DIR"), "/config/semidense.toml");
    let text = std::fs::read_to_string(path).unwrap();
    let (mut shipped, mut built_in) = (Vec::new(), Vec::new());
    keys(&text.parse().unwrap(), "", &mut shipped);
    keys(&Config::default().to_text().parse().unwrap(), "", &mut built_in);
    for (key, value) in &built_in {
        let listed = shipped.iter().find(|(k, _)| k == key).map(|(_, v)| v);
        assert_eq!(listed, Some(value), "{key} in config/semidense.toml");
    }
    assert_eq!(shipped.len(), built_in.len());
    let lines: Vec<&str> = text.lines().collect();
    for pair in lines.windows(2) {
        let is_entry = pair[1].contains('=') && !pair[1].starts_with('#');
        assert!(!is_entry || pair[0].starts_with("# "), "no unit and reason: {}", pair[1]);
    }
}

#[test]
fn presets_load_and_change_every_key_they_name() {
    let folder = concat!(env!("CARGO_MANIFEST_DIR"), "/config/presets");
    let mut num_presets = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let keys = Config::effective_keys(Some(&path), &[]).unwrap();
        let (mut named, mut same) = (0, Vec::new());
        for key in keys.iter().filter(|key| key.origin == Origin::File(path.clone())) {
            assert!(!key.is_expert, "{}: {} is an expert's", path.display(), key.key);
            named += 1;
            // Priorities are listed next to their policy for the reader.
            if key.built_in.is_none() && !key.key.ends_with(".priority") {
                same.push(&key.key);
            }
        }
        assert!(
            named > 0 && same.is_empty(),
            "{}: {named} keys, as built in: {same:?}",
            path.display()
        );
        num_presets += 1;
    }
    assert_eq!(num_presets, 4);
}

#[test]
fn the_text_of_a_configuration_has_a_users_keys_outside_expert() {
    let text = Config::default().to_text();
    let table: toml::Table = text.parse().unwrap();
    let has = |table: &toml::Table, of: &str, key: &str| {
        table.get(of).is_some_and(|inner| inner.get(key).is_some())
    };
    let expert = table["expert"].as_table().unwrap();
    assert!(has(&table, "tracker", "deadline_ms") && !has(expert, "tracker", "deadline_ms"));
    assert!(has(expert, "mapping", "min_gradient") && !has(&table, "mapping", "min_gradient"));
    assert_eq!(Config::from_text(&text, "x.toml").unwrap(), Config::default());
}

#[test]
fn a_key_is_the_same_with_and_without_expert() {
    let read = |text: &str| Config::from_text(text, "x.toml");
    let expected = set(&["mapping.matching.line_noise_px=0.5"]).unwrap();
    assert_eq!(expected.mapping.matching.line_noise_px, 0.5);
    assert_eq!(set(&["expert.mapping.matching.line_noise_px=0.5"]).unwrap(), expected);
    assert_eq!(read("[mapping.matching]\nline_noise_px = 0.5\n").unwrap(), expected);
    assert_eq!(read("[expert.mapping.matching]\nline_noise_px = 0.5\n").unwrap(), expected);
    // Tables may be spread over both parts, single keys may not.
    let spread =
        "[mapping]\ndepth_filter = \"both\"\n[expert.mapping.matching]\nline_noise_px = 0.5\n";
    assert_eq!(read(spread).unwrap().mapping.matching, expected.mapping.matching);
    let twice = "[mapping]\nmin_gradient = 4.0\n[expert.mapping]\nmin_gradient = 6.0\n";
    let error = read(twice).unwrap_err().to_string();
    let told = "x.toml:2: `min_gradient = 4.0`: `mapping.min_gradient` is also given as \
                `expert.mapping.min_gradient`: keep one";
    assert_eq!(error, told);
    // The later setting wins, whichever way it is written.
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.toml");
    std::fs::write(&path, "[expert.mapping]\nmin_gradient = 6.0\n").unwrap();
    for setting in ["mapping.min_gradient=7.0", "expert.mapping.min_gradient=7.0"] {
        let config = Config::load(Some(&path), &[setting.to_owned()]).unwrap();
        assert_eq!(config.mapping.min_gradient, 7.0, "{setting}");
    }
    assert_eq!(Config::load(Some(&path), &[]).unwrap().mapping.min_gradient, 6.0);
    // The configuration's text reads back unchanged.
    assert_eq!(read(&expected.to_text()).unwrap(), expected);
}

#[test]
fn errors_below_expert_name_line_and_listed_key() {
    let error = |text: &str| Config::from_text(text, "x.toml").unwrap_err().to_string();
    let told = error("[expert.tracking]\n\nmin_contrast = \"x\"\n");
    assert!(told.starts_with("x.toml:3: `min_contrast = \"x\"`: invalid type"), "{told}");
    let told = error("[expert.tracking]\nmin_contrast = -1.0\n");
    assert!(told.starts_with("x.toml: expert.tracking.min_contrast = -1: must be"), "{told}");
    let told = error("[tracker]\ndeadline_ms = 1.0\n[expert.tracker]\nmin_contrast = 1.0\n");
    assert!(told.starts_with("x.toml:4: `min_contrast = 1.0`: unknown field"), "{told}");
    let told = error("expert = 3\n");
    assert!(told.starts_with("x.toml:1: `expert = 3`: expected keys below it"), "{told}");
    assert!(
        error("[expert.expert.mapping]\nmin_gradient = 6.0\n").contains("unknown field `expert`")
    );
    let told = set(&["expert.mapping.min_gradint=6.0"]).unwrap_err();
    assert!(told.contains("unknown key `mapping.min_gradint`; keys of `mapping` are "), "{told}");
    for setting in ["expert=2", "expert. expert=2"] {
        let expected = format!("--set {setting}: it has keys below it");
        assert!(set(&[setting]).unwrap_err().starts_with(&expected), "{setting}");
    }
    let told = set(&["tracking.min_contrast=-1.0"]).unwrap_err();
    assert!(told.contains("expert.tracking.min_contrast = -1: must be"), "{told}");
}

#[test]
fn tracker_and_mapper_agree_on_keyframe_distance() {
    let mut expected = DistanceWeights::default();
    assert_eq!(Config::default().mapping.reuse.distance, expected);
    expected.translation = 2.0;
    let config = set(&["tracking.keyframe_distance_weight=2.0"]).unwrap();
    assert_eq!(config.mapping.reuse.distance, expected);
    assert_eq!(Config::from_text(&config.to_text(), "x.toml").unwrap(), config);
}

#[test]
fn later_settings_win() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("semidense.toml");
    let text = "instance = \"rig2\"\n[mapper]\nthreads = 3\n[capture]\nrig = \"cam.toml\"\nmask = \"arm.png\"\n";
    std::fs::write(&path, text).unwrap();
    let config = Config::load(Some(&path), &["mapper.threads=1".to_owned()]).unwrap();
    assert_eq!((config.instance.as_str(), config.mapper.threads), ("rig2", 1));
    // A path in a file is relative to that file, one on the command line is not.
    assert_eq!(Path::new(&config.capture.rig), folder.path().join("cam.toml"));
    assert_eq!(Path::new(&config.capture.mask), folder.path().join("arm.png"));
    let config = Config::load(Some(&path), &["capture.rig=x.toml".to_owned()]).unwrap();
    assert_eq!(config.capture.rig, "x.toml");
    assert_eq!(set(&["instance=rig3"]).unwrap().instance, "rig3");
    assert_eq!(Config::load(None, &[]).unwrap(), Config::default());
}

#[test]
fn an_instance_has_its_own_file_or_the_common_one() {
    let folder = tempfile::tempdir().unwrap();
    let found = |instance| {
        let file = file_for(folder.path(), instance)?;
        Some(file.file_name()?.to_str()?.to_owned())
    };
    assert_eq!(found(Some("front")), None);
    std::fs::write(folder.path().join("semidense.toml"), "").unwrap();
    std::fs::write(folder.path().join("front.toml"), "").unwrap();
    assert_eq!(found(Some("front")).as_deref(), Some("front.toml"));
    assert_eq!(found(Some("rear")).as_deref(), Some("semidense.toml"));
    assert_eq!(found(None).as_deref(), Some("semidense.toml"));
    assert_eq!(found(Some("../front")).as_deref(), Some("semidense.toml"));
}

#[test]
fn errors_name_place_key_value_and_range() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("x.toml");
    let load = |text: &str| {
        std::fs::write(&path, text).unwrap();
        Config::load(Some(&path), &[]).unwrap_err().to_string()
    };
    let error = load("[mapper]\n\nthread = 3\n");
    assert!(error.contains("x.toml:3: `thread = 3`: unknown field `thread`"), "{error}");
    let error = load("[tracker]\ndeadline_ms = -1.0\n");
    assert!(error.ends_with("x.toml: tracker.deadline_ms = -1: must be 0 to 10000"), "{error}");
    let error = load("[tracker]\ndeadline_ms = nan\n");
    assert!(error.contains("tracker.deadline_ms = NaN"), "{error}");
    assert!(load("[mapper]\nthreads = \"x\"\n").contains("x.toml:2: `threads = \"x\"`"));
    assert!(load("[[[").contains("x.toml:1"));
    assert_eq!(load("a = [\n\n\n").lines().count(), 1);
    let error = Config::load(Some(Path::new("/nowhere.toml")), &[]).unwrap_err().to_string();
    assert!(error.starts_with("/nowhere.toml: "), "{error}");
}

#[test]
fn bad_settings_are_refused() {
    assert!(set(&["mapper.threads"]).unwrap_err().contains("key=value"));
    let error = set(&["mapper.thread=1"]).unwrap_err();
    let told = "unknown key `mapper.thread`; keys of `mapper` are background, scheduling, threads";
    assert!(error.ends_with(told), "{error}");
    let error = set(&["tracking.alignment.hubr=1"]).unwrap_err();
    assert!(error.contains("unknown key `tracking.alignment.hubr`; keys of "), "{error}");
    let error = set(&["mappr.threads=1"]).unwrap_err();
    assert!(error.contains("unknown key `mappr`; keys are "), "{error}");
    assert!(set(&["mapper.threads=x"]).unwrap_err().contains("mapper.threads=x: invalid type"));
    assert!(set(&["mapper.threads=-3"]).unwrap_err().ends_with("a whole number, 0 or more"));
    assert!(set(&["mapper=2"]).unwrap_err().contains("expected keys below it"));
    assert!(set(&["tracker.deadline_ms=x"]).unwrap_err().ends_with("expected a number"));
    assert!(set(&["mapper.threads=999"]).unwrap_err().contains("0 to 256"));
    assert!(set(&["instance.x=1"]).is_err());
    assert!(set(&["=1"]).is_err());
    assert!(set(&["mapper.threads=1\nx=2"]).is_err());
}

#[test]
fn the_camera_noise_is_shared_and_replaced_keys_are_named() {
    let config = set(&["noise.pixel_std_dev=2.0", "expert.noise.model_std_dev=5.0"]).unwrap();
    let noise = ImageNoise { pixel_std_dev: 2.0, model_std_dev: 5.0 };
    let (tracking, mapping) = (&config.tracking, &config.mapping);
    assert_eq!(config.noise, noise);
    assert_eq!((tracking.alignment.noise, tracking.reference.selection.noise), (noise, noise));
    assert_eq!((mapping.matching.noise, mapping.two_frame.fit.noise), (noise, noise));
    let pixel = ["tracking.alignment.pixel_noise", "mapping.matching.image_noise"];
    let model = ["tracking.alignment.model_noise"];
    let replaced = pixel.map(|key| (key, "pixel")).into_iter();
    for (key, now) in replaced.chain(model.map(|key| (key, "model"))) {
        let expected = format!("`{key}` is now `expert.noise.{now}_std_dev`");
        let told = set(&[&format!("{key}=2.0")]).unwrap_err();
        assert!(told.ends_with(&expected), "{told}");
        let (table, name) = key.rsplit_once('.').unwrap();
        for table in [table.to_owned(), format!("expert.{table}")] {
            let text = format!("# Mine.\n[{table}]\n{name} = 2.0\n");
            let told = Config::from_text(&text, "mine.toml").unwrap_err().to_string();
            assert!(told.contains("mine.toml:3") && told.contains(&expected), "{told}");
        }
    }
}

#[test]
fn a_renamed_key_is_told_its_name() {
    let start = "mapping.two_frame";
    let renamed = [
        ("max_witnesses", "max_earlier_frames"),
        ("evidence.min_early_witnesses", "evidence.min_earlier_frames"),
    ];
    for (before, now) in renamed {
        let told = set(&[&format!("{start}.{before}=5")]).unwrap_err();
        let expected = format!("`{start}.{before}` is now `expert.{start}.{now}`");
        assert!(told.ends_with(&expected), "{told}");
        assert!(set(&[&format!("{start}.{now}=5")]).is_ok());
    }
}

#[test]
fn the_shipped_file_documents_the_range_of_every_number() {
    let text = include_str!("../../../config/semidense.toml");
    let mut all = Vec::new();
    keys(&text.parse().unwrap(), "", &mut all);
    let mut checked = 0;
    for (key, value) in all {
        // Too large, too small: one of them is refused, naming what is allowed.
        let wrong: &[&str] = match value {
            Value::Float(_) => &["1e30", "-1e30"],
            Value::Integer(_) => &["100000000", "255", "0"],
            _ => continue,
        };
        let refused = wrong.iter().find_map(|wrong| {
            let error = set(&[&format!("{key}={wrong}")]).err()?;
            error.split_once(": must be ").map(|(_, allowed)| allowed.to_owned())
        });
        let Some(allowed) = refused else { continue };
        let comment = comment_of(text, &key);
        assert!(comment.contains(&allowed), "{key}: {allowed} is not in: {comment}");
        checked += 1;
    }
    assert!(checked > 100, "{checked}");
}

/// The comment above a key of a file, on one line.
fn comment_of(text: &str, key: &str) -> String {
    let (table, name) = key.rsplit_once('.').unwrap_or(("", key));
    let header = format!("[{table}]");
    let lines: Vec<&str> = text.lines().collect();
    let begin = lines.iter().position(|line| *line == header).unwrap_or(0);
    let of_key = |line: &&str| line.strip_prefix(name).is_some_and(|rest| rest.starts_with(" = "));
    let end = begin + lines[begin..].iter().position(of_key).unwrap();
    let above = lines[..end].iter().rev().take_while(|line| line.starts_with('#'));
    let words: Vec<&str> = above.map(|line| line.trim_start_matches("# ")).collect();
    words.into_iter().rev().collect::<Vec<_>>().join(" ")
}

#[test]
fn a_read_out_time_of_the_configuration_comes_before_the_rig_s() {
    let readout_s = |settings: &[&str]| set(settings).unwrap().capture.corrections().readout_s;
    assert_eq!(readout_s(&[]), None);
    assert_eq!(readout_s(&["capture.readout_ms=20"]), Some(0.02));
    let off = "capture.undo_rolling_shutter=false";
    assert_eq!(readout_s(&[off]), Some(0.0));
    assert_eq!(readout_s(&["capture.readout_ms=20", off]), Some(0.0));
    assert!(!set(&["capture.brighten=false"]).unwrap().capture.corrections().brighten);
    let undone = |settings: &[&str]| set(settings).unwrap().capture.corrections().undo_vignette;
    assert!(undone(&[]) && !undone(&["capture.undo_vignette=false"]));
}

#[test]
fn spread_points_are_fused_without_support_around_them() {
    let params = |filter: &str| {
        let config = set(&[&format!("mapping.depth_filter={filter}")]).unwrap();
        let fusion = config.results.fusion();
        (fusion.min_support, fusion.min_company)
    };
    assert_eq!(params("interval"), (0, 0));
    assert!(params("gaussian").0 > 0 && params("both").1 > 0);
}
