//! A node as a service: its configuration file, read again at SIGHUP; what it tells the service manager.

use std::fs;
use std::os::unix::net::UnixDatagram;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use squealcast::recording::message::Payload;
use squealcast::recording::reader::{Entry, Recording};

use crate::domain::Domain;
use crate::program::{self, PATIENCE, Running, folder, run, text};
use crate::records::{known, read};
use crate::ros2_side::ParameterClient;

/// The socket of a service manager.
struct Manager(UnixDatagram);

impl Manager {
    fn new(folder: &Path) -> Self {
        let socket = UnixDatagram::bind(folder.join("notify")).expect("a socket");
        socket.set_read_timeout(Some(PATIENCE)).expect("a limit");
        Self(socket)
    }

    /// The next message.
    fn next(&self) -> String {
        let mut bytes = [0; 4096];
        let length = self.0.recv(&mut bytes).expect("told in time");
        String::from_utf8_lossy(&bytes[..length]).trim_end().to_owned()
    }

    /// Waits for a message that begins with `start`; returns those before it.
    fn until(&self, start: &str) -> Vec<String> {
        let began = Instant::now();
        let mut before = vec![];
        loop {
            let message = self.next();
            if message.starts_with(start) {
                return before;
            }
            before.push(message);
            assert!(began.elapsed() < PATIENCE, "waited for {start}, told {before:?}");
        }
    }

    /// Whether nothing is told for this long.
    fn is_silent(&self, time: Duration) -> bool {
        self.0.set_read_timeout(Some(time)).expect("a limit");
        let silent = self.0.recv(&mut [0; 4096]).is_err();
        self.0.set_read_timeout(Some(PATIENCE)).expect("a limit");
        silent
    }
}

fn node(file: &Path, folder: &Path, watchdog: Duration) -> Command {
    let mut command = program::command(["run", "--config", &text(file)]);
    command.env("NOTIFY_SOCKET", folder.join("notify")).env("WATCHDOG_USEC", watchdog.as_micros().to_string());
    command
}

/// The settings in the recordings that `open` reads from a folder, in order, after those of their start.
fn changed_settings(folder: &Path, open: impl Fn(&Path) -> Vec<Entry>) -> Vec<(String, f64)> {
    let sessions = fs::read_dir(folder).expect("recorded").map(|entry| entry.expect("a session").path());
    let entries: Vec<_> = sessions.flat_map(|session| open(&session)).collect();
    let settings = entries.iter().filter_map(|entry| match known(entry) {
        Some(Payload::SessionEvent(event)) if !event.name.is_empty() => Some((event.name.clone(), event.value)),
        _ => None,
    });
    settings.skip(squealcast::session::settings::PARAMETERS.len()).collect()
}

#[test]
fn a_configuration_is_read_again_at_sighup() {
    let (folder, domain) = (folder(), Domain::claim());
    let (file, records) = (folder.path().join("node.toml"), folder.path().join("records"));
    let content = |rig: &str, set: &str| {
        let (id, records) = (domain.id, text(&records));
        let prefix = std::process::id();
        format!(
            "rig = '{rig}'\nrecord = '{records}'\ndomain = {id}\nloopback = true\nno_display = true\nno_chart = true\n\
             shm_prefix = 'service-{prefix}/'\n[set]\n{set}\n"
        )
    };
    let write = |text: &str| fs::write(&file, text).expect("written");
    write(&content("nine-dof-case-2", "warn_margin = 0.1"));
    let manager = Manager::new(folder.path());
    let running = Running::start(node(&file, folder.path(), PATIENCE));
    manager.until("READY=1");
    let client = ParameterClient::join(domain.id);
    assert_eq!(client.get("warn_margin"), 0.1);
    let reload = || {
        running.send("HUP");
        let before = manager.until("RELOADING=1");
        manager.until("READY=1");
        before
    };

    write(&content("nine-dof-case-2", "warn_margin = 0.2\nsilence_timeout_s = 3"));
    reload();
    program::until("ROS 2 has the new value", || client.get("warn_margin") == 0.2);
    // Faulty: one value is right, one wrong.
    write(&content("nine-dof-case-2", "warn_margin = 0.3\nsilence_timeout_s = -1"));
    reload();
    write("rig = 'nine-dof-case-2'\nrecrd = 'x'\n");
    reload();
    // Not without a restart; and a setting that is no longer named is the rig's own.
    write(&content("tribometer", "warn_margin = 0.2"));
    reload();
    program::until("ROS 2 has the rig's own", || client.get("silence_timeout_s") == 1.0);
    assert_eq!(client.get("warn_margin"), 0.2);
    // A value that a peer has set gives way to the file's.
    assert_eq!(client.set("warn_margin", 0.4), Ok(()));
    // The ROS 2 side answers before the node has it.
    let so_far = |session: &Path| Recording::open(session).map_or(vec![], |recording| recording.messages().collect());
    program::until("the node has the peer's value", || {
        changed_settings(&records, so_far).last().is_some_and(|(_, value)| *value == 0.4)
    });
    reload();
    program::until("ROS 2 has the file's value again", || client.get("warn_margin") == 0.2);
    let ended = running.signal("TERM").exits(0);
    manager.until("STOPPING=1");

    let name = text(&file);
    for words in [
        "warn_margin is now 0.2, was 0.1",
        "silence_timeout_s is now 3, was 1",
        "silence_timeout_s is now 1, was 3",
        "takes effect with the next start: rig",
        "warn_margin is now 0.2, was 0.4",
    ] {
        assert!(ended.stderr.contains(&format!("{name}: {words}")), "{words}\n{}", ended.stderr);
    }
    for words in ["set: invalid value 'silence_timeout_s=-1'", "unknown key recrd, did you mean record?"] {
        assert!(
            ended.stderr.contains(&format!("error: nothing is changed: {name}: {words}")),
            "{words}\n{}",
            ended.stderr
        );
    }
    assert!(!ended.stderr.contains("now 0.3"), "{}", ended.stderr);
    let expected = [
        ("warn_margin", 0.2),
        ("silence_timeout_s", 3.0),
        ("silence_timeout_s", 1.0),
        ("warn_margin", 0.4),
        ("warn_margin", 0.2),
    ];
    assert_eq!(changed_settings(&records, read), expected.map(|(name, value)| (name.to_owned(), value)));
}

#[test]
fn a_stopped_node_feeds_no_watchdog() {
    let folder = folder();
    let file = folder.path().join("node.toml");
    fs::write(&file, "rig = 'nine-dof-case-2'\nno_ros = true\nno_shm = true\nno_display = true\nno_chart = true\n")
        .unwrap();
    let manager = Manager::new(folder.path());
    let running = Running::start(node(&file, folder.path(), Duration::from_secs(2)));
    assert_eq!(manager.next(), "READY=1");
    assert_eq!(manager.next(), "STATUS=WAITING: no input was received yet");
    for _ in 0..2 {
        manager.until("WATCHDOG=1");
    }
    running.send("STOP");
    program::until("it stops", || manager.is_silent(Duration::from_secs(3)));
    running.send("CONT");
    manager.until("WATCHDOG=1");
    running.signal("TERM").exits(0);
    manager.until("STOPPING=1");
}

#[test]
fn a_configuration_is_checked_without_a_start() {
    let folder = folder();
    let file =
        program::write(folder.path(), "node.toml", "rig = 'nine-dof'\nno_ros = true\n[set]\nwarn_margin = 0.1\n");
    let checked = run(["run", "--config", &file, "--no-chart", "--check-config"]).exits(0);
    let expected = format!("squealcast run --config {file} --no-chart nine-dof --no-ros --set=warn_margin=0.1\n");
    let words = |line: &str| line.split_whitespace().map(str::to_owned).collect::<std::collections::BTreeSet<_>>();
    assert_eq!(words(&checked.stdout), words(&expected));
    let file = program::write(folder.path(), "faulty.toml", "rig = 'no-such-rig'\n");
    run(["run", "--config", &file, "--check-config"]).exits(1).complains("no-such-rig");
    let file = program::write(folder.path(), "faulty.toml", "no_rso = true\n");
    run(["run", "--config", &file]).exits(2).complains("faulty.toml: unknown key no_rso, did you mean no_ros?");
    run(["run", "--config", "/no/such/file"]).exits(2).complains("/no/such/file: No such file");
    run(["run", "--check-config"]).exits(1).complains("--check-config needs --config FILE");
}

/// Statuses are on standard output, notes on standard error, as in the log that is text.
#[test]
fn a_log_in_json_is_one_object_a_line() {
    let folder = folder();
    let records = text(folder.path());
    let ended = run([
        "demo",
        "nine-dof-case-2",
        "--no-ros",
        "--no-shm",
        "--no-chart",
        "--display",
        "127.0.0.1:0",
        "--duration",
        "2",
        "--record",
        &records,
        "--log-format",
        "json",
    ])
    .exits(0);
    let lines = |text: &str| -> Vec<serde_json::Value> {
        text.lines().map(|line| serde_json::from_str(line).unwrap_or_else(|error| panic!("{error}: {line}"))).collect()
    };
    let (statuses, notes) = (lines(&ended.stdout), lines(&ended.stderr));
    assert!(
        statuses.iter().any(|line| line["message"].is_string() && line["friction_coefficient"].is_number()),
        "{statuses:?}"
    );
    assert!(statuses.iter().all(|line| line["event"] == "status" && line["time"].is_string()), "{statuses:?}");
    let said =
        |words: &str| notes.iter().any(|note| note["message"].as_str().is_some_and(|text| text.starts_with(words)));
    assert!(said("display: http://127.0.0.1:") && said("recorded "), "{notes:?}");
    assert!(notes.iter().all(|line| line["event"] == "note" && line["severity"] == "info"), "{notes:?}");
    run(["run", "no-such-rig", "--log-format", "json"]).exits(1).complains("error: ");
}
