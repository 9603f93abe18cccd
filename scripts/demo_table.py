#!/usr/bin/env python3
"""Prints the closing table of the demo from the files that `run` and `eval` wrote into a folder."""
import json
import pathlib
import sys


def load(file):
    with open(file, encoding="utf-8") as f:
        return json.load(f)


def main():
    result = pathlib.Path(sys.argv[1])
    summary = load(result / "summary.json")
    timing = load(result / "timing.json")
    evaluation = load(result / "evaluation.json")
    rows = [
        ("mode", summary["mode"]),
        ("frames", summary["frames"]),
        ("tracked", f"{summary['tracked_percent']:.1f} %"),
        ("keyframes", summary["keyframes"]),
        ("landmarks", summary["landmarks"]),
        ("maps", summary["maps"]),
        ("IMU initialised", "yes" if summary["imu_initialized"] else "no"),
        ("speed", f"{timing['fps']:.1f} frames/s"),
        ("path", f"{evaluation['path_length_m']:.2f} m"),
        ("ATE RMSE", f"{evaluation['ate_m']['rmse']:.4f} m"),
        ("RPE over 1 s", f"{evaluation['rpe']['translation_m']['rmse']:.4f} m, "
                         f"{evaluation['rpe']['rotation_deg']['rmse']:.3f} deg"),
    ]
    print()
    for name, value in rows:
        print(f"{name:<18}{value}")
    print(f"\n{'stage':<26}{'count':>7}{'p50 ms':>10}{'p95 ms':>10}{'p99 ms':>10}{'max ms':>10}")
    for name, t in timing["stages"].items():
        print(f"{name:<26}{t['count']:>7}{t['p50_ms']:>10.2f}{t['p95_ms']:>10.2f}"
              f"{t['p99_ms']:>10.2f}{t['max_ms']:>10.2f}")
    print("\nwritten:")
    for file in sorted(result.iterdir()):
        print(f"  {file}")


if __name__ == "__main__":
    main()
