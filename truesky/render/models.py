"""Draw single sources of a published image of spectra, for example to test deblending.

    python -m truesky.render.models LAKE [--name REQUEST] --exposure N --detector NAME --sources ID ..
                                 [--orders] --out FILE.fits

Each source is drawn separately and exactly as in the image, without noise. The FITS file has one extension per source,
or one per spectral order of each source with --orders; card SRC_ID is the identifier of the source. Extensions are cut
to the pixels with light; cards X0 and Y0 are the column and row of the first pixel on the detector, counted from 0.

The sum of all sources equals the truth map `noise_free` (expected signal of all sources) to the rounding of float32,
1e-7. The float64 frames that the function `models` returns add up exactly to the float64 noise-free frame.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from lake_schema import command, user_files
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.fits.images import Image, write_images
from lake_schema.store import layout, read
from lake_schema.store.object_storage.s3 import Folder
from truesky.command_line.parser import Parser
from truesky.render import detector_inputs
from truesky.render.exposure import single_source_spectra
from truesky.render.exposure.single_source_spectra import SourceSpectrum


def models(
    root: Folder, version: read.Version, exposure: int, detector: str, ids: Sequence[int] | None = None
) -> Iterator[SourceSpectrum]:
    """Draw the noise-free light of single sources in a stored image of spectra.

    Parameters
    ----------
    root : Folder
        Lake (folder of stored tables and images).
    version : Version
        Version of the table `products` that has the image.
    exposure : int
        Number of the exposure.
    detector : str
        Name of the detector.
    ids : sequence of int, optional
        Identifiers of the sources. None means all sources that may have light in the image.

    Returns
    -------
    iterator of SourceSpectrum
        One source after another with its light on the detector in electrons.

    Raises
    ------
    BadInput
        If there is no such image, if it is not an image through a grism, or if a source cannot have light in it. The
        error is raised at the call, before the first source is drawn.
    """
    image_facts = {"exposure_id": exposure, "detector": detector}
    parts = [part["facts"] for part in version.manifest["parts"] if image_facts.items() <= part["facts"].items()]
    if not parts:
        raise BadInput(f"table products has no detector {detector} of exposure {exposure}")
    facts = {**version.manifest["facts"], **parts[0]}
    aim, rows, variant = detector_inputs.load_inputs(root, facts)
    return single_source_spectra.draw_sources(aim, rows, variant, facts["request"]["seed"], ids)


def frame(image: Image, shape: tuple[int, int]) -> Float:
    """Return an extension of the FITS file, which is cut to the light of a source, in the full size of the detector.

    The result is a float64 array of shape (ny, nx) = `shape` in electrons, with 0 outside the extension. The image must
    have the cards X0 and Y0.
    """
    out, cards = np.zeros(shape), {key: value for key, value, _ in image.cards}
    if image.data is not None:
        (height, width), first_column, first_row = image.data.shape, int(cards["X0"]), int(cards["Y0"])
        out[first_row : first_row + height, first_column : first_column + width] = image.data
    return out


def _extension(number: int, order: int | None, light: Float) -> Image:
    """Return the FITS extension of a source: its light, shape (ny, nx), cut to the rectangle of pixels that are not 0.

    `number` is the identifier of the source and `order` the spectral order, None for all orders. A source without light
    has one pixel.
    """
    rows, columns = (np.flatnonzero((light != 0.0).any(axis=axis)) for axis in (1, 0))
    first_row, end_row = (rows[0], rows[-1] + 1) if len(rows) else (0, 1)
    first_column, end_column = (columns[0], columns[-1] + 1) if len(columns) else (0, 1)
    cards = (
        ("SRC_ID", number, "source identifier"),
        *((("ORDER", order, "spectral order"),) if order is not None else ()),
        ("X0", int(first_column), "column of the first pixel, 0-based"),
        ("Y0", int(first_row), "row of the first pixel, 0-based"),
        ("BUNIT", "electron", "pixel unit; expected signal of the source"),
    )
    name = f"{number}" if order is None else f"{number}.{order}"
    return Image(light[first_row:end_row, first_column:end_column].astype(np.float32), cards, name)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command: write the noise-free light of sources to a FITS file, and print the electrons of each.

    Return the exit status.
    """
    parser = Parser(prog="python -m truesky.render.models", description=(__doc__ or "").splitlines()[0])
    parser.add_lake("folder or address of the lake, with rendered images of spectra")
    parser.add_argument("--name", help="name of the request, required if the lake has several")
    parser.add_argument("--exposure", type=int, required=True, help="number of the exposure")
    parser.add_argument("--detector", required=True, help="name of the detector")
    parser.add_argument("--sources", type=int, nargs="+", required=True, metavar="ID", help="source identifiers")
    parser.add_argument("--orders", action="store_true", help="write an extension for each order of each source")
    parser.add_argument("--out", type=Path, required=True, help="FITS file to write")
    options = parser.parse_args(argv)
    return command.run("models", lambda: _write_models(options))


def _write_models(options: argparse.Namespace) -> int:
    out = user_files.check_target(options.out, (".fits",))
    ids = list(dict.fromkeys(options.sources))
    images = [
        Image(
            None,
            (("EXPOSURE", options.exposure, "exposure identifier"), ("DETECTOR", options.detector, "detector name")),
        )
    ]
    root = layout.open_lake(options.lake)
    version = read.version(root, "products", request=options.name)
    for model in models(root, version, options.exposure, options.detector, ids):
        layers = model.orders.items() if options.orders else [(None, model.frame)]
        images += [_extension(model.id, order, light) for order, light in layers]
        print(f"{model.id}: {model.frame.sum():.6g} electrons")
    write_images(out, images)
    return 0


if __name__ == "__main__":
    command.exit_with_status(main)
