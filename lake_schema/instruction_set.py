"""Limit numerical libraries to x86-64-v3 instructions, so that every x86-64 CPU computes the same bytes.

numpy, numba, Arrow and OpenBLAS use AVX-512 instructions if the CPU has them, and the results then differ in the last
bits. Importing `lake_schema` therefore limits them to the instruction set x86-64-v3 (AVX2 and FMA, in nearly all
desktop and server CPUs since 2015). The limits are environment variables, which have no effect after numpy is imported.
The environment variable TRUESKY_CPU=native removes the limit.

Importing this module imports the standard library only, because numpy must not be imported before the limit is set.
"""

from __future__ import annotations

import hashlib
import os
import platform
import sys
from functools import cache
from pathlib import Path

from lake_schema.errors import BadInput

SETTING = "TRUESKY_CPU"
PORTABLE, NATIVE = "portable", "native"
LEVEL = "x86-64-v3"
# numpy's names, since version 2.4, of the groups of instructions that x86-64-v3 does not contain.
_NUMPY_GROUPS_ABOVE = ("X86_V4", "AVX512_ICL", "AVX512_SPR")
_NUMPY_DISABLE, _NUMPY_ENABLE = "NPY_DISABLE_CPU_FEATURES", "NPY_ENABLE_CPU_FEATURES"
_ARROW, _ARROW_LEVEL = "ARROW_USER_SIMD_LEVEL", "AVX2"
_NUMBA_CPU, _NUMBA_FEATURES, _NUMBA_SVML = "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "NUMBA_DISABLE_INTEL_SVML"
_BLAS, _BLAS_CORE = "OPENBLAS_CORETYPE", "Haswell"
_DEFAULTS = {
    _NUMPY_DISABLE: " ".join(_NUMPY_GROUPS_ABOVE),
    _ARROW: _ARROW_LEVEL,
    _NUMBA_CPU: LEVEL,
    _NUMBA_FEATURES: "",
    _NUMBA_SVML: "1",
    _BLAS: _BLAS_CORE,
}
# Environment variables that are set only if the CPU executes x86-64-v3: they make numba and OpenBLAS compile or select
# code that does not run on an older CPU.
_FOR_THIS_CPU = (_NUMBA_CPU, _NUMBA_FEATURES, _NUMBA_SVML, _BLAS)
# Environment variables of numba that change the order of sums or the functions that compiled code calls.
_OTHER_NUMBA_VARIABLES = (
    "NUMBA_DISABLE_JIT", "NUMBA_ENABLE_AVX", "NUMBA_LOOP_VECTORIZE", "NUMBA_OPT", "NUMBA_SLP_VECTORIZE",
)  # fmt: skip
# CPU features that x86-64-v3 has and x86-64-v2 lacks, by their names in LLVM (https://gitlab.com/x86-psABIs/x86-64-ABI,
# table 3.1).
_LEVEL_FEATURES = ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")
# File in which Linux lists the features of the CPU, and its names of the features that x86-64-v3 adds to x86-64-v2.
_CPUINFO, _LEVEL_FLAGS = Path("/proc/cpuinfo"), {"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"}


def is_portable() -> bool:
    """Return True if libraries are limited to x86-64-v3, False if the user has set TRUESKY_CPU=native."""
    return _read_setting() != NATIVE


def limit() -> None:
    """Set the environment variables that limit numpy, Arrow, numba and OpenBLAS to x86-64-v3 instructions.

    Call this function before these libraries are imported. The variables of numba and OpenBLAS are set only if Linux
    reports that the CPU has these instructions, else `limit_numba` sets them later.
    """
    os.environ.update(variables())
    if is_portable() and _linux_lists_level():
        _limit_for_this_cpu()


def _read_setting() -> str:
    return os.environ.get(SETTING) or PORTABLE


def _limit_for_this_cpu() -> None:
    for name in _FOR_THIS_CPU:
        os.environ.setdefault(name, _DEFAULTS[name])


def variables() -> dict[str, str]:
    """Return environment variables that limit numpy and Arrow to x86-64-v3 in a Python process that starts with them.

    They have no effect on a CPU that is older or of another architecture, so Spark can send them to all its workers.
    The result also contains TRUESKY_CPU if it is set. Without a limit, it contains nothing else.
    """
    setting = {SETTING: os.environ[SETTING]} if SETTING in os.environ else {}
    if not is_portable() or not _is_x86():
        return setting
    setting[_ARROW] = os.environ.get(_ARROW, _ARROW_LEVEL)
    # numpy cannot be imported if both of its variables are set. If the user has set the other one, set none here;
    # `check` reports it if numpy then uses too many instructions.
    if _NUMPY_ENABLE not in os.environ:
        chosen = os.environ.get(_NUMPY_DISABLE, "").replace(",", " ").split()
        setting[_NUMPY_DISABLE] = " ".join(dict.fromkeys((*chosen, *_NUMPY_GROUPS_ABOVE)))
    return setting


def limit_numba() -> None:
    """Set the environment variables that limit numba and OpenBLAS to x86-64-v3, if this CPU has these instructions.

    Call this function before numba is imported. On Linux, `limit` has set the variables already. On other systems, it
    has not, because the features of the CPU must be read with llvmlite, whose import is slow.
    """
    if not is_portable() or not _has_level():
        return
    _limit_for_this_cpu()
    if "numba" in sys.modules:
        # numba has been imported before, so it must read the variables again. Functions that it has compiled stay as
        # they are; `check` reports them.
        sys.modules["numba"].config.reload_config()


@cache
def kind() -> str:
    """Return a text with the instruction sets and the C library that determine the last bits of results.

    Processes with equal texts compute the same bytes. With the limit to x86-64-v3, the text is "x86-64-v3" and the
    version of the C library. Otherwise it lists the architecture, the CPU for which numba compiles, and the instruction
    sets that numpy and Arrow use.

    Returns
    -------
    str
        For example "x86-64-v3 glibc 2.36" or "x86_64 znver5 numpy(X86_V3 X86_V4) arrow(avx512) glibc 2.36".
    """
    system = [word for word in platform.libc_ver() if word] or [platform.system(), platform.release()]
    target, features = numba_target()
    numpy, arrow, numba_settings = _numpy_in_use(), _arrow_in_use(), _other_numba_settings()
    if (target, features, numpy, arrow, numba_settings) == (LEVEL, "", ("X86_V3",), _ARROW_LEVEL.lower(), ()):
        return " ".join((LEVEL, *system))
    words = [
        platform.machine(),
        target,
        features,
        *numba_settings,
        f"numpy({' '.join(numpy)})",
        f"arrow({arrow})",
        *system,
    ]
    return " ".join(word for word in words if word)


def numba_target() -> tuple[str, str]:
    """Return the name and the features of the CPU for which numba compiles in this process.

    Returns
    -------
    name : str
        Name of the CPU in LLVM, such as "x86-64-v3" or "znver5".
    features : str
        "" if the features follow from the name, else the value of $NUMBA_CPU_FEATURES. If numba was imported before the
        limit was set, "features:" and a hash of the features of this CPU.
    """
    limit_numba()
    if "numba" in sys.modules:
        from numba.core.registry import cpu_target

        _, name, host_features = (str(word) for word in cpu_target.target_context.codegen().magic_tuple())
        chosen = os.environ.get(_NUMBA_FEATURES)
        if host_features == chosen or (chosen is None and name != LEVEL):
            return name, chosen or ""
        return name, f"features:{hashlib.sha256(host_features.encode()).hexdigest()[:8]}"
    return os.environ.get(_NUMBA_CPU) or _host_cpu(), os.environ.get(_NUMBA_FEATURES, "")


def _host_cpu() -> str:
    import llvmlite.binding

    return str(llvmlite.binding.get_host_cpu_name())


def _other_numba_settings() -> tuple[str, ...]:
    """Return "NAME=value" for each environment variable of numba that is set and may change results.

    NUMBA_DISABLE_INTEL_SVML is left out if it has the value that truesky sets. The variables with the name and the
    features of the CPU are not included.
    """
    settings = [f"{name}={os.environ[name]}" for name in _OTHER_NUMBA_VARIABLES if name in os.environ]
    if os.environ.get(_NUMBA_SVML, _DEFAULTS[_NUMBA_SVML]) != _DEFAULTS[_NUMBA_SVML]:
        settings.append(f"{_NUMBA_SVML}={os.environ[_NUMBA_SVML]}")
    return tuple(settings)


def check() -> str | None:
    """Check that TRUESKY_CPU has a valid value, and that the limit to x86-64-v3 instructions is in effect.

    Returns
    -------
    str or None
        None if results are the same as on other machines with the limit, if there is no limit, or if this CPU does not
        have all x86-64-v3 instructions. Else a warning in one line: the user's environment variables change the last
        bits of results.

    Raises
    ------
    BadInput
        If TRUESKY_CPU is neither "portable" nor "native", or if numpy, numba or Arrow uses instructions above x86-64-v3
        although they are limited, for example because numpy was imported before truesky.
    """
    if _read_setting() not in (PORTABLE, NATIVE):
        raise BadInput(f"{SETTING} must be {PORTABLE} or {NATIVE}, got {_read_setting()!r}")
    if not is_portable() or not _has_level():
        return None
    remedy = f"import truesky first, or set {SETTING}={NATIVE}"
    above = [name for name in _numpy_in_use() if name in _NUMPY_GROUPS_ABOVE or name.startswith("AVX512")]
    if above:
        why = "numpy was imported before truesky, or this version of numpy ignores the limit"
        if _NUMPY_ENABLE in os.environ:
            why, remedy = f"{_NUMPY_ENABLE} is set", f"unset it, or set {SETTING}={NATIVE}"
        raise BadInput(f"numpy uses {' '.join(above)}, so results would differ between machines: {why}; {remedy}")
    if _arrow_in_use() == "avx512":
        why = "pyarrow was imported before truesky"
        if os.environ.get(_ARROW, _ARROW_LEVEL) != _ARROW_LEVEL:
            why, remedy = f"{_ARROW} is {os.environ[_ARROW]!r}", f"unset it, or set {SETTING}={NATIVE}"
        raise BadInput(f"Arrow uses AVX-512, so results could differ between machines: {why}; {remedy}")
    if numba_target()[1].startswith("features:") and not os.environ.get(_NUMBA_FEATURES):
        why = "numba compiles for all instructions of this CPU, because it was used before truesky was imported"
        raise BadInput(f"{why}, so results would differ between machines; {remedy}")
    if kind().startswith(LEVEL):
        return None
    names = (_NUMPY_DISABLE, _NUMPY_ENABLE, _ARROW, _NUMBA_CPU, _NUMBA_FEATURES, _NUMBA_SVML, *_OTHER_NUMBA_VARIABLES)
    changed = {name: os.environ[name] for name in names if os.environ.get(name) not in (None, _DEFAULTS.get(name))}
    changes = ", ".join(f"{name}={value!r}" for name, value in changed.items())
    line = f"last bits may differ between machines: this process computes as {kind()}"
    return f"{line} ({changes})" if changes else line


@cache
def require_limit() -> None:
    """Raise BadInput if the limit to x86-64-v3 instructions is set but not in effect, see `check`.

    After a call without an error, later calls of the process do not check again.
    """
    check()


def _is_x86() -> bool:
    return platform.machine().lower() in ("x86_64", "amd64")


def _linux_lists_level() -> bool:
    """Return True if /proc/cpuinfo lists all features of x86-64-v3 for this CPU; False on other systems than Linux.

    Unlike `_has_level`, the function is fast, because it does not import llvmlite.
    """
    if not _is_x86():
        return False
    try:
        with _CPUINFO.open() as lines:
            flags = next((line for line in lines if line.startswith("flags")), "")
    except OSError:
        return False
    return set(flags.split()) >= _LEVEL_FLAGS


@cache
def _has_level() -> bool:
    """Return True if this CPU executes all x86-64-v3 instructions, according to Linux or llvmlite."""
    if not _is_x86():
        return False
    if _linux_lists_level():
        return True
    import llvmlite.binding

    features = llvmlite.binding.get_host_cpu_features()
    return all(features.get(name, False) for name in _LEVEL_FEATURES)


@cache
def _numpy_in_use() -> tuple[str, ...]:
    """Return numpy's names of the instruction sets that its functions use in this process, sorted.

    The baseline, which all CPUs have, is left out.
    """
    from numpy.lib import introspect

    targets = {kind["current"] for kinds in introspect.opt_func_info().values() for kind in kinds.values()}
    # A text lists one or more names of instruction sets; if it begins with "baseline", it is the baseline.
    return tuple(sorted({word for target in targets if not target.startswith("baseline") for word in target.split()}))


@cache
def _arrow_in_use() -> str:
    import pyarrow

    return str(pyarrow.runtime_info().simd_level)
