#!/usr/bin/env python3
"""The back end cuda as a user meets it, with a device, without one, and in builds without CUDA.

Usage: cli_cuda_test.py PROGRAM ON|OFF    whether the program was built with CUDA
"""
import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
import unittest

from cli_support import call_program

PROGRAM, WITH_CUDA = sys.argv[1], sys.argv[2] == "ON"


def call(*arguments):
    return call_program(PROGRAM, *arguments)


class Cuda(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.root = pathlib.Path(cls.folder.name)
        cls.map = cls.root / "a.flmap"
        made = call("simulate-map", "--keyframes", 150, "--features", 600, "--seed", 3, "--out", cls.map)
        assert made.returncode == 0, made.stderr
        cls.doctor = call("doctor").stdout
        cls.has_device = "\ndevice 0" in cls.doctor

    @classmethod
    def tearDownClass(cls):
        cls.folder.cleanup()

    def replay(self, backend):
        result = call("replay", self.map, "--backend", backend, "--repeat", 1, "--json")
        self.assertEqual(result.returncode, 0, result.stderr)
        return json.loads(result.stdout)["replays"][0], result.stderr

    def test_same_decisions_as_the_cpu_with_a_device_or_without(self):
        cpu, said = self.replay("cpu")
        self.assertEqual(said, "")
        cuda, said = self.replay("cuda")
        self.assertEqual(cuda["decision_digest"], cpu["decision_digest"])
        self.assertEqual(cuda["correction"], cpu["correction"])
        if self.has_device:
            self.assertEqual(cuda["backend"], "cuda")
            self.assertEqual(said, "")
        else:
            self.assertEqual(cuda["backend"], "cpu")
            self.assertEqual(cuda["pose_digest"], cpu["pose_digest"])
            self.assertEqual(len(said.splitlines()), 1, said)
            self.assertIn("no CUDA device", said)

    def test_auto_takes_what_is_there(self):
        auto, said = self.replay("auto")
        self.assertEqual(auto["backend"], "auto" if self.has_device else "cpu")
        self.assertEqual(len(said.splitlines()), 1 if WITH_CUDA and not self.has_device else 0, said)

    def test_bench_does_not_show_the_cpu_as_cuda(self):
        result = call("bench", "replay", self.map, "--backends", "reference,cuda", "--runs", 1, "--warm-up", 0)
        if self.has_device:
            self.assertEqual(result.returncode, 0, result.stderr)
        else:
            self.assertEqual(result.returncode, 2, result.stdout)
            self.assertIn("needs a device" if WITH_CUDA else "is not built", result.stderr)

    def test_doctor_says_what_there_is(self):
        if not WITH_CUDA:
            self.assertRegex(self.doctor, r"CUDA +not compiled in")
        elif not self.has_device:
            self.assertRegex(self.doctor, r"device +none: ")
        else:
            self.assertIn("10000 keyframes:", self.doctor)
        if not self.has_device:
            self.assertRegex(self.doctor, r"\nauto +cpu\n")

    def test_calibration(self):
        environment = dict(os.environ, XDG_CACHE_HOME=str(self.root / "cache"))
        result = subprocess.run([PROGRAM, "doctor", "--calibrate"], capture_output=True, text=True, env=environment)
        self.assertEqual(result.returncode, 0, result.stderr)
        stored = self.root / "cache" / "fastloop" / "cost_model.json"
        self.assertEqual(stored.exists(), self.has_device)
        if not self.has_device:
            self.assertIn("needs a device", result.stdout)
            return
        self.assertEqual(json.loads(stored.read_text())["version"], 1)
        stored.write_text("{")
        again = subprocess.run([PROGRAM, "doctor"], capture_output=True, text=True, env=environment)
        self.assertEqual(again.returncode, 0)
        self.assertIn("default costs are used", again.stderr)

    @unittest.skipIf(WITH_CUDA, "this build has the CUDA back end")
    def test_build_without_cuda_contains_nothing_of_it(self):
        symbols = subprocess.run(["nm", PROGRAM], capture_output=True, text=True, check=True).stdout
        names = [line.split()[-1] for line in symbols.splitlines() if line.split()]
        self.assertGreater(len(names), 1000)
        self.assertEqual([n for n in names if re.match(r"_*(cuda[A-Z_]|cu[A-Z]|nvtx)", n)], [])
        sections = subprocess.run(["readelf", "-SW", PROGRAM], capture_output=True, text=True, check=True).stdout
        self.assertNotIn("nv_fatbin", sections)
        needed = subprocess.run(["readelf", "-d", PROGRAM], capture_output=True, text=True, check=True).stdout
        self.assertNotIn("libcuda", needed)

    @unittest.skipUnless(WITH_CUDA, "this build has no CUDA back end")
    def test_program_starts_where_no_driver_library_is(self):
        needed = subprocess.run(["readelf", "-d", PROGRAM], capture_output=True, text=True, check=True).stdout
        self.assertNotIn("libcuda", needed)


if __name__ == "__main__":
    if not (shutil.which("nm") and shutil.which("readelf")):
        sys.exit("nm and readelf are needed")
    unittest.main(argv=sys.argv[:1])
