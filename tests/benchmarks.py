"""Benchmarks as a user runs them: in a process of their own, whose memory is theirs alone."""

import subprocess
import sys
from pathlib import Path


def run(name, *options):
    """`python -m benchmarks.<name>` with these options; its exit status must be 0."""
    command = [sys.executable, "-m", f"benchmarks.{name}", *map(str, options)]
    done = subprocess.run(command, cwd=Path(__file__).parents[1], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
