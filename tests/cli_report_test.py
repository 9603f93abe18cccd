#!/usr/bin/env python3
"""`fastloop report` and `fastloop bench` as a user meets them: a short run, its page in a browser, the tables.

Usage: cli_report_test.py PROGRAM
"""
import csv
import json
import os
import pathlib
import re
import sys
import tempfile
import unittest

from browser import Browser, find_browser
from cli_support import call_program

PROGRAM = sys.argv[1]
NUMBER = re.compile(r'data-key="([^"]+)" data-value="([^"]+)">([^<]*)<')


def call(*arguments):
    return call_program(PROGRAM, *arguments, timeout=600)


def load(file):
    return json.loads(pathlib.Path(file).read_text())


def look_up(tree, path):
    """The value at a path such as stages.orb.mean_ms; numbers are indices of lists."""
    for part in path.split("."):
        tree = tree[int(part)] if isinstance(tree, list) else tree[part]
    return tree


class Report(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.root = pathlib.Path(cls.folder.name)
        cls.data = cls.root / "short"
        cls.good("simulate", "room", "--seconds", 3, "--out", cls.data)
        cls.bench = cls.root / "bench"
        cls.loops_output = cls.good("bench", "loops", "--dataset", cls.data, "--runs", 2, "--warm-up", 1,
                                    "--backends", "reference,cpu", "--out", cls.bench)
        cls.scale = cls.root / "scale"
        cls.good("bench", "scale", "--keyframes", "100..300", "--features", 600, "--runs", 2,
                 "--reference-max", 150, "--out", cls.scale)
        cls.run_folder = cls.bench / "runs/short/cpu/run1"
        cls.page = cls.root / "report.html"
        cls.good("report", cls.run_folder, "--bench", f"{cls.bench / 'loops.json'},{cls.scale / 'scale.json'}",
                 "--out", cls.page)
        program = find_browser()
        cls.browser = Browser(program) if program else None

    @classmethod
    def tearDownClass(cls):
        if cls.browser:
            cls.browser.close()
        cls.folder.cleanup()

    @classmethod
    def good(cls, *arguments):
        result = call(*arguments)
        assert result.returncode == 0, (arguments, result.stderr)
        return result.stdout

    def bad(self, *arguments):
        result = call(*arguments)
        self.assertEqual(result.returncode, 2, result.stdout)
        self.assertNotIn("terminate", result.stderr)
        return result.stderr

    def check_numbers(self, html):
        """Every number with a key is that of the file it names, and is shown as it is, rounded."""
        benches = [load(self.bench / "loops.json"), load(self.scale / "scale.json")]
        files = {"summary": load(self.run_folder / "summary.json"), "timing": load(self.run_folder / "timing.json")}
        files.update({f"bench{i}": b for i, b in enumerate(benches)})
        evaluated = load_evaluation(self.run_folder, self.data)
        found = NUMBER.findall(html)
        seen = set()
        for key, value, shown in found:
            file, _, path = key.partition(".")
            seen.add(file)
            number = float(value)
            if file in files:
                self.assertEqual(number, look_up(files[file], path), key)
            elif key == "evaluation.final.ate_m.rmse":
                self.assertAlmostEqual(number, evaluated["ate_m"]["rmse"], 12)
            text = shown.split(" ")[0]
            decimals = len(text.partition(".")[2])
            self.assertLessEqual(abs(float(text) - number), 0.5001 * 10 ** -decimals, key)
        self.assertEqual(seen, {"summary", "timing", "evaluation", "bench0", "bench1"})
        self.assertGreater(len(found), 100)

    def test_numbers_are_those_of_the_files(self):
        self.check_numbers(self.page.read_text())

    def test_page_fetches_nothing(self):
        html = self.page.read_text()
        self.assertEqual(re.findall(r"<script|<iframe|<img|src=|url\(|@import", html), [])
        self.assertEqual(set(re.findall(r'href="([^"]*)"', html)), {"data:,"})

    def test_page_in_a_browser(self):
        if not self.browser:
            self.skipTest("chromium is not installed")
        dom, complaints = self.browser.open(self.page)
        self.assertEqual(complaints, [])
        self.check_numbers(dom)
        for text in ("Trajectory", "Stage times", "Machine", "Loop closing on sequences", "speed-up of cpu"):
            self.assertIn(text, dom)
        self.assertGreaterEqual(dom.count("<svg"), 7)
        self.assertNotIn("NaN", dom)
        for width in (390, 1280):
            self.assertLessEqual(self.browser.overflow_px(self.page, width), 0, f"{width} px wide")

    def test_table_of_loops(self):
        table = load(self.bench / "loops.json")
        self.assertEqual(table["backends"], ["reference", "cpu"])
        row, = table["sequences"]
        self.assertEqual((row["name"], row["kind"]), ("short", "simulated"))
        for backend in ("reference", "cpu"):
            b = row["backends"][backend]
            self.assertEqual((b["runs"], b["loops"]), (2, 0))
            self.assertTrue(b["same_every_run"])
            self.assertGreater(b["host_peak_mib"]["max"], 20)
        self.assertTrue(row["comparison"]["cpu"]["accuracy_kept"])
        self.assertEqual(self.loops_output, (self.bench / "loops.md").read_text())
        with open(self.bench / "loops.csv", newline="") as f:
            lines = list(csv.DictReader(f))
        self.assertEqual([line["backend"] for line in lines], ["reference", "cpu"])
        self.assertEqual(float(lines[0]["ate_median_m"]), row["backends"]["reference"]["ate_m"]["median"])
        self.assertFalse((self.bench / "runs/short/cpu/warm_up").exists())

    def test_scale(self):
        table = load(self.scale / "scale.json")
        self.assertEqual([c["keyframes"] for c in table["cases"]], [100, 300])
        small, large = table["cases"]
        self.assertIn("total", small["speed_up"]["cpu"])
        self.assertIsNone(large["backends"]["reference"])
        self.assertIn("reference left out", " ".join(large["notes"]))
        if not os.environ.get("FASTLOOP_SANITIZE"):  # a sanitizer's heap does not say how large it is
            self.assertGreater(large["map_mib"], small["map_mib"])
        self.assertIn("<svg", (self.scale / "speed_up.svg").read_text())

    def test_replay(self):
        map_file = self.root / "maps/a/loop_1.flmap"
        map_file.parent.mkdir(parents=True)
        self.good("simulate-map", "--keyframes", 100, "--features", 600, "--out", map_file)
        text = self.good("bench", "replay", self.root / "maps", "--runs", 2, "--out", self.root / "replay")
        case, = load(self.root / "replay/replay.json")["cases"]
        self.assertEqual(case["name"], "a/loop_1")
        self.assertTrue(case["decisions_equal"])
        self.assertIn("loop_fusion", text)

    def test_bad_calls(self):
        out = ("--out", self.root / "bad")
        if "\ndevice 0" not in call("doctor").stdout:
            self.assertRegex(self.bad("bench", "loops", "--backends", "cuda", *out),
                             "cuda is not built|cuda needs a device")
        self.assertIn("neither a folder", self.bad("bench", "loops", "--dataset", "nowhere", *out))
        self.assertIn("--keyframes", self.bad("bench", "scale", "--keyframes", "10..100", *out))
        self.assertIn("no map files", self.bad("bench", "replay", self.data))
        self.assertIn("summary.json", self.bad("report", self.data))
        self.assertIn("not a result", self.bad("report", self.run_folder, "--bench", self.run_folder / "summary.json"))


def load_evaluation(run_folder, data):
    result = call("eval", data / "mav0/state_groundtruth_estimate0/data.csv", run_folder / "trajectory_body.txt", "--json")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1])
