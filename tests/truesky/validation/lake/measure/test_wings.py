"""Known wings in rings around stars are recovered, whatever the sky level."""

import numpy as np
import pytest
from astropy.wcs import WCS

from tests.truesky import nightly
from tests.truesky.validation.lake import made
from truesky.validation.lake.measure import wings
from truesky.validation.lake.measure.frames import Amplifier, Frame
from truesky.validation.lake.measure.wings import Wings

SIDE, NOISE, SKY = 700, 14.0, 175.0


def frame(rng, strength, slope, band="euclid_vis"):
    """Stars of 4e5 to 1e6 e- and faint ones, with power-law wings from three pixels."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(130, 570, 4)] * 2))
    x, y = (np.concatenate([axis, rng.uniform(0, SIDE, 60)]) for axis in (x, y))
    mag = np.concatenate([rng.uniform(17.8, 18.8, 16), np.full(60, 23.0)])
    known = made.known(x, y, mag)
    axis, image = np.arange(SIDE), np.zeros((SIDE, SIDE))
    # Stars without wings need no sums.
    for across, up, flux in zip(known.x, known.y, known.expected, strict=True) if strength else ():
        image += flux * strength * np.maximum(np.hypot(axis - across, (axis - up)[:, None]), 3.0) ** -slope
    image += SKY + NOISE * rng.standard_normal(image.shape)
    amplifier = Amplifier("", (slice(0, SIDE), slice(0, SIDE)), 1.0, 0.0, np.nan, 4.4, 0, 2e5, 4.4)
    channel = {"euclid_vis": "VIS", "des_r": "EXT"}.get(band, "NISP-P")
    header = {"CHANNEL": channel, "FILTER": band, "PIXSCALE": 0.1}
    return Frame(image.astype(np.float32), (amplifier,), None, header, WCS(naxis=2)), known


@nightly.parametrize("slope", [2.8, 3.1], (0,))
def test_input_wings_are_recovered(slope):
    there = Wings(0.09, slope)
    of, known = frame(np.random.default_rng(4), there.strength, slope)
    found = wings.measure(of, known, np.arange(16), NOISE, 20)
    assert found.slope == pytest.approx(slope, abs=0.15)
    assert found.fraction_beyond(9.0) == pytest.approx(there.fraction_beyond(9.0), rel=0.08)
    assert found.error < 0.1 * found.strength


def test_ground_wings_have_an_outer_radius():
    of, known = frame(np.random.default_rng(4), 0.09, 3.0, "des_r")
    found = wings.measure(of, known, np.arange(16), NOISE, 20)
    assert found.outer_radius == pytest.approx(250.0)
    assert Wings(0.09, 3.0, outer_radius=250.0).fraction_beyond(10.0) == pytest.approx(0.18 * np.pi * (0.1 - 0.004))


def test_points_without_wings():
    of, known = frame(np.random.default_rng(4), 0.0, 3.0)
    found = wings.measure(of, known, np.arange(16), NOISE, 20)
    assert 0.0 <= found.strength < 4.0 * found.error
    assert found.error < 0.1 * wings.typical(of).strength


@pytest.mark.parametrize(("band", "unsure"), [("euclid_vis", 0.2), ("des_r", 0.5)])
def test_faint_frames_have_typical_wings(band, unsure):
    of, known = frame(np.random.default_rng(4), 0.0, 3.0, band)
    alone, usual = wings.measure(of, known, np.arange(1), NOISE, 20), wings.typical(of)
    assert alone == usual
    assert usual.error == unsure * usual.strength
    # Wings of faint stars are invisible.
    faint = wings.measure(of, known, np.arange(16, 30), NOISE, 20)
    assert faint.strength == pytest.approx(usual.strength * 20.0 ** (faint.slope - usual.slope), rel=0.3)


@pytest.mark.parametrize(
    ("band", "wavelength"),
    [("euclid_vis", 0.72e-6), ("euclid_y", 1.08e-6), ("euclid_j", 1.37e-6), ("euclid_h", 1.77e-6)],
)
def test_the_usual_wings_of_space_are_those_of_the_edges_of_the_pupil(band, wavelength):
    """The pupil has a stop of 1.2 m, a central obstruction of 0.42 m, and three bars of 12 mm between them."""
    outer, inner, bar = 0.6, 0.21, 0.012
    area = np.pi * (outer**2 - inner**2) - 3 * bar * (outer - inner)
    edges = 2 * np.pi * (outer + inner) + 6 * (outer - inner)
    wanted = wavelength * edges / (4 * np.pi**3 * area) * np.degrees(1.0) * 3600.0
    of, _ = frame(np.random.default_rng(4), 0.0, 3.0, band)
    assert wings.typical(of).strength * of.scale == pytest.approx(wanted, rel=0.15)
