"""Start the web page of a lake (the folder with all tables and images): the command `truesky page LAKE`.

The address of the page is printed and opened in the browser.
"""

from __future__ import annotations

import argparse
import re
import webbrowser
from collections.abc import Sequence

from aiohttp import web

from lake_schema import command
from lake_schema.errors import BadInput
from lake_schema.store import layout
from truesky.command_line import commands
from truesky.page.access_control import AccessRules, new_token, open_socket
from truesky.page.lake_session import LakeSession
from truesky.page.server import Server

_GIGABYTE = 1e9
_LOCAL_NAMES, _ALL_INTERFACES = ("127.0.0.1", "localhost"), ("", "0.0.0.0")  # noqa: S104  (refused without --token and --called)
# A token that a user may choose: 16 to 256 characters that need no escaping in addresses and cookies.
_TOKEN = re.compile(r"[A-Za-z0-9_.~-]{16,256}")
_NAME = re.compile(r"[A-Za-z0-9]([A-Za-z0-9.-]{0,251}[A-Za-z0-9])?")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the server of the page until it is stopped, and return the exit status.

    `argv` contains the command-line arguments without the name of the program; None means those of this process. The
    status is 0 after a stop with Ctrl-C, 1 if the lake is damaged or the port is in use, and 2 if an option is wrong.
    """
    return commands.run("page", run_command, argv)


def run_command(options: argparse.Namespace) -> int:
    """Serve the page with the parsed arguments of `truesky page` until it is stopped, and return 0.

    BadInput is raised for wrong arguments, and OSError if the port is in use.
    """
    root, host_names = layout.open_lake(options.lake, options.endpoint_url), _host_names(options)
    if options.token is None and host_names != _LOCAL_NAMES:
        raise BadInput(f"--host {options.host}: other machines can reach the server, so --token is required")
    if options.token is not None and not _TOKEN.fullmatch(options.token):
        raise BadInput("--token must have 16 to 256 characters: letters, digits or any of - _ . ~")
    if not 0 <= options.port < 65536:
        raise BadInput(f"--port {options.port} is outside [0, 65535]")

    def open_lake() -> LakeSession:
        return LakeSession(root, options.name, options.memory * _GIGABYTE, options.timeout)

    # Open the socket before the address is printed: the port is known only then, because port 0 selects a free port.
    server_socket = open_socket(options.host, options.port)
    port = int(server_socket.getsockname()[1])
    access = AccessRules(host_names, port, options.token or new_token())
    server = Server(open_lake, access)
    origin = f"http://{host_names[0]}:{port}"
    address = f"{origin}/?token={access.token}"
    print(f"{root} is shown at {address}\nTAP: {origin}/tap/{access.tap_token}", flush=True)
    if options.open:
        webbrowser.open(address)
    web.run_app(server.application(), sock=server_socket, print=None, handler_cancellation=True, access_log=None)
    return 0


def _host_names(options: argparse.Namespace) -> tuple[str, ...]:
    """Return the host names under which the server answers; the first name is part of the printed address.

    HTTP requests with other names are refused, because another site can let its name resolve to this machine (DNS
    rebinding). BadInput is raised if a name of --called is not a host name, or if --host is 0.0.0.0 or "" (all
    addresses of this machine) and --called is missing.
    """
    if invalid_name := next((name for name in options.called if not _NAME.fullmatch(name)), None):
        raise BadInput(f"--called {invalid_name[:80]!r} is not a host name or address")
    other_names = tuple(name.lower() for name in options.called)
    if options.host in _ALL_INTERFACES:
        if not other_names:
            problem = f"--host {options.host} accepts connections from other machines"
            raise BadInput(f"{problem}: give --called NAME, the name or address that they use")
        return (*other_names, *_LOCAL_NAMES)
    return (*other_names, *_LOCAL_NAMES) if options.host in _LOCAL_NAMES else (options.host.lower(), *other_names)


if __name__ == "__main__":
    command.exit_with_status(main)
