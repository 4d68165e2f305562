"""Measure the sky, the noise and the bad pixels of a raw frame after an ideal calibration.

The frame is calibrated as `truesky reduce` does, but with the true response and the true dark current of each pixel in
place of master frames, so that the result does not depend on the calibration frames of the lake.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lake_schema import sky
from lake_schema.arrays import Array, Bool, Float, Int
from lake_schema.tables.survey.depth import ORDER
from truesky.reduction import calibration
from truesky.reduction.calibration import Masters, ReducedImage, SkyMesh
from truesky.reduction.frames import Frame
from truesky.reduction.ideal_masters import ideal_masters
from truesky.reduction.infrared import nisp
from truesky.reduction.infrared.ramps import Estimator
from truesky.render.camera import astrometry
from truesky.render.channels import registry
from truesky.render.effects.light import pixel_area
from truesky.render.effects.readout import ramp_noise

# A pixel of the map is bad if at least this fraction of its area is on bad pixels of the detector (assumed).
BAD_FRACTION = 0.01
# Light above the sky is a source if, smoothed by a Gaussian of one pixel, it exceeds its noise by this factor.
_SOURCE_SIGMA = 4.0
# Pixels up to this distance from the detected pixels of a source are no blank sky.
_SOURCE_REACH = 5
# Pixels are compared with those this number of rows away. Neighbours share charge, and columns have their own bias.
_STEP = 4
# Differences beyond this number of standard deviations are left out, and the loss of variance by this.
_CLIP = 4.0
_CLIPPED = math.erf(_CLIP / math.sqrt(2.0)) - math.sqrt(2.0 / math.pi) * _CLIP * math.exp(-0.5 * _CLIP**2)
_KEPT_VARIANCE = _CLIPPED / math.erf(_CLIP / math.sqrt(2.0))
_ROUNDS = 4
# Fewest pixels of blank sky from which noise is measured, with an error of 1.6 %.
_FEWEST = 4000
# Smoothing by a Gaussian of one pixel divides the variance by this.
_SMOOTHING = 4.0 * math.pi
# Rows in which sources are searched at a time, to limit memory, and further rows on both sides.
_ROWS, _MARGIN = 512, 12


@dataclass(frozen=True, slots=True)
class FrameNoise:
    """Sky, noise and bad pixels of a frame.

    Attributes
    ----------
    sky : float
        Mean rate of the sky, electrons / s / pixel; NaN if the frame has no blank sky.
    variance : float
        Variance of a pixel of blank sky without interpixel capacitance, electrons^2; NaN if the frame has no blank sky.
    good : float
        Fraction of the pixels that are good, 0 to 1.
    blank : int
        Number of good pixels of blank sky, which were measured.
    bad_pixels : int64 array, shape (n,)
        HEALPix pixels of order 14, nested, ascending, of whose area at least `BAD_FRACTION` is on bad pixels.
    saturated : int64 array, shape (m,)
        HEALPix pixels of order 14, nested, ascending, with a saturated pixel.
    """

    sky: float
    variance: float
    good: float
    blank: int
    bad_pixels: Int
    saturated: Int


def measure(frame: Frame, hits: Bool | None = None) -> FrameNoise:
    """Measure the sky, the noise and the bad pixels of a frame.

    Parameters
    ----------
    frame : Frame
        A raw frame of the sky in a passband.
    hits : bool array, shape (ny, nx), optional
        Pixels of a CCD that cosmic rays hit, which are not good. In a NISP frame its quality flags mark them.

    Returns
    -------
    FrameNoise
        The measurements.

    Notes
    -----
    The variance is half of that of the differences between blank pixels four rows apart. This leaves out gradients of
    the sky and the bias of columns. For NISP, it is multiplied by the predicted ratio of the variances without and with
    interpixel capacitance, which smooths photon noise as it smooths sources.
    """
    # A hot pixel has more variance by its dark current alone than a normal pixel.
    masters = ideal_masters(frame, frame.scene.pixel_noise**2)
    known_bad = masters.flags
    image = calibrate(frame, masters)
    del masters
    used = image.weight > 0.0
    if hits is not None:
        used &= ~hits
    mesh = SkyMesh.from_image(image.image, used)
    blank = used & ~_find_sources(image, used, mesh)
    level, variance = _clipped_mean(image.image, blank, mesh), _difference_variance(image.image, blank)
    if frame.scene.ramp:
        variance *= _capacitance_ratio(frame, level)
    system = astrometry.from_cards(frame.cards)
    assert frame.scene.detector is not None
    share = (frame.scene.detector.pixel_scale / 3600.0) ** 2 / sky.cell_area(ORDER)
    is_bad = (known_bad != 0) | (image.flags & calibration.NO_DATA != 0)
    saturated = (image.flags & calibration.SATURATED != 0) & ~is_bad
    if hits is not None:
        saturated &= ~hits
    bad, counts = np.unique(_map_pixels(system, is_bad), return_counts=True)
    return FrameNoise(
        level / frame.scene.exposure_time_s,
        variance,
        float(used.mean()),
        int(blank.sum()),
        bad[counts * share >= BAD_FRACTION],
        np.unique(_map_pixels(system, saturated)),
    )


def calibrate(frame: Frame, masters: Masters) -> ReducedImage:
    """Calibrate a frame of a CCD or a ramp of NISP with ideal masters, without correction of persistence.

    Parameters
    ----------
    frame : Frame
        The raw frame.
    masters : Masters
        Masters of `ideal_masters`.

    Returns
    -------
    ReducedImage
        The calibrated image in electrons.
    """
    if frame.scene.ramp:
        return nisp.calibrate(frame, masters, None, tuple(frame.applied), 1.0)
    area = None
    if registry.CHANNELS[frame.exposure.channel].on_ground and pixel_area.EFFECT.name in frame.applied:
        area = pixel_area.parameters(frame.scene)[1:]
    pattern = calibration.SkyPattern(area=area)
    return calibration.calibrate(
        frame.electrons(), frame.saturated_pixels(), masters, frame.scene, frame.applied, 1.0, pattern
    )


def _find_sources(image: ReducedImage, used: Bool, mesh: SkyMesh) -> Bool:
    """Return True for pixels with the light of sources above the noise, and for pixels around them."""
    out = np.zeros(used.shape, bool)
    if not used.any():
        return out
    noise = math.sqrt(1.0 / float(np.median(image.weight[used])) / _SMOOTHING)
    for first in range(0, len(out), _ROWS):
        start, stop = max(first - _MARGIN, 0), min(first + _ROWS + _MARGIN, len(out))
        excess = np.where(used[start:stop], image.image[start:stop] - mesh.rows(slice(start, stop)), 0.0)
        is_source = ndimage.gaussian_filter(excess, 1.0, mode="nearest", radius=4) > _SOURCE_SIGMA * noise
        # The maximum along rows, then along columns, is that of a square, in a tenth of the time of a dilation.
        for axis in (0, 1):
            is_source = ndimage.maximum_filter1d(is_source, 2 * _SOURCE_REACH + 1, axis=axis, mode="constant")
        past = min(first + _ROWS, len(out))
        out[first:past] = is_source[first - start : past - start]
    return out


def _clipped_mean(image: Float, blank: Bool, mesh: SkyMesh) -> float:
    """Return the mean of blank pixels without those far from the level of the sky; NaN for too few pixels."""
    if blank.sum() < _FEWEST:
        return math.nan
    values = image[blank].astype(float)
    excess = values - mesh.rows(slice(0, len(image)))[blank]
    for _ in range(_ROUNDS):
        middle, spread = float(excess.mean()), float(excess.std())
        is_near = np.abs(excess - middle) <= _CLIP * spread
        values, excess = values[is_near], excess[is_near]
    return float(values.mean())


def _difference_variance(image: Float, blank: Bool) -> float:
    """Return half of the variance of differences between blank pixels of a column, electrons^2.

    It is NaN for too few pixels, and for images without noise, in which no depth can be measured.
    """
    pairs = blank[_STEP:] & blank[:-_STEP]
    if pairs.sum() < _FEWEST:
        return math.nan
    difference = (image[_STEP:].astype(float) - image[:-_STEP])[pairs]
    variance = float((difference**2).mean())
    for _ in range(_ROUNDS):
        if variance == 0.0:
            return math.nan
        difference = difference[np.abs(difference) < _CLIP * math.sqrt(variance)]
        variance = float((difference**2).mean()) / _KEPT_VARIANCE
    return 0.5 * variance


def _capacitance_ratio(frame: Frame, level: float) -> float:
    """Return the predicted variance of a pixel without interpixel capacitance, divided by that with it."""
    electrons = np.array([level + frame.scene.dark_electrons])
    drift = {ramp_noise.DRIFT.name} & frame.applied
    plain, smoothed = (Estimator.from_scene(frame.scene, effects) for effects in (drift, frame.applied))
    return float((plain.variance(electrons) / smoothed.variance(electrons))[0])


def _map_pixels(system: object, flags: Array) -> Int:
    """Return the HEALPix pixel of order 14 of each pixel with a True flag."""
    rows, columns = np.nonzero(flags)
    if not len(rows):
        return np.zeros(0, np.int64)
    return sky.cell_at(*astrometry.sky_of_pixel(system, columns, rows), ORDER)
