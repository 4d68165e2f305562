"""Compile functions in a process with low priority, before the jobs of a run need them, and compute spectra of stars.

Otherwise each worker would compile them itself, at the same time as the others, which takes about a minute. The list of
functions with the types of their arguments is compiled_functions.json; scripts/list_compiled_functions.py makes it. A
function that is not listed is compiled when it is first called.
"""

from __future__ import annotations

import ast
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any

from lake_schema import command
from truesky.numerics import activity, cache, cache_labels
from truesky.request.schema import Request
from truesky.running import supervise

# File with the functions "module:function" of each group, and the types of their arguments.
LIST = Path(__file__).with_name("compiled_functions.json")
CATALOGUES, CCD, INFRARED = "catalogues", "ccd", "infrared"
# Function that computes the spectra of stars, which the fluxes need, in about 12 s and keeps them in the cache.
_STELLAR_LIBRARY = "truesky.fluxes.libraries.templates:stellar_library"
# Channels of the renderer whose detectors are infrared arrays; all others are CCDs.
_INFRARED_CHANNELS = frozenset({"NISP-P", "NISP-S"})
# Priority of the process: the higher the number, the lower the priority.
_NICE = 10


def groups_of_request(request: Request) -> list[str]:
    """Return the groups of functions that the jobs of a request need, in the order in which they need them."""
    if not request.pointings and not request.observations:
        return [CATALOGUES]
    # An observation of Euclid has images of all channels. The drawing of sources, which all channels need, is in the
    # group of the CCDs.
    channels = {pointing.channel for pointing in request.pointings}
    return [CATALOGUES, CCD] + [INFRARED] * bool(request.observations or channels & _INFRARED_CHANNELS)


def missing_functions(groups: Sequence[str]) -> list[str]:
    """Return the functions "module:function" of some groups that should be called ahead, in order.

    These are the listed functions of which the cache has no machine code, and, after those of the catalogues, the
    function that computes the spectra of stars if the cache does not contain them.
    """
    listed, folder = json.loads(LIST.read_text()), cache.machine_code_dir()
    present = {f"{path.parent.name}.{path.name.rsplit('-', 1)[0]}" for path in folder.glob("*/*.nbi")}
    missing = []
    for group in groups:
        missing += [
            name for name in listed.get(group, {}) if name.removeprefix("truesky.").replace(":", ".") not in present
        ]
        if group == CATALOGUES and not cache.has_label(cache_labels.label_spectra()):
            missing.append(_STELLAR_LIBRARY)
    return missing


@contextmanager
def compile_in_background(functions: Sequence[str]) -> Iterator[None]:
    """Compile functions "module:function" in another process inside the `with` block, and end the process after it."""
    if not functions:
        yield
        return
    words = [sys.executable, "-m", "truesky.running.compile_ahead", *functions]
    with subprocess.Popen(
        words, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            yield
        finally:
            process.terminate()


def compile_functions(functions: Sequence[str]) -> None:
    """Compile functions "module:function" for all argument types in the list, unless the cache has them.

    Functions without arguments that are not listed are called.
    """
    listed = {name: types for group in json.loads(LIST.read_text()).values() for name, types in group.items()}
    for name in activity.track(functions, "compiling, function"):
        module, function = name.split(":")
        if name not in listed:
            getattr(import_module(module), function)()
            continue
        compiled: Any = getattr(import_module(module), function).load()
        for arguments in listed[name]:
            compiled.compile(argument_types(arguments))


def argument_types(text: str) -> tuple[Any, ...]:
    """Return numba's types of the arguments of a function, from their form in the list.

    The form is that of `repr`, such as "(Array(float64, 1, 'C', False, aligned=True), int64)".
    """
    from numba import types

    names = {"bool": types.boolean}

    def build(node: ast.expr) -> Any:
        match node:
            case ast.Constant(value):
                return value
            case ast.Name(name):
                return names.get(name) or getattr(types, name)
            case ast.Tuple(elements):
                return tuple(build(element) for element in elements)
            case ast.Call(function, arguments, keywords):
                options = {str(keyword.arg): build(keyword.value) for keyword in keywords}
                return build(function)(*(build(argument) for argument in arguments), **options)
        raise ValueError(f"{text}: not the form of types of numba")

    result: tuple[Any, ...] = build(ast.parse(text, mode="eval").body)
    return result


def main(argv: Sequence[str] | None = None) -> int:
    """Compile the functions in the arguments (by default sys.argv); return the exit status 0."""
    supervise.end_with_parent()
    os.nice(_NICE)
    compile_functions(sys.argv[1:] if argv is None else argv)
    return 0


if __name__ == "__main__":
    command.exit_with_status(main)
