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
sequence=$out/room
result=$out/result
fastloop=build/release/fastloop

fastloop_setup
fastloop_build release fastloop_app

mkdir -p "$out"
if [ ! -f "$sequence/.complete" ]; then
  rm -rf "$sequence"
  echo "demo: simulating 20 s of stereo images and IMU"
  "$fastloop" simulate room --seconds 20 --seed 1 --out "$sequence"
  touch "$sequence/.complete"
fi

echo "demo: running SLAM"
"$fastloop" run "$sequence" --out "$result"

truth=$sequence/mav0/state_groundtruth_estimate0/data.csv
"$fastloop" eval "$truth" "$result/trajectory_body.txt" --rpe 1 --json --plot "$result/error.svg" \
  >"$result/evaluation.json"
python3 scripts/demo_table.py "$result"
