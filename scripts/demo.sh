#!/usr/bin/env bash
# Runs the live node on the shipped bag: line_slam_node in one process, `line_slam play` in another, DDS in between.
# Usage: demo.sh [OUTPUT_FOLDER]
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/setup_env.sh"

BAG="$ROOT/bags/office"
OUTPUT=${1:-$ROOT/demo_output}
mkdir -p "$OUTPUT"
OUTPUT=$(cd "$OUTPUT" && pwd)

# Nobody else's nodes: this machine only, and a domain that the tests do not use.
export ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_DOMAIN_ID=${ROS_DOMAIN_ID:-$((215 + RANDOM % 18))}
export ROS_LOG_DIR="$OUTPUT/log"

finish() {
    kill -TERM ${NODE:-} ${PLAY:-} 2>/dev/null || true
    wait
}
trap finish EXIT
trap 'exit 130' INT TERM

echo "Starting line_slam_node; the very first start compiles for some minutes"
line_slam_node --ros-args -r image:=/cam0/image_raw -r camera_info:=/cam0/camera_info -r imu:=/imu0 \
    -p image_transport:=compressed -p calibration_file:="$BAG/calibration.yaml" &
NODE=$!
line_slam play "$BAG/bag" --output "$OUTPUT" &
PLAY=$!

wait -n "$NODE" "$PLAY" || true
if ! kill -0 "$NODE" 2>/dev/null; then
    echo "The node has ended: see above." >&2
    exit 1
fi
wait "$PLAY"
kill -TERM "$NODE"
wait "$NODE"

echo
line_slam evaluate "$OUTPUT" --truth "$BAG/groundtruth.tum" --lines "$BAG/gt_lines.csv"
echo
echo "Left in $OUTPUT:"
ls -lh "$OUTPUT"
