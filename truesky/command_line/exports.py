"""Arguments of the command that writes catalogues, maps and calibrations in the formats of other programs."""

from __future__ import annotations

from pathlib import Path

from truesky.command_line.parser import Parser

# Forms in which each kind of source can be written; the first one is the default.
FORMS = {
    "galaxies": ("fits", "skycatalogs", "euclid"),
    "stars": ("fits", "euclid"),
    "gaia": ("table", "ldac"),
    "depth": ("healsparse", "euclid"),
    "grisms": ("grismconf",),
}
RELEASES = ("dr2", "dr3")


def add_export_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky export`."""
    parser.add_choice("what", FORMS, f"what is written: {', '.join(FORMS)}")
    parser.add_lake("folder of the lake; grisms also work without one", is_optional=True)
    parser.add_argument("--form", metavar="FORM", help="format; default: the first one of those below")
    parser.add_argument("--out", type=Path, required=True, metavar="PATH", help="folder to write to; gaia: a file")
    parser.add_argument("--name", help="request whose tables are written, if the lake has several")
    of_gaia = parser.add_argument_group("options of gaia")
    of_gaia.add_argument("--release", choices=RELEASES, help="release with the column names of a table (default: dr2)")
    of_gaia.add_argument("--epoch", type=float, metavar="YEAR", help="move positions to this year")
    of_depth = parser.add_argument_group("options of depth")
    of_depth.add_argument("--bands", nargs="+", default=[], metavar="BAND", help="passbands (default: all)")
    of_depth.add_argument("--columns", nargs="+", default=[], metavar="NAME", help="columns (default: all maps)")
    of_grisms = parser.add_argument_group("options of grisms")
    of_grisms.add_argument("--exposure", type=int, metavar="N", help="number of a rendered exposure of the lake")
    of_grisms.add_argument("--detectors", nargs="+", default=[], metavar="NAME", help="detectors (default: all)")
    parser.add_argument_group(
        "forms", "; ".join(f"{what}: {', '.join(forms)}" for what, forms in FORMS.items()) + ". See docs/exports.md."
    )
