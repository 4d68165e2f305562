"""Measure a calibrated image like a survey, and compare the detections with the true sources: examples of a frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy import ndimage

from lake_schema import ids
from lake_schema.arrays import Array, Float, Int
from lake_schema.errors import OutOfRange
from lake_schema.fits.images import Card
from truesky.emulator import features, matching
from truesky.emulator.examples import Examples, Outcomes
from truesky.emulator.features import Features
from truesky.randomness import rng
from truesky.reduction import catalogue, files, ideal_masters
from truesky.reduction.calibration import COSMIC_RAY, HOT, NO_DATA, RESPONSE, SATURATED, UNSURE, ReducedImage
from truesky.reduction.catalogue import Limits
from truesky.reduction.frames import Frame
from truesky.reduction.infrared import nisp
from truesky.reduction.reduce import ReductionOptions, reduce_frame
from truesky.render.camera import astrometry
from truesky.render.products import read_back
from truesky.survey_maps import exposure_noise, psf_sizes

# Sources fainter than the depth by more than this (mag) are not used as examples.
FAINTEST = 1.5
# Sources closer to the edge of a detector than this (pixels) are not used as examples.
_BORDER = 10.0
# Bits of pixels that are bad in one exposure, but not in others that see the same place with other pixels.
_BAD = RESPONSE | HOT | UNSURE | COSMIC_RAY
# Differences from the noise-free image below this fraction of the light are no cosmic rays.
_TOLERANCE = 0.1
# Pixels whose difference from the noise-free image is below this number of standard deviations show the mean sky.
_CLIP = 3.0
# Signal-to-noise ratio of a point source at the depth.
_SIGMA = 5.0
# Detections with a smaller ratio of signal to noise in an aperture count as none; their magnitudes mean nothing.
_LEAST_SIGNAL = 1.0
# Highest kind of a source that is in the catalogues; bodies of the solar system have higher ones.
_LAST_KIND = 5


@dataclass(frozen=True, slots=True)
class Settings:
    """Settings of calibration, detection and measurement.

    Attributes
    ----------
    limits : Limits
        Detection threshold and smallest number of pixels of a source.
    aperture : float
        Diameter of the aperture of MAG_APER as a multiple of the FWHM of the PSF, 0.1 to 100.
    cosmic_rays : float
        Pixels that exceed the noise-free image by this number of standard deviations are replaced as cosmic rays, and
        bad pixels of the detector too, 2 to 1000; 0 to replace none.

    Raises
    ------
    OutOfRange
        If the aperture or the threshold of cosmic rays is out of range.
    """

    limits: Limits = field(default_factory=Limits)
    aperture: float = 3.0
    cosmic_rays: float = 5.0

    def __post_init__(self) -> None:
        if self.cosmic_rays and not 2.0 <= self.cosmic_rays <= 1e3:
            raise OutOfRange("--cosmic-rays", self.cosmic_rays, 2.0, 1e3)
        if not 0.1 <= self.aperture <= 100.0:
            raise OutOfRange("--aperture", self.aperture, 0.1, 100.0)

    def facts(self) -> dict[str, float]:
        """Return the settings as JSON values, which models that are used together must share."""
        return {"threshold": self.limits.threshold, "pixels": self.limits.pixels, "aperture_fwhm": self.aperture}


@dataclass(frozen=True, slots=True)
class TrueSources:
    """True sources on a detector and near its edges.

    Attributes
    ----------
    ids : int array, shape (n,)
        Identifiers.
    x, y : float array, shape (n,)
        Columns and rows, from 0.
    magnitude : float array, shape (n,)
        AB magnitudes.
    radius : float array, shape (n,)
        Half-light radii before convolution in arcsec, 0 for points.
    """

    ids: Int
    x: Float
    y: Float
    magnitude: Float
    radius: Float


@dataclass(frozen=True, slots=True)
class FrameExamples:
    """Examples of one frame.

    Attributes
    ----------
    examples : Examples
        Features and outcomes.
    rows : int array, shape (n,)
        Index of each example in the true sources.
    ra, dec : float array, shape (n,)
        Measured position of each example in deg, NaN if not detected.
    conditions : dict of str to float
        `depth` (mag), `psf_area` (arcsec2), `sky` (electron/s/pixel), `area` (arcmin2) and `unmatched`, the number of
        detections without a true source.
    """

    examples: Examples
    rows: Int
    ra: Float
    dec: Float
    conditions: dict[str, float]


def measure(
    frame: Frame,
    sources: TrueSources,
    settings: Settings,
    masters: Path | None = None,
    noise_free: Path | None = None,
) -> FrameExamples:
    """Calibrate a raw frame, detect and measure its sources, and compare them with the true sources.

    Parameters
    ----------
    frame : Frame
        The raw frame.
    sources : TrueSources
        True sources in and near the frame.
    settings : Settings
        Settings of calibration, detection and measurement.
    masters : Path, optional
        Folder with the masters of `truesky masters`. None for the ideal calibration, which knows the dark current and
        the response of each pixel of the simulated detector; other patterns of its bias stay in the image.
    noise_free : Path, optional
        Image of the expected electrons of the sources, with which cosmic rays and bad pixels are replaced. None to
        leave cosmic rays on CCDs; other bad pixels then have no weight.

    Returns
    -------
    FrameExamples
        Examples of the sources that are at most 1.5 mag fainter than the depth and on pixels with data.
    """
    image, cards = _calibrate(frame, masters)
    if noise_free is not None and settings.cosmic_rays:
        light = np.asarray(read_back.electrons(noise_free).data, float)
        # Exposures and detectors have the same names in each request, but the seeds differ.
        seed = str(frame.card("NOISSEED") or frame.card("SEED"))
        draws = rng.stream(seed, "emulator.cosmic_rays", frame.exposure.exposure_id, frame.detector)
        image = replace_hits(image, light, settings.cosmic_rays, draws)
    header = {keyword: value for keyword, value, _ in cards}
    scale = float(header["PIXSCALE"])
    diameter = settings.aperture * float(header["PSFFWHM"]) / scale
    measured, segments = catalogue.detect_segments(image, 1.0, 0.5 * diameter, settings.limits)
    zero_point = float(header["ZEROPNT"]) + 2.5 * float(np.log10(frame.scene.exposure_time_s))
    conditions = {**planned_conditions(frame, scale), "area": image.image.size * (scale / 60.0) ** 2}
    return compare(
        sources, (measured, segments), image, conditions, Geometry(astrometry.from_cards(cards), scale, zero_point)
    )


@dataclass(frozen=True, slots=True)
class Geometry:
    """Geometry and calibration of an image.

    Attributes
    ----------
    system : WCS
        WCS of the image.
    scale : float
        Pixel scale in arcsec.
    zero_point : float
        AB magnitude of a source with one unit of the image.
    """

    system: Any
    scale: float
    zero_point: float


def compare(
    sources: TrueSources,
    detections: tuple[dict[str, Array], Int],
    image: ReducedImage,
    conditions: dict[str, float],
    geometry: Geometry,
) -> FrameExamples:
    """Compare the detections in an image with the true sources.

    Parameters
    ----------
    sources : TrueSources
        True sources in and near the image.
    detections : (dict, int array)
        Measurements and pixels of detections, from `catalogue.detect_segments`.
    image : ReducedImage
        The image, for its flags.
    conditions : dict of str to float
        Conditions of the image with at least `depth` and `psf_area`.
    geometry : Geometry
        WCS, pixel scale and zero point of the image.

    Returns
    -------
    FrameExamples
        Examples of the sources that are at most 1.5 mag fainter than the depth and on pixels with data.
    """
    measured, segments = detections
    psf = float(features.psf_radius(conditions["psf_area"]))
    radius = np.hypot(sources.radius, psf)
    flux = 10.0 ** (-0.4 * (sources.magnitude - conditions["depth"]))
    matches = matching.match(sources.x, sources.y, flux, radius / geometry.scale, segments)
    ra, dec = astrometry.sky_of_pixel(geometry.system, sources.x, sources.y)
    is_bright = sources.magnitude - conditions["depth"] < -features.BRIGHT
    pairs = features.find_neighbours(sources.ids, ra, dec, is_bright)
    blending = features.neighbour_light(pairs, flux, radius, is_bright)
    rows = np.flatnonzero(_is_example(sources, image, conditions["depth"]))
    source_features = Features(
        sources.magnitude - conditions["depth"], np.log10(radius / psf), blending, features.is_point(sources.ids)
    ).select(rows)
    number = matches.detection[rows]
    offsets = tuple(_values_of(measured[axis], number) - getattr(sources, axis)[rows] for axis in ("x", "y"))
    outcomes = _outcomes(measured, number, matches.is_blended[rows], geometry, sources.magnitude[rows])
    outcomes |= {
        "radius": _values_of(measured["flux_radius"], number) * geometry.scale / radius[rows],
        "dx": offsets[0] * geometry.scale / psf, "dy": offsets[1] * geometry.scale / psf,
    }  # fmt: skip
    numbers: dict[str, Any] = {
        name: value.astype(np.float32) if value.dtype.kind == "f" else value for name, value in outcomes.items()
    }
    measured_ra, measured_dec = astrometry.sky_of_pixel(
        geometry.system, *(sources_axis[rows] + offset for sources_axis, offset in
                           zip((sources.x, sources.y), offsets, strict=True))
    )  # fmt: skip
    claimed = np.unique(matches.detection[matches.detection >= 0]).size
    return FrameExamples(
        Examples(source_features, Outcomes(**numbers)), rows, measured_ra, measured_dec,
        {**conditions, "unmatched": float(len(measured["x"]) - claimed)},
    )  # fmt: skip


def replace_hits(image: ReducedImage, light: Float, limit: float, draws: np.random.Generator) -> ReducedImage:
    """Replace the pixels that cosmic rays hit and bad ones, as a pipeline does that has several exposures of the field.

    Parameters
    ----------
    image : ReducedImage
        The image in electrons, including the sky.
    light : float array, shape (ny, nx)
        Expected electrons of the sources alone.
    limit : float
        Threshold in standard deviations of the noise.
    draws : Generator
        Random generator.

    Returns
    -------
    ReducedImage
        The image, in which hit pixels and their neighbours, and pixels that are flagged as bad for other reasons than
        saturation or missing data, have the expected light and sky with new noise, and the usual weight.

    Notes
    -----
    A pixel is hit if it exceeds the light of the sources and the mean sky by the limit and by a tenth of the light,
    since the response of pixels and the charge transfer are not perfect.
    """
    good = image.weight > 0.0
    excess = image.image - light
    variance = 1.0 / float(np.median(image.weight[good]))
    # The median of pixels, which are whole numbers of ADU, would be wrong by up to half an ADU.
    excess -= np.median(excess[good])
    is_sky = good & (np.abs(excess) < _CLIP * np.sqrt(variance))
    excess -= excess[is_sky].mean()
    sky = float((image.image - light)[is_sky].mean())
    noise = np.sqrt(variance + np.maximum(light, 0.0))
    tolerance = _TOLERANCE * np.maximum(light, 0.0)
    hits = good & (excess > limit * noise + tolerance)
    hits = good & ndimage.binary_dilation(hits, np.ones((3, 3), bool))
    is_bad = (image.flags & _BAD != 0) & (image.flags & (NO_DATA | SATURATED) == 0)
    values, weight = image.image.copy(), image.weight.copy()
    chosen = hits | is_bad
    values[chosen] = sky + light[chosen] + noise[chosen] * draws.standard_normal(int(chosen.sum()))
    weight[is_bad] = 1.0 / variance
    return ReducedImage(values, weight, np.where(is_bad, image.flags & ~np.uint8(_BAD), image.flags))


def planned_conditions(frame: Frame, scale: float) -> dict[str, float]:
    """Return the conditions of a frame as the table `depth` has them for places that only this exposure covers.

    Parameters
    ----------
    frame : Frame
        The frame.
    scale : float
        Pixel scale in arcsec.

    Returns
    -------
    dict of str to float
        `depth`, the magnitude of a point source at 5 sigma (mag), `psf_area` (arcsec2) and `sky` (electron/s/pixel).
    """
    scene, exposure = frame.scene, frame.exposure
    assert scene.detector is not None
    assert scene.band is not None
    sky, variance = _blank_sky(frame)
    psf_area, _ = psf_sizes.sizes(exposure, scene.detector, scene.band, scene.mission, 0)
    electrons = _SIGMA * np.sqrt(variance * psf_area / scale**2)
    depth = exposure.zero_point + 2.5 * np.log10(exposure.exposure_time_s / electrons)
    return {"depth": float(depth), "psf_area": psf_area, "sky": sky}


def _calibrate(frame: Frame, folder: Path | None) -> tuple[ReducedImage, tuple[Card, ...]]:
    """Calibrate a frame with the masters of a folder, or ideal ones; return the image in electrons and its header."""
    options = ReductionOptions("electron", ("persistence",))
    if folder is not None:
        read = nisp.read_masters if frame.scene.ramp else files.read_masters
        return reduce_frame(frame, read(folder, frame, ()), options)
    _, variance = _blank_sky(frame)
    masters = ideal_masters.ideal_masters(frame, math.sqrt(variance))
    without = (*ideal_masters.replaced_kinds(frame), *options.without)
    return reduce_frame(frame, masters, replace(options, without=without))


def _blank_sky(frame: Frame) -> tuple[float, float]:
    """Return the planned sky (electron/s/pixel) and the variance of a pixel of blank sky (electron^2)."""
    scene = frame.scene
    assert scene.detector is not None
    sky, variance = exposure_noise.variances([frame.exposure], [scene.detector], scene.mission)
    return float(sky[0]), float(variance[0])


def _is_example(sources: TrueSources, image: ReducedImage, depth: float) -> Array:
    height, width = image.image.shape
    out = (sources.x > _BORDER) & (sources.x < width - 1 - _BORDER)
    out &= (sources.y > _BORDER) & (sources.y < height - 1 - _BORDER)
    out &= (ids.kind_from_id(sources.ids) <= _LAST_KIND) & (sources.magnitude - depth <= FAINTEST)
    column = np.clip(np.rint(sources.x), 0, width - 1).astype(np.int64)
    row = np.clip(np.rint(sources.y), 0, height - 1).astype(np.int64)
    return np.asarray(out & (image.flags[row, column] & NO_DATA == 0))


def _values_of(values: Array, number: Int) -> Float:
    """Return the values of detections by their number, NaN for the number -1."""
    out = np.full(len(number), np.nan)
    out[number >= 0] = np.asarray(values, float)[number[number >= 0]]
    return out


def _outcomes(
    measured: dict[str, Array], number: Int, is_blended: Array, geometry: Geometry, magnitude: Float
) -> dict[str, Array]:
    """Return the outcomes of sources with these detections (-1 for none), besides radius and position.

    A detection counts as none if the ratio of signal to noise in one of its apertures is below 1, or if it has no size.
    """
    out: dict[str, Array] = {}
    detected = np.asarray(number >= 0) & (_values_of(measured["flux_radius"], number) > 0.0)
    for kind in ("auto", "aper"):
        flux, error = (_values_of(measured[f"{name}_{kind}"], number) for name in ("flux", "fluxerr"))
        detected &= (flux > 0.0) & (flux >= _LEAST_SIGNAL * error)
    for kind in ("auto", "aper"):
        flux = np.where(detected, _values_of(measured[f"flux_{kind}"], number), np.nan)
        out[f"mag_{kind}"] = geometry.zero_point - 2.5 * np.log10(flux) - magnitude
        out[f"magerr_{kind}"] = 2.5 / np.log(10.0) * _values_of(measured[f"fluxerr_{kind}"], number) / flux
    flags = np.zeros(len(number), np.int16)
    flags[detected] = measured["flags"][number[detected]]
    return {"detected": detected, "blended": is_blended, **out, "flags": flags}
