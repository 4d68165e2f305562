"""Run the body of a command-line program: print errors as one line on stderr, and return a defined exit status.

The exit status is 2 for wrong input, and 1 for a damaged file of a lake or an error of the operating system.
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

# Largest number of mistakes of one input that are printed.
_MAX_MISTAKES = 100


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
        The value that `body` returns, 2 if it raises BadInput, and 1 if it raises another LakeError, OSError or
        MemoryError. For these, one line is printed on stderr, or one line for each mistake of a BadInput. 1 is also
        returned, without a message, if the reader of stdout has closed the pipe. Other exceptions are not caught.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):
        # Print characters that the terminal's encoding lacks as escape sequences, instead of raising an error.
        sys.stdout.reconfigure(errors="backslashreplace")
    try:
        code = body()
        sys.stdout.flush()
        return code
    except BrokenPipeError:
        # The reader of the pipe has closed it. Redirect stdout to /dev/null, because Python would otherwise print the
        # same error again when it flushes stdout at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except BadInput as error:
        return _print_mistakes(name, error)
    except (LakeError, OSError, MemoryError) as error:
        return print_error(name, error, 1)


def exit_with_status(main: Callable[..., int], *arguments: object) -> NoReturn:
    """Run `main(*arguments)` and end the process with the exit status that it returns.

    Parameters
    ----------
    main : callable
        Function that returns an exit status, or raises SystemExit with one. Other exceptions are not caught.
    *arguments : object
        Arguments of `main`.

    Raises
    ------
    SystemExit
        If `main` raises SystemExit with a message instead of a number. Python then prints the message.

    Notes
    -----
    Functions registered with atexit are called and the output is flushed. Then the process ends without waiting for
    Arrow's threads: a thread that closes a Python file while the interpreter shuts down would abort the process
    (apache/arrow#34314).
    """
    try:
        code = main(*arguments)
    except SystemExit as stop:
        # argparse raises SystemExit with a number. If the code is a message, raise it again, so that Python prints it.
        if not isinstance(stop.code, int):
            raise
        code = stop.code
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        with contextlib.suppress(OSError, ValueError):
            stream.flush()
    os._exit(code)


def limit_resource(name: str, limit: int) -> None:
    """Limit a resource of this process, such as its memory; do nothing if the operating system cannot limit it.

    Parameters
    ----------
    name : str
        Name of a limit in the module `resource`, such as "RLIMIT_AS" (memory) or "RLIMIT_CPU" (CPU time).
    limit : int
        Limit in bytes, or for CPU time in seconds.

    Notes
    -----
    macOS cannot limit the memory of a process, so a hostile file or query can use all memory of the machine there.
    """
    with contextlib.suppress(OSError, ValueError, AttributeError):
        resource.setrlimit(getattr(resource, name), (limit, limit))


def _print_mistakes(name: str, error: BadInput) -> int:
    for message in error.messages[:_MAX_MISTAKES]:
        print_error(name, message, 2)
    if (count := len(error.messages) - _MAX_MISTAKES) > 0:
        print_error(name, f"and {count} more mistakes", 2)
    return 2


def print_error(name: str, error: object, code: int) -> int:
    """Print one line to stderr and return the exit status.

    Parameters
    ----------
    name : str
        Name of the command.
    error : object
        Exception or message; it is shortened to one line of at most 1000 characters.
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
