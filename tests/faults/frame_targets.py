"""Further targets of fuzzing: frames, PSFs and masters of users, catalogues kept in the cache, and object storage."""

import json
import os
import tempfile
import warnings
from contextlib import suppress
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import numpy as np
from astropy.io import fits
from astropy.wcs import WCS

from lake_schema.fits import headers, images
from tests.faults import lake_targets
from tests.faults.fuzz_targets import MANY, as_csv, as_image, written
from tests.faults.lake_targets import folder_target
from truesky.api import given_frames
from truesky.catalogue.external import ingest, mapping
from truesky.command_line import commands
from truesky.cosmology import FIDUCIAL
from truesky.reduction import files as reduction_files
from truesky.reduction import stack
from truesky.render.products import read_back

SHAPE = (20, 30)
RNG = np.random.default_rng(2)


def wcs_cards(projection):
    """Return the header cards of a WCS with a projection of some distortion."""
    system = WCS(naxis=2)
    system.wcs.ctype = [f"RA---{projection}", f"DEC--{projection}"]
    system.wcs.crval, system.wcs.crpix, system.wcs.cdelt = (53.1, -27.8), (15.0, 10.0), (-1e-4, 1e-4)
    header = system.to_header()
    cards = {key: header[key] for key in header if key != "DATE-REF"}
    if projection == "TPV":
        cards |= {"PV1_1": 1.0, "PV1_4": 1e-3, "PV2_1": 1.0, "PV2_5": -1e-3}
    if projection == "TAN-SIP":
        cards |= {"A_ORDER": 2, "A_2_0": 1e-5, "B_ORDER": 2, "B_1_1": -1e-5}
    return cards


def frames():
    counts = RNG.normal(100.0, 3.0, SHAPE).astype(np.float32)
    calibration = {"MAGZERO": 26.0, "GAIN": 1.5, "SATURATE": 6e4, "EXPTIME": 90.0, "BUNIT": "adu"}
    return [as_image(counts, {**calibration, **wcs_cards(name)}) for name in ("TAN", "TPV", "TAN-SIP")]


def of_frame(path):
    """Open a frame and find a position in it."""
    found = given_frames.frame(path, psf=0.9)
    x, y = given_frames.frame_wcs.pixels_of_sky(found.wcs, np.array([53.1]), np.array([-27.8]), *SHAPE[::-1])
    assert np.isfinite([found.zero_point, found.gain]).all()
    assert x.shape == y.shape == (1,)


@cache
def calibrated_frame():
    """Return what the reader of a master needs of the frame that is calibrated."""
    cards = {"INSTRUME": "mini", "DETECTOR": "chip", "SEED": 3}
    return SimpleNamespace(
        scene=SimpleNamespace(ny=SHAPE[0], nx=SHAPE[1]), exposure=SimpleNamespace(channel="EXT"), stem="000001_EXT",
        card=cards.get,
    )  # fmt: skip


def with_checksums(read):
    """Return a reader of a FITS file whose checksums are right, as another program could have written the file.

    The checksums are added in place, so a header stays invalid if it was.
    """

    def read_file(path):
        with suppress(Exception), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with path.open("rb") as stream:
                # astropy does not return from some headers.
                headers.check(path.name, stream)
            with fits.open(path, mode="update", disable_image_compression=True) as units:
                for unit in units:
                    unit.add_checksum()
        return read(path)

    return read_file


def master(path):
    cards = [(key, value, "") for key, value in {"INSTRUME": "mini", "DETECTOR": "chip", "SEED": 3}.items()]
    primary = images.Image(None, (*cards, ("IMAGETYP", "master flat", ""), ("EXPTIME", 30.0, "s")))
    values, counts = np.ones(SHAPE, np.float32), np.full(SHAPE, 5, np.int16)
    planes = [images.Image(values, (), "VALUE"), images.Image(0.1 * values, (), "UNCERTAINTY")]
    images.write_images(path, [primary, *planes, images.Image(counts, (), "COUNT")])


def of_master(path):
    combined, seconds = reduction_files.read_master(path, "flat", calibrated_frame())
    assert combined.mean.shape == combined.uncertainty.shape == combined.count.shape == SHAPE
    assert not np.isnan(seconds)


def calibrated(path, exposure=1):
    values = {"INSTRUME": "mini", "CHANNEL": "EXT", "FILTER": "des_r", "ZEROPNT": 26.0, "IMAGETYP": "science",
              "DETECTOR": "chip", "EXPOSURE": exposure, "EXPTIME": 90.0, "GAIN": 1.5, "PIXSCALE": 0.3,
              "BUNIT": "adu"}  # fmt: skip
    cards = (*((key, value, "") for key, value in values.items()), *lake_targets.pixels().cards)
    shape = lake_targets.pixels().data.shape
    light = np.random.default_rng(exposure).normal(100.0, 1.0, shape).astype(np.float32)
    planes = {"SCI": light, "WHT": np.ones(shape, np.float32), "FLG": np.zeros(shape, np.int32)}
    images.write_images(path, [images.Image(None, cards), *(images.Image(data, (), n) for n, data in planes.items())])


def of_stack(path):
    """Average a mutated image and a valid one."""
    with tempfile.TemporaryDirectory() as folder:
        calibrated(Path(folder) / "valid.fits", 2)
        options = [path, Path(folder) / "valid.fits", "--out", Path(folder) / "stack.fits"]
        stack.run_command(commands.parse("stack", [*map(str, options)]))


def kept_catalogue(folder):
    """Split a catalogue into the cells of the cache, which is the folder."""
    folder.mkdir(parents=True)
    columns = {name: MANY[name] for name in ("id", "ra", "dec", "z")}
    (folder / "galaxies.csv").write_bytes(as_csv({**columns, "magnitude": np.full(50, -20.0)}))
    split(folder)


@cache
def columns():
    titles = {"origin_id": "id", "ra": "ra", "dec": "dec", "z_true": "z", "abs_mag_r01": "magnitude"}
    return mapping.galaxy_columns("", {name: json.dumps(title) for name, title in titles.items()}, FIDUCIAL)


def split(folder):
    with mock.patch.dict(os.environ, {"TRUESKY_CACHE": str(folder)}):
        return ingest.split_by_cell([folder / "galaxies.csv"], ["0" * 64], columns())


def of_kept_catalogue(folder):
    """Open a catalogue that is in the cache: what has changed is computed again."""
    assert split(folder).rows == len(MANY["ra"])


def part(name):
    return lambda folder: next(folder.glob(f"ingest-*/{name}"))


TARGETS = {
    "frame with WCS": (frames, of_frame, ".fits"),
    "master": (lambda: [written(master), as_image(np.ones(SHAPE, np.float32))], of_master, ".fits"),
    "master, sealed": (lambda: [written(master)], with_checksums(of_master), ".fits"),
    "image, sealed": (
        lambda: [written(lake_targets.stored), written(lake_targets.packed)], with_checksums(read_back.frame), ".fits",
    ),
    "calibrated image, sealed": (
        lambda: [written(lake_targets.calibrated)], with_checksums(reduction_files.read_image), ".fits",
    ),
    "stack, sealed": (lambda: [written(calibrated)], with_checksums(of_stack), ".fits"),
    "split, checksums": folder_target(kept_catalogue, part("sums.json"), of_kept_catalogue, ".json"),
    "split, summary": folder_target(kept_catalogue, part("about.json"), of_kept_catalogue, ".json"),
}  # fmt: skip
