#!/usr/bin/env bash
# Builds the distribution's own version of oneTBB with ThreadSanitizer, once, below build/tsan-tbb, and prints the folder of the
# library. With the packaged library ThreadSanitizer does not see how the workers synchronise and reports races that are none.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

folder=$PWD/build/tsan-tbb
if [ ! -e "$folder/lib/libtbb.so.12" ]; then
  # The sources come through apt with lists of our own; the machine's configuration stays as it is.
  # shellcheck disable=SC1091
  source /etc/os-release
  rm -rf "$folder"
  mkdir -p "$folder/lists/partial"
  case "$ID" in
    ubuntu) echo "deb-src http://archive.ubuntu.com/ubuntu $VERSION_CODENAME universe" >"$folder/sources.list" ;;
    *) echo "deb-src http://deb.debian.org/debian $VERSION_CODENAME main" >"$folder/sources.list" ;;
  esac
  {
    cd "$folder"
    apt=(apt-get -q -o "Dir::Etc::sourcelist=$folder/sources.list" -o Dir::Etc::sourceparts=- -o "Dir::State::Lists=$folder/lists")
    "${apt[@]}" update
    "${apt[@]}" source --download-only onetbb
    tar xf onetbb_*.orig.tar.*
    cmake -S oneTBB-* -B build -G Ninja -DTBB_TEST=OFF -DTBB_STRICT=OFF -DTBBMALLOC_BUILD=OFF -DTBB_DISABLE_HWLOC_AUTOMATIC_SEARCH=ON \
      -DCMAKE_BUILD_TYPE=RelWithDebInfo "-DCMAKE_CXX_FLAGS=-fsanitize=thread -D__TBB_RESUMABLE_TASKS_USE_THREADS=1"
    cmake --build build --target tbb
    mkdir lib
    cp -P build/*/libtbb.so* lib/
  } >&2
fi
echo "$folder/lib"
