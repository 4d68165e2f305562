"""Run benchmarks as a user does: in a separate process, so that its memory is measured correctly."""

import subprocess
import sys
from pathlib import Path


def run(name, *options):
    """Run `python -m benchmarks.<name>` with options; its exit status must be 0."""
    command = [sys.executable, "-m", f"benchmarks.{name}", *map(str, options)]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
