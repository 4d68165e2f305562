"""User fields: the pointing is as requested, and the area in the error message is large enough."""

import re
import tomllib
from functools import cache

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.tables.exposures import ExposureRow
from tests.house.test_names import ROOT
from tests.truesky import nightly
from truesky.commands import plan
from truesky.render import plan_exposures
from truesky.render.channels import level1
from truesky.request.area import parse
from truesky.request.exposures import pointing_tables
from truesky.request.from_toml import from_table

BASE = {"name": "x", "seed": 7}


def made(block, area=(0.0, 0.0, 1.0)):
    cone = dict(zip(("ra", "dec", "radius"), area, strict=True))
    return from_table({**BASE, "area": {"cone": cone}, "observation": [block]})


PLACES = [(0.0, 35.0), (359.9999, -35.0), (10.0, 90.0), (200.0, -90.0), (123.0, 89.99), (150.1, 2.2)]


def one_visit(ra, dec, angle):
    """Rows of `exposures` and `tasks` of a field with one exposure."""
    block = {"channels": ["VIS"], "ra": ra, "dec": dec, "position_angle": angle, "dither": "none"}
    return plan_exposures.plan(None, made({**block, "flat": False, "short": False}))[1:]


@cache
def upright(ra, dec):
    """Rows of `tasks` of a field with position angle 0, the reference for all angles."""
    return one_visit(ra, dec, 0.0)[1]


def test_observations_at_own_positions_have_different_numbers():
    """The second observation has the field number 2 and the same exposures as without the first one."""
    blocks = [
        {"channels": ["VIS"], "ra": ra, "dec": 5.0, "flat": False, "short": False, "visits": 2} for ra in (20.0, 24.0)
    ]
    cone = {"ra": 22.0, "dec": 5.0, "radius": 4.0}
    both, second = (
        plan_exposures.plan(None, from_table({**BASE, "area": {"cone": cone}, "observation": chosen}))[1].to_pylist()
        for chosen in (blocks, blocks[1:])
    )
    rows = [ExposureRow.from_row(row) for row in both]
    assert [(row.field, row.visit) for row in rows[::4]] == [(1, 1), (1, 2), (2, 1), (2, 2)]
    assert len({level1.observation(row) for row in rows}) == 4
    assert len({(level1.observation(row), row.dither) for row in rows}) == len(rows) == 16
    for name in ("ra", "dec", "mjd", "position_angle", "visit", "dither"):
        assert [row[name] for row in both[8:]] == [row[name] for row in second], name


@pytest.mark.parametrize(("ra", "dec"), PLACES)
@nightly.parametrize("angle", [0.0, 359.999, -180.0], (1,))
def test_a_field_is_centred_on_the_requested_position(ra, dec, angle):
    exposures, rows = one_visit(ra, dec, angle)
    (row,) = exposures.to_pylist()
    assert float(sky.separation(row["ra"], row["dec"], ra, dec)) < 1e-9
    assert (row["position_angle"] - angle + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-9)
    # The detectors surround the centre, and the y axis has the requested angle.
    east, north = offsets(rows["ra"].to_numpy(), rows["dec"].to_numpy(), row["ra"], dec)
    assert np.abs([east.mean(), north.mean()]).max() < 0.02
    other = upright(ra, dec)
    east0, north0 = offsets(other["ra"].to_numpy(), other["dec"].to_numpy(), row["ra"], dec)
    turn = np.radians(angle)
    order, order0 = np.argsort(rows["detector"].to_numpy()), np.argsort(other["detector"].to_numpy())
    np.testing.assert_allclose(east[order], (np.cos(turn) * east0 + np.sin(turn) * north0)[order0], atol=2e-6)
    np.testing.assert_allclose(north[order], (np.cos(turn) * north0 - np.sin(turn) * east0)[order0], atol=2e-6)


def offsets(ra, dec, ra0, dec0):
    """Offsets in deg, east and north on the tangent plane."""
    a, d, d0 = np.radians(ra - ra0), np.radians(dec), np.radians(dec0)
    out = np.sin(d) * np.sin(d0) + np.cos(d) * np.cos(d0) * np.cos(a)
    return (
        np.degrees(np.cos(d) * np.sin(a) / out),
        np.degrees((np.sin(d) * np.cos(d0) - np.cos(d) * np.sin(d0) * np.cos(a)) / out),
    )


@nightly.parametrize(("ra", "dec"), PLACES, (0, 2))
def test_area_in_the_error_message_is_large_enough(ra, dec):
    block = {"channels": ["VIS"], "ra": ra, "dec": dec}
    with pytest.raises(BadInput, match="this area is large enough") as refused:
        plan.check(made(block, ((ra + 180.0) % 360.0, -dec / 2, 0.1)))
    area = tomllib.loads(re.search(r"large enough: (.*)", str(refused.value))[1])["area"]
    plan.check(from_table({**BASE, "area": area, "observation": [block]}))
    # The area is not much larger than the field of view.
    assert area["cone"]["radius"] < 0.8


def test_distant_fields_give_several_circles():
    blocks = [{"channels": ["VIS"], "ra": ra, "dec": -45.0} for ra in (10.0, 60.0)]
    elsewhere = {"cone": {"ra": 0.0, "dec": 0.0, "radius": 1.0}}
    with pytest.raises(BadInput, match="this area is large enough") as refused:
        plan.check(from_table({**BASE, "area": elsewhere, "observation": blocks}))
    area = tomllib.loads(re.search(r"large enough: (.*)", str(refused.value))[1])["area"]
    assert np.array(area["patches"]) == pytest.approx(np.array([[10, -45, 0.65], [60, -45, 0.65]]), abs=0.15)


def test_user_offsets_are_not_changed():
    block = {"channels": ["VIS"], "ra": 150.0, "dec": 0.0, "position_angle": 90.0, "short": False, "flat": False}
    _, exposures, _ = plan_exposures.plan(None, made({**block, "dither": [[0, 0], [36.0, 0.0], [0.0, 72.0]]}))
    east, north = offsets(exposures["ra"].to_numpy(), exposures["dec"].to_numpy(), 150.0, 0.0)
    # The y axis points to the east, x to the north.
    np.testing.assert_allclose(3600 * east, [0, 0, 72], atol=1e-3)
    np.testing.assert_allclose(3600 * north, [0, 36, 0], atol=1e-3)


def test_visits_without_a_date_satisfy_the_sun_constraint():
    _, exposures, _ = plan_exposures.plan(None, made({"channels": ["VIS"], "ra": 150.0, "dec": 0.0, "visits": 3}))
    assert set(exposures["visit"].to_pylist()) == {1, 2, 3}
    starts = [min(r["mjd"] for r in exposures.to_pylist() if r["visit"] == v) for v in (1, 2, 3)]
    assert (np.diff(starts) >= 0.04).all()


@nightly.parametrize(
    ("ra", "inside", "outside"), [([350, 10], [355.0, 5.0, 0.0], [15.0, 180.0]), ([-10, 10], [355.0], [20.0])], (1,)
)
def test_a_box_may_cross_zero(ra, inside, outside):
    area = parse({"box": {"ra": ra, "dec": [-5, 5]}})
    assert area.contains(inside, np.zeros(len(inside))).all()
    assert not area.contains(outside, np.zeros(len(outside))).any()
    assert set(sky.cell_at(inside, np.zeros(len(inside)), 8)) <= set(area.cells())


def test_a_table_s_columns_have_their_defaults(tmp_path):
    (tmp_path / "p.csv").write_text("ra,dec\n150.1,2.2\n")
    block = {"channels": ["VIS"], "pointings": "p.csv", "mjd": 61000.0}
    request = from_table({**BASE, "area": {"tile": 1}, "observation": [block]}, tmp_path)
    assert request.bands == ("euclid_vis",)
    _, exposures, _ = plan_exposures.plan(None, request)
    (row,) = exposures.to_pylist()
    assert (row["camera"], row["band"], row["mjd"], row["image_type"]) == ("vis", "euclid_vis", 61000.0, "science")
    assert row["exposure_time_s"] == 560.53
    (tmp_path / "p.csv").write_text("ra,dec\n150.2,2.2\n")
    changed = from_table({**BASE, "area": {"tile": 1}, "observation": [block]}, tmp_path)
    assert changed.facts("observations") != request.facts("observations")


def test_the_page_lists_every_column():
    page = (ROOT / "docs" / "own_field.md").read_text()
    for name, unit, doc, default in pointing_tables.COLUMNS:
        assert f"| `{name}` | {unit} | {doc} | {default or 'none: must be there'} |" in page
