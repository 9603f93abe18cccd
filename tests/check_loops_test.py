#!/usr/bin/env python3
"""The judgement of scripts/check_loops.py on loops whose truth is known.

Usage: check_loops_test.py REPOSITORY
"""
import contextlib
import io
import json
import math
import pathlib
import sys
import tempfile
import unittest
from unittest import mock

sys.path.insert(0, str(pathlib.Path(sys.argv[1]) / "scripts"))
import check_loops  # noqa: E402


def turn(degrees):
    half = math.radians(degrees) / 2
    return [0, 0, math.sin(half), math.cos(half)]


# A walk around a corner: at 2 s the body stands at (3, 1), turned left by 90 degrees.
TRUTH = [[0, 1, 1, 0, *turn(0)], [1, 2, 1, 0, *turn(30)], [2, 3, 1, 0, *turn(90)]]


class CheckLoops(unittest.TestCase):
    def judge(self, pose, euroc=False, start_s=1_000_000_000):
        with tempfile.TemporaryDirectory() as folder:
            truth = pathlib.Path(folder) / "truth"
            if euroc:
                truth.write_text("#timestamp\n" + "".join(
                    ",".join(map(str, [(start_s + t) * 10**9, x, y, z, qw, qx, qy, qz])) + "\n"
                    for t, x, y, z, qx, qy, qz, qw in TRUTH))
            else:
                truth.write_text("".join(" ".join(map(str, [start_s + p[0], *p[1:]])) + "\n" for p in TRUTH))
            loop = {"t": f"{start_s + 2}.0", "candidates": [
                {"verdict": "rejected"},
                {"verdict": "accepted", "matched_t": f"{start_s}.000000000", "T_matched_current": pose}]}
            (pathlib.Path(folder) / "loops.jsonl").write_text(json.dumps(loop) + "\n")
            with mock.patch.object(sys, "argv", ["check_loops.py", str(truth), folder]), \
                    contextlib.redirect_stdout(io.StringIO()) as out:
                return check_loops.main(), out.getvalue()

    def test_the_truth_is_right_in_both_formats(self):
        for euroc in (False, True):
            code, text = self.judge([2, 0, 0, *turn(90)], euroc)
            self.assertEqual(code, 0, text)
            self.assertIn("off by 0.000 m, 0.00 deg", text)
            self.assertIn("1 loops accepted, 0 wrong", text)

    def test_a_csv_that_begins_at_zero_is_in_nanoseconds_too(self):
        code, text = self.judge([2, 0, 0, *turn(90)], euroc=True, start_s=0)
        self.assertEqual(code, 0, text)
        self.assertIn("off by 0.000 m", text)

    def test_limits_on_distance_and_angle(self):
        self.assertEqual(self.judge([2.3, 0.39, 0, *turn(94.9)])[0], 0)
        self.assertEqual(self.judge([2.3, 0.41, 0, *turn(90)])[0], 4)
        self.assertEqual(self.judge([2, 0, 0, *turn(95.1)])[0], 4)

    def test_the_same_rotation_with_the_other_sign(self):
        self.assertEqual(self.judge([2, 0, 0, *(-x for x in turn(90))])[0], 0)


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1])
