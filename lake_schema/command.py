"""Run commands with a defined end: one line per error on stderr and a defined exit status.

The exit status is 2 for wrong input and 1 for a damaged lake or an error of the operating system.
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
    """Run the body of a command and return its exit status.

    Parameters
    ----------
    name : str
        Name of the command, for the error message.
    body : callable
        Function without arguments that returns an exit status.

    Returns
    -------
    int
        The value that `body` returns, 2 if it raises BadInput, 1 if the lake is damaged or the operating system fails.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Some terminals cannot show all characters of a name.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = body()
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # The reader has closed the pipe; without this, Python would report the error again at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except BadInput as error:
        return print_error(name, error, 2)
    except (LakeError, OSError, MemoryError) as error:
        return print_error(name, error, 1)


def exit_with_status(main: Callable[..., int], *arguments: object) -> NoReturn:
    """Run `main(*arguments)` and end the process with the exit status that it returns.

    Parameters
    ----------
    main : callable
        Function that returns an exit status. If it raises an error, the process ends with that error as usual.
    *arguments : object
        Arguments of `main`.

    Raises
    ------
    SystemExit
        If `main` raises one with a text, which Python prints.

    Notes
    -----
    The process ends without waiting for Arrow's threads. A thread that closes a Python file while the interpreter shuts
    down aborts the process (apache/arrow#34314), although all work is done.
    """
    try:
        code = main(*arguments)
    except SystemExit as stop:
        # argparse exits with a number; Python itself prints a text.
        if not isinstance(stop.code, int):
            raise
        code = stop.code
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def limit_resource(name: str, limit: int) -> None:
    """Limit a resource of this process, if the operating system can.

    Parameters
    ----------
    name : str
        Name of a limit in the module `resource`, such as "RLIMIT_AS".
    limit : int
        Limit in bytes, or in seconds of CPU time.

    Notes
    -----
    macOS cannot limit the memory of a process, so only the system bounds a hostile file or query there.
    """
    with contextlib.suppress(OSError, ValueError, AttributeError):
        resource.setrlimit(getattr(resource, name), (limit, limit))


def print_error(name: str, error: object, code: int) -> int:
    """Print one line to stderr and return the exit status.

    Parameters
    ----------
    name : str
        Name of the command.
    error : object
        Error or text; it is shortened to one line.
    code : int
        Exit status.

    Returns
    -------
    int
        The exit status `code`.
    """
    with contextlib.suppress(BrokenPipeError):
        print(f"{name}: {one_line(error).strip() or type(error).__name__}", file=sys.stderr, flush=True)
    return code
