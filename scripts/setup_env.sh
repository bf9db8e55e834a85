# Sourced by demo.sh and test.sh: makes the virtual environment .venv once, then activates it.
# Set PYTHON to choose the interpreter (CPython 3.10 to 3.13).

ROOT=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd -P)
VENV="$ROOT/.venv"

# A sourced ROS installation would be mixed with the ROS wheels of the environment.
leave_ros_installation() {
    if [ -n "${ROS_DISTRO:-}${AMENT_PREFIX_PATH:-}${_ROS_WHEELS_BOOTSTRAP_COMPLETE:-}" ]; then
        echo "Leaving the sourced ROS installation aside: the ROS 2 wheels in $VENV are used instead." >&2
        unset LD_LIBRARY_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH _ROS_WHEELS_BOOTSTRAP_COMPLETE
        unset "${!AMENT_@}" "${!ROS_@}" "${!RMW_@}"
    fi
    unset PYTHONPATH PYTHONHOME
}

# True if $1 runs (a pyenv shim may not), is supported by the ROS wheels and can make environments.
is_suitable() {
    "$1" -c 'import sys, venv, ensurepip; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))' 2>/dev/null
}

find_python() {
    local candidate
    for candidate in ${PYTHON:-python3.12 python3.11 python3 python3.13 python3.10 python}; do
        if is_suitable "$candidate"; then
            command -v "$candidate"
            return
        fi
    done
    echo "No suitable Python found (tried: ${PYTHON:-python3.12 python3.11 python3 python3.13 python3.10 python})." >&2
    echo "Install Python 3.10 to 3.13 with its venv module (Debian, Ubuntu: apt install python3-venv)" >&2
    echo "or name one: PYTHON=/path/to/python3.12 $0" >&2
    return 1
}

# What the environment depends on; a difference means that it has to be installed again.
fingerprint() {
    echo "$ROOT"
    "$VENV/bin/python" --version 2>&1
    cat "$ROOT/package.xml" "$ROOT/setup.py" "$ROOT/setup.cfg" "$ROOT/pyproject.toml" "$ROOT/scripts/setup_env.sh" | sha256sum
}

# A copied or moved environment has scripts that point to its old place: make it anew.
make_environment() {
    if ! { is_suitable "$VENV/bin/python" && grep -qsF "$VENV" "$VENV/bin/activate"; }; then
        local python
        python=$(find_python) || return
        echo "Making $VENV with $("$python" --version) ($python)"
        "$python" -m venv --clear "$VENV" || return
    fi
    echo "Installing line_slam_ros, its requirements and ROS 2 Jazzy into $VENV (once; some minutes, 1.2 GB)"
    "$VENV/bin/python" -m pip install --quiet --disable-pip-version-check --editable "$ROOT[ros,evaluate,test]" || return
    fingerprint >"$VENV/line_slam_ros.stamp"
}

leave_ros_installation
if [ "$(fingerprint 2>/dev/null)" != "$(cat "$VENV/line_slam_ros.stamp" 2>/dev/null)" ]; then
    make_environment || { echo "The set-up failed: see the messages above." >&2; exit 1; }
fi
# shellcheck source=/dev/null
. "$VENV/bin/activate"
