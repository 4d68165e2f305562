"""Polynomials of ghosts: the table of VIS is that of its script, and ghosts that leave the focal plane are refused."""

import numpy as np
import pytest

from lake_schema.errors import BadInput
from lake_schema.mission import checks, ghost_offsets
from lake_schema.mission.configuration import MissionConfiguration, resolve
from scripts import trace_ghosts
from truesky.request.from_toml import from_table

MISSION = resolve()
BASE = {"name": "x", "seed": 7, "area": {"cone": {"ra": 150.0, "dec": 20.0, "radius": 0.5}}}
VIS = ("vis", "ghost")


class Other(MissionConfiguration):
    """Configuration with another table of the ghosts of VIS."""

    def numbers(self, key):
        return self.table if key == "vis.ghost.offsets" else super().numbers(key)


def with_table(table):
    mission = Other(MISSION.parameters, models=MISSION.models)
    object.__setattr__(mission, "table", table)
    return mission


def test_the_table_is_that_of_the_script():
    """If this fails, run: python -m scripts.trace_ghosts, and update the checksum in models.csv"""
    assert trace_ghosts.TABLE.read_text(encoding="utf-8") == trace_ghosts.text(MISSION)


def test_a_plate_displaces_the_middle_as_published():
    """750 pixels in the middle of the field (Niemi 2015), and twice as much in the second order."""
    for order in ghost_offsets.orders(MISSION, *VIS):
        np.testing.assert_allclose(ghost_offsets.offset(MISSION, VIS, order, 0.0, 0.0), (0.0, 750.0 * order))
    # A plate of 19.897 mm with the sine of the angle of incidence s: t sin 2a / sqrt(n^2 - s^2).
    angle = trace_ghosts.tilt_of(9.0, 19.897)
    assert 19.897 * np.sin(2 * angle) / np.sqrt(1.45**2 - np.sin(angle) ** 2) == pytest.approx(9.0, rel=1e-9)


def test_polynomials_are_sums_of_powers():
    mission = with_table(((1.0, 0.0, 0.0, 0.0, 1.0), (1.0, 2.0, 1.0, 0.5, -0.25), (3.0, 0.0, 1.0, 2.0, 0.0)))
    assert ghost_offsets.orders(mission, *VIS) == (1, 3)
    x, y = np.array([0.2, -0.3]), np.array([0.1, 0.4])
    np.testing.assert_allclose(ghost_offsets.offset(mission, VIS, 1, x, y)[0], 750.0 * 0.5 * x**2 * y)
    np.testing.assert_allclose(ghost_offsets.offset(mission, VIS, 1, x, y)[1], 750.0 * (1.0 - 0.25 * x**2 * y))
    np.testing.assert_allclose(ghost_offsets.offset(mission, VIS, 3, x, y)[0], 750.0 * 2.0 * y)


def test_a_plate_without_table_has_one_order_and_one_offset():
    for plate, shift in (("ghost", 250.0), ("filter_ghost", -60.0)):
        assert ghost_offsets.orders(MISSION, "nisp", plate) == (1,)
        dx, dy = ghost_offsets.offset(MISSION, ("nisp", plate), 1, np.array([0.0, 0.3]), np.array([0.0, -0.3]))
        assert (dx.tolist(), dy.tolist()) == ([0.0, 0.0], [shift, shift])


@pytest.mark.parametrize(
    ("table", "words"),
    [
        (((1.0, 0.0, 0.0, 0.0, 1.0), (1.0, 3.0, 0.0, 500.0, 0.0)), "order 1 of a star at x = -0.35, y = -0.39 deg"),
        (((1.0, 0.0, 0.0, 0.0, 1.0), (2.0, 0.0, 0.0, 0.0, -20.0)), "order 2 .* by 0 and 15000 pixels"),
        (((1.0, 1.0, 0.0, np.nan, 1.0),), "order 1 .* by nan and"),
    ],
)
def test_a_polynomial_that_leaves_the_focal_plane_is_named(table, words):
    with pytest.raises(BadInput, match=rf"^mission parameter vis\.ghost\.offset_y: .*{words}.*leaves the focal plane"):
        checks.check(with_table(table))


@pytest.mark.parametrize("key", ["vis.ghost.offset_y", "nisp.ghost.offset_y", "nisp.filter_ghost.offset_y"])
def test_an_offset_of_a_request_that_leaves_the_focal_plane_is_one_line(key):
    """The focal planes are about 25,000 and 8,700 pixels wide."""
    overrides = {"mission": {"overrides": {key: {"value": 16_000.0, "unit": "pix"}}}}
    with pytest.raises(BadInput, match=rf"^mission: mission parameter {key}: .*leaves the focal plane.*$") as raised:
        from_table({**BASE, **overrides})
    assert len(raised.value.messages) == 1
    with pytest.raises(BadInput, match=rf"^explore\.{key}: .*leaves the focal plane"):
        from_table({**BASE, "explore": {key: {"values": [100.0, 16_000.0], "unit": "pix"}}})
    overrides["mission"]["overrides"][key]["value"] = -1000.0
    from_table({**BASE, **overrides})
