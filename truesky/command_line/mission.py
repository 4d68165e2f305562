"""Arguments of `truesky mission`, which shows the mission database and writes the folder of a new camera."""

from __future__ import annotations

from pathlib import Path

from truesky.command_line.parser import Parser

_LADDER = "CBE,BLT,DES,REQ,SIM"
_CONFIGURATION = f"a ladder ({_LADDER}), a request file, or LAKE or LAKE@KEY with a table mission"


def add_mission_arguments(parser: Parser) -> None:
    """Declare the subcommands list, diff and camera with their arguments."""
    commands = parser.add_subparsers(dest="action", required=True, metavar="list|diff|camera")
    listing = commands.add_parser("list", help="names, values, units, bounds, status and source")
    listing.add_argument(
        "pattern", nargs="?", default="*", help="pattern of names, such as vis.* or *gain*; without *, a substring"
    )
    listing.add_argument("--of", default=_LADDER, metavar="WHAT", help=f"{_CONFIGURATION} (default: {_LADDER})")
    listing.add_argument("--json", action="store_true", help="print a JSON list")
    difference = commands.add_parser("diff", help="differences between two configurations")
    difference.add_argument("first", help=_CONFIGURATION)
    difference.add_argument("second", nargs="?", default=_LADDER, help=f"second configuration (default: {_LADDER})")
    camera = commands.add_parser("camera", help="write the folder of a ground camera, to be edited")
    camera.add_argument("folder", type=Path, help="folder to create; its name is the camera's name")
    camera.add_argument("--like", required=True, metavar="CAMERA", help="camera whose numbers are copied")
