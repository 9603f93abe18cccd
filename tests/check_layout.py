#!/usr/bin/env python3
"""Checks that the rooms of src/fastloop keep to the order of ARCHITECTURE.md.

  - a room includes only itself and rooms above it in the list of src/fastloop/CMakeLists.txt;
  - tracking, mapping and loop never include each other;
  - nothing under src/ includes apps/, bench/ or tests/;
  - a header that includes OpenCV is private: only sources of its own room may include it;
  - headers have at most 250 lines, sources 500.

Usage: check_layout.py REPOSITORY     prints every breach as file:line and exits with 1 when there is one.
       check_layout.py --self-test
"""
import pathlib
import re
import sys
import tempfile

INCLUDE = re.compile(r'^\s*#\s*include\s*[<"]([^>"]+)[>"]')
SIBLINGS = {"tracking", "mapping", "loop"}
MAX_LINES = {".hpp": 250, ".cuh": 250, ".inl": 500, ".cpp": 500, ".cu": 500}


def rooms_in_order(root):
    text = (root / "src/fastloop/CMakeLists.txt").read_text(encoding="utf-8")
    return re.search(r"set\(rooms\s+([^)]*)\)", text).group(1).split()


def includes(file):
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), start=1):
        match = INCLUDE.match(line)
        if match:
            yield number, match.group(1)


def sources(root):
    base = root / "src/fastloop"
    return [f for f in sorted(base.rglob("*")) if f.suffix in MAX_LINES]


def room_breaches(root):
    order = {room: index for index, room in enumerate(rooms_in_order(root))}
    for file in sources(root):
        room = file.relative_to(root / "src/fastloop").parts[0]
        for number, included in includes(file):
            parts = included.split("/")
            where = f"{file.relative_to(root)}:{number}"
            if parts[0] in ("apps", "bench", "tests", ".."):
                yield f"{where}: {included} lies outside the library"
            if parts[0] != "fastloop" or len(parts) < 3 or parts[1] == room:
                continue
            other = parts[1]
            if other not in order:
                yield f"{where}: {other} is no room"
            elif order[other] > order[room]:
                yield f"{where}: {room} may not include {other}, which stands below it"
            elif room in SIBLINGS and other in SIBLINGS:
                yield f"{where}: {room} and {other} may not include each other"


def opencv_breaches(root):
    files = sources(root)
    private = {}
    for file in files:
        if file.suffix == ".hpp" and any(i.startswith("opencv2/") for _, i in includes(file)):
            private[str(file.relative_to(root / "src"))] = file.parent
    for file in files:
        for number, included in includes(file):
            if included not in private:
                continue
            where = f"{file.relative_to(root)}:{number}"
            if file.suffix == ".hpp":
                yield f"{where}: a header includes {included}, which includes OpenCV"
            elif file.parent != private[included]:
                yield f"{where}: {included} is private to its room, because it includes OpenCV"


def length_breaches(root):
    for file in sources(root):
        lines = len(file.read_text(encoding="utf-8").splitlines())
        if lines > MAX_LINES[file.suffix]:
            yield f"{file.relative_to(root)}:{lines}: longer than {MAX_LINES[file.suffix]} lines"


def check(root):
    return [*room_breaches(root), *opencv_breaches(root), *length_breaches(root)]


def self_test():
    """The checker must find each kind of breach, and nothing in a tidy tree."""
    def tree(files):
        folder = tempfile.TemporaryDirectory()
        root = pathlib.Path(folder.name)
        files = {"CMakeLists.txt": "set(rooms core map tracking mapping)\n", **files}
        for name, text in files.items():
            file = root / "src/fastloop" / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(text, encoding="utf-8")
        found = check(root)
        folder.cleanup()
        return found

    private = {"map/cv.hpp": "#include <opencv2/core.hpp>\n"}
    include_private = '#include "fastloop/map/cv.hpp"\n'
    cases = [
        ({"map/a.hpp": '#include "fastloop/core/b.hpp"\n'}, 0),
        ({"core/a.hpp": '#include "fastloop/map/b.hpp"\n'}, 1),
        ({"mapping/a.cpp": '#include "fastloop/tracking/b.hpp"\n'}, 1),
        ({"core/a.cpp": '#include "fastloop/nowhere/b.hpp"\n'}, 1),
        ({**private, "map/a.cpp": include_private}, 0),
        ({**private, "map/a.hpp": include_private}, 1),
        ({**private, "tracking/a.cpp": include_private}, 1),
        ({"core/long.hpp": "\n" * 251}, 1),
        ({"core/long.cpp": "\n" * 251}, 0),
    ]
    for files, expected in cases:
        found = tree(files)
        if len(found) != expected:
            print(f"self-test: expected {expected} breaches in {files}, found {found}")
            return 1
    return 0


def main():
    if sys.argv[1] == "--self-test":
        return self_test()
    root = pathlib.Path(sys.argv[1]).resolve()
    files = sources(root)
    breaches = check(root)
    for breach in breaches:
        print(breach)
    longest = sorted(files, key=lambda f: -len(f.read_text(encoding="utf-8").splitlines()))[:5]
    print(f"{len(files)} files checked, {len(breaches)} breaches; the longest:")
    for file in longest:
        print(f"  {len(file.read_text(encoding='utf-8').splitlines())} {file.relative_to(root)}")
    return 1 if breaches else 0


if __name__ == "__main__":
    sys.exit(main())
