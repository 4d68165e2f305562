"""Where a grism puts light: traces of its orders, as polynomials.

An order m puts light of wavelength lambda at (x0 + X(t), y0 + Y(t)), (x0, y0) the place of the undispersed image,
t = (lambda - first) / (last - first) exactly linear in the wavelength, and

    X(t; x0, y0) = sum_i t^i (a_i0 + a_i1 x0 + a_i2 y0),    Y likewise

as grismconf has it.  In the mission database the coefficients are along the dispersion and across it, over the focal
plane; a grism that is turned turns them, and a detector has them in its own pixels.

Trace             one order on a detector
traces            of all orders of a grism
direction         in which a grism disperses
throughput        how much light an order has
source_rectangle  where sources lie whose light reaches a detector

Ref : Pirzkal & Ryan 2017, STScI WFC3 ISR 2017-01 (the form); laws of the orders, the mission database
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import MissionConfiguration
from truesky.numerics import matrices
from truesky.render.camera.detectors import Detector, detectors


@dataclass(frozen=True, slots=True)
class Trace:
    """One order of a grism on a detector.

    order       : -1, 0, 1, 2
    first, last : wavelengths of t = 0 and 1, A
    x, y        : float64[i, 3] pixels: coefficients of t^i, and of 1, x0, y0 (0-based pixels)
    """

    order: int
    first: float
    last: float
    x: Float
    y: Float

    def offsets(self, column: float, row: float, wavelength: npt.ArrayLike) -> tuple[Float, Float]:
        """(columns, rows) [n] from the undispersed place (column, row) to light of wavelengths [n] A."""
        t = (np.asarray(wavelength, float) - self.first) / (self.last - self.first)
        along, across = self.polynomials(column, row)
        columns, rows = (np.asarray(np.polynomial.polynomial.polyval(t, part), float) for part in (along, across))
        return columns, rows

    def polynomials(self, column: npt.ArrayLike, row: npt.ArrayLike) -> tuple[Float, Float]:
        """Coefficients [i] of t^i of a source's own trace, columns and rows, pixels; [i, n] of n sources."""
        place = np.array([np.ones_like(column, float), column, row])
        return np.asarray(matrices.matmul(self.x, place)), np.asarray(matrices.matmul(self.y, place))


def traces(grism: str, tilt: float, detector: Detector, mission: MissionConfiguration) -> tuple[Trace, ...]:
    """Of all orders of a grism that is turned by `tilt` deg from its own direction, by falling order.

    grism, tilt       : its name, and by how much it is turned
    detector, mission : of the camera, and the mission database
    Error : field coordinates of a source are those of its pixel, without the optics' distortion
    """
    rows = _grism_rows(grism, detector.section, mission)
    to_field = _to_field_matrix(detector, mission)
    # From the grism's direction to the detector's columns and rows.
    turn = np.radians(float(rows[0]["direction_deg"]) + tilt - detector.rotation)
    cosine, sine = float(np.cos(turn)), float(np.sin(turn))
    order_traces = []
    for order in sorted({int(row["order"]) for row in rows}, reverse=True):
        order_rows = [row for row in rows if int(row["order"]) == order]
        highest = max(int(row["power"]) for row in order_rows)
        along, across = (_coefficients(order_rows, axis, highest, to_field) for axis in ("along", "across"))
        first, last = (float(order_rows[0][name]) * 10.0 for name in ("first_nm", "last_nm"))
        order_traces.append(Trace(order, first, last, along * cosine - across * sine, along * sine + across * cosine))
    return tuple(order_traces)


def direction(grism: str, section: str, mission: MissionConfiguration) -> float:
    """Of the spectra of a grism that is not turned, deg from the focal plane's x axis to y."""
    return float(_grism_rows(grism, section, mission)[0]["direction_deg"])


def _grism_rows(grism: str, section: str, mission: MissionConfiguration) -> list[Mapping[str, str]]:
    """Of a grism's laws; BadInput where there is none of that name."""
    rows = mission.rows(f"{section}.traces")
    grism_rows = [row for row in rows if row["grism"] == grism]
    if not grism_rows:
        raise BadInput(f"grism {grism!r} is not one of {', '.join(sorted({row['grism'] for row in rows}))}")
    return grism_rows


def _coefficients(rows: Sequence[Mapping[str, str]], axis: str, highest: int, to_field: Float) -> Float:
    """float64[highest + 1, 3] pixels of t^i, of (1, x0, y0)."""
    powers = {int(row["power"]): row for row in rows if row["axis"] == axis}
    out = np.zeros((highest + 1, 3))
    for power, row in powers.items():
        # Of 1, and of both field coordinates.
        field_terms = np.array([float(row[name]) for name in ("constant", "slope_x", "slope_y")])
        out[power] = matrices.matmul(field_terms, to_field)
    return out


def _to_field_matrix(detector: Detector, mission: MissionConfiguration) -> Float:
    """float64[3, 3]: (1, x0, y0) -> 1 and the field coordinates, -1 .. 1 over the detectors' outer edges."""
    all_detectors = detectors(detector.section, mission)
    turn = np.radians(detector.rotation)
    half = np.array([(detector.nx - 1) / 2, (detector.ny - 1) / 2])
    out = np.array([[1.0, 0.0, 0.0]] * 3)
    for axis, name in enumerate("xy"):
        reach = max(abs(getattr(d, name)) + (d.nx, d.ny)[axis] * d.pixel_scale / 2 for d in all_detectors)
        step = np.array([(np.cos(turn), -np.sin(turn)), (np.sin(turn), np.cos(turn))][axis]) * detector.pixel_scale
        out[axis + 1] = np.array([getattr(detector, name) - float((step * half).sum()), *step]) / reach
    return out


def throughput(grism: str, order: int, wavelength: Float, detector: Detector, mission: MissionConfiguration) -> Float:
    """float64[n] light of an order at wavelengths [n] A, of what the passband of the first order detects there.

    grism, order      : its name, and which;  wavelength : float64[n] A
    detector, mission : of the camera, and the mission database
    """
    rows = [
        (float(row["wavelength_nm"]) * 10.0, float(row["throughput"]))
        for row in mission.rows(f"{detector.section}.orders")
        if row["grism"] == grism and int(row["order"]) == order
    ]
    if not rows:
        return np.ones(len(wavelength))
    waves, light = np.array(sorted(rows)).T
    return np.asarray(np.interp(wavelength, waves, light))


def source_rectangle(
    trace: Trace, nx: int, ny: int, wavelength: tuple[float, float]
) -> tuple[float, float, float, float]:
    """(left, right, low, high) pixels within which sources lie whose light in a stretch of A falls onto nx x ny pixels.

    trace : of an order;  nx, ny : columns and rows;  wavelength : first and last, A
    The field's slopes are taken at the detector's corners: farther out the trace differs by less than a pixel in 100.
    """
    waves = np.linspace(*wavelength, 33)
    corners = [(x, y) for x in (0.0, nx - 1.0) for y in (0.0, ny - 1.0)]
    corner_offsets = [trace.offsets(*corner, waves) for corner in corners]
    x, y = np.array([x for x, _ in corner_offsets]), np.array([y for _, y in corner_offsets])
    return float(-x.max()), float(nx - 1 - x.min()), float(-y.max()), float(ny - 1 - y.min())
