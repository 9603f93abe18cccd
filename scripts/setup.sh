#!/usr/bin/env bash
# Installs the Debian / Ubuntu packages fastloop needs, and only those that are missing.
# Run it alone, or source it and call `fastloop_setup`. Debian 12 is supported; Ubuntu 24.04 has not been tried.

fastloop_packages=(
  g++ cmake ninja-build pkg-config git ccache python3
  libeigen3-dev libopencv-dev libceres-dev libtbb-dev libspdlog-dev libyaml-cpp-dev libcli11-dev
  nlohmann-json3-dev libzstd-dev libgtest-dev libgmock-dev libbenchmark-dev
)

fastloop_missing_packages() {
  local package
  for package in "${fastloop_packages[@]}"; do
    dpkg-query -W -f '${db:Status-Status}\n' "$package" 2>/dev/null | grep -qx installed || echo "$package"
  done
}

fastloop_setup() {
  if ! command -v dpkg-query >/dev/null || ! command -v apt-get >/dev/null; then
    echo "setup: this is not Debian or Ubuntu; please install: ${fastloop_packages[*]}" >&2
    return 0
  fi
  local missing
  mapfile -t missing < <(fastloop_missing_packages)
  if [ "${#missing[@]}" -eq 0 ]; then
    return 0
  fi
  local as_root=()
  if [ "$(id -u)" -ne 0 ]; then
    if ! command -v sudo >/dev/null; then
      echo "setup: needs root or sudo to install: ${missing[*]}" >&2
      return 1
    fi
    as_root=(sudo)
  fi
  echo "setup: installing ${missing[*]}"
  # Noise of a successful installation helps nobody; of a failed one, everybody.
  local log
  log=$(mktemp)
  local apt=("${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -qq -o Dpkg::Use-Pty=0)
  if ! { "${apt[@]}" update && "${apt[@]}" install -y --no-install-recommends "${missing[@]}"; } \
      >"$log" 2>&1 </dev/null; then
    cat "$log" >&2
    rm -f "$log"
    echo "setup: could not install ${missing[*]}" >&2
    return 1
  fi
  rm -f "$log"
}

# Configures a preset unless that was done before, then builds the targets (all when none is named).
# Two gigabytes of memory a compiler is what the largest files need.
fastloop_build() {
  local preset=$1
  shift
  local cores memory_gib jobs
  cores=$(nproc)
  memory_gib=$(awk '/MemAvailable/ {print int($2 / 1048576)}' /proc/meminfo)
  jobs=$((memory_gib / 2 < cores ? memory_gib / 2 : cores))
  jobs=$((jobs < 1 ? 1 : jobs))
  if [ ! -f "build/$preset/build.ninja" ]; then
    local log
    log=$(mktemp)
    cmake --preset "$preset" >"$log" 2>&1 || {
      cat "$log" >&2
      rm -f "$log"
      return 1
    }
    rm -f "$log"
  fi
  local targets=()
  if [ "$#" -gt 0 ]; then
    targets=(--target "$@")
  fi
  cmake --build --preset "$preset" --parallel "$jobs" "${targets[@]}"
}

if [ "${BASH_SOURCE[0]}" = "$0" ]; then
  set -euo pipefail
  fastloop_setup
  echo "setup: everything needed is installed"
fi
