#!/usr/bin/env python3
"""`fastloop simulate-map` and `fastloop map` as a user meets them.

Usage: cli_map_test.py PROGRAM
"""
import json
import pathlib
import sys
import tempfile
import unittest

from cli_support import call_program

PROGRAM = sys.argv[1]
SMALL = ("--keyframes", 150, "--covisible", 12, "--features", 200)


def call(*arguments):
    return call_program(PROGRAM, *arguments)


class MapFiles(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.root = pathlib.Path(cls.folder.name)
        cls.map = cls.root / "a.flmap"
        cls.made = call("simulate-map", *SMALL, "--seed", 3, "--out", cls.map)
        assert cls.made.returncode == 0, cls.made.stderr

    @classmethod
    def tearDownClass(cls):
        cls.folder.cleanup()

    def good(self, *arguments):
        result = call(*arguments)
        self.assertEqual(result.returncode, 0, result.stderr)
        return result.stdout

    def bad(self, *arguments):
        result = call(*arguments)
        self.assertEqual(result.returncode, 2, result.stdout)
        self.assertNotIn("terminate", result.stderr)
        return result.stderr

    def info(self, file):
        """Lines of `map info` by their first word; extras by name."""
        pairs = [line.split(maxsplit=1) for line in self.good("map", "info", file).splitlines()]
        extras = dict(rest.split(", ", 1) for word, rest in pairs if word == "extra")
        return dict(pairs), extras

    def test_info_tells_what_was_made(self):
        facts, extras = self.info(self.map)
        self.assertTrue(facts["keyframes"].startswith("150 (0 removed)"))
        self.assertIn("loop_request", extras)
        self.assertIn("truth", extras)
        request = json.loads(extras["loop_request"].split(": ", 1)[1])
        self.assertEqual(request["keyframe"], 149)
        self.assertEqual(request["inertial"], False)

    def test_same_seed_same_bytes(self):
        for seed, equal in ((3, True), (4, False)):
            other = self.root / f"seed{seed}.flmap"
            self.good("simulate-map", *SMALL, "--seed", seed, "--out", other)
            self.assertEqual(other.read_bytes() == self.map.read_bytes(), equal)

    def test_every_kind_of_map_is_consistent(self):
        file = self.root / "kind.flmap"
        for options in (("--fisheye",), ("--inertial",), ("--two-maps",), ("--drift", 0),
                        ("--keyframes", 300, "--loops", 2)):
            self.good("simulate-map", *SMALL[2:], "--keyframes" if "--keyframes" not in options else "--seed", 150,
                      *options, "--out", file)
            self.assertIn("consistent", self.good("map", "check", file))
        facts, _ = self.info(file)
        self.assertIn("2", facts["loops"])

    def test_check_of_a_damaged_file_is_exit_code_2_with_the_reason(self):
        data = bytearray(self.map.read_bytes())
        broken = self.root / "broken.flmap"
        for name, contents, reason in (("flipped", data[:5000] + bytes([data[5000] ^ 1]) + data[5001:], "damaged"),
                                       ("truncated", data[:-100], "cut short"), ("other", b"x" * 99, "not a map")):
            broken.write_bytes(contents)
            for command in ("info", "check", "export-ply", "export-g2o"):
                message = self.bad("map", command, broken)
                self.assertIn(reason, message, name)
                self.assertIn(str(broken), message)
        self.assertIn("missing", self.bad("map", "check", self.root / "missing"))

    def test_exports_can_be_read(self):
        self.good("map", "export-ply", self.map)
        header, body = (self.root / "a.ply").read_text().split("end_header\n")
        count = int(header.split("element vertex ")[1].split()[0])
        self.assertEqual(len(body.splitlines()), count)
        graph = self.root / "graph.g2o"
        self.good("map", "export-g2o", self.map, "--out", graph)
        lines = graph.read_text().splitlines()
        self.assertEqual(sum(line.startswith("VERTEX_SE3:QUAT") for line in lines), 150)
        self.assertGreaterEqual(sum(line.startswith("EDGE_SE3:QUAT") for line in lines), 149)
        self.good("posegraph", graph)

    def test_impossible_wishes_are_exit_code_2(self):
        out = self.root / "never.flmap"
        self.assertIn("too few", self.bad("simulate-map", "--keyframes", 100, "--loops", 50, "--out", out))
        self.bad("simulate-map", "--keyframes", 3, "--out", out)
        self.bad("simulate-map")
        self.assertFalse(out.exists())
        folder = self.root / "no" / "such" / "folder"
        self.assertIn("cannot be written", self.bad("simulate-map", *SMALL, "--out", folder / "a.flmap"))
        self.assertIn("cannot be written", self.bad("map", "export-ply", self.map, "--out", folder / "a.ply"))


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1], verbosity=2)
