#!/usr/bin/env python3
"""Prints the closing table of the demo from the files that `run` and `eval` wrote into a folder."""
import json
import pathlib
import sys


def load(file):
    with open(file, encoding="utf-8") as f:
        return json.load(f)


def drift_m(evaluation):
    return evaluation["end_drift_percent_of_path"] / 100 * evaluation["path_length_m"]


def print_replay(file):
    """Stages of one loop, reference beside cpu."""
    replays = {r["backend"]: r for r in load(file)["replays"]}
    reference, cpu = replays["reference"], replays["cpu"]
    print(f"\n{'one loop, median of 5':<26}{'reference ms':>14}{'cpu ms':>10}{'ratio':>8}")

    def line(name, a, b):
        ratio = f"{a / b:.1f}" if b > 0.005 else "-"
        print(f"{name:<26}{a:>14.3f}{b:>10.3f}{ratio:>8}")

    stages = reference["stages_ms"]
    for name in list(stages) + [n for n in cpu["stages_ms"] if n not in stages]:
        line(name, stages.get(name, 0.0), cpu["stages_ms"].get(name, 0.0))
    line("total", reference["total_ms"], cpu["total_ms"])


def main():
    result = pathlib.Path(sys.argv[1])
    summary = load(result / "summary.json")
    timing = load(result / "timing.json")
    without = load(pathlib.Path(sys.argv[2]) / "evaluation.json")
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
        ("loops closed", summary["loops_closed"]),
        ("path", f"{evaluation['path_length_m']:.2f} m"),
        ("ATE RMSE", f"{evaluation['ate_m']['rmse']:.4f} m, without loop closing {without['ate_m']['rmse']:.4f} m"),
        ("drift at the end", f"{drift_m(evaluation):.4f} m, without loop closing {drift_m(without):.4f} m"),
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
    if (result / "replay.json").exists():
        print_replay(result / "replay.json")
    print("\nwritten:")
    for file in sorted(result.iterdir()):
        print(f"  {file}")


if __name__ == "__main__":
    main()
