#!/usr/bin/env python3
"""The judgement of scripts/soak.sh on runs whose truth is known.

Usage: soak_check_test.py REPOSITORY
"""
import pathlib
import sys
import unittest

sys.path.insert(0, str(pathlib.Path(sys.argv[1]) / "scripts"))
from soak_check import judge  # noqa: E402


def run(keyframes, resident_mib, fifths=(10, 10, 10, 10, 10), seconds=1800):
    samples = [{"t_s": t, "keyframes": keyframes(t), "landmarks": 9, "resident_mib": resident_mib(t)}
               for t in range(0, seconds, 5)]
    return {"memory": {"peak_mib": 999, "samples": samples}, "track_p50_ms_by_fifth": list(fifths)}


def until(t, end):
    return int(min(t, end))


class Judge(unittest.TestCase):
    def missed(self, timing):
        return " ".join(judge(timing)[1])

    def test_a_map_that_stops_growing(self):
        self.assertEqual(self.missed(run(lambda t: until(t, 600), lambda t: 100 + until(t, 600))), "")

    def test_a_leak_after_that(self):
        def leak(percent):
            return run(lambda t: until(t, 600), lambda t: 100 + until(t, 600) + 7 * percent * t / 600)
        self.assertIn("memory grows", self.missed(leak(1.5)))
        self.assertEqual(self.missed(leak(0.5)), "")

    def test_a_map_that_grows_all_the_time(self):
        self.assertEqual(self.missed(run(int, lambda t: 100 + 0.1 * t)), "")
        self.assertIn("more and more", self.missed(run(int, lambda t: 100 + 0.1 * t + 1e-4 * t * t)))

    def test_tracking_that_slows_down(self):
        steady = (lambda t: until(t, 600), lambda t: 500)
        self.assertEqual(self.missed(run(*steady, fifths=(5, 10, 10, 11, 11.9))), "")
        self.assertIn("slower", self.missed(run(*steady, fifths=(5, 10, 10, 11, 12.1))))

    def test_a_run_too_short(self):
        self.assertIn("too short", self.missed(run(int, float, seconds=60)))


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1])
