"""Limit numerical libraries to x86-64-v3 instructions, so that every x86-64 CPU computes the same bytes.

numpy, numba and Arrow use AVX-512 where the CPU has it, and their AVX-512 code rounds some last bits differently.
Importing `lake_schema` therefore limits them to x86-64-v3 (AVX2 and FMA, in all CPUs since about 2015). This must
happen before numpy is imported. The environment variable TRUESKY_CPU=native removes the limit.

The module uses the standard library only when it is imported.
"""

from __future__ import annotations

import os
import platform
import sys
from functools import cache

from lake_schema.errors import BadInput

SETTING = "TRUESKY_CPU"
PORTABLE, NATIVE = "portable", "native"
LEVEL = "x86-64-v3"
# numpy's dispatch groups above x86-64-v3, by their names since numpy 2.4.
_NUMPY_ABOVE = ("X86_V4", "AVX512_ICL", "AVX512_SPR")
_NUMPY_DISABLE, _NUMPY_ENABLE = "NPY_DISABLE_CPU_FEATURES", "NPY_ENABLE_CPU_FEATURES"
_ARROW, _ARROW_LEVEL = "ARROW_USER_SIMD_LEVEL", "AVX2"
_NUMBA_CPU, _NUMBA_FEATURES, _NUMBA_SVML = "NUMBA_CPU_NAME", "NUMBA_CPU_FEATURES", "NUMBA_DISABLE_INTEL_SVML"
_DEFAULTS = {
    _NUMPY_DISABLE: " ".join(_NUMPY_ABOVE),
    _ARROW: _ARROW_LEVEL,
    _NUMBA_CPU: LEVEL,
    _NUMBA_FEATURES: "",
    _NUMBA_SVML: "1",
}
# LLVM's names of the features that x86-64-v3 adds to v2. https://gitlab.com/x86-psABIs/x86-64-ABI, table 3.1
_LEVEL_FEATURES = ("avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe")


def is_portable() -> bool:
    """Return True unless the user asked for all instructions of this CPU."""
    return os.environ.get(SETTING, PORTABLE) != NATIVE


def limit() -> None:
    """Set the environment variables of numpy and Arrow; call this before they are imported."""
    os.environ.update(variables())


def variables() -> dict[str, str]:
    """Environment variables that limit numpy and Arrow in a Python process that starts with them.

    A CPU of another architecture, or an older one, ignores them, so a driver can send them to any worker.
    """
    setting = {SETTING: os.environ[SETTING]} if SETTING in os.environ else {}
    if not is_portable() or not _is_x86():
        return setting
    setting[_ARROW] = os.environ.get(_ARROW, _ARROW_LEVEL)
    # numpy refuses to start with both of its variables; `check` reports the conflict.
    if _NUMPY_ENABLE not in os.environ:
        chosen = os.environ.get(_NUMPY_DISABLE, "").replace(",", " ").split()
        setting[_NUMPY_DISABLE] = " ".join(dict.fromkeys((*chosen, *_NUMPY_ABOVE)))
    return setting


def limit_numba() -> None:
    """Set the environment variables of numba; call this before numba is imported.

    Unlike `variables`, these must fit the CPU: code for x86-64-v3 does not run on an older one.
    """
    if not is_portable() or not _has_level():
        return
    for name in (_NUMBA_CPU, _NUMBA_FEATURES, _NUMBA_SVML):
        os.environ.setdefault(name, _DEFAULTS[name])
    if "numba" in sys.modules:
        # Too late for functions that are compiled already; `check` reports that.
        sys.modules["numba"].config.reload_config()


@cache
def kind() -> str:
    """Describe what determines the last bits of this process's results.

    Two machines of the same kind compute the same bytes. The standard kind is "x86-64-v3" with the C library's
    version; every other kind lists the architecture, numba's target and the instruction sets that numpy and Arrow use.

    Returns
    -------
    str
        For example "x86-64-v3 glibc 2.36" or "x86_64 znver5 numpy(X86_V3 X86_V4) arrow(avx512) glibc 2.36".
    """
    system = [word for word in platform.libc_ver() if word] or [platform.system(), platform.release()]
    target, features = numba_target()
    numpy, arrow = _numpy_in_use(), _arrow_in_use()
    if (target, features, numpy, arrow) == (LEVEL, "", ("X86_V3",), _ARROW_LEVEL.lower()):
        return " ".join((LEVEL, *system))
    words = [platform.machine(), target, features, f"numpy({' '.join(numpy)})", f"arrow({arrow})", *system]
    return " ".join(word for word in words if word)


def numba_target() -> tuple[str, str]:
    """CPU name and features for which numba compiles in this process."""
    limit_numba()
    if "numba" in sys.modules:
        from numba.core.registry import cpu_target

        _, name, features = cpu_target.target_context.codegen().magic_tuple()
        if str(features) == os.environ.get(_NUMBA_FEATURES, ""):
            return str(name), str(features)
        # The names of all features of this CPU take hundreds of characters.
        return str(name), "" if _NUMBA_FEATURES not in os.environ else "with features of this CPU"
    import llvmlite.binding

    return os.environ.get(_NUMBA_CPU) or llvmlite.binding.get_host_cpu_name(), os.environ.get(_NUMBA_FEATURES, "")


def check() -> str | None:
    """Check that the setting is valid and in effect.

    Returns
    -------
    str or None
        A line about what differs from the standard kind, if the user's environment variables cause a difference.

    Raises
    ------
    BadInput
        If TRUESKY_CPU has an unknown value, or if numpy or Arrow uses instructions above x86-64-v3 nevertheless.
    """
    setting = os.environ.get(SETTING, PORTABLE)
    if setting not in (PORTABLE, NATIVE):
        raise BadInput(f"{SETTING} must be {PORTABLE} or {NATIVE}, got {setting!r}")
    if setting == NATIVE or not _has_level():
        return None
    above = [name for name in _numpy_in_use() if name in _NUMPY_ABOVE or name.startswith("AVX512")]
    if above:
        why = (
            f"{_NUMPY_ENABLE} is set"
            if _NUMPY_ENABLE in os.environ
            else "numpy was imported before truesky, or this version of numpy ignores the limit"
        )
        raise BadInput(
            f"numpy uses {' '.join(above)}, so the results would differ between machines: {why}; "
            f"import truesky first and unset {_NUMPY_ENABLE}, or set {SETTING}={NATIVE}"
        )
    if _arrow_in_use() == "avx512":
        raise BadInput(
            f"Arrow uses AVX-512, so the results could differ between machines: import truesky before "
            f"pyarrow and set {_ARROW} to {_ARROW_LEVEL} or unset it, or set {SETTING}={NATIVE}"
        )
    if kind().startswith(LEVEL):
        return None
    names = (_NUMPY_DISABLE, _NUMPY_ENABLE, _ARROW, _NUMBA_CPU, _NUMBA_FEATURES)
    changed = {name: os.environ[name] for name in names if os.environ.get(name) not in (None, _DEFAULTS.get(name))}
    given = ", ".join(f"{name}={value!r}" for name, value in changed.items()) or "numba was imported before truesky"
    return f"last bits may differ between machines: this process computes as {kind()} ({given})"


def _is_x86() -> bool:
    return platform.machine().lower() in ("x86_64", "amd64")


@cache
def _has_level() -> bool:
    """Return True if this CPU executes x86-64-v3."""
    if not _is_x86():
        return False
    import llvmlite.binding

    features = llvmlite.binding.get_host_cpu_features()
    return all(features.get(name, False) for name in _LEVEL_FEATURES)


@cache
def _numpy_in_use() -> tuple[str, ...]:
    """Dispatch groups above the baseline that numpy's functions use in this process, sorted."""
    from numpy.lib import introspect

    targets = {kind["current"] for kinds in introspect.opt_func_info().values() for kind in kinds.values()}
    # A target can name several groups; the baseline is written as baseline(...).
    return tuple(sorted({word for target in targets if not target.startswith("baseline") for word in target.split()}))


@cache
def _arrow_in_use() -> str:
    import pyarrow

    return str(pyarrow.runtime_info().simd_level)
