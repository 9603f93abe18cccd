#!/usr/bin/env bash
# Installs what is missing, builds everything and runs the test suite.
#
#   scripts/test.sh                       the whole suite, release build
#   scripts/test.sh --sanitize asan       under AddressSanitizer and UndefinedBehaviorSanitizer
#   scripts/test.sh --sanitize tsan       under ThreadSanitizer
#   scripts/test.sh [...] -- -R map       what follows -- goes to ctest
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/setup.sh

usage() {
  sed -n '2,8s/^# \{0,1\}//p' scripts/test.sh
}

preset=release
while [ "$#" -gt 0 ]; do
  case "$1" in
    --sanitize)
      preset=${2:-}
      case "$preset" in
        asan | tsan) ;;
        *) echo "test.sh: --sanitize takes asan or tsan" >&2; exit 2 ;;
      esac
      shift 2
      ;;
    -h | --help) usage; exit 0 ;;
    --) shift; break ;;
    *) echo "test.sh: unknown option $1" >&2; usage >&2; exit 2 ;;
  esac
done

# The sanitizers stop at the first finding, so that ctest sees it.
export ASAN_OPTIONS=${ASAN_OPTIONS:-detect_leaks=1:halt_on_error=1}
export UBSAN_OPTIONS=${UBSAN_OPTIONS:-print_stacktrace=1:halt_on_error=1}
export TSAN_OPTIONS=${TSAN_OPTIONS:-halt_on_error=1:second_deadlock_stack=1:suppressions=$PWD/cmake/tsan_suppressions.txt}

# The tests of `fastloop report` look at its page in a browser, and leave that out where there is none. Ubuntu's
# package is only a door to another system of packages.
if grep -qx 'ID=debian' /etc/os-release 2>/dev/null; then
  fastloop_packages+=(chromium fonts-dejavu-core)
fi
fastloop_setup
fastloop_build "$preset"
if [ "$preset" = tsan ]; then
  tbb=$(scripts/tsan_tbb.sh)
  # OpenMP below CHOLMOD is not instrumented: its barriers are invisible and every parallel loop looks like a race.
  export OMP_THREAD_LIMIT=1
  export LD_LIBRARY_PATH=$tbb${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}
fi
ctest --test-dir "build/$preset" --parallel 2 --output-on-failure "$@"
