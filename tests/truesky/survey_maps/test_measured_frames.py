"""The table `measured_frames` of a lake with rendered frames of small detectors, and depth maps with its values."""

import shutil
from collections import Counter
from dataclasses import replace

import numpy as np
import pyarrow.compute as pc
import pytest

from lake_schema import sky
from lake_schema.errors import TasksFailed
from lake_schema.fits import images
from lake_schema.store import layout, publish, read
from lake_schema.tables.survey.depth import BOTH, EDGE, MEASURED, ORDER, PLANNED, SATELLITE, SATURATED
from tests import requests
from tests.truesky.render.test_render_exposures_calibration import small_detectors
from truesky.catalogue import build_galaxies, build_stars
from truesky.fluxes import compute_fluxes
from truesky.render import plan_exposures, render_exposures
from truesky.render.camera import astrometry, detectors
from truesky.render.products import read_back
from truesky.request.from_toml import parse
from truesky.survey_maps import build_depth, measured_frames, planned_footprints, psf_sizes

from . import planned

SIDE = 512
# Trails per second and degree: one crosses the small detector of the first exposure of LSSTCam.
RATE = 1.0
SHIFT = 60.0 / 3600.0
REQUEST = f"""
accuracy = "draft"
[sources]
only = "table"
band = "lsst_r"
stars = "stars.csv"
[mission.overrides]
"survey.satellites.rate" = {{ value = {RATE}, unit = "1 / (deg s)" }}
[products]
truth = ["cosmic_rays", "satellites"]
"""
# The second LSSTCam exposure observes nearly the same place with another detector.
POINTINGS = (
    ("NISP-P", "nisp", "euclid_j", "DET22", 0.0, 60905.0),
    ("EXT", "lsstcam", "lsst_r", "R22_S11", 0.0, 60905.25),
    ("EXT", "lsstcam", "lsst_r", "R22_S12", SHIFT, 60905.26),
)
RENDERED = ("DET22", "R22_S11")


def wanted(folder, pointings=POINTINGS):
    """Return a request with pointings, of which only the detectors `RENDERED` are to be rendered."""
    (folder / "stars.csv").write_text(f"ra,dec,mag\n{planned.RA},{planned.DEC},14.0\n")
    more = REQUEST
    for channel, camera, band, name, shift, mjd in pointings:
        more += f'[[pointing]]\nchannel = "{channel}"\ncamera = "{camera}"\nband = "{band}"\nra = {planned.RA}\n'
        more += f'dec = {planned.DEC + shift}\ncentre_on = "{name}"\ndetectors = ["{name}"]\nmjd = {mjd}\n'
        more += "position_angle = 0.0\n"
    return parse(requests.written(folder, more, requests.FIELD.format(2.5), seed=3))


def make(lake, request, *jobs, fail=(), skip=()):
    """Run jobs in this process, and count the calls for each frame.

    Frames of detectors in `fail` cannot be read, and tables in `skip` are not made.
    """
    calls = Counter()
    for job in jobs:
        for step in job.steps(lake, request):
            if step.plan.table.name in skip:
                continue

            def work(root, facts, run=step.run_task):
                if run is measured_frames.measure_frame:
                    calls[facts["part"]] += 1
                    if any(name.lower() in facts["part"] for name in fail):
                        raise ValueError("killed")
                return run(root, facts)

            publish.make_version(lake, step.plan, work, name=request.name)
    return calls


@pytest.fixture(scope="module", autouse=True)
def _small():
    planned_footprints.read_part.cache_clear()
    listed = detectors._read_layout

    def smaller(section, mission):
        return tuple(replace(d, nx=SIDE, ny=SIDE + d.injection_rows) for d in listed(section, mission))

    # One is for Euclid, the other for ground cameras.
    with small_detectors(SIDE), pytest.MonkeyPatch.context() as patch:
        patch.setattr(detectors, "_read_layout", smaller)
        for name in ("in_field", "in_air"):
            patch.setattr(psf_sizes, name, globals()[f"_{name}"])
        yield
    planned_footprints.read_part.cache_clear()


def _in_field(exposure, band, mission, seed):
    return {name: planned.SIZES for name in RENDERED}


def _in_air(exposures, ranges, band, mission):
    return np.full(len(exposures), 2.0), np.full(len(exposures), 0.8)


@pytest.fixture(scope="module")
def once(tmp_path_factory):
    """Return a folder with a lake, the rows of its depth map before anything was rendered, and its request."""
    folder = tmp_path_factory.mktemp("measured")
    lake, request = layout.resolve_lake(folder / "lake"), wanted(folder)
    make(lake, request, build_galaxies, build_stars, compute_fluxes, plan_exposures, build_depth)
    before = read.version(lake, "depth", request=request.name).rows()
    assert "measured_frames" not in layout.table_names(lake)
    make(lake, replace(request, detectors=RENDERED), render_exposures)
    return lake, before, request


@pytest.fixture(scope="module")
def measured(once):
    lake, _, request = once
    make(lake, request, build_depth)
    return lake


@pytest.fixture
def copied(once, tmp_path):
    """Return a copy of the lake with frames, and its request."""
    lake, _, request = once
    copy = layout.resolve_lake(shutil.copytree(lake, tmp_path / "lake", symlinks=True))
    for name in ("depth", "measured_frames"):
        shutil.rmtree(copy / name, ignore_errors=True)
    return copy, request


def band_rows(version, band):
    rows = version.rows()
    return rows.filter(pc.equal(rows["band"], band))


def test_sky_and_noise_are_those_of_the_plan(measured):
    """The sky agrees within 1 % with that of the plan, and the noise within 2 %: 1e5 pixels, and light of a star.

    sample: 2 frames of 262,144 pixels. significance: 5 sigma
    """
    rows = read.version(measured, "measured_frames").rows().to_pylist()
    assert sorted(row["detector"] for row in rows) == sorted(RENDERED)
    for row in rows:
        assert row["sky"] == pytest.approx(row["planned_sky"], rel=0.01)
        assert row["variance"] == pytest.approx(row["planned_variance"], rel=0.04)
        assert 0.9 < row["good"] <= 1.0
        assert row["blank"] > 20_000


def test_the_origin_tells_what_was_measured(measured):
    version = read.version(measured, "depth")
    assert set(band_rows(version, "euclid_j")["origin"].to_pylist()) == {MEASURED}
    ground = band_rows(version, "lsst_r")
    origin, exposures = ground["origin"].to_numpy(), ground["exposures"].to_numpy()
    assert set(origin.tolist()) == {PLANNED, MEASURED, BOTH}
    np.testing.assert_array_equal(origin == BOTH, exposures == 2)


def test_planned_rows_keep_their_values_and_measured_depths_are_close(measured, once):
    _, before, _ = once
    after = read.version(measured, "depth").rows()
    planned_only = pc.equal(after["origin"], PLANNED)
    assert after.filter(planned_only).to_pylist() == before.filter(planned_only).to_pylist()
    assert 0 < planned_only.to_numpy().sum() < len(after)
    change = after["depth_point"].to_numpy() - before["depth_point"].to_numpy()
    assert 0.0 < np.abs(change).max() < 0.05
    for name in ("pixel", "band", "exposures", "exposure_time_s", "seeing", "covered", "a_v"):
        assert after[name].equals(before[name]), name


def test_the_depth_is_that_of_the_measured_variance(measured, once):
    """1.25 log10(planned variance / measured variance x good fraction), with rows of one exposure."""
    _, before, _ = once
    after = read.version(measured, "depth").rows()
    (frame,) = (
        row for row in read.version(measured, "measured_frames").rows().to_pylist() if row["detector"] == "R22_S11"
    )
    chosen = pc.and_(pc.equal(after["band"], "lsst_r"), pc.equal(after["origin"], MEASURED))
    change = after.filter(chosen)["depth_point"].to_numpy() - before.filter(chosen)["depth_point"].to_numpy()
    expected = 1.25 * np.log10(frame["planned_variance"] / frame["variance"] * frame["good"])
    assert change == pytest.approx(np.full(len(change), expected), abs=2e-3)


def test_a_saturated_star_has_its_bit(measured):
    rows = band_rows(read.version(measured, "depth"), "lsst_r")
    saturated = rows["pixel"].to_numpy()[(rows["mask"].to_numpy() & SATURATED) != 0]
    assert sky.cell_at([planned.RA], [planned.DEC], ORDER)[0] in saturated


def truth_pixels(lake, detector):
    """Return the map pixels with light of satellites above 0.1 times the noise, from the truth map of a frame."""
    products = read.version(lake, "products")
    rows = products.rows().to_pylist()
    (row,) = (row for row in rows if row["detector"] == detector and row["content"] == "satellites")
    path = read_back.image_file(products, row["path"])
    (noise,) = (
        np.sqrt(row["planned_variance"])
        for row in read.version(lake, "measured_frames").rows().to_pylist()
        if row["detector"] == detector
    )
    y, x = np.nonzero(np.asarray(images.read_images(path)[0].data) > 0.1 * noise)
    assert len(x) > 100
    system = astrometry.from_cards(read_back.header(path))
    return np.unique(sky.cell_at(*astrometry.sky_of_pixel(system, x, y), ORDER))


def test_trails_of_satellites_are_where_they_were_drawn(measured):
    """Map pixels with light of a trail have the bit, and others only next to them.

    Inside the exposure that was rendered: the other exposure has other trails.
    """
    rows = band_rows(read.version(measured, "depth"), "lsst_r")
    rows = rows.filter(pc.equal(rows["origin"], MEASURED))
    pixel, mask = rows["pixel"].to_numpy(), rows["mask"].to_numpy()
    truth = truth_pixels(measured, "R22_S11")
    has_bit, has_light = (mask & SATELLITE) != 0, np.isin(pixel, truth)
    assert has_bit[has_light].all()
    assert has_light.sum() > 3
    ra, dec = sky.cell_centres(ORDER, pixel)
    ra_light, dec_light = sky.cell_centres(ORDER, truth)
    for i in np.flatnonzero(has_bit & ~has_light & ((mask & EDGE) == 0)):
        assert sky.separation(ra[i], dec[i], ra_light, dec_light).min() * 3600.0 < 20.0
    assert not has_bit.all()


def test_a_plan_without_images_has_the_same_trails(measured, once):
    _, before, _ = once
    after = read.version(measured, "depth").rows()
    bits = [rows["mask"].to_numpy() & SATELLITE for rows in (before, after)]
    np.testing.assert_array_equal(*bits)


def test_an_interrupted_measurement_continues_with_the_same_bytes(measured, copied):
    """Only the frame that failed is measured in the next run."""
    lake, request = copied
    with pytest.raises(TasksFailed, match=r"table measured_frames: 1 of 2 tasks failed: .*ValueError: killed"):
        make(lake, request, build_depth, fail=["DET22"])
    calls = make(lake, request, build_depth, skip=["depth"])
    assert sum(calls.values()) == 1
    again, first = (read.version(root, "measured_frames") for root in (lake, measured))
    assert again.fingerprint == first.fingerprint


def test_frames_that_were_measured_are_not_measured_again(measured, once, tmp_path):
    lake = layout.resolve_lake(shutil.copytree(measured, tmp_path / "lake", symlinks=True))
    *_, request = once
    make(lake, replace(request, detectors=("R22_S12",)), render_exposures)
    calls = make(lake, request, build_depth, skip=["depth"])
    assert [name for name, number in calls.items() if number] == ["000003-r22_s12.parquet"]
    assert read.version(lake, "measured_frames").num_rows == 3


def test_a_damaged_frame_is_named(copied):
    lake, request = copied
    products = read.version(lake, "products")
    (row,) = (r for r in products.rows().to_pylist() if r["detector"] == "DET22" and r["content"] == "science")
    path = products.folder / row["path"]
    content = bytearray(path.read_bytes())
    content[-3000] ^= 1
    path.unlink()
    path.write_bytes(content)
    with pytest.raises(TasksFailed, match=r"1 of 2 tasks failed: 000001-det22.*DET22.*has other contents than the"):
        make(lake, request, build_depth)


def test_frames_of_an_older_plan_are_not_measured(copied, tmp_path, capsys):
    lake, request = copied
    (step, _) = build_depth.steps(lake, request)
    assert step.plan.table.name == "measured_frames"
    later = wanted(tmp_path, [(*pointing[:-1], pointing[-1] + 1.0) for pointing in POINTINGS])
    make(lake, later, plan_exposures)
    capsys.readouterr()
    (step,) = build_depth.steps(lake, later)
    assert step.plan.table.name == "depth"
    assert "measured_frames" not in step.plan.facts
    assert "were rendered from another plan or with other settings and are not measured" in capsys.readouterr().err
    (step,) = build_depth.steps(lake, replace(request, noise_seed=99))
    assert step.plan.table.name == "depth"
    assert "with other settings and are not measured" in capsys.readouterr().err
