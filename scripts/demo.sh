#!/usr/bin/env bash
# Builds fastloop, makes a sequence with its simulator, runs SLAM on it and prints what came out.
# Whatever exists already is kept: the second call takes seconds.
#
#   scripts/demo.sh [FOLDER]     results go to FOLDER (default: out/demo)
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/setup.sh

case "${1:-}" in
  -h | --help) sed -n '2,5s/^# \{0,1\}//p' scripts/demo.sh; exit 0 ;;
esac
out=${1:-out/demo}
sequence=$out/ring
result=$out/result
without=$out/result_without_loops
fastloop=build/release/fastloop

fastloop_setup
fastloop_build release fastloop_app

mkdir -p "$out"
if [ ! -f "$sequence/.complete" ]; then
  rm -rf "$sequence"
  echo "demo: simulating 64 s of stereo images and IMU along a ring corridor"
  "$fastloop" simulate ring --seed 1 --out "$sequence"
  touch "$sequence/.complete"
fi
truth=$sequence/mav0/state_groundtruth_estimate0/data.csv

echo "demo: running SLAM without loop closing"
"$fastloop" run "$sequence" --out "$without" --no-loop
"$fastloop" eval "$truth" "$without/trajectory_body.txt" --json >"$without/evaluation.json"

echo "demo: running SLAM"
rm -rf "$out/loops"
"$fastloop" run "$sequence" --out "$result" --record-loops "$out/loops"
"$fastloop" eval "$truth" "$result/trajectory_body.txt" --rpe 1 --json --plot "$result/error.svg" \
  >"$result/evaluation.json"

echo "demo: closing the recorded loop again with both back ends"
for map in "$out"/loops/*.flmap; do
  [ -f "$map" ] || continue
  "$fastloop" replay "$map" --backend reference cpu --json >"$result/replay.json"
done
python3 scripts/demo_table.py "$result" "$without"
