"""The table `depth` of a small plan, against depths that are computed for one position with the plan's rows."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.store import read
from lake_schema.tables.exposures import ExposureRow
from lake_schema.tables.survey.depth import BRIGHT_STAR, DEPTH, EDGE, ORDER
from tests import hats_readers
from truesky.commands import __main__ as commands
from truesky.render.camera import footprints
from truesky.survey_maps import build_depth, planned_footprints
from truesky.survey_maps.depth_lookup import choose_bands, read_blocks, read_depth_map

from . import planned


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """Return a lake with a plan and its depth map."""
    root = tmp_path_factory.mktemp("lake")
    planned.depth(root, planned.request())
    return root


@pytest.fixture
def version(lake):
    return read.version(lake, "depth")


def test_counts_are_those_of_the_footprints(lake, version):
    """A pixel whose centre is in n footprints has at least n exposures, and exactly n away from edges."""
    rows = version.rows()
    exposures, tasks = (read.version(lake, name).rows() for name in ("exposures", "tasks"))
    for band in ("euclid_vis", "euclid_j", "lsst_r"):
        numbers = [row["exposure_id"] for row in exposures.to_pylist() if row["band"] == band]
        chosen = tasks.filter([number in numbers for number in tasks["exposure_id"].to_pylist()])
        of_band = rows.filter([name == band for name in rows["band"].to_pylist()])
        counts = footprints.counts(chosen, *sky.cell_centres(ORDER, of_band["pixel"].to_numpy()))
        inner = (of_band["mask"].to_numpy() & EDGE) == 0
        np.testing.assert_array_equal(of_band["exposures"].to_numpy()[inner], counts[inner])
        assert (of_band["exposures"].to_numpy() >= counts).all()
        assert inner.mean() > 0.7


def test_the_depth_is_that_of_the_formula(lake, version):
    """One exposure: 5 sigma = 5 sqrt(A (sky t + dark t + r^2)) with the noise-equivalent pixels A, within 0.01 mag."""
    (exposure,) = (row for row in read.version(lake, "exposures").rows().to_pylist() if row["band"] == "lsst_r")
    depth = read_depth_map(version, "lsst_r", ["depth_point", "depth_aperture", "psf_area", "sky"])
    row = depth.rows_at(planned.RA, planned.DEC)
    values = {name: float(column[row]) for name, column in depth.columns.items()}
    assert values["sky"] == pytest.approx(exposure["sky"], rel=0.01)
    t = exposure["exposure_time_s"]
    # LSSTCam: 0.2 arcsec per pixel; dark current and read noise are small beside the sky of 30 s.
    for name, area in (("depth_point", values["psf_area"]), ("depth_aperture", np.pi)):
        noise = np.sqrt(area / 0.04 * (exposure["sky"] * t + 36.0))
        expected = exposure["zero_point"] - 2.5 * np.log10(5.0 * noise / t)
        assert values[name] == pytest.approx(expected, abs=0.01)


def test_two_equal_exposures_are_deeper_by_0_376_mag(version):
    depth = read_depth_map(version, "euclid_vis", ["depth_point", "exposures", "covered", "exposure_time_s"])
    whole = depth.columns["covered"] == 1.0
    by_count = {n: np.median(depth.columns["depth_point"][whole & (depth.columns["exposures"] == n)]) for n in (1, 2)}
    assert by_count[2] - by_count[1] == pytest.approx(1.25 * np.log10(2.0), abs=0.02)


def test_positions_outside_have_no_depth(version):
    depth = read_depth_map(version, "lsst_r", ["depth_point"])
    assert depth.rows_at([planned.RA, 10.0], [planned.DEC, -40.0]).tolist()[1] == -1
    assert choose_bands(version) == ["euclid_j", "euclid_vis", "lsst_r"]
    with pytest.raises(BadInput, match="table depth has no band lsst_u: it has euclid_j"):
        choose_bands(version, ["lsst_u"])
    pixels = np.concatenate([pixels for pixels, _ in read_blocks(version, "lsst_r", "sky")])
    np.testing.assert_array_equal(pixels, depth.pixels)


def test_a_lake_without_a_plan_is_refused(tmp_path):
    with pytest.raises(BadInput, match="has no tables: run truesky run REQUEST"):
        build_depth.steps(tmp_path, planned.request())


def test_an_empty_area_is_refused(tmp_path):
    spectra = planned.pointing("NISP-S", "nisp", "nisp_red", ["DET22"])
    wanted = planned.request([spectra])
    planned.make(tmp_path, wanted)
    with pytest.raises(BadInput, match="has no image of the sky"):
        build_depth.steps(tmp_path, wanted)


def test_short_exposures_count_with_their_weight(tmp_path):
    """The inverse variances of both exposures are summed: 89.5 s add little to 560 s."""
    short = planned.pointing("VIS", "vis", "euclid_vis", ["3-4"], exposure_time_s=89.5, mjd=60905.1)
    columns = ["exposures", "exposure_time_s", "depth_point", "covered"]
    rows = planned.depth(tmp_path, planned.request([planned.POINTINGS[0], short])).rows(columns).to_pandas()
    rows = rows[rows.covered == 1.0]
    depth = rows.groupby("exposures").depth_point.median()
    assert depth.index.tolist() == [1, 2]
    assert 0.0 < depth[2] - depth[1] < 1.25 * np.log10(1.0 + 89.5 / 560.0)
    time = rows.groupby("exposures").exposure_time_s.median()
    assert time[2] - time[1] == pytest.approx(89.5, abs=2.0)


def test_two_cameras_in_a_band_are_refused(lake):
    """Two cameras of the user may have the same band."""
    exposures = [ExposureRow.from_row(row) for row in read.version(lake, "exposures").rows().to_pylist()]
    build_depth._require_one_camera("x", exposures)
    other = [replace(exposure, camera="decam") for exposure in exposures if exposure.band == "lsst_r"]
    with pytest.raises(BadInput, match="x: band lsst_r is observed by decam and lsstcam, but a depth map has one"):
        build_depth._require_one_camera("x", [*exposures, *other])


def test_explored_parameters_are_refused(tmp_path):
    wanted = planned.request([planned.POINTINGS[0]], explore={"effects.ghosts": [True, False]})
    planned.make(tmp_path, wanted)
    with pytest.raises(BadInput, match="explores 2 combinations of parameters"):
        build_depth.steps(tmp_path, wanted)


def test_hats_opens_the_map(lake, version):
    """The version of the table is a HATS map with all rows. It is no collection, which hats would not open."""
    import hats

    assert hats_readers.is_valid(version.folder / "depth")
    assert not version.has_file("collection.properties")
    catalog = hats.read_hats(lake / "depth" / "current" / "depth")
    assert str(catalog.catalog_info.catalog_type) == "map"
    assert catalog.catalog_info.total_rows == version.num_rows
    assert [(p.order, p.pixel) for p in catalog.get_healpix_pixels()] == sorted(
        (5, int(name.split("Npix=")[1].split(".")[0])) for name in version.partitions
    )


def test_the_map_can_be_queried_with_sql(lake, version):
    from truesky.explore.explorer import Explorer

    explorer = Explorer(lake)
    try:
        answer = explorer.sql("SELECT band, count(*) AS pixels FROM depth GROUP BY band ORDER BY band")
    finally:
        explorer.close()
    assert answer["band"].tolist() == ["euclid_j", "euclid_vis", "lsst_r"]
    assert answer["pixels"].sum() == version.num_rows


def test_all_files_of_the_map_are_verified(lake):
    assert commands.main(["verify", str(lake), "depth", "--deep"]) == 0


def test_no_star_is_masked_without_a_catalogue_of_stars(version):
    assert DEPTH.column("mask").hi == 127
    assert not (version.rows(["mask"])["mask"].to_numpy() & BRIGHT_STAR).any()


def test_partitions_do_not_depend_on_what_was_read_before(lake):
    """The rows of a cell are the same if the process starts with it."""
    ground = planned.request(planned.POINTINGS[3:], name="ground")
    planned.make(lake, ground)
    (step,) = build_depth.steps(lake, ground)
    tasks = [{**step.plan.facts, **task.facts} for task in step.plan.tasks]
    first = [step.run_task(lake, facts).rows for facts in tasks]
    planned_footprints.read_part.cache_clear()
    again = [step.run_task(lake, facts).rows for facts in reversed(tasks)][::-1]
    assert all(one.equals(other) for one, other in zip(first, again, strict=True))
