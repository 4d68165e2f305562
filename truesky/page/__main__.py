"""Show a lake in the browser: python -m truesky.page --lake LAKE, or truesky page LAKE."""

from __future__ import annotations

import argparse
import re
import socket
import webbrowser
from collections.abc import Sequence

from aiohttp import web

from lake_schema import __version__, command
from lake_schema.errors import BadInput
from lake_schema.store import layout
from truesky.explore.process import MEMORY, TIMEOUT
from truesky.page.gate import Gate, new_token
from truesky.page.opened import Lake
from truesky.page.server import Server

_GIGABYTE = 1e9
_HERE, _EVERYWHERE = ("127.0.0.1", "localhost"), ("", "0.0.0.0")
# What an address and a cookie hold as it is.
_TOKEN = re.compile(r"[A-Za-z0-9_.~-]{16,256}")
_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?")


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 stopped, 1 the lake is damaged or the port is taken, 2 the call is wrong."""
    options = _options(argv)
    return command.status("page", lambda: _served(options))


def _served(options: argparse.Namespace) -> int:
    root, names = layout.opened(_lake(options), options.endpoint_url), _names(options)
    if options.token is None and names != _HERE:
        raise BadInput(f"--host {options.host}: others can reach it, so a --token of your own is wanted")
    if options.token is not None and not _TOKEN.fullmatch(options.token):
        raise BadInput("--token: wanted 16 to 256 letters, digits or any of - _ . ~")
    if not 0 <= options.port < 65536:
        raise BadInput(f"--port {options.port}: wanted 0 to 65535")

    def opened() -> Lake:
        return Lake(root, options.name, options.memory * _GIGABYTE, options.timeout)

    # Taken before anything is said of it: port 0 is any that is free.
    listening = socket.create_server((options.host, options.port))
    port = int(listening.getsockname()[1])
    gate = Gate(names, port, options.token or new_token())
    server = Server(opened, gate)
    site = f"http://{names[0]}:{port}"
    address = f"{site}/?token={gate.token}"
    print(f"{root} is shown at {address}\nTAP: {site}/tap/{gate.tap_token}", flush=True)
    if options.open:
        webbrowser.open(address)
    web.run_app(server.application(), sock=listening, print=None, handler_cancellation=True, access_log=None)
    return 0


def _lake(options: argparse.Namespace) -> str:
    if (options.lake is None) == (options.folder is None):
        raise BadInput("wanted the folder of one lake: LAKE, or --lake LAKE")
    return str(options.folder if options.lake is None else options.lake)


def _names(options: argparse.Namespace) -> tuple[str, ...]:
    """By which it may be called, that which is printed first: a name of another's may lead to this machine, too."""
    if wrong := next((name for name in options.called if not _NAME.fullmatch(name)), None):
        raise BadInput(f"--called {wrong[:80]!r} is no name or address of a machine")
    called = tuple(name.lower() for name in options.called)
    if options.host in _EVERYWHERE:
        if not called:
            accepts = f"--host {options.host} accepts connections from other machines"
            raise BadInput(f"{accepts}: give --called NAME, the name or address that they use")
        return (*called, *_HERE)
    return (*called, *_HERE) if options.host in _HERE else (options.host.lower(), *called)


def _options(argv: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m truesky.page",
        description="Show a lake in the browser, and serve its tables by TAP, until stopped with Ctrl-C.",
        epilog=f"truesky {__version__}",
    )
    parser.add_argument("folder", nargs="?", metavar="LAKE", help="folder of the lake, or s3://BUCKET/PREFIX")
    parser.add_argument("--lake", help="the same")
    parser.add_argument("--endpoint-url", help="of the object storage (default: $AWS_ENDPOINT_URL, else Amazon S3)")
    parser.add_argument("--name", help="of the request whose tables are meant, where the lake has several")
    parser.add_argument("--port", type=int, default=0, help="port to listen on (default: any that is free)")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on (default 127.0.0.1: this machine alone)"
    )
    parser.add_argument(
        "--called",
        action="append",
        default=[],
        metavar="NAME",
        help="name or address by which others reach this machine (with --host 0.0.0.0; may be given several times)",
    )
    parser.add_argument("--token", help="that the address holds, 16 characters or more (default: a new one)")
    parser.add_argument("--no-open", dest="open", action="store_false", help="do not open a browser")
    limit = MEMORY / _GIGABYTE
    parser.add_argument("--memory", type=float, default=limit, help=f"GB that a query may take (default {limit:g})")
    parser.add_argument("--timeout", type=float, default=TIMEOUT, help=f"s that a query may take (default {TIMEOUT:g})")
    return parser.parse_args(argv)


if __name__ == "__main__":
    command.leave(main)
