"""Calibrated images from the raw frames of a lake: bias, dark, response of the amplifiers, flat, vignetting.

    python -m jobs.render.reduce --lake LAKE [--name REQUEST] --masters FOLDER --out FOLDER [--detectors ..]
                                 [--exposures ..] [--rate] [--without ..]

A file a frame that sees the sky, with the extensions SCI (electrons, or e-/s), WHT (inverse variance) and FLG (bits).
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from jobs.render.channels.image_types import SKY_TYPES
from jobs.render.reduction import calibration, files
from jobs.render.reduction import frames as frames_of
from jobs.render.reduction.calibration import Masters, Reduced
from jobs.render.reduction.frames import Frame
from lake_schema import command, user_files
from lake_schema.errors import BadInput
from lake_schema.store import layout


def reduced(frame: Frame, masters: Masters, per_second: bool = False) -> Reduced:
    """A frame with the masters of its detector."""
    return calibration.reduced(frame.electrons(), frame.full(), masters, frame.scene, frame.applied, per_second)


def main(argv: Sequence[str] | None = None) -> int:
    """Prints a line an image."""
    parser = argparse.ArgumentParser(prog="python -m jobs.render.reduce", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--lake", required=True, help="folder of the lake, with rendered frames")
    parser.add_argument("--name", help="of the request whose frames are meant, where the lake has several")
    parser.add_argument("--masters", type=Path, help="folder that jobs.render.masters has written")
    parser.add_argument("--out", type=Path, required=True, help="folder of the calibrated images")
    parser.add_argument("--detectors", nargs="+", default=[], metavar="NAME", help="default: all")
    parser.add_argument("--exposures", nargs="+", type=int, default=[], metavar="ID", help="default: all")
    parser.add_argument("--rate", action="store_true", help="electrons a second instead of those of the exposure")
    parser.add_argument("--without", nargs="+", default=[], choices=files.KINDS, help="masters that are not applied")
    options = parser.parse_args(argv)
    return command.status("reduce", lambda: _written(options))


def _written(options: argparse.Namespace) -> int:
    out = user_files.folder(options.out)
    if options.masters is None and set(options.without) != set(files.KINDS):
        raise BadInput(f"--masters: which folder? Or --without {' '.join(files.KINDS)}")
    found = frames_of.of_lake(layout.lake(options.lake), options.detectors, options.exposures, options.name)
    science = [own for frames in found.values() if (own := frames_of.of_types(frames, SKY_TYPES))]
    if not science:
        raise BadInput(f"lake {options.lake} has no such frame that sees the sky")
    out.mkdir(parents=True, exist_ok=True)
    for frames in science:
        masters = files.masters(options.masters or out, frames[0], options.without)
        for frame in frames:
            made = reduced(frame, masters, options.rate)
            path = out / f"{frame.stem}.fits"
            files.write_image(path, made, files.reduced_cards(frame, options.rate, options.without))
            good = made.flags == 0
            shown = f"sky {np.median(made.image[good]):.5g}" if good.any() else "no pixel is good"
            print(f"{path}: {shown}, {100.0 * good.mean():.2f} % of the pixels without flags")
    return 0


if __name__ == "__main__":
    sys.exit(main())
