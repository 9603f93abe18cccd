#!/usr/bin/env bash
# A long run on images: memory must stop growing when the map does, tracking must not get slower.
#
#   scripts/soak.sh [--seconds 1800] [--dataset DIR] [FOLDER]
#
# Simulates a room for that long (30 minutes take about 15 GB of disk and as many minutes to render; kept for the next
# call) unless a recording is given, runs SLAM with loop closing, judges timing.json and writes report.html. Results go
# to FOLDER (default: out/soak). Exit code 1: a bound was missed, which is named.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/setup.sh

seconds=1800
dataset=
out=out/soak
fastloop=${FASTLOOP:-build/release/fastloop}
while [ "$#" -gt 0 ]; do
  case "$1" in
    --seconds) seconds=$2; shift 2 ;;
    --dataset) dataset=$2; shift 2 ;;
    -h | --help) sed -n '2,8s/^# \{0,1\}//p' scripts/soak.sh; exit 0 ;;
    -*) echo "soak.sh: unknown option $1" >&2; exit 2 ;;
    *) out=$1; shift ;;
  esac
done

if [ -z "${FASTLOOP:-}" ]; then
  fastloop_setup
  fastloop_build release fastloop_app
fi
mkdir -p "$out"
if [ -z "$dataset" ]; then
  dataset=$out/room_$seconds
  if [ ! -f "$dataset.complete" ]; then
    rm -rf "$dataset"
    echo "soak: simulating $seconds s in a room"
    "$fastloop" simulate room --seconds "$seconds" --out "$dataset"
    touch "$dataset.complete"
  fi
fi
echo "soak: running SLAM"
"$fastloop" run "$dataset" --out "$out/result" --quiet
"$fastloop" report "$out/result"
python3 scripts/soak_check.py "$out/result/timing.json"
