//! Other people, and other nodes, on the same machine.

use std::process::{Command, Stdio};

use crate::program::{self, Running, command, ended, until};

/// Runs a shell script as root in a separate mount namespace: `/dev/shm` and `/tmp` are empty and gone afterwards, and
/// `$SQUEALCAST` can be started by any user. `None`, with a note, if that is not possible.
fn in_a_namespace(script: &str) -> Option<program::Run> {
    let possible =
        Command::new("unshare").args(["-m", "setpriv", "--reuid", "1111", "true"]).stderr(Stdio::null()).status();
    if !possible.is_ok_and(|status| status.success()) {
        program::skipped("this is not root, or there is no unshare and setpriv");
        return None;
    }
    // Mounted where `/tmp` does not hide it, whatever the permissions of its folder are.
    let around = format!(
        "set -eu
         mount -t tmpfs -o mode=755 tmpfs /mnt
         touch /mnt/squealcast
         mount --bind \"$0\" /mnt/squealcast
         mount -t tmpfs -o mode=1777,size=256m tmpfs /dev/shm
         mount -t tmpfs -o mode=1777 tmpfs /tmp
         cd /tmp
         export HOME=/tmp SQUEALCAST=/mnt/squealcast
         as() {{ user=$1; shift; exec setpriv --reuid $user --regid $user --clear-groups \"$SQUEALCAST\" \"$@\"; }}
         wait_for() {{ n=0; until \"$@\" 2>/dev/null; do n=$((n+1)); [ $n -lt 600 ] || exit 99; sleep 0.1; done; }}
         {script}"
    );
    let output = Command::new("unshare").args(["-m", "sh", "-c", &around, env!("CARGO_BIN_EXE_squealcast")]).output();
    Some(ended(output.expect("unshare was there")))
}

/// iceoryx2 keeps its files in a folder that belongs to its first user. The second user gets a separate folder, which all
/// of this user's processes share.
#[test]
fn a_second_user_gets_shared_memory_of_their_own() {
    let script = "
        as 1111 simulate --no-ros --rate 50 > first.out 2>&1 & first=$!
        wait_for test -d /tmp/iceoryx2/services
        as 2222 run nine-dof --no-ros --no-display --no-chart --plain > node.out 2> node.err & node=$!
        wait_for grep -q 'using /tmp/iceoryx2-2222' node.err
        as 2222 simulate --no-ros --rate 50 > second.out 2>&1 & second=$!
        wait_for grep -q 'seq ' node.out
        kill -TERM $second $node $first
        wait $second; wait $node; wait $first
        grep -c 'using /tmp' node.err
        cat node.err >&2
        stat -c '%u %a' /tmp/iceoryx2-2222";
    let Some(ran) = in_a_namespace(script) else { return };
    let ran = ran.exits(0).says("1\n2222 700\n");
    ran.complains("shared memory: /tmp/iceoryx2 belongs to user 1111");
}

/// The name of the folder may be taken already.
#[test]
fn a_folder_that_others_could_write_to_is_refused() {
    let script = "
        mkdir -m 755 /tmp/iceoryx2; chown 1111 /tmp/iceoryx2
        mkdir -m 777 /tmp/iceoryx2-2222; chown 1111 /tmp/iceoryx2-2222
        as 2222 run nine-dof --no-ros --no-display";
    let Some(ran) = in_a_namespace(script) else { return };
    ran.exits(1).complains("/tmp/iceoryx2-2222: expected a folder of user 2222 that no other user can write to");
}

/// A page of shared memory without memory behind it would end the node with a signal.
#[test]
fn too_little_shared_memory_is_an_error() {
    let script = "
        mount -t tmpfs -o size=8m tmpfs /dev/shm
        as 2222 run nine-dof --no-ros --no-display";
    let Some(ran) = in_a_namespace(script) else { return };
    ran.exits(1).complains("/dev/shm has 8388608 bytes free, expected at least").complains("--no-shm stays off it");
}

/// Two nodes on one service: readers cannot distinguish their predictions.
#[test]
fn a_second_node_of_the_same_name_is_warned_about() {
    let prefix = format!("test-neighbours-{}/", std::process::id());
    let node = |rig| {
        ["run", rig, "--no-ros", "--no-display", "--no-chart", "--plain", "--shm-prefix", &prefix].map(str::to_owned)
    };
    let source = ["simulate", "--no-ros", "--rate", "50", "--shm-prefix", &prefix];
    let out = program::folder();
    let log = |name: &str| std::fs::File::create(out.path().join(name)).expect("a log");
    let read = |name: &str| std::fs::read_to_string(out.path().join(name)).expect("a log");
    let source = Running::start(command(source));
    let mut first =
        command(node("nine-dof")).stdout(log("first")).stderr(log("first.err")).spawn().expect("the program starts");
    until("the first node to predict", || read("first").contains("seq "));
    assert!(!read("first.err").contains("warning"), "{}", read("first.err"));
    let mut second = command(node("nine-dof-case-2"))
        .stdout(log("second"))
        .stderr(log("second.err"))
        .spawn()
        .expect("the program starts");
    until("the second node's warning", || {
        read("second.err").contains(&format!("warning: 1 more publish on the service {prefix}squealcast/prediction"))
    });
    for node in [&mut first, &mut second] {
        interrupt(node.id());
        assert!(node.wait().expect("it ends").success());
    }
    source.signal("INT").exits(0);
}

fn interrupt(id: u32) {
    assert!(Command::new("kill").args(["-INT", &id.to_string()]).status().expect("kill is there").success());
}
