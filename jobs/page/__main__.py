"""Show a lake in the browser: python -m jobs.page LAKE, or truesky page LAKE."""

from __future__ import annotations

import argparse
import socket
import sys
import webbrowser
from collections.abc import Sequence

from aiohttp import web

from jobs.explore.process import MEMORY, TIMEOUT
from jobs.page.gate import Gate, new_token
from jobs.page.opened import Lake
from jobs.page.server import Server
from lake_schema import __version__, command
from lake_schema.errors import BadInput
from lake_schema.store import layout

_GIGABYTE = 1e9
_HERE = ("127.0.0.1", "localhost")
_SHORTEST_TOKEN = 16


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 stopped, 1 the lake is damaged or the port is taken, 2 the call is wrong."""
    options = _options(argv)
    return command.status("page", lambda: _served(options))


def _served(options: argparse.Namespace) -> int:
    root = layout.lake(options.lake)
    here = options.host in _HERE
    if not here and len(options.token or "") < _SHORTEST_TOKEN:
        raise BadInput(
            f"--host {options.host}: others can reach it, so --token of {_SHORTEST_TOKEN} characters is wanted"
        )
    if not 0 <= options.port < 65536:
        raise BadInput(f"--port {options.port}: wanted 0 to 65535")

    def opened() -> Lake:
        return Lake(root, options.name, options.memory * _GIGABYTE, options.timeout)

    # Taken before anything is said of it: port 0 is any that is free.
    listening = socket.create_server((options.host, options.port))
    port = int(listening.getsockname()[1])
    gate = Gate(_HERE if here else (options.host,), port, options.token or new_token())
    server = Server(opened, gate)
    address = f"http://{options.host}:{port}/?token={gate.token}"
    print(f"{root} is shown at {address}\nTAP: http://{options.host}:{port}/tap/{gate.tap_token}", flush=True)
    if options.open:
        webbrowser.open(address)
    web.run_app(server.application(), sock=listening, print=None, handler_cancellation=True, access_log=None)
    return 0


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m jobs.page",
        description="Show a lake in the browser, and serve its tables by TAP, until stopped with Ctrl-C.",
        epilog=f"truesky {__version__}",
    )
    parser.add_argument("lake", help="folder of the lake")
    parser.add_argument("--name", help="of the request whose tables are meant, where the lake has several")
    parser.add_argument("--port", type=int, default=0, help="port to listen on (default: any that is free)")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on (default 127.0.0.1: this machine alone)"
    )
    parser.add_argument("--token", help="that the address holds (default: a new one)")
    parser.add_argument("--no-open", dest="open", action="store_false", help="do not open a browser")
    limit = MEMORY / _GIGABYTE
    parser.add_argument("--memory", type=float, default=limit, help=f"GB that a query may take (default {limit:g})")
    parser.add_argument("--timeout", type=float, default=TIMEOUT, help=f"s that a query may take (default {TIMEOUT:g})")
    return parser.parse_args(argv)


if __name__ == "__main__":
    sys.exit(main())
