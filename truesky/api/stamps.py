"""Draw images of many places and write them to a folder: truesky stamps LAKE PLACES OUT."""

from __future__ import annotations

import argparse
import csv
from collections.abc import Iterator, Sequence
from pathlib import Path

from tqdm import tqdm

from lake_schema import user_files
from lake_schema.errors import BadInput
from truesky.api.image_options import ImageOptions
from truesky.api.lake import Lake
from truesky.api.sky_images import SkyImage
from truesky.command_line import injection
from truesky.commands import submit

# Options of the command that are arguments of `Lake.stamps`.
_OPTIONS = ("size", "band", "camera", "exposure", "date", "accuracy", "effects", "seed", "processes")
# Columns of the list of written files. `ra` and `dec` are the middle of the image.
_COLUMNS = ("row", "file", "ra", "dec", "exposure", "detector", "first_column", "first_row", "sources")


def run_command(options: argparse.Namespace) -> int:
    """Write the images of the places in a table to a new folder as the parsed arguments say, print it, and return 0.

    Raises BadInput if an argument is not valid or an image cannot be drawn, and SystemExit with the status 130 or 143
    after Ctrl-C or SIGTERM. No folder is left in these cases.
    """
    out = Path(options.out)
    if out.exists():
        raise BadInput(f"{user_files.format_path(out)}: exists already; give the name of a new folder")
    user_files.check_folder(out)
    chosen: ImageOptions = {"noise": options.noise, "accuracy": options.accuracy}
    for name in ("camera", "exposure", "date", "seed", "effects"):
        if (value := getattr(options, name)) is not None:
            chosen[name] = value
    with (
        submit.stop_on_signal("truesky stamps", f"{user_files.format_path(out)} was not written"),
        Lake(options.lake) as lake,
    ):
        try:
            images = lake.stamps(options.places, options.size, options.band, options.processes, **chosen)
        except BadInput as error:
            raise injection.name_options(error, _OPTIONS) from None
        with user_files.create_folder(out) as folder:
            rows = list(_write(images, folder))
            _write_list(rows, folder / "stamps.csv")
    print(f"{out}: {len(rows)} images, listed in stamps.csv")
    return 0


def _write(images: Iterator[SkyImage], folder: Path) -> Iterator[Sequence[str | int | float]]:
    """Write the images to a folder, and yield a row of the list for each."""
    for number, image in enumerate(tqdm(images, unit="image", desc="stamps", disable=None), 1):
        file = image.write(folder / f"stamp_{number:06d}.fits")
        ny, nx = image.electrons.shape
        ra, dec = (float(value) for value in image.wcs.all_pix2world((nx - 1) / 2, (ny - 1) / 2, 0))
        identity = image.exposure["exposure_id"], image.detector
        yield number, file.name, round(ra, 9), round(dec, 9), *identity, *image.first_pixel, len(image.truth)


def _write_list(rows: Sequence[Sequence[str | int | float]], file: Path) -> None:
    with file.open("w", newline="") as stream:
        writer = csv.writer(stream, lineterminator="\n")
        writer.writerow(_COLUMNS)
        writer.writerows(rows)
