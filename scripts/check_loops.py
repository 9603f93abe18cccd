#!/usr/bin/env python3
"""Compares every accepted loop of a run with ground truth.

    scripts/check_loops.py GROUNDTRUTH RUN [--metres 0.5] [--degrees 5]

GROUNDTRUTH: TUM text (seconds tx ty tz qx qy qz qw) or EuRoC csv (nanoseconds, tx ty tz, qw qx qy qz), poses of
the body. RUN: folder written by `fastloop run`. Exit code 4 when a loop is wrong by more than the limits.
"""
import argparse
import bisect
import json
import math
import pathlib
import sys


def multiply(a, b):
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (aw * bx + ax * bw + ay * bz - az * by, aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw, aw * bw - ax * bx - ay * by - az * bz)


def conjugate(q):
    return (-q[0], -q[1], -q[2], q[3])


def rotate(q, v):
    return multiply(multiply(q, (*v, 0.0)), conjugate(q))[:3]


def between(a, b):
    """Pose of b in the frame of a; poses are (translation, quaternion xyzw)."""
    inverse = conjugate(a[1])
    return rotate(inverse, [y - x for x, y in zip(a[0], b[0])]), multiply(inverse, b[1])


def read_poses(path):
    """Sorted time stamps in seconds and poses."""
    poses = []
    for line in pathlib.Path(path).read_text().splitlines():
        if not line.strip() or line.startswith("#"):
            continue
        v = [float(x) for x in line.replace(",", " ").split()[:8]]
        if len(v) < 8:
            raise ValueError(f"{path}: expected eight numbers, found: {line}")
        if "," in line:  # nanoseconds: EuRoC csv; stamps may begin at zero
            poses.append((v[0] * 1e-9, (v[1:4], (v[5], v[6], v[7], v[4]))))
        else:
            poses.append((v[0], (v[1:4], tuple(v[4:8]))))
    poses.sort(key=lambda p: p[0])
    return [p[0] for p in poses], [p[1] for p in poses]


def at(times, poses, t):
    """Pose nearest in time, None beyond 20 ms."""
    k = bisect.bisect(times, t)
    near = [i for i in (k - 1, k) if 0 <= i < len(times)]
    best = min(near, key=lambda i: abs(times[i] - t), default=None)
    return poses[best] if best is not None and abs(times[best] - t) <= 0.02 else None


def errors_of(loops, times, poses):
    """For each accepted loop: its two times, error in metres and degrees (None without ground truth)."""
    for line in pathlib.Path(loops).read_text().splitlines():
        record = json.loads(line)
        for c in record["candidates"]:
            if c["verdict"] != "accepted":
                continue
            t, matched = float(record["t"]), float(c["matched_t"])
            current_pose, matched_pose = at(times, poses, t), at(times, poses, matched)
            if current_pose is None or matched_pose is None:
                yield t, matched, None, None
                continue
            stated = c["T_matched_current"]
            off = between(between(matched_pose, current_pose), (stated[:3], tuple(stated[3:])))
            angle = 2 * math.atan2(math.hypot(*off[1][:3]), abs(off[1][3]))
            yield t, matched, math.hypot(*off[0]), math.degrees(angle)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("groundtruth")
    parser.add_argument("run")
    parser.add_argument("--metres", type=float, default=0.5)
    parser.add_argument("--degrees", type=float, default=5.0)
    options = parser.parse_args()
    times, poses = read_poses(options.groundtruth)
    count = wrong = 0
    for t, matched, metres, degrees in errors_of(pathlib.Path(options.run) / "loops.jsonl", times, poses):
        count += 1
        if metres is None:
            print(f"{t:.3f} -> {matched:.3f}: no ground truth at one of these times")
            continue
        bad = metres > options.metres or degrees > options.degrees
        wrong += bad
        print(f"{t:.3f} -> {matched:.3f}: off by {metres:.3f} m, {degrees:.2f} deg{'  WRONG' if bad else ''}")
    print(f"{count} loops accepted, {wrong} wrong")
    return 4 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
