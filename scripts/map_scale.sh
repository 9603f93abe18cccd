#!/usr/bin/env bash
# Large maps without images: loop closing on simulated maps of up to 30,000 keyframes, and the memory a keyframe takes,
# which must not depend on how many there are.
#
#   scripts/map_scale.sh [--keyframes 1000,3000,10000,30000] [FOLDER]
#
# 30,000 keyframes need about 6 GB of memory. Results go to FOLDER (default: out/map_scale): scale.json, scale.md,
# scale.csv, speed_up.svg. Exit code 1: memory per keyframe of the largest map is more than 1.1 times that of the smallest.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/setup.sh

keyframes=1000,3000,10000,30000
out=out/map_scale
fastloop=${FASTLOOP:-build/release/fastloop}
while [ "$#" -gt 0 ]; do
  case "$1" in
    --keyframes) keyframes=$2; shift 2 ;;
    -h | --help) sed -n '2,8s/^# \{0,1\}//p' scripts/map_scale.sh; exit 0 ;;
    -*) echo "map_scale.sh: unknown option $1" >&2; exit 2 ;;
    *) out=$1; shift ;;
  esac
done

if [ -z "${FASTLOOP:-}" ]; then
  fastloop_setup
  fastloop_build release fastloop_app
fi
"$fastloop" bench scale --keyframes "$keyframes" --inertial --runs 3 --out "$out"
python3 - "$out/scale.json" <<'PYTHON'
import json
import sys

cases = json.load(open(sys.argv[1], encoding="utf-8"))["cases"]
cost = [1024 * c["map_mib"] / c["keyframes"] for c in cases]
for c, kib in zip(cases, cost):
    print(f"map_scale: {c['keyframes']:>7} keyframes, {c['map_mib']:8.0f} MiB, {kib:6.1f} KiB a keyframe, {c['verdict']}")
missed = [f"{c['keyframes']} keyframes: the loop was not closed" for c in cases if c["verdict"] != "accepted"]
if cost[-1] > 1.1 * cost[0]:
    missed.append("large maps take more memory per keyframe than small ones")
for bound in missed:
    print("map_scale: MISSED: " + bound)
sys.exit(1 if missed else 0)
PYTHON
