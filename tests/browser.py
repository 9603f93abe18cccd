"""Headless Chromium, where it is installed, as a judge of the pages that fastloop writes."""
import pathlib
import re
import shutil
import subprocess
import tempfile


def find_browser():
    return next((p for p in map(shutil.which, ("chromium", "chromium-browser", "google-chrome")) if p), None)


class Browser:
    def __init__(self, program):
        self.program = program
        self.profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)

    def close(self):
        self.profile.cleanup()

    def call(self, *arguments):
        return subprocess.run(
            [self.program, "--headless=new", "--no-sandbox", "--disable-gpu", "--no-first-run", "--hide-scrollbars",
             "--allow-file-access-from-files", "--enable-logging=stderr", f"--user-data-dir={self.profile.name}",
             *map(str, arguments)],
            capture_output=True, text=True, timeout=120, stdin=subprocess.DEVNULL, check=False)

    def open(self, page):
        """The page as the browser understood it, and what it complained about on its console."""
        result = self.call("--dump-dom", pathlib.Path(page).as_uri())
        return result.stdout, [line for line in result.stderr.splitlines() if "CONSOLE" in line]

    def overflow_px(self, page, width):
        """By how much the page is wider than a screen of this width."""
        page = pathlib.Path(page)
        probe = page.with_name("probe.html")
        # A window cannot be as narrow as a phone; a frame can.
        probe.write_text(
            f'<iframe id="f" src="{page.name}" style="width:{width}px;height:800px;border:0"></iframe><p id="o"></p>'
            "<script>window.onload = () => { const d = document.getElementById('f').contentDocument;"
            "document.getElementById('o').textContent = 'overflow ' +"
            "(d.documentElement.scrollWidth - d.documentElement.clientWidth); };</script>")
        dom, complaints = self.open(probe)
        found = re.search(r"overflow (-?\d+)", dom)
        assert found, (dom[-500:], complaints)
        return int(found.group(1))
