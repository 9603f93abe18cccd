#!/usr/bin/env bash
# Puts programs and the shared libraries they need into one folder that runs on another Linux machine
# of the same architecture. glibc, libstdc++ and the GPU driver are those of that machine.
#
#   scripts/bundle.sh FOLDER PROGRAM...
set -euo pipefail
case "${1:-}" in
  "" | -h | --help) sed -n '2,5s/^# \{0,1\}//p' "$0"; exit 0 ;;
esac
folder=$1
shift
mkdir -p "$folder/lib"
for program in "$@"; do
  name=$(basename "$program")
  cp "$program" "$folder/$name.bin"
  ldd "$program" | awk '$3 ~ /^\// {print $3}' |
    grep -Ev '/(libc|libm|libdl|librt|libpthread|libstdc\+\+|libgcc_s|ld-linux[^/]*|libcuda)\.so' |
    xargs -r cp -Lnt "$folder/lib"
  # A wrapper finds the libraries beside it, wherever the folder lies.
  printf '#!/bin/sh\nhere=$(dirname "$(readlink -f "$0")")\nLD_LIBRARY_PATH="$here/lib${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}" exec "$here/%s.bin" "$@"\n' \
    "$name" >"$folder/$name"
  chmod +x "$folder/$name"
done
strip --strip-unneeded "$folder"/*.bin "$folder"/lib/*.so* 2>/dev/null || true
