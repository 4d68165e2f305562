"""Arguments of the command that adds sources to a frame: inject."""

from __future__ import annotations

from truesky.command_line.parser import Parser


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
