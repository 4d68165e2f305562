"""Arguments of the commands that reduce images: masters, reduce and stack."""

from __future__ import annotations

from pathlib import Path

from truesky.command_line.parser import Parser

_NAME = "request whose frames are used, if the lake has several"


def add_masters_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky masters`."""
    parser.add_lake("folder of the lake with rendered calibration frames")
    parser.add_argument("--name", help=_NAME)
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="folder of the masters")
    parser.add_argument(
        "--detectors", nargs="+", default=[], metavar="NAME", help="default: all with calibration frames"
    )


def add_reduce_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky reduce`."""
    parser.add_lake("folder of the lake with rendered frames")
    parser.add_argument("--name", help=_NAME)
    parser.add_argument("--masters", type=Path, metavar="FOLDER", help="masters of `truesky masters` or other masters")
    parser.add_argument("--out", type=Path, required=True, metavar="FOLDER", help="folder of the calibrated images")
    parser.add_argument("--detectors", nargs="+", default=[], metavar="NAME", help="default: all")
    parser.add_argument("--exposures", nargs="+", type=int, default=[], metavar="ID", help="default: all")
    parser.add_argument("--rate", action="store_true", help="write electrons per second instead of electrons")
    parser.add_argument(
        "--without", nargs="+", default=[], metavar="CORRECTION", help="corrections to omit, such as dark"
    )
    parser.add_argument(
        "--cosmic-rays",
        type=float,
        metavar="SIGMA",
        help="flag cosmic rays; default: 4.5 with --level2, else 0 (no)",
    )
    parser.add_argument("--level2", action="store_true", help="write counts, with catalogue, PSF and .head files")
    parser.add_argument("--aperture", type=float, metavar="ARCSEC", help="diameter of MAG_APER (default: 3 FWHM)")
    parser.add_argument("--threshold", type=float, metavar="SIGMA", help="level of sources (default: 1.5)")
    parser.add_argument("--least-pixels", type=int, metavar="N", help="pixels of the smallest source (default: 5)")


def add_train_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky train`."""
    parser.add_lake("folder of the lake with rendered frames")
    parser.add_argument("--name", help=_NAME)
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="file of the model, .parquet")
    parser.add_argument("--band", metavar="NAME", help="passband, if the lake has images in several")
    parser.add_argument("--masters", type=Path, metavar="FOLDER", help="masters (default: ideal calibration)")
    parser.add_argument("--detectors", nargs="+", default=[], metavar="NAME", help="default: all")
    parser.add_argument("--exposures", nargs="+", type=int, default=[], metavar="ID", help="default: all")
    parser.add_argument("--aperture", type=float, metavar="FWHM", help="diameter of MAG_APER (default: 3 FWHM)")
    parser.add_argument("--threshold", type=float, metavar="SIGMA", help="level of sources (default: 1.5)")
    parser.add_argument("--least-pixels", type=int, metavar="N", help="pixels of the smallest source (default: 5)")
    parser.add_argument(
        "--cosmic-rays", type=float, metavar="SIGMA", help="level of replaced cosmic rays (default: 5; 0: none)"
    )


def add_stack_arguments(parser: Parser) -> None:
    """Declare the arguments of `truesky stack`."""
    parser.add_argument("images", nargs="+", type=Path, metavar="FILE", help="images of `truesky reduce`")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="FITS file of the stack")
    parser.add_argument(
        "--scale", type=float, metavar="ARCSEC", help="pixel scale (default: pixel scale of the detectors)"
    )
    parser.add_argument("--lake", metavar="LAKE", help="folder of the lake with the raw images, to add the PSF")
    parser.add_argument("--name", help=_NAME)
