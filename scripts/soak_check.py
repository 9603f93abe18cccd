#!/usr/bin/env python3
"""Judges a long run by its timing.json: memory against the size of the map, tracking time over the run.

  - Where the map has stopped growing (the last stretch in which keyframes change by less than 3 %, if that is a
    quarter of the run or more), the resident memory may grow by less than 1 % in 10 minutes.
  - Where it has not, a keyframe of the last third may not cost more than 1.25 times one of the second third.
  - The median tracking time of the last fifth may be at most 1.2 times that of the second one.

Usage: soak_check.py TIMING_JSON      exit code 1 when a bound is missed
"""
import json
import sys

MAX_SLOPE_PERCENT_PER_10_MIN = 1.0
MAX_TRACKING_RATIO = 1.2
MAX_KEYFRAME_COST_RATIO = 1.25
STEADY_KEYFRAMES = 0.03
SETTLED_S = 20  # the first seconds load and initialise


def slope(x, y):
    """Of the least-squares line, y per x."""
    n = len(x)
    mean_x, mean_y = sum(x) / n, sum(y) / n
    xx = sum((a - mean_x) ** 2 for a in x)
    return sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y)) / xx if xx else 0.0


def steady_part(samples):
    """The longest stretch at the end over which the map keeps its size."""
    begin = len(samples)
    low = high = samples[-1]["keyframes"]
    for i in range(len(samples) - 1, -1, -1):
        low, high = min(low, samples[i]["keyframes"]), max(high, samples[i]["keyframes"])
        if high - low > STEADY_KEYFRAMES * high:
            break
        begin = i
    return samples[begin:]


def keyframe_cost_mib(samples):
    return slope([s["keyframes"] for s in samples], [s["resident_mib"] for s in samples])


def judge(timing):
    """Lines to print, and the bounds that were missed."""
    samples = [s for s in timing["memory"]["samples"] if s["t_s"] >= SETTLED_S]
    if len(samples) < 12:
        return [], ["too short to judge: fewer than 12 samples of memory after the first 20 s"]
    lines, missed = [], []
    last = samples[-1]
    lines.append(f"{last['t_s']:.0f} s of recording, {last['keyframes']} keyframes, {last['landmarks']} landmarks, "
                 f"resident {last['resident_mib']:.0f} MiB, peak {timing['memory']['peak_mib']:.0f} MiB")
    steady = steady_part(samples)
    if steady[-1]["t_s"] - steady[0]["t_s"] >= 0.25 * (last["t_s"] - samples[0]["t_s"]):
        growth = 600 * slope([s["t_s"] for s in steady], [s["resident_mib"] for s in steady])
        percent = 100 * growth / last["resident_mib"]
        lines.append(f"map steady for the last {steady[-1]['t_s'] - steady[0]['t_s']:.0f} s: memory grows by "
                     f"{percent:+.2f} % in 10 minutes (bound {MAX_SLOPE_PERCENT_PER_10_MIN} %)")
        if percent >= MAX_SLOPE_PERCENT_PER_10_MIN:
            missed.append("memory grows though the map does not")
    else:
        third = len(samples) // 3
        before, after = keyframe_cost_mib(samples[third:2 * third]), keyframe_cost_mib(samples[2 * third:])
        lines.append(f"map still growing: {1024 * before:.0f} KiB a keyframe in the second third, "
                     f"{1024 * after:.0f} KiB in the last (bound {MAX_KEYFRAME_COST_RATIO} times)")
        if after > MAX_KEYFRAME_COST_RATIO * max(before, 0.05):
            missed.append("keyframes cost more and more memory")
    fifths = timing["track_p50_ms_by_fifth"]
    ratio = fifths[4] / fifths[1]
    lines.append("median tracking time by fifth: " + ", ".join(f"{f:.1f}" for f in fifths) +
                 f" ms; last / second {ratio:.2f} (bound {MAX_TRACKING_RATIO})")
    if ratio > MAX_TRACKING_RATIO:
        missed.append("tracking gets slower")
    return lines, missed


def main():
    with open(sys.argv[1], encoding="utf-8") as f:
        lines, missed = judge(json.load(f))
    for line in lines:
        print("soak: " + line)
    for bound in missed:
        print("soak: MISSED: " + bound)
    return 1 if missed else 0


if __name__ == "__main__":
    sys.exit(main())
