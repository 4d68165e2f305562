"""A DECam exposure in one file, made by the jobs: CCDs in the order of their numbers, with DECam's keywords."""

import shutil
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS

from lake_schema.fits import images
from lake_schema.store import layout, publish, read
from tests import requests
from tests.truesky.render.fields import MISSION
from tests.truesky.render.products import test_tools as tools
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.render import plan_exposures, render_exposures
from truesky.render.camera import astrometry, detectors
from truesky.render.camera.pointing import boresight_for
from truesky.render.camera.sections import Section, steps_of_text
from truesky.render.products import head_files, read_back
from truesky.request.from_toml import parse

SIDE, PLACE = 64, (53.117, -27.808)
# Their names have another order.
NUMBERS = {"S29": 1, "S25": 4}
TEXT = """
accuracy = "draft"
[sources]
only = "table"
band = "des_r"
stars = "stars.csv"
[products]
truth = []
files = "exposure"
[[pointing]]
channel = "EXT"
camera = "decam"
band = "des_r"
ra = 53.117
dec = -27.808
mjd = 60905.0
detectors = ["S25", "S29"]
centre_on = "S29"
"""


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    folder, listed = tmp_path_factory.mktemp("decam"), detectors._read_layout

    def smaller(*args):
        return tuple(replace(d, nx=SIDE, ny=SIDE) for d in listed(*args))

    # The last star is bright, and at the centre of a CCD that shares electronics with the first.
    other = detectors.detector("decam", "S30", MISSION)
    ra, dec, angle = boresight_for(detectors.detector("decam", "S29", MISSION), *PLACE, 0.0)
    ra, dec = astrometry.centre(other, astrometry.wcs(other, ra, dec, angle))
    rows = f"53.117,-27.808,18.0\n53.1172,-27.8082,20.0\n{ra:.7f},{dec:.7f},12.0\n"
    (folder / "stars.csv").write_text(f"ra,dec,mag\n{rows}")
    request = parse(requests.written(folder, TEXT, requests.FIELD.format(0.45), seed=5))
    root = layout.resolve_lake(folder / "lake")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(detectors, "_read_layout", smaller)
        for module in (build_galaxies, build_stars, compute_fluxes, plan_exposures, render_exposures):
            make(root, module.steps(root, request))
        yield root


def make(root, steps, mapper=map):
    for step in steps:
        publish.make_version(root, step.plan, step.run_task, mapper, name="x")


@pytest.fixture(scope="module")
def whole(lake):
    version = read.version(lake, "exposure_files")
    (row,) = version.rows().to_pylist()
    return row, version.sidecar_path(row["path"])


def test_the_ccds_are_in_the_order_of_their_numbers(lake, whole):
    row, path = whole
    assert (row["detectors"], row["planned"]) == (2, 2)
    products = read.version(lake, "products")
    files = {one["detector"]: products.sidecar_path(one["path"]) for one in products.rows().to_pylist()}
    with fits.open(path, checksum=True) as units:
        units.verify("exception")
        first, *ccds = units
        assert first.data is None
        assert (first.header["INSTRUME"], first.header["OBSTYPE"], first.header["NDETECT"]) == ("DECam", "object", 2)
        assert not {"CCDNUM", "DETPOS", "GAINA", "CRVAL1"} & set(first.header)
        assert [(unit.name, unit.header["CCDNUM"]) for unit in ccds] == list(NUMBERS.items())
        for unit in ccds:
            (own,) = images.read_images(files[unit.name])
            np.testing.assert_array_equal(unit.data, own.data)
            said = {key: value for key, value, _ in own.cards}
            assert {key: {**first.header, **unit.header}[key] for key in said} == said
            for letter in "AB":
                assert {f"{key}{letter}" for key in ("DATASEC", "BIASSEC", "GAIN", "RDNOISE", "SATURAT")} <= set(
                    unit.header
                )
        gaps = [unit.header["DETSEC"] for unit in ccds]
        assert gaps[0] != gaps[1]


def test_only_the_head_file_has_the_true_pointing(lake, whole):
    """All CCDs have the same pointing error; the head file has the true WCS of the CCDs in file order."""
    path = whole[1]
    heads = path.with_suffix(".head").read_text("ascii").split("END\n")[:-1]
    exposure = read.version(lake, "exposures").rows().to_pylist()[0]
    with fits.open(path) as units:
        off = []
        for text, unit in zip(heads, units[1:], strict=True):
            true = fits.Header.fromstring(text, sep="\n")
            assert true["CRPIX1"] == pytest.approx(unit.header["CRPIX1"])
            assert (true["CRVAL1"], true["CRVAL2"]) == pytest.approx((exposure["ra"], exposure["dec"]), abs=1e-9)
            seen = [SkyCoord(*WCS(h).all_pix2world([100.0], [20.0], 0), unit="deg") for h in (true, unit.header)]
            off.append(seen[0].separation(seen[1]).arcsec[0])
            assert unit.header["CSYER1"] == pytest.approx(3.0 / 3600.0)
    assert 0.5 < min(off) <= max(off) < 20.0
    # With a rotation of half an arcminute, neighbours differ by 0.1 arcsec.
    assert np.ptp(off) < 0.5


def test_ccdproc_reduces_the_file_by_its_header(whole):
    found = list(tools.reduced(whole[1]))
    assert len(found) == 4
    for text, image in found:
        assert image.unit == "electron"
        assert image.shape == images_shape(text)
    levels = [np.median(image.data) for _, image in found]
    assert min(levels) > 100.0
    assert np.ptp(levels) < 0.05 * np.mean(levels)


def test_separate_amplifiers_are_extensions(lake, whole, tmp_path):
    """If the request sets it, each amplifier is an extension in readout order; the pixels are the same."""
    root = layout.resolve_lake(shutil.copytree(lake, tmp_path / "lake", symlinks=True))
    make(root, render_exposures.steps(root, replace(parse(lake.parent / "r.toml"), readout="amplifiers")))
    version = read.version(root, "exposure_files")
    (row,) = version.rows().to_pylist()
    with fits.open(version.sidecar_path(row["path"]), checksum=True) as units, fits.open(whole[1]) as together:
        assert [unit.name for unit in units[1:]] == [f"{name}.{letter}" for name in NUMBERS for letter in "AB"]
        for number, unit in enumerate(units[1:]):
            ccd, letter = together[1 + number // 2], "AB"[number % 2]
            own, there = tools.window(unit.header["DATASEC"]), tools.window(ccd.header[f"DATASEC{letter}"])
            column_step, row_step = steps_of_text(unit.header["CCDSEC"])
            # Both CCDs are southern ones: amplifier A is read from the upper right, B from the upper left.
            assert (column_step, row_step) == (-1 if letter == "A" else 1, -1)
            np.testing.assert_array_equal(unit.data[own][::row_step, ::column_step], ccd.data[there])
            assert unit.header["GAIN"] == pytest.approx(ccd.header[f"GAIN{letter}"])
            places = [header[key] for header, key in ((unit.header, "DETSEC"), (ccd.header, f"DETSEC{letter}"))]
            assert Section.from_text(places[0]) == Section.from_text(places[1])
            assert steps_of_text(places[0])[0] == column_step * steps_of_text(places[1])[0]


def images_shape(text):
    rows, columns = tools.window(text)
    return rows.stop - rows.start, columns.stop - columns.start


def test_read_back_has_the_true_wcs(lake):
    products = read.version(lake, "products")
    exposure = read.version(lake, "exposures").rows().to_pylist()[0]
    for row in products.rows().to_pylist():
        cards = {key: value for key, value, _ in read_back.frame(products.sidecar_path(row["path"])).cards}
        assert (cards["CRVAL1"], cards["CRVAL2"]) == pytest.approx((exposure["ra"], exposure["dec"]), abs=1e-9)
        assert products.sidecar_path(head_files.head_path(row["path"])).is_file()


def test_crosstalk_is_independent_of_the_order_of_rendering(lake, tmp_path):
    """Render the CCDs one after another, two at a time in reverse order, and alone."""
    wanted = parse(lake.parent / "r.toml")
    (pointing,) = wanted.pointings
    wanted = replace(wanted, files="detector", pointings=(replace(pointing, detectors=("S29", "S30")),))

    def together(function, parts):
        with ThreadPoolExecutor(2) as pool:
            yield from pool.map(function, [*parts][::-1])

    found = []
    for name, mapper, some in (("one", map, ()), ("two", together, ()), ("alone", map, ("S29",))):
        root = layout.resolve_lake(shutil.copytree(lake, tmp_path / name, symlinks=True))
        shutil.rmtree(layout.table_folder(root, "products"))
        make(root, plan_exposures.steps(root, wanted))
        make(root, render_exposures.steps(root, replace(wanted, detectors=some)), mapper)
        version = read.version(root, "products")
        found.append({row["detector"]: version.sidecar_path(row["path"]) for row in version.rows().to_pylist()})
    one, two, alone = ({key: path.read_bytes() for key, path in files.items()} for files in found)
    assert one == two
    assert (len(one), alone) == (2, {"S29": one["S29"]})
    said = [value for key, value, _ in read_back.header(found[0]["S29"]) if key.startswith("EFFECT")]
    assert any(str(value).startswith("detector_crosstalk: on") for value in said)
