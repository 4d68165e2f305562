"""Read a user's PSF: a cube of planes, or a file written by PSFEx.

A cube is the first image of a FITS file with two axes, or with three axes and wavelengths along the third. The sum of
each plane is the fraction of the light that it contains. The cards are:

- CDELT1 = CDELT2 and CUNIT1 (arcsec, mas or deg): spacing of the samples.
- CRPIX1 and CRPIX2: position of the chief ray; by default the middle.
- CRVAL3, CDELT3 and CRPIX3, or WAVE1 to WAVEn: wavelengths in CUNIT3 (Angstrom, nm, um or m).
- PIXEL: T if the PSF includes the detector's pixel.

Planes have the axes of the focal plane, with x to the right; they are rotated for detectors that are mounted rotated.
A file of PSFEx has the axes and pixels of the detector, includes the pixel's response, and contains polynomials of the
position on the detector.
"""

from __future__ import annotations

from collections.abc import Mapping
from math import comb
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.fits import external
from truesky.fluxes.passbands import Passband
from truesky.numerics import matrices
from truesky.render.camera.detectors import Detector
from truesky.render.psf.model import SAMPLES, SIDE, Planes, Psf, from_planes
from truesky.render.psf.sub_bands import sub_bands

_ARCSEC = {"arcsec": 1.0, "mas": 1e-3, "deg": 3600.0}
_ANGSTROM = {"Angstrom": 1.0, "nm": 10.0, "um": 1e4, "m": 1e10}
# Allowed range of the sum of a plane.
_LEAST_SUM, _MOST_SUM = 0.5, 1.001
# Smallest and largest spacing of samples, pixels.
_SPACING = (0.02, 2.0)
# Largest number in a card, and largest degree of polynomials.
_LARGEST, _MOST_DEGREE = 1e300, 20
# Smallest side of a plane, samples.
_LEAST_SIDE = 3 * 66 + 1
# Lobes of the interpolant: models of PSFEx are made for three; for cubes more lobes are more accurate.
_OF_PSFEX, _OF_CUBES = 3, 15


def path_for_detector(name: str, detector: str) -> Path:
    """Path of the PSF for a detector: {detector} in the path is replaced by the detector's name."""
    return Path(name.replace("{detector}", detector))


def read(path: Path, detector: Detector, band: Passband) -> Psf:
    """Read the PSF of a file for a detector and a band.

    Parameters
    ----------
    path : Path
        The file.
    detector : Detector
        The detector.
    band : Passband
        The passband.

    Returns
    -------
    Psf
        The PSF.

    Raises
    ------
    BadInput
        If the content of the file is invalid; the message contains the path.

    Notes
    -----
    The interpolation has an error of 5e-5 of the peak for a cube whose samples are finer than half its width. For PSFEx
    it is 1e-3, since its interpolant rings at frequencies that planes of three samples per pixel do not contain.
    """
    data, header = external.read_planes(path, "PSF_MASK")
    try:
        if not np.isfinite(data).all():
            raise BadInput("contains values that are not finite numbers")
        if "POLNAXIS" in header:
            return from_planes(_psfex(data, header, detector), detector.pixel_scale, has_pixel=True)
        return from_planes(_cube(data, header, detector, band), detector.pixel_scale, has_pixel=_has_pixel(header))
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from None


# ------------------------------------------------------------------------------------------------ cubes


def _cube(data: Float, header: Mapping[str, Any], detector: Detector, band: Passband) -> Planes:
    planes = data if data.ndim == 3 else data[None]
    for number, total in enumerate(planes.sum(axis=(1, 2)), start=1):
        if not _LEAST_SUM <= total <= _MOST_SUM:
            raise BadInput(f"plane {number} sums to {total:.4g}, but {_LEAST_SUM:g} to {_MOST_SUM:g} is allowed")
    step = _card(header, "CDELT1") * _unit(header, "CUNIT1", _ARCSEC)
    if step <= 0.0 or _card(header, "CDELT2") != _card(header, "CDELT1"):
        raise BadInput("CDELT1 and CDELT2 must be equal and positive")
    middle = [
        _number(header, f"CRPIX{axis}", (n + 1) / 2) - 1 for axis, n in ((2, data.shape[-2]), (1, data.shape[-1]))
    ]
    waves, weights = _colours(header, len(planes), band)
    spaced = matrices.matmul(weights, planes.reshape(len(planes), -1)).reshape(-1, *planes.shape[1:])
    turns = round(detector.rotation / 90.0)
    images = np.stack([np.rot90(_resample(p, step / detector.pixel_scale, middle, _OF_CUBES), turns) for p in spaced])
    return Planes(waves, images.astype(np.float32), np.zeros((0, *images.shape[1:]), np.float32), _half(detector))


def _has_pixel(header: Mapping[str, Any]) -> bool:
    value = header.get("PIXEL", False)
    if not isinstance(value, bool):
        raise BadInput(f"PIXEL = {value!r} is not T or F")
    return value


def _colours(header: Mapping[str, Any], count: int, band: Passband) -> tuple[Float, Float]:
    """Wavelengths of the resulting planes, Angstrom, and their weights [planes, count] of the planes in the cube."""
    parts = sub_bands(band)
    means: Float = np.array([np.average(p.wavelength, weights=p.response / p.wavelength) for p in parts])
    if count == 1:
        return means[:1], np.ones((1, 1))
    unit = _unit(header, "CUNIT3", _ANGSTROM)
    if "WAVE1" in header:
        waves: Float = unit * np.array([_card(header, f"WAVE{i}") for i in range(1, count + 1)])
    else:
        number: Float = np.arange(1.0, count + 1) - _number(header, "CRPIX3", 1.0)
        waves = np.asarray(unit * (_card(header, "CRVAL3") + number * _card(header, "CDELT3")))
    if (np.diff(waves) <= 0).any():
        raise BadInput("its wavelengths must increase")
    if waves[0] > means[0] or waves[-1] < means[-1]:
        reach = f"{waves[0]:.0f} to {waves[-1]:.0f} A, but band {band.name} requires {means[0]:.0f} to {means[-1]:.0f}"
        raise BadInput(f"its planes reach from {reach}")
    hats = [np.stack([np.interp(p.wavelength, waves, row) for row in np.eye(count)]) for p in parts]
    return means, np.stack(
        [np.average(hat, axis=1, weights=p.response / p.wavelength) for hat, p in zip(hats, parts, strict=True)]
    )


# ------------------------------------------------------------------------------------------------ PSFEx


def _psfex(data: Float, header: Mapping[str, Any], detector: Detector) -> Planes:
    """Convert a PSFEx model to planes, with polynomials about the detector's middle.

    The sum of the PSF is 1 in the middle, and kept constant elsewhere to first order.

    References
    ----------
    Bertin 2011, ASPC 442, 435; galsim.des.DES_PSFEx (the order of terms).
    """
    degree, groups = (int(_card(header, key)) for key in ("POLDEG1", "POLNGRP"))
    names = [str(header.get(f"POLNAME{i}", "")).strip() for i in (1, 2)]
    places = all(n.startswith(axis) and n.endswith("IMAGE") for n, axis in zip(names, "XY", strict=True))
    if int(_card(header, "POLNAXIS")) != 2 or groups != 1 or not places:
        variables = f"{', '.join(names)} in {groups} groups"
        raise BadInput(f"its polynomials are of {variables}, but must be of X and Y of the image in one group")
    if not 0 <= degree <= _MOST_DEGREE:
        raise BadInput(f"its polynomials are of degree {degree}, but 0 to {_MOST_DEGREE} is allowed")
    powers = [(i, j) for j in range(degree + 1) for i in range(degree + 1 - j)]
    if data.ndim != 3 or len(data) != len(powers):
        raise BadInput(f"PSF_MASK has {list(data.shape)} samples, but degree {degree} requires {len(powers)} planes")
    half = _half(detector)
    # (x - zero) / scale = shift + stretch * (position in the units of Planes).
    zero, scale = ([_card(header, f"POL{kind}{axis}") for axis in (1, 2)] for kind in ("ZERO", "SCAL"))
    if not all(scale):
        raise BadInput("POLSCAL1 and POLSCAL2 must not be 0")
    shift = [(half[k] + 1.0 - zero[k]) / scale[k] for k in (0, 1)]
    stretch = [(half[k] + 0.5) / scale[k] for k in (0, 1)]
    middle = [(n - 1) / 2 for n in data.shape[1:]]
    planes = np.zeros_like(data)
    for number, (p, q) in enumerate(powers):
        for (i, j), term in zip(powers, data, strict=True):
            if i >= p and j >= q:
                along = comb(i, p) * shift[0] ** (i - p) * stretch[0] ** p
                planes[number] += along * comb(j, q) * shift[1] ** (j - q) * stretch[1] ** q * term
    drawn = np.stack([_resample(plane, _card(header, "PSF_SAMP"), middle, _OF_PSFEX) for plane in planes])
    totals = drawn.sum(axis=(1, 2))
    if not totals[0] > 0.0:
        raise BadInput(f"its PSF in the middle of the detector must have a positive sum, got {totals[0]:.4g}")
    image = drawn[0] / totals[0]
    drift = (drawn[1:] - totals[1:, None, None] * image) / totals[0]
    return Planes(
        np.zeros(1),
        image[None].astype(np.float32),
        drift.astype(np.float32),
        half,
        tuple((i, j, 0) for i, j in powers[1:]),
    )


# ------------------------------------------------------------------------------------------------ samples


def _resample(plane: Float, spacing: float, middle: list[float], lobes: int) -> Float:
    """Resample a plane with samples `spacing` pixels apart, centred on `middle` (row, column), to that of `Planes`."""
    if not _SPACING[0] <= spacing <= _SPACING[1]:
        raise BadInput(f"its samples are {spacing:.4g} pixels apart, but {_SPACING[0]:g} to {_SPACING[1]:g} is allowed")
    reach = max(max(m, n - 1 - m) for m, n in zip(middle, plane.shape, strict=True)) + lobes
    half = max(min(int(reach * spacing * SAMPLES), SIDE * SAMPLES // 2), _LEAST_SIDE // 2)
    at = np.arange(-half, half + 1) / (SAMPLES * spacing)
    rows, columns = (_interpolant(at + m, n, lobes) for m, n in zip(middle, plane.shape, strict=True))
    return np.asarray(matrices.matmul(rows, matrices.matmul(plane, columns.T)) / (SAMPLES * spacing) ** 2)


def _interpolant(at: Float, count: int, lobes: int) -> Float:
    """Weights [n, count] of the samples for the positions `at`: Lanczos' kernel, normalised to preserve a constant."""
    distance = at[:, None] - np.arange(count)
    kernel = np.where(np.abs(distance) < lobes, np.sinc(distance) * np.sinc(distance / lobes), 0.0)
    # Sum of the kernel over an infinite grid of samples.
    steps = (at % 1.0)[:, None] - np.arange(1 - lobes, lobes + 1)
    total = (np.sinc(steps) * np.sinc(steps / lobes)).sum(axis=1, keepdims=True)
    return np.asarray(kernel / total)


def _half(detector: Detector) -> tuple[float, float]:
    return (detector.nx - 1) / 2, (detector.ny - 1) / 2


def _card(header: Mapping[str, Any], key: str) -> float:
    if key not in header:
        raise BadInput(f"has no card {key}")
    return _number(header, key, 0.0)


def _number(header: Mapping[str, Any], key: str, default: float) -> float:
    value = header.get(key, default)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not abs(value) < _LARGEST:
        raise BadInput(f"{key} = {value!r} is not a number")
    return float(value)


def _unit(header: Mapping[str, Any], key: str, units: Mapping[str, float]) -> float:
    name = str(header.get(key, "")).strip()
    if name not in units:
        raise BadInput(f"{key} = {name!r} is not one of {', '.join(units)}")
    return units[name]
