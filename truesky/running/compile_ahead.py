"""Compile functions in a process with low priority, before the jobs of a run need them.

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
from truesky.numerics import activity, cache
from truesky.request.schema import Request
from truesky.running import supervise

# File with the functions "module:function" of each group, and the types of their arguments.
LIST = Path(__file__).with_name("compiled_functions.json")
CATALOGUES, CCD, INFRARED = "catalogues", "ccd", "infrared"
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
    """Return the listed functions "module:function" of some groups of which the cache has no machine code."""
    listed, folder = json.loads(LIST.read_text()), cache.machine_code_dir()
    present = {f"{path.parent.name}.{path.name.rsplit('-', 1)[0]}" for path in folder.glob("*/*.nbi")}
    return [
        name
        for group in groups
        for name in listed.get(group, {})
        if name.removeprefix("truesky.").replace(":", ".") not in present
    ]


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
    """Compile listed functions "module:function" for all argument types in the list, unless the cache has them."""
    listed = {name: types for group in json.loads(LIST.read_text()).values() for name, types in group.items()}
    for name in activity.track(functions, "compiling, function"):
        module, function = name.split(":")
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
