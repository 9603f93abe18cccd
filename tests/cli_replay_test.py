#!/usr/bin/env python3
"""`fastloop replay` as a user meets it.

Usage: cli_replay_test.py PROGRAM
"""
import json
import pathlib
import sys
import tempfile
import unittest

from cli_support import call_program

PROGRAM = sys.argv[1]


def call(*arguments):
    return call_program(PROGRAM, *arguments)


class Replay(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.root = pathlib.Path(cls.folder.name)
        cls.map = cls.root / "a.flmap"
        made = call("simulate-map", "--keyframes", 150, "--features", 600, "--seed", 3, "--out", cls.map)
        assert made.returncode == 0, made.stderr

    @classmethod
    def tearDownClass(cls):
        cls.folder.cleanup()

    def replay(self, *arguments):
        result = call("replay", *arguments)
        self.assertEqual(result.returncode, 0, result.stderr)
        return result.stdout

    def bad(self, *arguments):
        result = call("replay", *arguments)
        self.assertEqual(result.returncode, 2, result.stdout)
        self.assertNotIn("terminate", result.stderr)
        return result.stderr

    def test_json_of_all_back_ends(self):
        report = json.loads(self.replay(self.map, "--backend", "all", "--repeat", 2, "--json"))
        self.assertEqual(report["keyframes"], 150)
        with_device = "\ndevice 0" in call("doctor").stdout
        self.assertEqual([r["backend"] for r in report["replays"]],
                         ["reference", "cpu", "cuda", "auto"] if with_device else ["reference", "cpu"])
        for replay in report["replays"]:
            self.assertEqual(replay["verdict"], "accepted")
            self.assertTrue(replay["correction"]["applied"])
            self.assertLess(replay["loop_edge_error"]["translation_m"], 0.1)
            self.assertGreater(replay["total_ms"], replay["total_without_graph_ms"])
            self.assertIn("loop_fusion", replay["stages_ms"])
            self.assertIn("apply_landmarks", replay["stages_ms"])
            self.assertTrue(replay["candidates"][0]["gates"])
        self.assertTrue(report["comparison"]["decisions_equal"])
        self.assertLess(report["comparison"]["largest_pose_difference"], 1e-6)
        self.assertEqual(len({r["decision_digest"] for r in report["replays"]}), 1)

    def test_table_and_repeatability(self):
        digests = [self.replay(self.map, "--repeat", 1).split("digest of decisions")[1] for _ in range(2)]
        self.assertEqual(*digests)
        self.assertIn("without graph optimisation", self.replay(self.map, "--backend", "cpu", "--repeat", 1))

    def test_files_that_cannot_be_replayed(self):
        self.assertIn("no.flmap", self.bad(self.root / "no.flmap"))
        damaged = self.root / "damaged.flmap"
        data = bytearray(self.map.read_bytes())
        data[len(data) // 2] ^= 1
        damaged.write_bytes(data)
        self.assertIn("damaged.flmap", self.bad(damaged))
        self.bad(self.map, "--backend", "abacus")
        self.bad(self.map, "--repeat", 0)


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1])
