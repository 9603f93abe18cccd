#!/usr/bin/env python3
"""Makes groundtruth.csv, estimate.txt and evo_numbers.json beside this file.

evo is the oracle of the tests, not part of fastloop. To run this again:
    python3 -m venv /tmp/evo && /tmp/evo/bin/pip install evo==1.38.1
    /tmp/evo/bin/python make_testdata.py
The same numbers, with six decimals, are printed by
    evo_ape euroc groundtruth.csv estimate.txt [-a | -as]
    evo_rpe euroc groundtruth.csv estimate.txt [-a | -as] -d 20 -u f [-r angle_deg] [--all_pairs]
"""
import copy
import json
import pathlib

import numpy as np
from evo import __version__ as evo_version
from evo import main_ape, main_rpe
from evo.core import metrics, sync
from evo.tools import file_interface
from scipy.spatial.transform import Rotation

HERE = pathlib.Path(__file__).parent
START_NS = 1403715274312142104


def motion(t):
    """Position and rotation of a smooth walk."""
    position = np.stack([3 * np.sin(0.5 * t), 2 * np.cos(0.7 * t), 0.4 * np.sin(1.3 * t) + 1.2], axis=1)
    rotation = Rotation.from_rotvec(np.stack([0.3 * np.sin(t), 0.2 * np.cos(0.6 * t), 0.5 * t], axis=1))
    return position, rotation


def write_files(random):
    t = np.arange(0, 12, 0.025)
    position, rotation = motion(t)
    with open(HERE / "groundtruth.csv", "w") as f:
        f.write("#timestamp [ns], p_x [m], p_y [m], p_z [m], q_w [], q_x [], q_y [], q_z [], v_x [m s^-1]\n")
        for stamp, p, q in zip(t, position, rotation.as_quat()):
            f.write(f"{START_NS + round(stamp * 1e9)},{p[0]:.7f},{p[1]:.7f},{p[2]:.7f},"
                    f"{q[3]:.8f},{q[0]:.8f},{q[1]:.8f},{q[2]:.8f},0.0\n")

    # 20 poses a second from 1 s to 11.5 s: another world frame, 3 % too small, drifting, noisy, stamps jitter.
    t = np.arange(1, 11.5, 0.05)
    position, rotation = motion(t)
    turn = Rotation.from_rotvec([0.4, -1.1, 0.7])
    drift = np.cumsum(random.normal(0, 0.002, position.shape), axis=0)
    position = turn.apply(position * 0.97 + drift + random.normal(0, 0.004, position.shape)) + [5, -7, 2]
    rotation = turn * rotation * Rotation.from_rotvec(np.cumsum(random.normal(0, 0.001, position.shape), axis=0))
    stamps = START_NS + np.round(t * 1e9).astype(np.int64) + random.integers(-3_000_000, 3_000_000, t.size)
    with open(HERE / "estimate.txt", "w") as f:
        for stamp, p, q in zip(stamps, position, rotation.as_quat()):
            seconds = f"{stamp // 10**9}.{stamp % 10**9:09d}"
            f.write(" ".join([seconds] + [f"{v:.8f}" for v in [*p, *q]]) + "\n")


def evo_numbers():
    reference = file_interface.read_euroc_csv_trajectory(str(HERE / "groundtruth.csv"))
    estimate = file_interface.read_tum_trajectory_file(str(HERE / "estimate.txt"))
    reference, estimate = sync.associate_trajectories(reference, estimate, max_diff=0.01)
    numbers = {"evo": evo_version, "matched": reference.num_poses, "path_length_m": reference.path_length}
    for name, align, scale in [("none", False, False), ("se3", True, False), ("sim3", True, True)]:
        result = main_ape.ape(copy.deepcopy(reference), copy.deepcopy(estimate),
                              metrics.PoseRelation.translation_part, align=align, correct_scale=scale)
        numbers[f"ape_{name}"] = result.stats
        for frames in (1, 20):
            for all_pairs in (False, True):
                for part in ("translation_part", "rotation_angle_deg"):
                    result = main_rpe.rpe(copy.deepcopy(reference), copy.deepcopy(estimate),
                                          metrics.PoseRelation[part], delta=frames,
                                          delta_unit=metrics.Unit.frames, all_pairs=all_pairs,
                                          align=align, correct_scale=scale)
                    pairs = "all" if all_pairs else "consecutive"
                    numbers[f"rpe_{name}_{frames}_{pairs}_{part}"] = result.stats
    return numbers


if __name__ == "__main__":
    write_files(np.random.default_rng(1))
    (HERE / "evo_numbers.json").write_text(json.dumps(evo_numbers(), indent=1, sort_keys=True) + "\n")
