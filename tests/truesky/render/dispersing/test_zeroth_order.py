"""The zeroth order: position and width of the light follow its polynomial, and its colours are correct."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from tests.truesky.render.dispersing import fine
from tests.truesky.render.dispersing.made import DETECTOR, FIRST, LAST, MISSION, drawn, order, psf, trace
from tests.truesky.render.dispersing.test_lines import galaxies, one
from truesky.render.camera import traces
from truesky.render.dispersing import draw
from truesky.request.accuracy import SURVEY

WAVES = np.arange(float(FIRST), LAST + 1.0)
SIDE, MIDDLE, NOISE = 96, 48.0, 1.0
SETTINGS = draw.settings_for(SURVEY)
STILL = trace((0.0, 1e-6))


def moments(image):
    """Return the centroid, and the second moments: along, across, mixed."""
    rows, columns = np.indices(image.shape)
    total = image.sum()
    centre = np.array([(image * part).sum() / total for part in (columns, rows)])
    along, across = columns - centre[0], rows - centre[1]
    return centre, np.array([(image * part).sum() / total for part in (along**2, across**2, along * across)])


@cache
def grey():
    """Return the PSF of the middle of the band for all wavelengths, so that colours do not shift or widen images."""
    own = psf()
    middle = np.repeat(own.planes.images[1:2], len(own.planes.images), axis=0)
    return replace(own, planes=replace(own.planes, images=middle))


def frame(source, path, spectrum, through):
    of, whole = spectrum[None].astype(np.float32), replace(SETTINGS, min_size=64, edge=10.0)
    return drawn(source, lambda _: of, [order(path)], through, (SIDE, SIDE), NOISE, whole)


@pytest.mark.parametrize(("grism", "tilt"), [("RGS000", 0.0), ("RGS180", 4.0), ("RGS000", -4.0), ("BGS000", 0.0)])
@pytest.mark.parametrize("red", [False, True])
def test_its_place_and_width_are_the_polynomial_s(grism, tilt, red):
    """The position is the mean of the polynomial over the photons. Its scatter adds to the width.

    The reference is the same light without dispersion.
    """
    own = next(part for part in traces.traces(grism, tilt, DETECTOR, MISSION) if part.order == 0)
    # The polynomial of the blue grism is also used with the band and the PSF of the red one.
    path = replace(own, first=float(FIRST), last=float(LAST))
    spectrum = 3e3 / len(WAVES) * (WAVES / 15000.0) ** (4.0 if red else -4.0)
    x, y = path.offsets(0.0, 0.0, WAVES)
    source = fine.placed(one(galaxies(4), 1), *(MIDDLE + 0.3 - float(part.mean()) for part in (x, y)))
    x, y = path.offsets(float(source.column[0]), float(source.row[0]), WAVES)
    mean = [np.average(part, weights=spectrum) for part in (x, y)]
    wide = moments(frame(source, path, spectrum, grey()))
    # Pixels undersample the PSF, so moments of an undispersed image depend on its position within a pixel.
    phases = [
        moments(
            frame(
                fine.placed(source, source.column[0] + mean[0] + shift, source.row[0] + mean[1]),
                STILL,
                spectrum,
                grey(),
            )
        )
        for shift in (0.0, 0.25, 0.5, 0.75)
    ]
    narrow = [
        np.mean([part[0] for part in phases], axis=0) - (0.375, 0.0),
        np.mean([part[1] for part in phases], axis=0),
    ]
    assert np.abs(wide[0] - narrow[0]).max() < 0.01
    scatter = [np.average((a - a_mean) * (b - b_mean), weights=spectrum) for a, a_mean, b, b_mean in (
        (x, mean[0], x, mean[0]), (y, mean[1], y, mean[1]), (x, mean[0], y, mean[1]))]  # fmt: skip
    assert scatter[0] > 2.0
    np.testing.assert_allclose(wide[1] - narrow[1], scatter, atol=3e-3 * scatter[0])


def test_colours_change_within_a_pixel():
    """A block of wavelengths shares a PSF.

    Eight pixels are a tenth of the band in the first order, but the whole band in this order.
    """
    own = next(part for part in traces.traces("RGS000", 0.0, DETECTOR, MISSION) if part.order == 0)
    x, _ = own.offsets(0.0, 0.0, WAVES)
    source = fine.placed(one(galaxies(4), 1), MIDDLE - float(x.mean()), MIDDLE)
    blue, red = (np.where((WAVES < 13000.0) == early, 20.0, 0.0) for early in (True, False))
    apart = frame(source, own, blue, psf()) + frame(source, own, red, psf())
    together = frame(source, own, blue + red, psf())
    assert np.abs(together - apart).max() < 1e-3 * apart.max()
