#!/usr/bin/env bash
# Trains the vocabulary that ships with the project, src/fastloop/place/default_vocabulary.flvoc, on renders of
# the project's own simulator: free of the rights of others. About ten minutes on two cores, 3 GB of images.
#
# Many worlds with a few frames each, for the frames of one world resemble each other. The same simulator
# and extractor give the same file.
#
# Usage: scripts/train_vocabulary.sh [FASTLOOP] [FOLDER] [OUT]
#   FASTLOOP  the program, default build/release/fastloop
#   FOLDER    for the renders, kept between runs; default build/vocabulary
#   OUT       default src/fastloop/place/default_vocabulary.flvoc
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
fastloop=${1:-$root/build/release/fastloop}
renders=${2:-$root/build/vocabulary}
out=${3:-$root/src/fastloop/place/default_vocabulary.flvoc}
seeds=${SEEDS:-90}

render() {  # world seed folder program
  local folder=$3/$1-$2
  [ -f "$folder/done" ] && return
  "$4" simulate "$1" --seconds 0.1 --seed "$2" --threads 1 --out "$folder.part" > /dev/null 2>&1
  mv "$folder.part" "$folder"
  touch "$folder/done"
}
export -f render

mkdir -p "$renders"
for seed in $(seq 1001 $((1000 + seeds))); do
  for world in room hall campus corridor; do echo "$world $seed"; done
done | xargs -P "$(nproc)" -I {} bash -c 'render {} "$0" "$1"' "$renders" "$fastloop"

# Every third image: the first frame of either camera.
"$fastloop" vocab train "$renders" --every 3 --features 1200 --levels 6 --min-to-split 16 \
            --out "$out"
