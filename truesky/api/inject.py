"""Add sources to a calibrated frame: truesky inject IMAGE ROWS OUT --psf FILE."""

from __future__ import annotations

import argparse
import os

from lake_schema.errors import BadInput
from truesky.api import given_frames


def run_command(options: argparse.Namespace) -> int:
    """Add the sources of a table to a frame as the parsed arguments say, print the written files, and return 0.

    Raises BadInput if a file or a value cannot be used.
    """
    if os.path.realpath(options.out) == os.path.realpath(options.image):
        raise BadInput(f"OUT {options.out} is the file IMAGE: write the new image to another file")
    given = given_frames.frame(
        options.image,
        psf=_psf(options.psf),
        weight=_extension(options.weight),
        flags=_extension(options.flags),
        extension=_extension(options.extension),
        zero_point=options.zero_point,
        gain=options.gain,
        saturation=options.saturation,
    )
    new = given.with_sources(
        options.rows, seed=options.seed, noise=options.noise, ellipticity=options.ellipticity, axes=options.axes
    )
    written = new.write(options.out)
    print(f"added {len(new.truth) - new.outside} sources; {new.outside} are outside the frame")
    for path in written:
        print(path)
    return 0


def _psf(text: str) -> str | float:
    """Return the FWHM if the text is a number, else the text, which names a file."""
    try:
        return float(text)
    except ValueError:
        return text


def _extension(text: str | None) -> str | int | None:
    """Return the number of an extension if the text is one, else the text."""
    return int(text) if text is not None and text.isdigit() else text
