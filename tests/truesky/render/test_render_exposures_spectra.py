"""All image types of NISP-S, made by the jobs: four settings of the red grisms, the blue grism, and calibrations."""

import re
from pathlib import Path

import grismconf
import numpy as np
import pyarrow.compute as pc
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits

import truesky
from lake_schema.errors import BadInput
from lake_schema.fits import images
from lake_schema.store import layout, publish, read
from lake_schema.store.object_storage import push, s3
from tests import requests
from truesky.catalogue import build_galaxies, build_stars
from truesky.commands import __main__ as commands
from truesky.fluxes import compute_fluxes
from truesky.reduction import masters
from truesky.render import models, plan_exposures, render_exposures
from truesky.render.products import read_back
from truesky.request.from_toml import parse
from truesky.running import submitted_job

MODULES = (build_galaxies, build_stars, compute_fluxes, plan_exposures, render_exposures)
MJD, NX, NY = 60905.0, 640, 96
POINTING = """
[[pointing]]
channel = "NISP-S"
camera = "nisp"
band = "{}"
ra = 53.117
dec = -27.808
centre_on = "DET22"
detectors = ["DET22"]
mjd = {}
{}
"""
BLOCK = """
[[observation]]
channels = ["NISP-S"]
detectors = ["DET22"]
exposures = 1
mjd = {}
image_type = {}
"""
ANGLES = (0.0, 184.0, -4.0, 180.0)
REQUEST = f"""
accuracy = "draft"
[mission]
overrides = {{"nisp.fpa.nx" = {{value = {NX}, unit = "pix"}}, "nisp.fpa.ny" = {{value = {NY}, unit = "pix"}}}}
[sources]
only = "table"
band = "euclid_h"
stars = "stars.csv"
[products]
truth = ["noise_free", "order_1", "order_0", "order_2", "order_m1", "saturation", "persistence", "cosmic_rays"]
{"".join(POINTING.format("nisp_red", MJD + i, f"grism_angle = {angle}") for i, angle in enumerate(ANGLES))}
{POINTING.format("nisp_blue", MJD + 4, "")}
{BLOCK.format(MJD + 5, '"dark"')}
{BLOCK.format(MJD + 6, '"flat"')}
lamps = [4]
{BLOCK.format(MJD + 7, '"standard_star"')}
{BLOCK.format(MJD + 8, '"planetary_nebula"')}
"""
RED = [("science", "nisp_red", grism, angle) for grism, angle in zip(("RGS000", "RGS180") * 2, ANGLES, strict=True)]
KINDS = [
    *RED,
    ("science", "nisp_blue", "BGS000", 0.0),
    ("dark", "nisp_red", None, None),
    ("flat", "nisp_red", "RGS000", 0.0),
    *[("standard_star", "nisp_red", "RGS000", 0.0)] * 2,
    *[("planetary_nebula", *row[1:]) for row in RED],
]

BLUE = '"NISP-S"\ncamera = "nisp"\nband = "nisp_blue"'
PHOTOMETRIC = '"NISP-P"\ncamera = "nisp"\nband = "euclid_h"\ngrism_angle = 0.0'
# 265 pixels from the detector, on both sides.
BESIDE = "53.1721,-27.808,16.0\n53.0619,-27.808,16.5\n"


def wanted(folder, more="", replaced=("", "")):
    (folder / "stars.csv").write_text("ra,dec,mag\n53.117,-27.808,15.0\n53.119,-27.807,18.0\n" + BESIDE)
    return parse(requests.written(folder, REQUEST.replace(*replaced) + more, requests.FIELD.format(0.7), seed=3))


def made(root, request, modules=MODULES):
    for module in modules:
        for step in module.steps(root, request):
            publish.make_version(root, step.plan, step.run_task)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("spectra")


@pytest.fixture(scope="module")
def rendered(folder):
    root = layout.resolve_lake(folder / "lake")
    made(root, wanted(folder))
    return root


def opened(root, content):
    """Return the path of a file by exposure, for one content."""
    version = read.version(root, "products")
    return {
        row["exposure_id"]: version.sidecar_path(row["path"])
        for row in version.rows().to_pylist()
        if row["content"] == content
    }


def check(root):
    files, light = opened(root, "science"), opened(root, "noise_free")
    assert sorted(files) == list(range(1, len(KINDS) + 1))
    for number, (kind, band, grism, angle) in enumerate(KINDS, start=1):
        with fits.open(files[number]) as units:
            header = units[0].header
            assert (header["IMAGETYP"], header["FILTER"]) == (kind, band)
            assert (header.get("GRISM"), header.get("GRISMPA")) == (grism, angle)
            assert (header["READMODE"], header["NG"], header["NR"], header["ND"]) == ("MACC", 15, 16, 11)
            assert [unit.name for unit in units[1:]] == ["DET22.SCI", "DET22.CHI2"]
        median, stars = np.median(read_back.electrons(files[number]).data), fits.getdata(light[number])
        least, most = {"dark": (-2, 30), "flat": (1e4, 6e4)}.get(kind, (200, 2000))
        assert least < median < most
        assert (stars.sum() > 1e4) == (kind not in ("dark", "flat"))
    # The dark and the flat have no light of the orders of the star.
    assert set(opened(root, "order_1")) == set(files) - {6, 7}
    spectra = read.version(root, "rendered_spectra").rows().to_pylist()
    assert {row["exposure_id"] for row in spectra} == set(files) - {6, 7}
    # The PSF of a spectrum changes along it, so there is no file with one PSF.
    assert not [e for e in read.version(root, "products").manifest["files"] if e["path"].endswith(".psf")]


def test_each_kind_is_planned_rendered_and_published(rendered):
    check(rendered)


def test_directions_of_the_traces_of_all_grism_angles(rendered):
    """The direction of the trace on the detector is the requested angle minus the 0.1 deg of the wheel."""
    rows = read.version(rendered, "rendered_spectra").rows().to_pylist()
    brightest = {}
    for row in rows:
        if row["order"] == 1 and row["exposure_id"] <= len(ANGLES):
            other = brightest.get(row["exposure_id"], row)
            brightest[row["exposure_id"]] = max(row, other, key=lambda one: one["expected"])
    found = {}
    for number, row in brightest.items():
        along, across = row["x_last"] - row["x_first"], row["y_last"] - row["y_first"]
        found[number] = np.degrees(np.arctan2(across, along))
        assert np.hypot(along, across) == pytest.approx(500.0, abs=40.0)
    # A row of detectors may be mounted upside down; angles are relative to the first row.
    for number, angle in enumerate(ANGLES, start=1):
        apart = (found[number] - found[1] - angle + 180.0) % 360.0 - 180.0
        assert apart == pytest.approx(0.0, abs=0.7)


@pytest.mark.nightly
def test_spark_gives_the_same_bytes(spark, rendered, tmp_path):
    root = layout.resolve_lake(tmp_path / "lake")
    for module in MODULES:
        submitted_job.run(module.JOB, root, wanted(tmp_path))
    for name in ("products", "rendered_truth", "rendered_spectra"):
        assert read.version(root, name).manifest == read.version(rendered, name).manifest
        assert read.find_faults(read.version(root, name), deep=True) == []


def test_first_orders_of_sources_far_outside_the_detector(rendered):
    """Of two sources 265 px from the detector, only the one that the grism disperses towards it."""
    fluxes = read.version(rendered, "star_fluxes").rows(["id", "f_nu_euclid_h"]).to_pylist()
    mags = {row["id"]: round(23.9 - 2.5 * np.log10(row["f_nu_euclid_h"]), 1) for row in fluxes}
    rows = read.version(rendered, "rendered_spectra").rows().to_pylist()
    towards = []
    for number in range(1, len(ANGLES) + 1):
        firsts = {mags[row["id"]]: row["drawn"] for row in rows if (row["exposure_id"], row["order"]) == (number, 1)}
        light = {mag: firsts.get(mag, 0.0) for mag in (16.0, 16.5)}
        towards.append(max(light, key=light.get))
        # The other source contributes only the wings of its closest light.
        assert light[towards[-1]] > 1000.0 > 20.0 * min(light.values())
    assert towards in ([16.0, 16.5] * 2, [16.5, 16.0] * 2)


def test_models_of_single_sources_add_up_to_the_published_image(rendered, folder, capsys):
    light = opened(rendered, "noise_free")
    found = list(models.models(rendered, read.version(rendered, "products"), 3, "DET22"))
    np.testing.assert_array_equal(sum(one.frame for one in found).astype(np.float32), fits.getdata(light[3]))
    bright = max(found, key=lambda one: one.frame.sum())
    file = folder / "models.fits"
    arguments = ["--lake", str(rendered), "--exposure", "3", "--detector", "DET22", "--sources", str(bright.id)]
    for more, count in (([], 1), (["--orders"], 4)):
        assert models.main([*arguments, "--out", str(file), *more]) == 0
        assert capsys.readouterr().out.startswith(f"{bright.id}: ")
        head, *units = images.read_images(file)
        assert (head.data, len(units)) == (None, count)
        # As 32-bit numbers.
        np.testing.assert_allclose(sum(models.frame(unit, (NY, NX)) for unit in units), bright.frame, rtol=1e-6)


@pytest.mark.nightly
def test_a_lake_on_object_storage_has_the_same_models(rendered, bucket):
    source, place = drawn_first(rendered), s3.parse_address(f"s3://{bucket[1]}/lake", bucket[0].url)
    list(push.push(rendered, place))
    found = []
    for address in (rendered, str(place)):
        with truesky.open(address) as lake:
            found.append([frame for _, frame in lake.models(3, "DET22", [source])])
    np.testing.assert_array_equal(*found)


def test_python_draws_the_same_models(rendered):
    """The brightest pixels of each source lie at the position predicted by the WCS and its trace."""
    version = read.version(rendered, "products")
    (bright,) = models.models(rendered, version, 3, "DET22", [drawn_first(rendered)])
    with truesky.open(rendered) as lake:
        ((source, electrons),) = lake.models(3, "DET22", [bright.id])
        assert source == bright.id
        np.testing.assert_array_equal(electrons, bright.frame)
        path = lake.images().set_index("exposure_id")["path"][3]
        header, signal, quality = lake.extensions(path)
        assert header.data is None
        assert signal.data.shape == quality.data.shape == (NY + 8, NX + 8)
        x, y = lake.wcs(path).world_to_pixel(SkyCoord(53.117, -27.808, unit="deg"))
        assert abs(x - NX / 2) < 2.0
        assert abs(y - NY / 2) < 2.0
        with pytest.raises(truesky.BadInput, match="no detector DET22 of exposure 99"):
            lake.models(99, "DET22")
        with pytest.raises(truesky.BadInput, match="source 12 has no light on the detector"):
            lake.models(3, "DET22", [12])


def drawn_first(root):
    """Return the identifier of a source with a first order on exposure 3."""
    spectra = read.version(root, "rendered_spectra").rows(where=pc.field("exposure_id") == 3)
    return spectra.filter(pc.field("order") == 1)["id"][0].as_py()


@pytest.mark.parametrize(
    ("replaced", "message"),
    [
        ({"--sources": "12"}, "exposure 3, detector DET22: source 12 has no light on the detector"),
        ({"--exposure": "99"}, "table products has no detector DET22 of exposure 99"),
        ({"--exposure": "6"}, "exposure 6: NISP-S dark is no image of spectra"),
        ({"--out": "models.txt"}, "must end in .fits"),
    ],
)
def test_invalid_models_are_refused_in_one_line(rendered, tmp_path, capsys, replaced, message):
    options = {"--lake": rendered, "--exposure": 3, "--detector": "DET22", "--sources": 1, "--out": "models.fits"}
    options |= replaced
    options["--out"] = tmp_path / options["--out"]
    assert models.main([str(text) for pair in options.items() for text in pair]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert line.startswith("models: ")
    assert message in line
    assert list(tmp_path.iterdir()) == []


def test_grism_files_of_an_exposure_agree_with_its_spectra(rendered, tmp_path, capsys):
    """Traces and the wheel error agree; exposures without spectra give a one-line error and no file."""
    arguments = ["export", "grisms", str(rendered), "--out", str(tmp_path / "new"), "--exposure"]
    for number, message in ((99, "no exposure 99"), (6, "exposure 6: NISP-S dark is no image of spectra")):
        assert commands.main([*arguments, str(number)]) == 2
        assert message in capsys.readouterr().err
        assert not (tmp_path / "new").exists()
    assert commands.main([*arguments, "3"]) == 0
    found = grismconf.Config(str(tmp_path / "new" / "RGS000_000003_DET22.conf"))
    here = (pc.field("exposure_id") == 3) & (pc.field("detector") == "DET22")
    places = {row["id"]: row for row in read.version(rendered, "rendered_truth").rows(where=here).to_pylist()}
    rows = read.version(rendered, "rendered_spectra").rows(where=here).to_pylist()
    assert 1 in {row["order"] for row in rows}
    for row in rows:
        name, place = f"{row['order']:+d}" if row["order"] else "0", (places[row["id"]]["x"], places[row["id"]]["y"])
        for axis, displaced in (("x", found.DISPX), ("y", found.DISPY)):
            ends = [place["xy".index(axis)] + float(displaced(name, *place, t)) for t in (0.0, 1.0)]
            assert ends == pytest.approx([row[f"{axis}_first"], row[f"{axis}_last"]], abs=0.01)


def test_masters_from_dark_and_flat(rendered, folder, capsys):
    """They have the ramp of the spectra; the lake does not change."""
    before = sorted(path for path in rendered.rglob("*") if path.is_file())
    assert masters.main(["--lake", str(rendered), "--out", str(folder / "masters")]) == 0
    dark, flat, bad = (line.split(": ") for line in capsys.readouterr().out.strip().splitlines())
    assert Path(bad[0]).name == "NISP_DET22_bad_pixels.fits"
    assert Path(dark[0]).name == "NISP-S_15-16-11_DET22_dark.fits"
    assert Path(flat[0]).name == "NISP-S_nisp_red_DET22_flat.fits"
    assert float(re.search(r"median (\S+),", dark[1])[1]) == pytest.approx(0.02, abs=0.005)
    assert float(re.search(r"median (\S+),", flat[1])[1]) == pytest.approx(1.0, abs=0.005)
    assert sorted(path for path in rendered.rglob("*") if path.is_file()) == before


def test_fluxes_for_source_selection_are_computed(rendered, folder):
    """Fluxes in H are computed although no exposure is taken in H."""
    assert wanted(folder).bands == ("nisp_red", "nisp_blue", "euclid_h")
    assert "f_nu_euclid_h" in read.version(rendered, "star_fluxes").schema.names


@pytest.mark.parametrize(
    ("replaced", "message"),
    [
        (("grism_angle = 184.0", "grism_angle = 90.0"), r"pointing\[1\]\.grism_angle = 90 deg tilts RGS000, RGS180"),
        (("grism_angle = -4.0", "grism_angle = nan"), r"pointing\[2\]\.grism_angle"),
        ((BLUE, PHOTOMETRIC), r"pointing\[4\]\.grism_angle: must not be set in euclid_h"),
    ],
)
def test_invalid_grism_angles_are_refused_in_one_line(tmp_path, lake, replaced, message):
    with pytest.raises(BadInput, match=message) as caught:
        made(lake, wanted(tmp_path, replaced=replaced), (plan_exposures,))
    assert "\n" not in str(caught.value)
    assert list(lake.rglob("*.parquet")) == []


def test_a_table_of_pointings_selects_grisms_by_angle(tmp_path):
    (tmp_path / "some.csv").write_text("ra,dec,mjd,band,grism_angle\n53.117,-27.808,60905.0,nisp_red,184\n")
    block = '[[observation]]\nchannels = ["NISP-S"]\npointings = "some.csv"\n'
    request = parse(requests.written(tmp_path, block, requests.FIELD.format(1.0)))
    _, exposures, _ = plan_exposures.plan(None, request)
    (row,) = exposures.to_pylist()
    assert (row["grism"], row["grism_angle"]) == ("RGS180", 184.0)
    assert request.bands == ("nisp_red", "euclid_h")
