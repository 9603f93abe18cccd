#!/usr/bin/env python3
"""Calls the program as a user would: help, exit codes, messages of the commands.

Usage: cli_smoke_test.py PROGRAM REPOSITORY
"""
import json
import pathlib
import re
import sys
import tempfile
import unittest

from cli_support import call_program

PROGRAM, REPOSITORY = sys.argv[1], pathlib.Path(sys.argv[2])
TESTDATA = REPOSITORY / "src/fastloop/eval/testdata"
TRUTH, ESTIMATE = str(TESTDATA / "groundtruth.csv"), str(TESTDATA / "estimate.txt")


def call(*arguments):
    return call_program(PROGRAM, *arguments)


def commands():
    """Names of all commands, from the program's own help."""
    listing = call("--help").stdout.split("Subcommands:")[1]
    return re.findall(r"^  (\S+)", listing, re.MULTILINE)


class CommandLine(unittest.TestCase):
    def test_help_lists_the_commands_and_each_explains_itself(self):
        names = commands()
        for expected in ("run", "simulate", "eval", "convert-calib", "doctor"):
            self.assertIn(expected, names)
        for name in names:
            result = call(name, "--help")
            self.assertEqual(result.returncode, 0, name)
            self.assertIn("Usage:", result.stdout, name)

    def test_bad_usage_is_exit_code_2(self):
        self.assertEqual(call().returncode, 2)
        self.assertEqual(call("dance").returncode, 2)
        for name in commands():
            result = call(name, "--no-such-option")
            self.assertEqual(result.returncode, 2, name)
            self.assertNotEqual(result.stderr, "", name)

    def test_version(self):
        result = call("--version")
        self.assertEqual(result.returncode, 0)
        self.assertRegex(result.stdout, r"^\d+\.\d+\.\d+\n$")

    def test_missing_input_is_exit_code_2_and_names_the_file(self):
        with tempfile.TemporaryDirectory() as out:
            missing = f"{out}/missing"
            for arguments in (("run", missing, "--out", f"{out}/result"), ("doctor", missing),
                              ("eval", missing, missing)):
                result = call(*arguments)
                self.assertEqual(result.returncode, 2, arguments)
                self.assertIn(missing, result.stderr, arguments)

    def test_empty_folder_is_exit_code_2(self):
        with tempfile.TemporaryDirectory() as empty, tempfile.TemporaryDirectory() as out:
            result = call("run", empty, "--out", out)
            self.assertEqual(result.returncode, 2)
            self.assertIn(empty, result.stderr)


class Eval(unittest.TestCase):
    def test_json_agrees_with_evo(self):
        evo = json.loads((TESTDATA / "evo_numbers.json").read_text())
        for align in ("none", "se3", "sim3"):
            result = call("eval", TRUTH, ESTIMATE, "--align", align, "--rpe", 1, "--json")
            self.assertEqual(result.returncode, 0, result.stderr)
            ours = json.loads(result.stdout)
            self.assertAlmostEqual(ours["ate_m"]["rmse"], evo[f"ape_{align}"]["rmse"], delta=1e-6)
            self.assertAlmostEqual(ours["rpe"]["consecutive_translation_m"]["rmse"],
                                   evo[f"rpe_{align}_20_consecutive_translation_part"]["rmse"], delta=1e-6)

    def test_missed_thresholds_are_exit_code_4(self):
        self.assertEqual(call("eval", TRUTH, ESTIMATE, "--max-ate", 0.1).returncode, 0)
        self.assertEqual(call("eval", TRUTH, ESTIMATE, "--max-ate", 0.08).returncode, 4)
        self.assertEqual(call("eval", TRUTH, ESTIMATE, "--min-coverage", 80).returncode, 0)
        result = call("eval", TRUTH, ESTIMATE, "--min-coverage", 99)
        self.assertEqual(result.returncode, 4)
        self.assertIn("--min-coverage", result.stderr)

    def test_bad_values_are_exit_code_2(self):
        self.assertEqual(call("eval", TRUTH, ESTIMATE, "--align", "rigid").returncode, 2)
        self.assertEqual(call("eval", TRUTH, ESTIMATE, "--rpe", -1).returncode, 2)
        self.assertEqual(call("eval", TRUTH, ESTIMATE, "--rpe", 1000).returncode, 2)
        self.assertEqual(call("eval", TRUTH, ESTIMATE, "--plot", "/nonexistent/plot.svg").returncode, 2)

    def test_plot_is_xml(self):
        with tempfile.TemporaryDirectory() as out:
            plot = pathlib.Path(out) / "plot.svg"
            self.assertEqual(call("eval", TRUTH, ESTIMATE, "--plot", plot).returncode, 0)
            from xml.etree import ElementTree
            self.assertTrue(ElementTree.parse(plot).getroot().tag.endswith("svg"))


class Doctor(unittest.TestCase):
    def test_names_versions_machine_and_output_folder(self):
        with tempfile.TemporaryDirectory() as out:
            result = call("doctor", "--out", f"{out}/not/yet/there")
            self.assertEqual(result.returncode, 0, result.stderr)
            for word in ("fastloop", "Eigen", "OpenCV", "Ceres", "oneTBB", "CUDA", "SIMD", "memory", "writable"):
                self.assertIn(word, result.stdout)
            self.assertEqual(list(pathlib.Path(out).iterdir()), [], "the probe must be removed")

    def test_output_folder_that_cannot_be_written_is_exit_code_2(self):
        result = call("doctor", "--out", "/proc/fastloop")
        self.assertEqual(result.returncode, 2)
        self.assertIn("NOT writable", result.stdout)


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1], verbosity=2)
