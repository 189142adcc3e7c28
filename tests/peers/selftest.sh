#!/bin/sh
# Checks the peers against the stand-in: they must pass when all is right and fail, for the right reason, for each
# defect it can have. Takes about two minutes.
#
#     tests/peers/selftest.sh [DIR]        DIR: where setup.sh put the environments, default target/peers
set -eu

here=$(cd "$(dirname "$0")" && pwd)
dir=${1:-$here/../../target/peers}
domain=$((30 + $$ % 60))
bad=0
standin=
out=$(mktemp)
trap 'stop; rm -f "$out"' EXIT
trap 'exit 1' INT TERM

start() { # arguments of the stand-in
    domain=$((30 + (domain - 29) % 60)) # a separate domain: endpoints linger
    "$dir/bin/ros-python" "$here/echo_node.py" --domain "$domain" --seconds 60 "$@" &
    standin=$!
}

stop() {
    [ -z "$standin" ] || { kill "$standin" 2>/dev/null || :; wait "$standin" 2>/dev/null || :; }
    standin=
}

rclpy_peer() { "$dir/bin/ros-python" "$here/rclpy_peer.py" --domain "$domain" "$@" >"$out"; }
cyclone_peer() { "$dir/bin/python" "$here/cyclone_peer.py" --domain "$domain" "$@" >"$out"; }

expect() { # what must be found ("" nothing, else the kind of failure), what was run, its exit code
    if [ -z "$1" ]; then
        [ "$3" = 0 ] && grep -q '"ok": true' "$out" && { echo "ok    $2: passes"; return; }
    else
        [ "$3" = 1 ] && grep -q "\"$1\": [1-9]" "$out" && { echo "ok    $2: found ($1)"; return; }
    fi
    bad=1
    echo "WRONG $2: exit code $3, expected ${1:-no failure}"
    cat "$out"
}

# The peer, what it must find, options of the peer, then of the stand-in.
try() {
    peer=$1 kind=$2 options=$3
    shift 3
    start "$@"
    code=0
    # Options are words without spaces.
    $peer --seconds 2 --expect-modes 9 --expect-unstable-above 0.35 $options || code=$?
    stop
    expect "$kind" "$peer $options, stand-in $*" "$code"
}

for peer in rclpy_peer cyclone_peer; do
    try $peer "" ""
    try $peer "" "--first-seq 9007199254740993"
    try $peer missing "" --defect drop
    try $peer "" "--allow-passed-over" --defect drop
    try $peer duplicate "" --defect duplicate
    try $peer out_of_order "" --defect swap
    try $peer stamp "" --defect stamp
    try $peer foreign "" --defect seq
    try $peer fault "" --defect fault
    try $peer modes "" --modes 8
    try $peer stability "" --critical 0.36
done
try rclpy_peer "" "--only-exchange" --defect no-rig
try rclpy_peer rig "" --defect no-rig
try rclpy_peer rig "--expect-rig other"
try rclpy_peer parameters "" --defect accept-all
try rclpy_peer parameters "" --defect no-reason
try rclpy_peer diagnostics "" --defect no-diagnostics
try rclpy_peer silence "" --defect no-silence
try rclpy_peer silence "" --defect chatty-silence

for peer in rclpy_peer cyclone_peer; do
    domain=$((30 + (domain - 29) % 60))
    code=0
    $peer --wait 3 || code=$?
    expect discovery "$peer, no node" "$code"
done
exit $bad
