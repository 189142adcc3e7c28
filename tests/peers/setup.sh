#!/bin/sh
# Sets up the real peers of the node's tests: rclpy with the messages of msgs/ built by rosidl,
# CycloneDDS, iceoryx2 and readers of recordings.
#
#     tests/peers/setup.sh [DIR]        DIR: default target/peers
#
# Needs Python 3.11 or later, gcc, g++, make and a package index that pip can reach. Environment:
#     PEERS_ROS=kilted|jazzy    which ROS 2 (default kilted)
#     PEERS_TOOLS=no            rclpy alone, without DIR/bin/python
#     PYTHON=...                which Python (default python3)
#
# Leaves DIR/bin/ros-python (rclpy, squealcast_msgs), DIR/bin/python (everything else) and DIR/env.sh
# (the environment of ros-python, to be sourced). A run with nothing to do takes a moment.
set -eu

here=$(cd "$(dirname "$0")" && pwd)
msgs=$(cd "$here/../../msgs" && pwd)
mkdir -p "${1:-$here/../../target/peers}"
dir=$(cd "${1:-$here/../../target/peers}" && pwd)
ros=${PEERS_ROS:-kilted}
python=${PYTHON:-python3}

say() { echo "peers: $*"; }
die() { echo "peers: $*" >&2; exit 1; }

# One at a time, if two tests start it at the same time.
exec 9>"$dir/lock"
flock 9

# Runs a step, showing its output only where it fails.
quietly() {
    log=$dir/$1.log
    shift
    "$@" >"$log" 2>&1 || { tail -n 40 "$log" >&2; die "failed: $* (see $log)"; }
}

# The name of a stamp is that of a step, its content the step's input; so a step is repeated when its input changes.
done_for() { [ "$(cat "$dir/$1.stamp" 2>/dev/null)" = "$2" ]; }
hash_of() { cat "$@" | sha256sum | cut -c 1-16; }

[ -f "$here/requirements-$ros.txt" ] || die "PEERS_ROS=$ros: not one of kilted, jazzy"

# --- required programs -----------------------------------------------------------------------------------------

needs=
command -v "$python" >/dev/null || needs="$needs python3"
"$python" -c 'import venv, ensurepip' 2>/dev/null || needs="$needs python3-venv"
"$python" -c 'import os, sysconfig as s; os.stat(s.get_path("include") + "/Python.h")' 2>/dev/null || needs="$needs python3-dev"
command -v gcc >/dev/null || needs="$needs gcc"
command -v g++ >/dev/null || needs="$needs g++"
command -v make >/dev/null || needs="$needs make"
if [ -n "$needs" ]; then
    [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null || die "install first:$needs"
    say "installing$needs"
    quietly apt env DEBIAN_FRONTEND=noninteractive sh -c "apt-get update && apt-get install -y --no-install-recommends$needs"
fi
"$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' || die "needs Python 3.11 or later"
version=$("$python" -c 'import platform, sys; print(platform.python_version(), sys.base_prefix)')

# --- the two virtual environments -------------------------------------------------------------------------------

# The wheels of ROS contain their own libraries and re-execute Python at every start: other packages are kept separate.
make_venv() { # name, requirements
    key="$version $dir $(hash_of "$2")"
    done_for "$1" "$key" && return
    say "$1: installing $(grep -cv '^#' "$2") packages and what they need"
    rm -rf "${dir:?}/$1" "$dir/$1.stamp"
    [ "$1" != ros ] || rm -f "$dir/msgs.stamp"
    quietly "$1" "$python" -m venv "$dir/$1"
    quietly "$1" "$dir/$1/bin/python" -m pip install --disable-pip-version-check -r "$2"
    echo "$key" >"$dir/$1.stamp"
}
make_venv ros "$here/requirements-$ros.txt"
[ "${PEERS_TOOLS:-yes}" = no ] || make_venv tools "$here/requirements-tools.txt"

# --- the environment --------------------------------------------------------------------------------------------

site=$(echo "$dir"/ros/lib/python3*/site-packages)
libs=$(find "$site" -maxdepth 1 -name 'ros_*.libs' | sort | tr '\n' ':')
msgs_site=$dir/msgs/lib/$(basename "$(dirname "$site")")/site-packages

mkdir -p "$dir/bin"
cat >"$dir/env.sh" <<EOF
export PATH="$dir/ros/bin:\$PATH"
export LD_LIBRARY_PATH="$dir/msgs/lib:$dir/ros/lib:$libs\${LD_LIBRARY_PATH:-}"
export PYTHONPATH="$msgs_site"
export AMENT_PREFIX_PATH="$dir/msgs:$dir/ros"
export RMW_IMPLEMENTATION=rmw_fastrtps_cpp
export ROS_LOG_DIR="\${ROS_LOG_DIR:-$dir/log}"
# The bootstrapper of the wheels would set what is set above, by re-executing Python.
export _ROS_WHEELS_BOOTSTRAP_COMPLETE=1
EOF
cat >"$dir/bin/ros-python" <<EOF
#!/bin/sh
. "$dir/env.sh"
exec "$dir/ros/bin/python" "\$@"
EOF
chmod +x "$dir/bin/ros-python"
if [ "${PEERS_TOOLS:-yes}" != no ]; then
    cat >"$dir/bin/python" <<EOF
#!/bin/sh
exec "$dir/tools/bin/python" "\$@"
EOF
    chmod +x "$dir/bin/python"
fi

# --- squealcast_msgs, built by rosidl ---------------------------------------------------------------------------

msgs_key="$(cat "$dir/ros.stamp") $(hash_of "$here/setup.sh" "$msgs/package.xml" "$msgs/CMakeLists.txt" "$msgs"/msg/*.msg)"
if ! done_for msgs "$msgs_key"; then
    say "msgs: building squealcast_msgs"
    rm -rf "$dir/msgs" "$dir/msgs-build" "$dir/msgs.stamp"
    # Two folders of the machine that built the wheels are baked into their CMake files.
    include=$("$dir/ros/bin/python" -c 'import sysconfig; print(sysconfig.get_path("include"))')
    numpy=$("$dir/ros/bin/python" -c 'import numpy; print(numpy.get_include())')
    baked=$(grep -rlE --include='*.cmake' '/opt/python/' "$dir/ros/share" || true)
    [ -z "$baked" ] || sed -i -E \
        -e "s#/opt/python/[^;\"]*/numpy/_core/include#$numpy#g" \
        -e "s#/opt/python/[^;\"]*/include/python3\.[0-9]+#$include#g" $baked
    (
        . "$dir/env.sh"
        quietly msgs-configure "$dir/ros/bin/cmake" -S "$msgs" -B "$dir/msgs-build" \
            -DCMAKE_BUILD_TYPE=Release -DBUILD_TESTING=OFF -DCMAKE_INSTALL_PREFIX="$dir/msgs" \
            -DCMAKE_PREFIX_PATH="$dir/ros" -DPython3_EXECUTABLE="$dir/ros/bin/python"
        quietly msgs-build "$dir/ros/bin/cmake" --build "$dir/msgs-build" --parallel "${PEERS_JOBS:-2}"
        quietly msgs-install "$dir/ros/bin/cmake" --install "$dir/msgs-build"
    )
    rm -rf "$dir/msgs-build"
    "$dir/bin/ros-python" -c 'import rclpy; from squealcast_msgs.msg import OperatingPoint, Prediction, RigInfo, SessionEvent' ||
        die "squealcast_msgs was built but does not import"
    echo "$msgs_key" >"$dir/msgs.stamp"
fi
say "ready: $(ls "$dir"/bin/* | tr '\n' ' ')(ROS 2 $ros)"
