#!/usr/bin/env python3
"""When gravity and scale of a stereo-inertial run have converged, from the poses as they were known at the time.

  scripts/imu_convergence.py GROUNDTRUTH OUT/trajectory_live.txt [--seconds 15] [--max-tilt 0.5] [--max-scale 0.01]

GROUNDTRUTH: EuRoC csv or TUM file with z up. Tilt is the angle between the estimated and the true direction of gravity in the body
frame. Scale is the factor that fits the lengths of the true movements over half a second to the estimated ones, from a third of the
time to the limit. Neither needs an alignment, so the turns of the world at an initialisation do no harm. Times count from the first
pose of the estimate. Exit code 4 when a limit is missed at --seconds.
"""
import argparse
import sys

import numpy as np


def load(path):
    """Stamps in ns, positions, quaternions x y z w."""
    rows = []
    euroc = path.endswith(".csv")
    with open(path, encoding="utf-8") as file:
        for line in file:
            if line.startswith("#") or not line.strip():
                continue
            fields = line.replace(",", " ").split()
            seconds, _, fraction = fields[0].partition(".")
            stamp = int(fields[0]) if euroc else int(seconds) * 10**9 + int(fraction.ljust(9, "0")[:9])
            values = [float(v) for v in fields[1:8]]
            if euroc:  # the csv writes w first
                values = values[:3] + values[4:7] + values[3:4]
            rows.append((stamp, values))
    stamps = np.array([r[0] for r in rows], dtype=np.int64)
    values = np.array([r[1] for r in rows])
    return stamps, values[:, :3], values[:, 3:]


def up_in_body(q):
    """Third row of the rotation matrices: the world's z axis in the body frame."""
    x, y, z, w = q.T
    return np.stack([2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], axis=1)


def movement_scale(t, reference, estimate, begin, end, span=0.5):
    """Least-squares factor between the lengths of movements over `span` seconds that lie in [begin, end]."""
    later = np.searchsorted(t, t + span)
    first = np.nonzero((t >= begin) & (later < t.size))[0]
    first = first[t[later[first]] <= end]
    a = np.linalg.norm(reference[later[first]] - reference[first], axis=1)
    b = np.linalg.norm(estimate[later[first]] - estimate[first], axis=1)
    return (a * b).sum() / (b * b).sum()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("groundtruth")
    parser.add_argument("estimate")
    parser.add_argument("--seconds", type=float, default=15)
    parser.add_argument("--max-tilt", type=float, default=0.5, help="degrees")
    parser.add_argument("--max-scale", type=float, default=0.01, help="difference from 1")
    args = parser.parse_args()

    truth_ns, truth_p, truth_q = load(args.groundtruth)
    ns, p, q = load(args.estimate)
    start_ns = ns[0]
    right = np.clip(np.searchsorted(truth_ns, ns), 1, len(truth_ns) - 1)
    nearest = np.where(ns - truth_ns[right - 1] < truth_ns[right] - ns, right - 1, right)
    known = np.abs(truth_ns[nearest] - ns) <= 10_000_000
    t, p, q = (ns[known] - start_ns) * 1e-9, p[known], q[known]
    truth_p, truth_q = truth_p[nearest[known]], truth_q[nearest[known]]
    if t.size == 0 or t[-1] < args.seconds:
        print(f"imu_convergence: the estimate has no {args.seconds:g} s with ground truth", file=sys.stderr)
        return 2

    cosine = np.sum(up_in_body(q) * up_in_body(truth_q), axis=1)
    tilt = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    bad = np.nonzero(tilt > args.max_tilt)[0]
    last_bad = t[bad[-1]] if bad.size else 0.0
    at = np.searchsorted(t, args.seconds, side="right") - 1
    scale = movement_scale(t, truth_p, p, args.seconds / 3, args.seconds)

    print(f"tilt at {args.seconds:g} s      {tilt[at]:.3f} deg (limit {args.max_tilt:g}); above the limit for the last time at {last_bad:.2f} s")
    print(f"scale, {args.seconds / 3:g} to {args.seconds:g} s  {scale:.5f} (limit 1 +- {args.max_scale:g})")
    return 0 if tilt[at] <= args.max_tilt and abs(scale - 1) <= args.max_scale else 4


if __name__ == "__main__":
    sys.exit(main())
