"""The common instruction set is used in every process, and conflicting settings are reported."""

import os
import platform
import subprocess
import sys
from functools import cache

import numpy as np
import pytest

from lake_schema import instruction_set
from lake_schema.errors import BadInput, TasksFailed
from lake_schema.store import publish, read
from lake_schema.store.provenance import machine
from tests.universe import plain_plan, plain_work

NAMES = ("TRUESKY_CPU", "NPY_", "NUMBA_CPU", "NUMBA_DISABLE", "NUMBA_OPT", "ARROW_USER", "OPENBLAS_CORE")
on_x86 = pytest.mark.skipif(platform.machine() != "x86_64", reason="limits the instructions of x86-64 CPUs")
LIMITED = {"NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR", "ARROW_USER_SIMD_LEVEL": "AVX2"}
KIND = "from lake_schema import instruction_set as i; print(i.kind()); print(i.check())"


def clean_environment(**variables):
    kept = {name: value for name, value in os.environ.items() if not name.startswith(NAMES)}
    return {**kept, **variables}


# Several tests need the same output, and a process takes a second.
@cache
def told(code, **variables):
    """Return the lines that a new process prints, with the given variables of the limit."""
    done = subprocess.run(
        [sys.executable, "-c", code], env=clean_environment(**variables), capture_output=True, text=True, check=False
    )
    return done.stdout.splitlines() or done.stderr.splitlines()[-1:]


def has_level():
    return instruction_set._has_level()


@on_x86
def test_this_process_is_of_the_standard_kind():
    """The tests run with the limit; otherwise they could not compare published bytes."""
    from numpy._core._multiarray_umath import __cpu_features__

    if not instruction_set.is_portable() or not has_level():
        pytest.skip("the tests run with TRUESKY_CPU=native or on a CPU without AVX2")
    assert not any(__cpu_features__[name] for name in ("X86_V4", "AVX512_ICL", "AVX512_SPR"))
    assert machine().startswith("x86-64-v3 ")
    assert instruction_set.check() is None


@on_x86
def test_a_new_process_is_limited_by_the_first_import():
    if not has_level():
        pytest.skip("this CPU has no AVX2")
    kind, difference = told("import truesky.numerics.machine_code; " + KIND)
    assert kind == " ".join(("x86-64-v3", *platform.libc_ver()))
    assert difference == "None"
    assert told("import truesky; " + KIND)[0] == kind


@on_x86
def test_native_uses_and_records_all_instructions():
    if not has_level():
        pytest.skip("this CPU has no AVX2")
    kind, difference = told(KIND, TRUESKY_CPU="native")
    assert "x86-64-v3" not in kind
    assert "numpy(X86_V3" in kind
    assert difference == "None"


@on_x86
@pytest.mark.parametrize(
    ("name", "value", "word"),
    [
        ("NUMBA_CPU_NAME", "nehalem", "nehalem"),
        ("NPY_DISABLE_CPU_FEATURES", "X86_V3 X86_V4", "numpy()"),
        ("ARROW_USER_SIMD_LEVEL", "SSE4_2", "arrow(sse4_2)"),
        ("NPY_ENABLE_CPU_FEATURES", "X86_V2", "numpy()"),
        ("NUMBA_OPT", "0", "NUMBA_OPT=0"),
        ("NUMBA_DISABLE_JIT", "1", "NUMBA_DISABLE_JIT=1"),
        ("NUMBA_DISABLE_INTEL_SVML", "0", "NUMBA_DISABLE_INTEL_SVML=0"),
    ],
)
def test_another_choice_of_the_user_is_respected_and_reported(name, value, word):
    if not has_level():
        pytest.skip("this CPU has no AVX2")
    kind, difference = told(KIND, **{name: value})
    assert word in kind
    assert not kind.startswith("x86-64-v3")
    assert difference == (
        f"last bits may differ between machines: this process computes as {kind} "
        f"({name}='{value}{' AVX512_ICL AVX512_SPR' * name.endswith('DISABLE_CPU_FEATURES')}')"
    )


@pytest.mark.parametrize("above", [("X86_V3", "X86_V4"), ("AVX512_SKX", "X86_V3")])
def test_a_limit_without_effect_is_refused(monkeypatch, above):
    """This happens if numpy was imported first, or if its groups have other names than in this version."""
    monkeypatch.setattr(instruction_set, "_has_level", lambda: True)
    monkeypatch.setattr(instruction_set, "_numpy_in_use", lambda: above)
    monkeypatch.delenv("TRUESKY_CPU", raising=False)
    with pytest.raises(
        BadInput, match=r"numpy uses \S*(X86_V4|AVX512_SKX)\S*, .*import truesky first, or set TRUESKY_CPU=native$"
    ):
        instruction_set.check()
    monkeypatch.setenv("TRUESKY_CPU", "native")
    assert instruction_set.check() is None


def test_arrow_without_the_limit_is_refused(monkeypatch):
    monkeypatch.setattr(instruction_set, "_has_level", lambda: True)
    monkeypatch.setattr(instruction_set, "_numpy_in_use", lambda: ("X86_V3",))
    monkeypatch.setattr(instruction_set, "_arrow_in_use", lambda: "avx512")
    monkeypatch.delenv("TRUESKY_CPU", raising=False)
    with pytest.raises(
        BadInput, match=r"Arrow uses AVX-512, .*pyarrow was imported before truesky; import truesky first"
    ):
        instruction_set.check()


@on_x86
def test_numpy_imported_first_is_refused_on_a_cpu_with_more():
    native = told(KIND, TRUESKY_CPU="native")[0]
    line = told("import numpy; from lake_schema import instruction_set as i; print(i.check())")[-1]
    assert ("numpy was imported before truesky" in line) == ("X86_V4" in native)


@on_x86
@pytest.mark.parametrize("before", ["import numba; numba.njit(lambda x: x)(1)", "import numba"])
def test_numba_that_was_used_first_is_refused(before):
    """If numba was only imported before truesky, or is imported later, it is still limited."""
    if not has_level():
        pytest.skip("this CPU has no AVX2")
    code = f"import os; os.environ.update({LIMITED!r}); {before}\n"
    line = told(code + "import truesky; from lake_schema import instruction_set as i; print(i.check())")[-1]
    if before.endswith("(1)"):
        assert "numba compiles for all instructions of this CPU, because it was used before truesky" in line
    else:
        assert line == "None"
    after = "import truesky, numba; numba.njit(lambda x: x)(1); " + KIND
    assert told(after) == [" ".join(("x86-64-v3", *platform.libc_ver())), "None"]


def test_an_empty_setting_is_the_default():
    assert told(KIND, TRUESKY_CPU="") == told(KIND)


def test_a_worker_without_the_limit_makes_nothing(lake, monkeypatch):
    """Workers of a user's Spark session may have imported numpy before truesky."""
    instruction_set.require_limit.cache_clear()
    monkeypatch.setattr(instruction_set, "_has_level", lambda: True)
    monkeypatch.setattr(instruction_set, "_numpy_in_use", lambda: ("X86_V3", "X86_V4"))
    monkeypatch.delenv("TRUESKY_CPU", raising=False)
    try:
        with pytest.raises(TasksFailed, match="numpy uses X86_V4"):
            publish.make_version(lake, plain_plan(1), plain_work)
    finally:
        instruction_set.require_limit.cache_clear()
    assert read.table_names(lake) == []


def test_an_unknown_setting_is_refused(monkeypatch):
    monkeypatch.setenv("TRUESKY_CPU", "fast")
    with pytest.raises(BadInput, match=r"^TRUESKY_CPU must be portable or native, got 'fast'$"):
        instruction_set.check()


def test_variables_of_other_processes(monkeypatch):
    for name in [name for name in os.environ if name.startswith(NAMES)]:
        monkeypatch.delenv(name)
    monkeypatch.setattr(instruction_set, "_is_x86", lambda: True)
    assert instruction_set.variables() == {
        "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR", "ARROW_USER_SIMD_LEVEL": "AVX2",
    }  # fmt: skip
    monkeypatch.setenv("TRUESKY_CPU", "native")
    assert instruction_set.variables() == {"TRUESKY_CPU": "native"}
    monkeypatch.delenv("TRUESKY_CPU")
    monkeypatch.setattr(instruction_set, "_is_x86", lambda: False)
    assert instruction_set.variables() == {}


def test_a_cpu_of_another_architecture_is_another_kind(monkeypatch):
    """It is neither limited nor refused; the manifest contains its name."""
    monkeypatch.setattr(platform, "machine", lambda: "aarch64")
    monkeypatch.setattr(instruction_set, "numba_target", lambda: ("apple-m1", ""))
    monkeypatch.setattr(instruction_set, "_numpy_in_use", lambda: ("ASIMDHP",))
    monkeypatch.setattr(instruction_set, "_arrow_in_use", lambda: "none")
    instruction_set._has_level.cache_clear()
    try:
        assert instruction_set.kind.__wrapped__().startswith("aarch64 apple-m1 numpy(ASIMDHP) arrow(none) ")
        assert instruction_set.check() is None
    finally:
        instruction_set._has_level.cache_clear()


@on_x86
@pytest.mark.parametrize("setting", ["portable", "native"])
def test_functions_of_numpy_agree_with_slow_references(setting):
    """Results agree within two units in the last place with any instruction set."""
    code = (
        "import lake_schema, math, numpy as np; x = np.linspace(0.01, 30.0, 4001)\n"
        "for f in ('exp', 'log', 'log10', 'sin', 'cos', 'tanh', 'sqrt'):\n"
        "    ours, slow = getattr(np, f)(x), np.array([getattr(math, f)(v) for v in x])\n"
        "    print(f, np.max(np.abs(ours - slow) / np.spacing(np.abs(slow))))"
    )
    for line in told(code, TRUESKY_CPU=setting):
        name, error = line.split()
        assert float(error) <= (0.0 if name == "sqrt" else 2.0), line
    assert np.isfinite(float(error))
