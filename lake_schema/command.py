"""How a command ends: bad input in one line and exit status 2, a damaged lake or a disc that refuses in one line and 1.

status    run a command's body and return its exit status
leave     run a command and end the process with its exit status
limit_resource  bound the memory or CPU time of this process
say       a line on stderr
"""

from __future__ import annotations

import atexit
import contextlib
import io
import os
import resource
import sys
from collections.abc import Callable
from typing import NoReturn

from lake_schema.errors import BadInput, LakeError, one_line


def run(name: str, body: Callable[[], int]) -> int:
    """What `body` returns; 2 where it refuses what it was given, 1 where the lake or the machine is at fault.

    name : of the command, as it is to be named in the line
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Not every terminal has the letters of every name.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = body()
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # Who reads has seen enough, and Python would complain again at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except BadInput as error:
        return print_error(name, error, 2)
    except (LakeError, OSError, MemoryError) as error:
        return print_error(name, error, 1)


def exit_with_status(main: Callable[..., int], *arguments: object) -> NoReturn:
    """Run `main(*arguments)` and end the process with what it returns.

    Nobody waits for Arrow's threads: one that still closes a file of ours once Python is being taken down finds no
    interpreter and aborts the process (apache/arrow#34314), after all the work was done. An error that `main`
    raises ends the process as any other.
    """
    try:
        code = main(*arguments)
    except SystemExit as stop:
        # The parser of arguments; a text is one that Python prints itself.
        if not isinstance(stop.code, int):
            raise
        code = stop.code
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def limit_resource(name: str, limit: int) -> None:
    """Limit a resource of this process, where the operating system can.

    macOS has no limit of a process's memory: there a hostile file or query is bounded by the system alone.

    Parameters
    ----------
    name : str
        A name of the module `resource`, such as "RLIMIT_AS".
    limit : int
        Bytes, or seconds of CPU time.
    """
    with contextlib.suppress(OSError, ValueError, AttributeError):
        resource.setrlimit(getattr(resource, name), (limit, limit))


def print_error(name: str, error: object, code: int) -> int:
    """Print one line, never longer than anybody reads, and return the exit status."""
    with contextlib.suppress(BrokenPipeError):
        print(f"{name}: {one_line(error).strip() or type(error).__name__}", file=sys.stderr, flush=True)
    return code
