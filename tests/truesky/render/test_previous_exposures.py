"""Charge maps in memory: the limit, what is removed first, and the setting."""

import pickle

import numpy as np
import pytest

from lake_schema.errors import BadInput
from tests.truesky.render import fields
from truesky.render.previous_exposures import ChargeMaps

# Size of a map of the tests, MB.
SIDE = 500
SIZE = 4e-6 * SIDE**2


class Drawings:
    """Draw maps through a memory of some maps, and record which exposures were drawn."""

    def __init__(self, maps):
        self.charge_maps, self.drawn = ChargeMaps(maps * SIZE), []

    def get(self, number, detector="DET22"):
        def draw():
            self.drawn.append((number, detector))
            return np.full((SIDE, SIDE), number, np.float32)

        row = fields.exposure(exposure_id=number, mjd=60905.0 + 0.01 * number)
        charge = self.charge_maps.get(row, detector, draw)
        assert (charge == number).all()
        assert self.charge_maps.megabytes <= self.charge_maps.limit_mb
        return charge


def test_a_map_is_drawn_once():
    maps = Drawings(3)
    assert maps.get(1) is maps.get(1)
    assert maps.get(1) is not maps.get(1, "DET23")
    assert maps.drawn == [(1, "DET22"), (1, "DET23")]
    with pytest.raises(ValueError, match="read-only"):
        maps.get(1)[0, 0] = 7.0


def test_the_earliest_maps_are_removed_first():
    """Exposures in order of time, each with three earlier ones: each map is drawn once, even in memory for two."""
    maps = Drawings(2)
    for now in range(8):
        for number in range(max(now - 3, 0), now):
            maps.get(number)
    assert maps.drawn == [(number, "DET22") for number in range(7)]
    # In memory for one, the latest map is kept, and two are drawn each time.
    maps = Drawings(1)
    for now in range(3, 8):
        for number in range(now - 3, now):
            maps.get(number)
    assert len(maps.drawn) == 3 + 4 * 2


def test_maps_of_other_detectors_are_removed_before():
    maps = Drawings(3)
    for number in (5, 6, 7):
        maps.get(number)
    for number in (1, 2, 3):
        maps.get(number, "DET11")
    maps.drawn.clear()
    for number in (1, 2, 3):
        maps.get(number, "DET11")
    assert maps.drawn == []


@pytest.mark.parametrize("maps", [0, 0.9])
def test_too_little_memory_keeps_nothing(maps):
    small = Drawings(maps)
    small.get(1)
    small.get(1)
    assert len(small.drawn) == 2
    assert small.charge_maps.megabytes == 0.0


def test_a_copy_for_a_worker_has_the_limit_but_no_maps():
    maps = Drawings(3)
    maps.get(1)
    copy = pickle.loads(pickle.dumps(maps.charge_maps))
    assert (copy.limit_mb, copy.megabytes) == (3 * SIZE, 0.0)


def test_the_limit_is_a_setting(monkeypatch):
    monkeypatch.delenv("TRUESKY_CHARGE_MAPS", raising=False)
    assert ChargeMaps.from_environment().limit_mb == 500.0
    for text, limit in (("", 500.0), ("0", 0.0), (" 120.5 ", 120.5), ("inf", np.inf)):
        monkeypatch.setenv("TRUESKY_CHARGE_MAPS", text)
        assert ChargeMaps.from_environment().limit_mb == limit
    for text in ("-1", "nan", "many", "1 GB"):
        monkeypatch.setenv("TRUESKY_CHARGE_MAPS", text)
        said = rf"^\$TRUESKY_CHARGE_MAPS = '{text}' must be a number of MB >= 0 \(0: keep no charge maps\)$"
        with pytest.raises(BadInput, match=said):
            ChargeMaps.from_environment()
