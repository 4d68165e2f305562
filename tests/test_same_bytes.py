"""The arrays of the chain do not depend on threads, BLAS or cache."""

import json
import os
import platform
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from lake_schema.store.provenance import machine
from truesky.numerics import cache

ROOT = Path(__file__).parents[1]
# OpenBLAS chooses its kernels by processor; any x86-64 of today runs these two.
KERNELS = ("Nehalem", "Haswell") if platform.machine() in ("x86_64", "AMD64") else ("", "")


on_avx2 = pytest.mark.skipif(
    not machine().startswith("x86-64-v3"), reason="compares with the standard kind of machine, which this is not"
)


def environment(setting):
    """Return the environment variables of this process with another instruction set."""
    chosen = ("TRUESKY_CPU", "NPY_", "NUMBA_CPU", "NUMBA_DISABLE", "ARROW_USER")
    return {**{name: value for name, value in os.environ.items() if not name.startswith(chosen)}, **setting}


def digests(what, folder, cached, threads, kernel, python=sys.executable, setting=()):
    """Return digests from tests/chain.py in a separate process, with the compiled code of this process."""
    folder.mkdir(exist_ok=True)
    variables = {
        "OMP_NUM_THREADS": str(threads),
        "OPENBLAS_NUM_THREADS": str(threads),
        "OPENBLAS_CORETYPE": kernel,
        "TRUESKY_CACHE": str(cached),
        "NUMBA_CACHE_DIR": str(cache.machine_code_dir()),
    }
    command = [python, "-m", "tests.chain", what, str(folder)]
    done = subprocess.run(
        command, env={**environment(dict(setting)), **variables}, cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def differing(one, other):
    return sorted(name for name in one.keys() | other.keys() if one.get(name) != other.get(name))


@pytest.fixture(scope="module")
def standard(tmp_path_factory):
    """Reference digests: cold cache, one thread, standard instruction set."""
    folder = tmp_path_factory.mktemp("standard")
    return digests("quick", folder, folder / "cache", 1, KERNELS[0])


def test_threads_and_kernels_change_no_bit_of_a_table(tmp_path):
    first, other = (
        digests("table", tmp_path / str(threads), tmp_path / f"cache {threads}", threads, kernel)
        for threads, kernel in zip((1, 2), KERNELS, strict=True)
    )
    assert len(first) == 2
    assert differing(first, other) == []


@pytest.mark.nightly
def test_threads_and_kernels_change_no_bit(standard, tmp_path):
    other = digests("quick", tmp_path, tmp_path / "cache", 2, KERNELS[1])
    assert len(standard) > 10
    assert differing(standard, other) == []


@pytest.mark.nightly
def test_the_whole_chain(tmp_path):
    """Compare a lake, two CCDs and all cached arrays: cold and warm, one and two threads, both kernels."""
    first = digests("whole", tmp_path / "0", tmp_path / "cache", 1, KERNELS[0])
    assert len(first) > 150
    assert any(".fits" in name for name in first)
    assert any(name.endswith(".npy") for name in first)
    for number, (cached, threads, kernel) in enumerate(
        [("cache", 2, KERNELS[1]), ("cache 2", 2, KERNELS[1]), ("cache 3", 1, KERNELS[1]), ("cache 4", 2, KERNELS[0])]
    ):
        again = digests("whole", tmp_path / f"{number + 1}", tmp_path / cached, threads, kernel)
        assert differing(first, again) == [], (cached, threads, kernel)


def emulator():
    """The command of an emulator of x86-64 CPUs; the test is skipped without one.

    qemu 7.2 crashes in numpy's AVX2 sorts.
    """
    command = os.environ.get("TRUESKY_QEMU") or shutil.which("qemu-x86_64")
    if command is None:
        pytest.skip("no qemu-x86_64 (Debian 13: apt install qemu-user; another's path in $TRUESKY_QEMU)")
    told = subprocess.run([command, "--version"], capture_output=True, text=True, check=True).stdout
    if int(re.search(r"version (\d+)", told)[1]) < 10:
        pytest.skip(f"{told.splitlines()[0]} is older than 10")
    return command


# In the default run, the test of threads compares two processes of the standard kind, and
# tests/lake_schema/test_instruction_set.py tests what is reported.
@pytest.mark.nightly
@on_avx2
@pytest.mark.parametrize("setting", [{}, {"TRUESKY_CPU": "native"}, {"NPY_DISABLE_CPU_FEATURES": "X86_V3"}])
def test_other_instruction_sets_are_reported(standard, tmp_path, setting):
    """Another instruction set is reported, because results can differ: those of numpy without AVX2 do."""
    command = [sys.executable, "-c", "from lake_schema.store.provenance import machine; print(machine())"]
    kind = subprocess.run(command, env=environment(setting), capture_output=True, text=True, check=True).stdout.strip()
    if kind == machine():
        again = digests("quick", tmp_path, tmp_path / "cache", 1, KERNELS[0], setting=setting)
        assert differing(standard, again) == []
    else:
        assert not kind.startswith("x86-64-v3")
    if "NPY_DISABLE_CPU_FEATURES" in setting:
        assert kind != machine()
        again = digests("table", tmp_path, tmp_path / "cache", 1, KERNELS[0], setting=setting)
        assert standard["galaxy_table"] != again["galaxy_table"]


@pytest.mark.nightly
@on_avx2
@pytest.mark.parametrize("cpu", ["Haswell-v4", "EPYC-v3"])
def test_emulated_cpus_compute_the_same(standard, tmp_path, cpu):
    program = tmp_path / "python"
    program.write_text(f'#!/bin/sh\nexec {emulator()} -cpu {cpu} {sys.executable} "$@" 2>/dev/null\n')
    program.chmod(0o755)
    again = digests("quick", tmp_path, tmp_path / "cache", 1, KERNELS[0], str(program))
    assert differing(standard, again) == []


@pytest.mark.nightly
@pytest.mark.skipif("TRUESKY_OTHER_PYTHON" not in os.environ, reason="names a Python of another version with truesky")
def test_another_python_gives_the_same_bytes(tmp_path):
    other = os.environ["TRUESKY_OTHER_PYTHON"]
    first, again = (
        digests("whole", tmp_path / str(n), tmp_path / f"cache {n}", 1, KERNELS[0], python)
        for n, python in enumerate((sys.executable, other))
    )
    assert differing(first, again) == []
