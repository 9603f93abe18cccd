"""What the tests of the command line share."""
import subprocess


def call_program(program, *arguments, timeout=120):
    """Runs the program with these arguments and nothing to read; returns its exit code and output."""
    return subprocess.run([program, *map(str, arguments)], capture_output=True, text=True, timeout=timeout,
                          stdin=subprocess.DEVNULL, check=False)
