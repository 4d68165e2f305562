"""Arguments of the commands that draw images without a request: inject, stamps."""

from __future__ import annotations

import re
from collections.abc import Collection

from lake_schema.errors import BadInput, bad_input
from truesky.command_line.parser import Parser

# Positional arguments of the commands, by the name that they have in Python.
_POSITIONS = {"rows": "ROWS", "table": "PLACES"}
# Place in a message where an argument is named: the beginning, or the remedy.
_NAMED = re.compile(r"(^|: give )(\w+)(?=[ :,])")


def name_options(error: BadInput, names: Collection[str]) -> BadInput:
    """Return an error of the Python interface that names the options of a command.

    `names` are the arguments in Python that are options of the command, such as zero_point for --zero-point.
    """

    def name_option(match: re.Match[str]) -> str:
        place, name = match.groups()
        return place + _POSITIONS.get(name, f"--{name.replace('_', '-')}" if name in names else name)

    return bad_input(_NAMED.sub(name_option, message) for message in error.messages)


def add_inject_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky inject`."""
    parser.add_argument("image", metavar="IMAGE", help="FITS file of a calibrated frame")
    parser.add_argument("rows", metavar="ROWS", help="table of galaxies or stars (Parquet, FITS, CSV or HDF5)")
    parser.add_argument("out", metavar="OUT", help="FITS file to write")
    parser.add_argument(
        "--psf", required=True, metavar="FILE", help="file of PSFEx, FITS image of the PSF, or FWHM in arcsec"
    )
    parser.add_argument("--extension", metavar="NAME", help="extension of the image (default: the first with an image)")
    parser.add_argument("--weight", metavar="FILE", help="inverse variances: a file, or an extension of IMAGE")
    parser.add_argument("--flags", metavar="FILE", help="flag bits: a file, or an extension of IMAGE")
    parser.add_argument("--zero-point", type=float, metavar="MAG", help="AB magnitude of one count")
    parser.add_argument("--gain", type=float, metavar="G", help="electrons per count (default: card GAIN)")
    parser.add_argument("--saturation", type=float, metavar="COUNTS", help="saturation level (default: card SATURATE)")
    parser.add_argument("--ellipticity", metavar="NAME", help="convention of e1 and e2, such as shear")
    parser.add_argument("--axes", metavar="NAME", help="axes of e1 and e2 (default: east_north)")
    parser.add_argument("--seed", type=int, default=1, metavar="N", help="seed of the noise (default: 1)")
    parser.add_argument("--no-noise", dest="noise", action="store_false", help="add the light without noise")


def add_stamps_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky stamps`."""
    parser.add_lake()
    parser.add_argument(
        "places", metavar="PLACES",
        help="table (Parquet, FITS, CSV or HDF5) with the columns ra and dec, deg; also size, exposure, seed, date",
    )  # fmt: skip
    parser.add_argument("out", metavar="OUT", help="new folder for the images")
    parser.add_argument("--size", type=float, default=64.0, metavar="ARCSEC", help="side of the images (default: 64)")
    parser.add_argument("--band", default="euclid_vis", metavar="NAME", help="passband (default: euclid_vis)")
    parser.add_argument("--camera", metavar="NAME", help="camera (default: the first one with the band)")
    parser.add_argument("--exposure", type=int, metavar="N", help="planned exposure (default: a nominal one)")
    parser.add_argument("--date", metavar="DATE", help="MJD or ISO date of a nominal exposure")
    parser.add_argument("--accuracy", default="survey", metavar="NAME", help="named accuracy (default: survey)")
    parser.add_argument("--effects", nargs="+", metavar="NAME", help="detector effects (default: noticeable ones)")
    parser.add_argument("--seed", type=int, metavar="N", help="seed of the noise (default: the seed of the lake)")
    parser.add_argument("--no-noise", dest="noise", action="store_false", help="write the expected electrons only")
    parser.add_argument("--processes", type=int, metavar="N", help="number of processes (default: all cores)")
