"""The default resolution of the lensing maps follows from the area and the accuracy of a request."""

import math

import pytest

from benchmarks import _lensing
from truesky.request import accuracy, lensing_resolution
from truesky.request.accuracy import DRAFT, QUICKLOOK, REFERENCE, SURVEY
from truesky.request.area import Area
from truesky.request.from_toml import from_table
from truesky.request.schema import LENSING_NSIDES

REQUEST = {"name": "a", "seed": 1}


def cone(square_degrees):
    """Return a circle with this area."""
    return Area(ra=30.0, dec=-20.0, radius=math.degrees(math.acos(1.0 - square_degrees / 41252.96 * 2.0)))


def test_more_area_and_more_accuracy_never_lower_the_resolution():
    sizes = [0.01, 0.1, 0.5, 1.0, 2.0, 5.0, 20.0, 100.0, 1000.0, 15_000.0]
    table = [
        [lensing_resolution.default_nside(cone(size), preset) for size in sizes]
        for preset in (QUICKLOOK, DRAFT, SURVEY, REFERENCE)
    ]
    assert all(row == sorted(row) for row in table)
    assert all(list(column) == sorted(column) for column in zip(*table, strict=True))
    assert {nside for row in table for nside in row} <= set(LENSING_NSIDES)


def test_small_fields_take_seconds_and_surveys_have_all_structure():
    seconds = {int(row["nside"]): row["cpu_s"] for row in lensing_resolution.rows()}
    assert seconds[lensing_resolution.default_nside(cone(1.0), SURVEY)] < 60.0
    for size in (0.05, 1.0):
        assert seconds[lensing_resolution.default_nside(cone(size), DRAFT)] < 40.0
    assert lensing_resolution.default_nside(cone(20.0), SURVEY) == 1024
    assert lensing_resolution.default_nside(Area(wide=True), SURVEY) == 1024


def test_the_error_of_a_default_is_below_the_scatter_between_fields():
    """The error of xi+ for another seed and other positions is also below the scatter, with a factor 1.5."""
    scatter = lensing_resolution.rows()[-1]
    for row in lensing_resolution.rows()[:-1]:
        # The largest area with this resolution.
        size = (2.0 / 3.0 / lensing_resolution.relative_error(row)) ** 2
        assert lensing_resolution.default_nside(cone(0.99 * size), SURVEY) <= row["nside"]
        assert lensing_resolution.default_nside(cone(1.01 * size), SURVEY) > row["nside"]
        for low in _lensing.EDGES[:-1]:
            error = abs(row[f"xi_plus_{low:g}_held"])
            assert error < 1.5 * scatter[f"xi_plus_{low:g}_held"] / math.sqrt(size)


def test_errors_fall_and_costs_grow_with_the_resolution():
    rows = lensing_resolution.rows()
    assert [row["nside"] for row in rows] == [nside for nside in LENSING_NSIDES if nside < 2048]
    for name in ("shear_rms", "shear_rms_held"):
        errors = [row[name] for row in rows[:-1]]
        assert errors == sorted(errors, reverse=True)
        assert errors[0] < rows[-1][name]
    assert [row["cpu_s"] for row in rows] == sorted(row["cpu_s"] for row in rows)
    # 16 source planes of five float32 fields, and their convergence.
    for row in rows:
        assert row["gb"] == pytest.approx(16 * 12 * row["nside"] ** 2 * 6 * 4 / 1e9, rel=0.01)


@pytest.mark.parametrize(
    ("area", "size"),
    [
        ({"cone": {"ra": 10.0, "dec": 80.0, "radius": 2.0}}, 12.565),
        ({"box": {"ra": [359.0, 1.0], "dec": [-1.0, 1.0]}}, 4.0),
        ({"polygon": [[0.0, -1.0], [2.0, -1.0], [2.0, 1.0], [0.0, 1.0]]}, 4.0),
        ({"patches": [[0.0, 0.0, 1.0], [50.0, 0.0, 2.0]]}, 15.71),
        ({"wide": True}, 15_000.0),
    ],
)
def test_areas_have_their_size(area, size):
    assert from_table({**REQUEST, "area": area}).area.square_degrees() == pytest.approx(size, rel=1e-3)


def test_an_octant_has_an_eighth_of_the_sphere():
    octant = Area(vertices=((0.0, 0.0), (90.0, 0.0), (0.0, 90.0)))
    assert octant.square_degrees() == pytest.approx(41252.96 / 8.0, rel=1e-6)


def test_the_request_has_the_default_unless_it_states_a_resolution():
    area = {"cone": {"ra": 0.0, "dec": 0.0, "radius": 0.5}}
    parsed = from_table({**REQUEST, "area": area})
    assert parsed.universe.lensing_nside == lensing_resolution.default_nside(parsed.area, accuracy.SURVEY)
    draft = from_table({**REQUEST, "area": area, "accuracy": "quicklook"})
    assert draft.universe.lensing_nside < parsed.universe.lensing_nside
    for nside in LENSING_NSIDES:
        stated = from_table({**REQUEST, "area": area, "universe": {"lensing_nside": nside}})
        assert stated.universe.lensing_nside == nside
