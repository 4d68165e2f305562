"""Add sources to a calibrated frame: truesky inject IMAGE ROWS OUT --psf FILE."""

from __future__ import annotations

import argparse
import os

from lake_schema import user_files
from lake_schema.errors import BadInput
from truesky.api import given_frames
from truesky.api.given_frames import InjectedFrame
from truesky.command_line import injection

# Options of the command that are arguments in Python.
_OPTIONS = (
    "psf", "weight", "flags", "extension", "zero_point", "gain", "saturation", "ellipticity", "axes", "seed",
)  # fmt: skip


def run_command(options: argparse.Namespace) -> int:
    """Add the sources of a table to a frame as the parsed arguments say, print the written files, and return 0.

    Raises BadInput if a file or a value cannot be used, or no source is on the frame.
    """
    if os.path.realpath(options.out) == os.path.realpath(options.image):
        raise BadInput(f"OUT {options.out} is the file IMAGE: write the new image to another file")
    given_frames.check_target(options.out)
    try:
        new = _add_sources(options)
    except BadInput as error:
        raise injection.name_options(error, _OPTIONS) from None
    _refuse_distant(new, options.rows)
    written = new.write(options.out)
    print(f"added {len(new.truth) - new.outside} sources; {new.outside} are outside the frame")
    for path in written:
        print(path)
    return 0


def _add_sources(options: argparse.Namespace) -> InjectedFrame:
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
    return given.with_sources(
        options.rows, seed=options.seed, noise=options.noise, ellipticity=options.ellipticity, axes=options.axes
    )


def _refuse_distant(new: InjectedFrame, rows: str) -> None:
    """Raise BadInput if no source of a table reaches the frame."""
    truth = new.truth
    if not len(truth) or truth["on_frame"].any() or truth["drawn"].any():
        return
    ny, nx = new.image.shape
    ra, dec = (float(angle) for angle in new.original.wcs.all_pix2world((nx - 1) / 2, (ny - 1) / 2, 0))
    first = f"row 1 is at ra {truth['ra'][0]:.5f}, dec {truth['dec'][0]:.5f}"
    place = user_files.format_path(rows)
    raise BadInput(f"{place}: no source is on the frame, whose middle is at ra {ra:.5f}, dec {dec:.5f}; {first}")


def _psf(text: str) -> str | float:
    """Return the FWHM if the text is a number, else the text, which names a file."""
    try:
        return float(text)
    except ValueError:
        return text


def _extension(text: str | None) -> str | int | None:
    """Return the number of an extension if the text is one, else the text."""
    return int(text) if text is not None and text.isdigit() else text
