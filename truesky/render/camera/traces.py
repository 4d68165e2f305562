"""Traces of grism orders as polynomials: the pixels that receive the light of each wavelength.

An order m puts light of wavelength lambda at (x0 + X(t), y0 + Y(t)), where (x0, y0) is the undispersed image and
t = (lambda - first) / (last - first) is exactly linear in wavelength. The polynomials have the form of grismconf::

    X(t; x0, y0) = sum_i t^i (a_i0 + a_i1 x0 + a_i2 y0)
    Y(t; x0, y0) = sum_i t^i (b_i0 + b_i1 x0 + b_i2 y0)

In the mission database the coefficients are along and across the dispersion, over the whole focal plane. They are
rotated with the grism and converted to the pixels of each detector.

References
----------
Pirzkal & Ryan 2017, STScI WFC3 ISR 2017-01 (form of the polynomials); the mission database (their coefficients).
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
    """Trace of one grism order on a detector.

    Attributes
    ----------
    order : int
        Diffraction order: -1, 0, 1 or 2.
    first, last : float
        Wavelengths of t = 0 and t = 1, Angstrom.
    x, y : float array, shape (n_powers, 3)
        Coefficients of t^i and of 1, x0, y0 (0-based pixels) for columns and rows, pixels.
    """

    order: int
    first: float
    last: float
    x: Float
    y: Float

    def offsets(self, column: float, row: float, wavelength: npt.ArrayLike) -> tuple[Float, Float]:
        """Offsets from the undispersed image of a source to its light at given wavelengths.

        Parameters
        ----------
        column, row : float
            Undispersed image, 0-based pixels.
        wavelength : array_like, shape (n,)
            Wavelengths, Angstrom.

        Returns
        -------
        (float array, float array), each of shape (n,)
            Offsets in columns and rows, pixels.
        """
        t = (np.asarray(wavelength, float) - self.first) / (self.last - self.first)
        along, across = self.polynomials(column, row)
        columns, rows = (np.asarray(np.polynomial.polynomial.polyval(t, part), float) for part in (along, across))
        return columns, rows

    def polynomials(self, column: npt.ArrayLike, row: npt.ArrayLike) -> tuple[Float, Float]:
        """Coefficients of t^i for the trace of a source, for columns and rows, pixels: [i], or [i, n] for n sources."""
        place = np.array([np.ones_like(column, float), column, row])
        return np.asarray(matrices.matmul(self.x, place)), np.asarray(matrices.matmul(self.y, place))


def traces(grism: str, tilt: float, detector: Detector, mission: MissionConfiguration) -> tuple[Trace, ...]:
    """Traces of all orders of a tilted grism on a detector.

    Parameters
    ----------
    grism : str
        Name of the grism.
    tilt : float
        Rotation of the grism from its nominal direction, deg.
    detector : Detector
        The detector.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    tuple of Trace
        Traces from the highest to the lowest order.

    Notes
    -----
    The field coordinates of a source are taken from its pixel, without the distortion of the optics.
    """
    rows = _grism_rows(grism, detector.section, mission)
    to_field = _to_field_matrix(detector, mission)
    # Angle from the detector's columns to the dispersion.
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
    """Direction of the spectra of an untilted grism, deg from the focal plane's x axis to the y axis.

    Parameters
    ----------
    grism : str
        Name of the grism.
    section : str
        Prefix of the camera in the mission database.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float
        Direction, deg.
    """
    return float(_grism_rows(grism, section, mission)[0]["direction_deg"])


def _grism_rows(grism: str, section: str, mission: MissionConfiguration) -> list[Mapping[str, str]]:
    """Rows of a grism in the table of traces. Raises BadInput if the table does not contain the grism."""
    rows = mission.rows(f"{section}.traces")
    grism_rows = [row for row in rows if row["grism"] == grism]
    if not grism_rows:
        raise BadInput(f"grism {grism!r} is not one of {', '.join(sorted({row['grism'] for row in rows}))}")
    return grism_rows


def _coefficients(rows: Sequence[Mapping[str, str]], axis: str, highest: int, to_field: Float) -> Float:
    """Coefficients [highest + 1, 3] of t^i and of (1, x0, y0), pixels."""
    powers = {int(row["power"]): row for row in rows if row["axis"] == axis}
    out = np.zeros((highest + 1, 3))
    for power, row in powers.items():
        field_terms = np.array([float(row[name]) for name in ("constant", "slope_x", "slope_y")])
        out[power] = matrices.matmul(field_terms, to_field)
    return out


def _to_field_matrix(detector: Detector, mission: MissionConfiguration) -> Float:
    """Matrix [3, 3] from (1, x0, y0) to 1 and the field coordinates, which run from -1 to 1 between the outer edges."""
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
    """Light of an order relative to the light that the passband of the first order detects.

    Parameters
    ----------
    grism : str
        Name of the grism.
    order : int
        Diffraction order.
    wavelength : float array, shape (n,)
        Wavelengths, Angstrom.
    detector : Detector
        A detector of the camera.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float array, shape (n,)
        Relative throughput; 1 if the database has none for this order.
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
    """Rectangle that contains all sources whose light of an order falls on a detector.

    Parameters
    ----------
    trace : Trace
        Trace of the order.
    nx, ny : int
        Columns and rows of the detector.
    wavelength : (float, float)
        First and last wavelength, Angstrom.

    Returns
    -------
    (float, float, float, float)
        Left, right, lower and upper limit of the undispersed images, pixels.

    Notes
    -----
    The slopes across the field are taken at the corners. Farther out the trace differs by less than 0.01 pixels.
    """
    waves = np.linspace(*wavelength, 33)
    corners = [(x, y) for x in (0.0, nx - 1.0) for y in (0.0, ny - 1.0)]
    corner_offsets = [trace.offsets(*corner, waves) for corner in corners]
    x, y = np.array([x for x, _ in corner_offsets]), np.array([y for _, y in corner_offsets])
    return float(-x.max()), float(nx - 1 - x.min()), float(-y.max()), float(ny - 1 - y.min())
