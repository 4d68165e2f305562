"""Traces of NISP's grisms: the laws that they are made of, and where sources lie."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from truesky.render.camera import traces
from truesky.render.camera.detectors import detector, detectors

MISSION = resolve()
DETECTOR = detector("nisp", "DET23", MISSION)


def place(trace, column, row, wavelength):
    x, y = trace.offsets(column, row, np.array([wavelength]))
    return float(x[0]), float(y[0])


@pytest.mark.parametrize("grism", ["RGS000", "RGS180", "BGS000"])
def test_the_first_order_has_the_missions_dispersion_and_the_zeroth_hardly_any(grism):
    found = {trace.order: trace for trace in traces.traces(grism, 0.0, DETECTOR, MISSION)}
    assert sorted(found) == [-1, 0, 1, 2]
    low, high = {"BGS000": (9260.0, 13660.0)}.get(grism, (12060.0, 18920.0))
    wanted = {"RGS000": 13.4, "RGS180": 13.4, "BGS000": 12.4}[grism]
    length = np.hypot(*np.subtract(place(found[1], 1000, 1000, high), place(found[1], 1000, 1000, low)))
    # Within the field's gradients of 1 %.
    assert (high - low) / length == pytest.approx(wanted, rel=0.02)
    second = np.hypot(*np.subtract(place(found[2], 1000, 1000, high), place(found[2], 1000, 1000, low)))
    assert second == pytest.approx(2.0 * length, rel=1e-3)
    zeroth = np.hypot(*np.subtract(place(found[0], 1000, 1000, high), place(found[0], 1000, 1000, low)))
    assert zeroth == pytest.approx((high - low) / 700.0, rel=0.01)
    # In the middle of the field, from end to end and at half of it.
    own = [
        row for row in MISSION.rows("nisp.traces") if (row["grism"], row["order"], row["axis"]) == (grism, "0", "along")
    ]
    middle = np.polynomial.Polynomial([float(row["constant"]) for row in own])
    assert middle(1.0) - middle(0.0) == pytest.approx((high - low) / 700.0, rel=1e-6)
    assert middle(0.5) == pytest.approx({"BGS000": -1120.0 / 1.24}.get(grism, -1500.0 / 1.34), rel=1e-6)


@pytest.mark.parametrize("grism", ["RGS000", "RGS180", "BGS000"])
@pytest.mark.parametrize("tilt", [0.0, -4.0])
def test_traces_are_the_mission_s_table_on_every_detector(grism, tilt):
    """At the corners, on detectors of either orientation; in the focal plane, by complex numbers."""
    everything, waves = detectors("nisp", MISSION), np.linspace(9000.0, 19000.0, 5)
    half = 0.5 * everything[0].pixel_scale * 2040
    edge_x, edge_y = (max(abs(getattr(one, axis)) for one in everything) + half for axis in "xy")
    assert {one.upside_down for one in everything} == {False, True}
    rows = [row for row in MISSION.rows("nisp.traces") if row["grism"] == grism]
    turn = np.exp(1j * np.radians(float(rows[0]["direction_deg"]) + tilt))
    for one, trace in itertools.product(everything, (0, 1, 2, 3)):
        found, own_turn = traces.traces(grism, tilt, one, MISSION)[trace], np.exp(1j * np.radians(one.rotation))
        # Mounted to a tenth of a degree.
        assert own_turn.real * (-1.0 if one.upside_down else 1.0) > 0.999
        for column, row in itertools.product((0.0, 2039.0), repeat=2):
            place = complex(one.x, one.y) + own_turn * one.pixel_scale * complex(column - 1019.5, row - 1019.5)
            x, y = place.real / edge_x, place.imag / edge_y
            light = np.zeros(len(waves), complex)
            for law in (law for law in rows if int(law["order"]) == found.order):
                t = (waves / 10.0 - float(law["first_nm"])) / (float(law["last_nm"]) - float(law["first_nm"]))
                own = float(law["constant"]) + float(law["slope_x"]) * x + float(law["slope_y"]) * y
                light += (1.0 if law["axis"] == "along" else 1j) * own * t ** int(law["power"])
            light *= turn / own_turn
            seen = found.offsets(column, row, waves)
            np.testing.assert_allclose(seen, [light.real, light.imag], rtol=0.0, atol=1e-9)


def test_grisms_half_a_turn_apart_disperse_to_opposite_sides():
    one, other = (
        {trace.order: trace for trace in traces.traces(grism, tilt, DETECTOR, MISSION)}[1]
        for grism, tilt in (("RGS000", 4.0), ("RGS180", 4.0))
    )
    for wavelength in (12060.0, 18920.0):
        here, there = place(one, 1000, 1000, wavelength), place(other, 1000, 1000, wavelength)
        np.testing.assert_allclose(here, -np.array(there), atol=4.5)


def test_a_turned_grism_turns_its_traces():
    straight, turned = (
        {trace.order: trace for trace in traces.traces("RGS000", tilt, DETECTOR, MISSION)} for tilt in (0.0, 4.0)
    )
    angle = np.radians(4.0)
    for number, trace in straight.items():
        x, y = trace.offsets(700.0, 1500.0, np.linspace(trace.first, trace.last, 9))
        found = turned[number].offsets(700.0, 1500.0, np.linspace(trace.first, trace.last, 9))
        np.testing.assert_allclose(found[0], x * np.cos(angle) - y * np.sin(angle), atol=1e-9)
        np.testing.assert_allclose(found[1], x * np.sin(angle) + y * np.cos(angle), atol=1e-9)


def test_a_detector_upside_down_sees_the_same_light_in_the_focal_plane():
    """At one place of the focal plane, from either side of the line between two detectors."""
    for name in ("DET22", "DET32"):
        d = detector("nisp", name, MISSION)
        turn = np.radians(d.rotation)
        (trace,) = (one for one in traces.traces("RGS000", 0.0, d, MISSION) if one.order == 1)
        x, y = place(trace, (d.nx - 1) / 2, (d.ny - 1) / 2, 18920.0)
        along = x * np.cos(turn) - y * np.sin(turn)
        assert along == pytest.approx(292.5, rel=0.012)


def test_an_unknown_grism_is_refused_by_name():
    with pytest.raises(BadInput, match="'RGS270' is not one of BGS000, RGS000, RGS180"):
        traces.traces("RGS270", 0.0, DETECTOR, MISSION)


@given(st.floats(-4.0, 4.0), st.floats(0.0, 1.0), st.floats(0.0, 1.0), st.sampled_from([-1, 0, 1, 2]))
def test_sources_of_light_on_a_detector_lie_in_the_rectangle(tilt, u, v, number):
    (trace,) = (one for one in traces.traces("RGS000", tilt, DETECTOR, MISSION) if one.order == number)
    left, right, low, high = traces.source_rectangle(trace, 2040, 2040, (trace.first, trace.last))
    # Somewhere about the detector; where its light falls on it, it is inside.
    column, row = -5000.0 + 12000.0 * u, -400.0 + 2900.0 * v
    x, y = trace.offsets(column, row, np.linspace(trace.first, trace.last, 40))
    inside = (column + x >= 0) & (column + x <= 2039) & (row + y >= 0) & (row + y <= 2039)
    # Slopes of 1 % over the field, beyond the corners.
    slack = 60.0
    if inside.any():
        assert left - slack <= column <= right + slack
        assert low - slack <= row <= high + slack


def test_orders_share_the_light_as_the_mission_has_it():
    waves = np.array([12060.0, 15000.0, 18920.0])
    assert traces.throughput("RGS000", 1, waves, DETECTOR, MISSION).tolist() == [1.0, 1.0, 1.0]
    for number, low, high in ((0, 0.01, 0.03), (2, 0.01, 0.04), (-1, 0.004, 0.006)):
        found = traces.throughput("RGS000", number, waves, DETECTOR, MISSION)
        assert (low <= found).all()
        assert (found <= high).all()


def test_paths_of_many_sources_are_those_of_each():
    column, row = np.array([-300.0, 17.25, 2039.0]), np.array([5.5, 2040.0, 1000.0])
    for trace in traces.traces("RGS000", 4.0, DETECTOR, MISSION):
        many = trace.polynomials(column, row)
        for i in range(len(column)):
            for one, all_of_them in zip(trace.polynomials(column[i], row[i]), many, strict=True):
                np.testing.assert_array_equal(one, all_of_them[:, i])
