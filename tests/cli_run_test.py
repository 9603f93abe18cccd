#!/usr/bin/env python3
"""`fastloop run` as a user meets it: good runs, bad input, full disks, interruption.

Usage: cli_run_test.py PROGRAM
"""
import json
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import unittest

PROGRAM = sys.argv[1]
OUTPUTS = ("trajectory_body.txt", "trajectory_cam0.txt", "trajectory_live.txt", "keyframes.txt", "summary.json",
           "timing.json", "events.jsonl", "map.ply")
SECONDS, RATE = 2, 20


def command(*arguments):
    return [PROGRAM, *map(str, arguments)]


def call(*arguments):
    return subprocess.run(command(*arguments), capture_output=True, text=True, timeout=300, stdin=subprocess.DEVNULL,
                          check=False)


def lines(file):
    return [line for line in file.read_text().splitlines() if line and not line.startswith("#")]


def summary(out):
    return json.loads((out / "summary.json").read_text())


class Run(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.folder = tempfile.TemporaryDirectory()
        cls.root = pathlib.Path(cls.folder.name)
        cls.data = cls.root / "data"
        result = call("simulate", "room", "--seconds", SECONDS, "--out", cls.data)
        assert result.returncode == 0, result.stderr
        cls.frames = SECONDS * RATE + 1

    @classmethod
    def tearDownClass(cls):
        cls.folder.cleanup()

    def setUp(self):
        self.out = self.root / "out"
        shutil.rmtree(self.out, ignore_errors=True)
        self.changed = self.root / "changed"

    def tearDown(self):
        shutil.rmtree(self.changed, ignore_errors=True)

    def images(self, folder, camera):
        return sorted((folder / f"mav0/cam{camera}/data").glob("*.png"))

    def copy_of_data(self):
        """A copy of the sequence that shares the files; a file is replaced, never written in place."""
        shutil.copytree(self.data, self.changed, copy_function=lambda a, b: pathlib.Path(b).hardlink_to(a))
        return self.changed

    def replace(self, file, content):
        file.unlink()
        file.write_bytes(content)

    def assert_complete(self, frames):
        for name in OUTPUTS:
            self.assertTrue((self.out / name).is_file(), name)
        self.assertEqual(summary(self.out)["frames"], frames)
        self.assertEqual(len(lines(self.out / "trajectory_body.txt")), summary(self.out)["frames_tracked"])

    def test_writes_every_output(self):
        result = call("run", self.data, "--out", self.out)
        self.assertEqual(result.returncode, 0, result.stderr)
        self.assert_complete(self.frames)
        self.assertEqual(summary(self.out)["frames_tracked"], self.frames)
        self.assertEqual(summary(self.out)["mode"], "stereo-inertial")

    def test_deterministic_runs_write_the_same_bytes(self):
        again = self.root / "again"
        for out in (self.out, again):
            self.assertEqual(call("run", self.data, "--out", out, "--deterministic", "--quiet", "--max-frames",
                                  20).returncode, 0)
        for name in OUTPUTS:
            if name != "timing.json":
                self.assertEqual((self.out / name).read_bytes(), (again / name).read_bytes(), name)

    def test_start_and_max_frames_choose_a_part(self):
        result = call("run", self.data, "--out", self.out, "--start", 0.5, "--max-frames", 12)
        self.assertEqual(result.returncode, 0, result.stderr)
        self.assert_complete(12)
        first = float(lines(self.out / "trajectory_body.txt")[0].split()[0])
        stamp = int(self.images(self.data, 0)[10].stem) * 1e-9
        self.assertAlmostEqual(first, stamp, places=5)
        self.assertEqual(call("run", self.data, "--out", self.out, "--start", 60).returncode, 2)

    def test_mode_that_the_data_cannot_serve_is_exit_code_2(self):
        result = call("run", self.data, "--out", self.out, "--mode", "rgbd")
        self.assertEqual(result.returncode, 2)
        self.assertIn("depth", result.stderr)

    def test_file_in_place_of_the_output_folder_is_exit_code_2(self):
        self.out.write_text("in the way")
        try:
            for out in (self.out, self.out / "below"):
                result = call("run", self.data, "--out", out)
                self.assertEqual(result.returncode, 2)
                self.assertIn(str(out), result.stderr)
            self.assertEqual(self.out.read_text(), "in the way")
        finally:
            self.out.unlink()

    def test_full_disk_is_exit_code_2_and_names_the_file(self):
        for name in ("map.ply", "trajectory_body.txt", "summary.json"):
            shutil.rmtree(self.out, ignore_errors=True)
            self.out.mkdir()
            (self.out / name).symlink_to("/dev/full")
            result = call("run", self.data, "--out", self.out, "--max-frames", 8)
            self.assertEqual(result.returncode, 2, result.stderr)
            self.assertIn(name, result.stderr)
            # One file that fails does not take the others along.
            for other in OUTPUTS:
                if other != name:
                    self.assertTrue((self.out / other).is_file(), f"{other} beside {name}")

    def test_truncated_image_is_exit_code_2_and_saves_the_frames_until_then(self):
        data = self.copy_of_data()
        image = self.images(data, 1)[15]
        self.replace(image, image.read_bytes()[:2000])
        result = call("run", data, "--out", self.out)
        self.assertEqual(result.returncode, 2)
        self.assertIn(str(image), result.stderr)
        self.assert_complete(15)

    def test_gap_and_nan_in_the_imu_are_reported_and_survived(self):
        data = self.copy_of_data()
        csv = data / "mav0/imu0/data.csv"
        rows = csv.read_text().splitlines()
        middle = len(rows) // 2
        rows[50] = ",".join([rows[50].split(",")[0], "nan", *rows[50].split(",")[2:]])
        del rows[middle:middle + 60]
        self.replace(csv, ("\n".join(rows) + "\n").encode())
        result = call("run", data, "--out", self.out)
        self.assertIn(result.returncode, (0, 2), result.stderr)
        self.assertIn("imu0", result.stderr + json.dumps(summary(self.out) if self.out.exists() else ""))
        if result.returncode == 0:
            self.assertEqual(summary(self.out)["frames_tracked"], self.frames)

    def test_missing_imu_is_a_stereo_run(self):
        data = self.copy_of_data()
        shutil.rmtree(data / "mav0/imu0")
        result = call("run", data, "--out", self.out, "--max-frames", 10)
        self.assertEqual(result.returncode, 0, result.stderr)
        self.assertEqual(summary(self.out)["mode"], "stereo")
        result = call("run", data, "--out", self.out, "--mode", "stereo-inertial")
        self.assertEqual(result.returncode, 2)
        self.assertIn("IMU", result.stderr)

    def test_blank_images_never_initialise_and_are_exit_code_3(self):
        data = self.copy_of_data()
        blank = self.root / "blank.png"
        width, height = 752, 480
        blank.write_bytes(grey_png(width, height))
        for camera in (0, 1):
            for image in self.images(data, camera):
                self.replace(image, blank.read_bytes())
        result = call("run", data, "--out", self.out, "--max-frames", 8)
        self.assertEqual(result.returncode, 3, result.stderr)
        self.assert_complete(8)
        self.assertIn("keypoints", (self.out / "events.jsonl").read_text())

    def test_interrupt_saves_everything_and_is_exit_code_0(self):
        # At the recorded pace the run lasts as long as the recording: time to interrupt it.
        process = subprocess.Popen(command("run", self.data, "--out", self.out, "--realtime", "--quiet"),
                                   stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        deadline = time.monotonic() + 60
        while not self.out.exists() and time.monotonic() < deadline:
            time.sleep(0.01)
        time.sleep(0.6)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate(timeout=120)
        self.assertEqual(process.returncode, 0, errors)
        frames = summary(self.out)["frames"]
        self.assertGreater(frames, 0)
        self.assertLess(frames, self.frames)
        self.assertTrue(summary(self.out)["interrupted"])
        self.assert_complete(frames)

    def test_realtime_counts_what_it_drops(self):
        # A recording that claims to be sixteen times faster cannot be kept up with.
        data = self.copy_of_data()
        stamps = [int(image.stem) for image in self.images(data, 0)]
        names = {stamp: stamps[0] + (stamp - stamps[0]) // 16 for stamp in stamps}
        shutil.rmtree(data / "mav0/imu0")
        for camera in (0, 1):
            for image in self.images(data, camera):
                image.rename(image.with_name(f"{names[int(image.stem)]}.png"))
            rows = [f"{names[s]},{names[s]}.png" for s in stamps]
            self.replace(data / f"mav0/cam{camera}/data.csv", ("#timestamp [ns],filename\n" + "\n".join(rows) + "\n").encode())
        result = call("run", data, "--out", self.out, "--realtime", "--mode", "stereo")
        self.assertEqual(result.returncode, 0, result.stderr)
        facts = summary(self.out)
        self.assertGreater(facts["dropped_frames"], 0)
        self.assertEqual(facts["frames"] + facts["dropped_frames"], self.frames)


def grey_png(width, height):
    """An evenly grey image, 8 bits."""
    import struct
    import zlib

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    rows = (b"\0" + b"\x60" * width) * height
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1], verbosity=2)
