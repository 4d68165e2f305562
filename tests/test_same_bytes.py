"""The chain's arrays do not know how many threads there were, which BLAS was chosen, or what lay in the cache."""

import json
import os
import platform
import subprocess
import sys
from pathlib import Path

import pytest

from jobs import cache

ROOT = Path(__file__).parents[1]
# OpenBLAS chooses its kernels by processor; any x86-64 of today runs these two.
KERNELS = ("Nehalem", "Haswell") if platform.machine() in ("x86_64", "AMD64") else ("", "")


def digests(what, folder, cached, threads, kernel, python=sys.executable):
    """Of what tests/chain.py makes in a process of its own; the compiled code is this process's."""
    folder.mkdir(exist_ok=True)
    variables = {
        "OMP_NUM_THREADS": str(threads),
        "OPENBLAS_NUM_THREADS": str(threads),
        "OPENBLAS_CORETYPE": kernel,
        "TRUESKY_CACHE": str(cached),
        "NUMBA_CACHE_DIR": str(cache.machine_code_dir()),
    }
    command = [python, "-m", "tests.chain", what, str(folder)]
    done = subprocess.run(command, env={**os.environ, **variables}, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def differing(one, other):
    return sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name))


def test_threads_and_kernels_change_no_bit(tmp_path):
    one = digests("quick", tmp_path / "1", tmp_path / "cache 1", 1, KERNELS[0])
    two = digests("quick", tmp_path / "2", tmp_path / "cache 2", 2, KERNELS[1])
    assert len(one) > 10
    assert differing(one, two) == []


@pytest.mark.nightly
def test_the_whole_chain(tmp_path):
    """Cold and warm, one thread and two, both kernels: a lake, two CCDs and every array that was kept."""
    first = digests("whole", tmp_path / "0", tmp_path / "cache", 1, KERNELS[0])
    assert len(first) > 150
    assert any(".fits" in name for name in first)
    assert any(name.endswith(".npy") for name in first)
    for number, (cached, threads, kernel) in enumerate(
        [("cache", 2, KERNELS[1]), ("cache 2", 2, KERNELS[1]), ("cache 3", 1, KERNELS[1]), ("cache 4", 2, KERNELS[0])]
    ):
        again = digests("whole", tmp_path / f"{number + 1}", tmp_path / cached, threads, kernel)
        assert differing(first, again) == [], (cached, threads, kernel)


@pytest.mark.nightly
@pytest.mark.skipif("TRUESKY_OTHER_PYTHON" not in os.environ, reason="names a Python of another version with truesky")
def test_another_python_makes_the_same(tmp_path):
    other = os.environ["TRUESKY_OTHER_PYTHON"]
    first, again = (
        digests("whole", tmp_path / str(n), tmp_path / f"cache {n}", 1, KERNELS[0], python)
        for n, python in enumerate((sys.executable, other))
    )
    assert differing(first, again) == []
