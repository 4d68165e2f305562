"""Traces of grism spectra: for each spectral order, the pixels that receive the light of each wavelength.

For a source whose undispersed image is at (x0, y0), an order puts light of the wavelength lambda at (x0 + X, y0 + Y).
The parameter t = (lambda - first) / (last - first) is linear in wavelength. X and Y are polynomials in t, as in the
program grismconf::

    X(t; x0, y0) = sum_i t^i (a_i0 + a_i1 x0 + a_i2 y0)
    Y(t; x0, y0) = sum_i t^i (b_i0 + b_i1 x0 + b_i2 y0)

In the mission database the coefficients are along and across the dispersion, for the whole focal plane. They are
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
    """Trace of one spectral order of a grism on a detector, as polynomials.

    Attributes
    ----------
    order : int
        Diffraction order: -1, 0, 1 or 2.
    first, last : float
        Wavelengths at which the parameter t of the polynomials is 0 and 1, Angstrom.
    x, y : float array, shape (n_powers, 3)
        Coefficients of the offset in columns (x) and in rows (y), in pixels. Row i belongs to t^i; its three numbers
        are multiplied by 1, x0 and y0, the undispersed image (0-based pixels).
    """

    order: int
    first: float
    last: float
    x: Float
    y: Float

    def offsets(self, column: float, row: float, wavelength: npt.ArrayLike) -> tuple[Float, Float]:
        """Return the offsets from the undispersed image of a source to its light at given wavelengths.

        Parameters
        ----------
        column, row : float
            Position of the undispersed image, 0-based pixels.
        wavelength : array_like, shape (n,)
            Wavelengths, Angstrom. Values outside `first` to `last` are extrapolated.

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
        """Return the coefficients of t^i for the traces of sources: offsets in columns and in rows, pixels.

        `column` and `row` are the positions of the undispersed images in 0-based pixels, one number or n numbers each.
        The parameter t is 0 at the wavelength `first` and 1 at `last`. Index i of a result belongs to t^i. Its shape is
        (powers,) for one source, or (powers, n) for n sources.
        """
        place = np.array([np.ones_like(column, float), column, row])
        return np.asarray(matrices.matmul(self.x, place)), np.asarray(matrices.matmul(self.y, place))


def traces(grism: str, tilt: float, detector: Detector, mission: MissionConfiguration) -> tuple[Trace, ...]:
    """Return the traces of all spectral orders of a tilted grism on a detector.

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
    # Angle from the direction of increasing column index on the detector to the direction of dispersion.
    turn = np.radians(detector.own_degrees(float(rows[0]["direction_deg"]) + tilt))
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
    """Return the direction of the spectra of an untilted grism in the focal plane.

    Parameters
    ----------
    grism : str
        Name of the grism.
    section : str
        Prefix of the camera's parameters in the mission database, such as "nisp".
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float
        Angle from the focal plane's x axis towards the y axis, deg. BadInput is raised if the grism is unknown.
    """
    return float(_grism_rows(grism, section, mission)[0]["direction_deg"])


def _grism_rows(grism: str, section: str, mission: MissionConfiguration) -> list[Mapping[str, str]]:
    """Return the rows of a grism in the mission database's table of traces, at least one.

    Each row has coefficients of one power of the polynomial along or across the dispersion, for one spectral order.
    `section` is the prefix of the camera's parameters, such as "nisp". BadInput is raised if the grism is not in the
    table.
    """
    rows = mission.rows(f"{section}.traces")
    grism_rows = [row for row in rows if row["grism"] == grism]
    if not grism_rows:
        raise BadInput(f"grism {grism!r} is not one of {', '.join(sorted({row['grism'] for row in rows}))}")
    return grism_rows


def _coefficients(rows: Sequence[Mapping[str, str]], axis: str, highest: int, to_field: Float) -> Float:
    """Return the coefficients [highest + 1, 3] of a trace "along" or "across" the dispersion (`axis`), in pixels.

    Row i belongs to t^i, where t goes from 0 to 1 along the trace. Its three numbers are multiplied by 1, x0 and y0,
    the position of the undispersed image in 0-based pixels. Powers without a row in the table are 0. `to_field` [3, 3]
    converts (1, x0, y0) to (1, x, y) in the field of the camera, for which the table has its coefficients.
    """
    powers = {int(row["power"]): row for row in rows if row["axis"] == axis}
    out = np.zeros((highest + 1, 3))
    for power, row in powers.items():
        field_terms = np.array([float(row[name]) for name in ("constant", "slope_x", "slope_y")])
        out[power] = matrices.matmul(field_terms, to_field)
    return out


def _to_field_matrix(detector: Detector, mission: MissionConfiguration) -> Float:
    """Return the matrix [3, 3] that converts (1, column, row) of a detector to (1, x, y) in the field of the camera.

    Columns and rows are 0-based pixels. The coordinates x and y are 0 at the boresight. They are -1 and 1 at the outer
    edges of the camera's mosaic of detectors, if this is symmetric.
    """
    all_detectors = detectors(detector.section, mission)
    half = np.array([(detector.nx - 1) / 2, (detector.ny - 1) / 2])
    out = np.array([[1.0, 0.0, 0.0]] * 3)
    for axis, name in enumerate("xy"):
        reach = max(abs(getattr(d, name)) + (d.nx, d.ny)[axis] * d.pixel_scale / 2 for d in all_detectors)
        step = detector.axes[axis] * detector.pixel_scale
        out[axis + 1] = np.array([getattr(detector, name) - float((step * half).sum()), *step]) / reach
    return out


def throughput(grism: str, order: int, wavelength: Float, detector: Detector, mission: MissionConfiguration) -> Float:
    """Return the detected light of a spectral order relative to that of the first order at the same wavelength.

    The passband of the camera describes the light that the first order detects.

    Parameters
    ----------
    grism : str
        Name of the grism.
    order : int
        Diffraction order.
    wavelength : float array, shape (n,)
        Wavelengths, Angstrom.
    detector : Detector
        Any detector of the camera.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float array, shape (n,)
        Relative throughput. Wavelengths outside the table in the mission database have the value at its end. The result
        is 1 if the database has no throughput of this order.
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
    """Return the rectangle of undispersed images of all sources whose light of a spectral order may fall on a detector.

    Parameters
    ----------
    trace : Trace
        Trace of the spectral order on the detector.
    nx, ny : int
        Columns and rows of the detector.
    wavelength : (float, float)
        First and last wavelength of the light, Angstrom.

    Returns
    -------
    (float, float, float, float)
        Left, right, lower and upper limit of the undispersed images, 0-based pixels. They may be outside the detector.

    Notes
    -----
    The offsets of the trace are taken at the corners of the detector. For sources farther out they differ by less than
    0.01 pixels.
    """
    waves = np.linspace(*wavelength, 33)
    corners = [(x, y) for x in (0.0, nx - 1.0) for y in (0.0, ny - 1.0)]
    corner_offsets = [trace.offsets(*corner, waves) for corner in corners]
    x, y = np.array([x for x, _ in corner_offsets]), np.array([y for _, y in corner_offsets])
    return float(-x.max()), float(nx - 1 - x.min()), float(-y.max()), float(ny - 1 - y.min())
