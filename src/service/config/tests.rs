//! The configuration against its shipped file, and what is wrong said in one line.

use super::*;

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
fn later_words_win() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("semidense.toml");
    let text = "instance = \"rig2\"\n[mapper]\nthreads = 3\n[capture]\nrig = \"cam.toml\"\n";
    std::fs::write(&path, text).unwrap();
    let config = Config::load(Some(&path), &["mapper.threads=1".to_owned()]).unwrap();
    assert_eq!((config.instance.as_str(), config.mapper.threads), ("rig2", 1));
    // A path in a file is the file's, one on the command line is not.
    assert_eq!(Path::new(&config.capture.rig), folder.path().join("cam.toml"));
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
    assert!(
        error.ends_with("unknown key `mapper.thread`; keys of `mapper` are scheduling, threads")
    );
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
