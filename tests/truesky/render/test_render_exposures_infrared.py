"""All image types of NISP-P, made by the jobs: a star of AB 0, its persistence for an hour, and calibrations."""

import galsim
import galsim.des
import numpy as np
import pytest
from astropy.io import fits

from lake_schema.errors import BadInput
from lake_schema.store import layout, publish, read
from tests import requests
from tests.truesky.render.test_render_exposures_calibration import small_detectors
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.render import plan_exposures, render_exposures
from truesky.render.products import read_back
from truesky.request.from_toml import parse
from truesky.running import submitted_job

MODULES = (build_galaxies, build_stars, compute_fluxes, plan_exposures, render_exposures)
MJD, HOUR, FRAME = 60905.0, 1.0 / 24.0, 1.454
BLOCK = """
[[observation]]
channels = ["NISP-P"]
detectors = ["DET22"]
"""
REQUEST = f"""
accuracy = "draft"
[sources]
only = "table"
band = "euclid_h"
stars = "stars.csv"
[products]
truth = ["saturation", "persistence", "ramp", "cosmic_rays", "noise_free"]
wcs = "tpv"
[[pointing]]
channel = "NISP-P"
camera = "nisp"
band = "euclid_h"
ra = 53.117
dec = -27.808
centre_on = "DET22"
detectors = ["DET22"]
mjd = {MJD}
{BLOCK}
image_type = "dark"
exposures = 1
mjd = {MJD + HOUR}
{BLOCK}
image_type = "dark"
exposures = 1
exposure_time_s = 600.0
mjd = {MJD + 10 * HOUR}
{BLOCK}
image_type = "dark"
exposures = 1
macc = [2, 1, 0]
mjd = {MJD + 20 * HOUR}
{BLOCK}
image_type = "flat"
exposures = 1
lamps = [5, 3]
mjd = {MJD + 30 * HOUR}
{BLOCK}
image_type = "self_calibration"
exposures = 1
bands = ["euclid_j"]
mjd = {MJD + 40 * HOUR}
"""
# Image type, band, seconds, (groups, reads, drops), lamp, and range of the median in e-.
_NOMINAL = 60 * FRAME, (4, 16, 4)
KINDS = [
    ("science", "euclid_h", *_NOMINAL, None, (60, 1e5)),
    ("dark", "euclid_y", *_NOMINAL, None, (-2, 12)),
    ("dark", "euclid_y", 600.0, (4, 16, 122), None, (8, 16)),
    ("dark", "euclid_y", FRAME, (2, 1, 0), None, (-4, 4)),
    ("flat", "euclid_h", *_NOMINAL, 5, (1.5e4, 4e4)),
    ("flat", "euclid_j", *_NOMINAL, 3, (1.5e4, 4e4)),
    ("self_calibration", "euclid_j", *_NOMINAL, None, (60, 300)),
]


def wanted(folder, more="", replaced=("", "")):
    (folder / "stars.csv").write_text("ra,dec,mag\n53.117,-27.808,0.0\n53.119,-27.807,18.0\n")
    return parse(requests.written(folder, REQUEST.replace(*replaced) + more, requests.FIELD.format(0.7), seed=3))


def opened(root, content):
    """Return the path of a file by exposure, for one content."""
    version = read.version(root, "products")
    return {
        row["exposure_id"]: version.sidecar_path(row["path"])
        for row in version.rows().to_pylist()
        if row["content"] == content
    }


def check(root):
    files = opened(root, "science")
    assert sorted(files) == list(range(1, 8))
    for number, (kind, band, seconds, mode, lamp, (least, most)) in enumerate(KINDS, start=1):
        with fits.open(files[number]) as units:
            header = units[0].header
            assert (header["IMAGETYP"], header["FILTER"], header.get("LAMP")) == (kind, band, lamp)
            assert (header["READMODE"], header["NG"], header["NR"], header["ND"]) == ("MACC", *mode)
            assert header["EXPTIME"] == pytest.approx(seconds)
            assert [unit.name for unit in units[1:]] == ["DET22.SCI", "DET22.CHI2"][: 1 + (mode[0] > 2)]
        assert least < np.median(read_back.electrons(files[number]).data) < most
    # Truth maps of each exposure.
    assert (
        set(opened(root, "saturation")) == set(opened(root, "persistence")) == set(opened(root, "ramp")) == set(files)
    )
    check_persistence(root, files)
    # Images of the sky have a file with the PSF.
    psfs = {path.parent.name: path for path in psf_files(root)}
    assert sorted(psfs) == ["000001", "000007"]
    model = galsim.des.DES_PSFEx(str(psfs["000007"])).getPSF(galsim.PositionD(100.0, 100.0))
    with fits.open(files[7]) as units:
        assert 0.3 * model.calculateFWHM() == pytest.approx(units[0].header["PSFFWHM"], rel=0.05)
        assert units[0].header["PSFWIN"] == 0.21
    assert psfs["000007"].name == "NISP-P_euclid_j_DET22.psf"


def psf_files(root):
    """Return the paths of the PSF files of all images."""
    version = read.version(root, "products")
    files = [entry["path"] for entry in version.manifest["files"]]
    return [version.sidecar_path(path) for path in files if path.endswith(".psf")]


def check_persistence(root, files):
    """A saturated pixel releases 12 e- an hour later in the dark, at the position of the star; none after ten hours."""
    left = {number: fits.getdata(path) for number, path in opened(root, "persistence").items()}
    full = fits.getdata(opened(root, "saturation")[1]) == 1
    assert full.sum() > 100
    of_full = (120.0 + 1.5e-3 * 1.3e5) * 36.0**-0.9
    assert left[2][full].mean() == pytest.approx(of_full, rel=0.1)
    dark = read_back.electrons(files[2]).data
    assert np.median(dark[full]) == pytest.approx(of_full + 0.02 * 60 * FRAME, abs=2.0)
    assert all((left[number] == 0.0).all() for number in (1, 3, 4))


def made(root, request, modules=MODULES):
    for module in modules:
        for step in module.steps(root, request):
            publish.make_version(root, step.plan, step.run_task)


def test_each_kind_is_planned_rendered_and_published(lake, tmp_path):
    with small_detectors(320):
        made(lake, wanted(tmp_path))
        check(lake)


@pytest.mark.nightly
def test_by_spark_whole_detectors(spark, tmp_path):
    root = layout.resolve_lake(tmp_path / "lake")
    for module in MODULES:
        submitted_job.run(module.JOB, root, wanted(tmp_path))
    check(root)


@pytest.mark.parametrize(
    ("replaced", "message"),
    [
        (("macc = [2, 1, 0]", "macc = [1, 1, 0]"), r"observation\[2\]\.macc\[0\] \(groups\) .* 1"),
        (("macc = [2, 1, 0]", "macc = [2, 1.0, 0]"), r"observation\[2\]\.macc\[1\] \(reads\) .* 1\.0"),
        (("exposure_time_s = 600.0", "exposure_time_s = 30.0"), r"observation\[1\]: exposure time 30 s"),
    ],
)
def test_invalid_ramps_are_refused_in_one_line(tmp_path, lake, replaced, message):
    with pytest.raises(BadInput, match=message) as caught:
        made(lake, wanted(tmp_path, replaced=replaced), (plan_exposures,))
    assert "\n" not in str(caught.value)
    assert list(lake.rglob("*.parquet")) == []
