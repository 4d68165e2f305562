"""Known wings in rings around stars are recovered, whatever the sky level; those of space are those of the pupil."""

import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import scipy
from astropy.wcs import WCS

from lake_schema.errors import BadInput
from scripts import pupil_wings
from tests.truesky import nightly
from tests.truesky.validation.lake import made
from truesky.validation.lake.measure import wings
from truesky.validation.lake.measure.frames import Amplifier, Frame
from truesky.validation.lake.measure.wings import Wings

SIDE, NOISE, SKY = 700, 14.0, 175.0


def frame(rng, there, band="euclid_vis"):
    """Stars of 4e5 to 1e6 e- and faint ones, with wings from three pixels."""
    x, y = (axis.ravel() for axis in np.meshgrid(*[np.linspace(130, 570, 4)] * 2))
    x, y = (np.concatenate([axis, rng.uniform(0, SIDE, 60)]) for axis in (x, y))
    mag = np.concatenate([rng.uniform(17.8, 18.8, 16), np.full(60, 23.0)])
    known = made.known(x, y, mag)
    axis, image = np.arange(SIDE), np.zeros((SIDE, SIDE))
    # Stars without wings need no sums.
    for across, up, flux in zip(known.x, known.y, known.expected, strict=True) if there.strength else ():
        image += flux * there.profile(np.maximum(np.hypot(axis - across, (axis - up)[:, None]), 3.0))
    image += SKY + NOISE * rng.standard_normal(image.shape)
    amplifier = Amplifier("", (slice(0, SIDE), slice(0, SIDE)), 1.0, 0.0, np.nan, 4.4, 0, 2e5, 4.4)
    return Frame(image.astype(np.float32), (amplifier,), None, header(band), WCS(naxis=2)), known


def header(band):
    return {"CHANNEL": {"euclid_vis": "VIS", "des_r": "EXT"}.get(band, "NISP-P"), "FILTER": band, "PIXSCALE": 0.1}


def typical(band):
    return wings.typical(Frame(np.zeros((2, 2), np.float32), (), None, header(band), WCS(naxis=2)))


@nightly.parametrize("slope", [2.8, 3.1], (0,))
def test_input_power_laws_are_recovered_on_the_ground(slope):
    there = Wings(0.09, slope, outer_radius=250.0)
    of, known = frame(np.random.default_rng(4), there, "des_r")
    found = wings.measure(of, known, np.arange(16), NOISE, 20)
    assert found.slope == pytest.approx(slope, abs=0.15)
    assert found.fraction_beyond(9.0) == pytest.approx(there.fraction_beyond(9.0), rel=0.08)
    assert found.error < 0.1 * found.strength


@nightly.parametrize("factor", [1.3, 0.8], (0,))
def test_the_strength_of_wings_in_space_is_recovered(factor):
    there = replace(typical("euclid_vis"), strength=factor)
    of, known = frame(np.random.default_rng(4), there)
    found = wings.measure(of, known, np.arange(16), NOISE, 20)
    # The typical strength has a weight: its error is 0.1, that of the rings 0.03.
    assert found.error < 0.05
    assert found.strength == pytest.approx(factor, abs=0.08)
    assert found.strength < factor if factor > 1.0 else found.strength > factor - 0.08


def test_the_light_beyond_a_radius_is_the_integral_of_the_profile():
    """Compare with a sum over thin rings; the wings of VIS are far from r^-3."""
    there = typical("euclid_vis")
    edges = np.geomspace(9.2, 2e5, 40001)
    middle = np.sqrt(edges[1:] * edges[:-1])
    total = np.sum(there.profile(middle) * np.pi * np.diff(edges**2))
    assert there.fraction_beyond(9.2) == pytest.approx(total, rel=1e-4)
    assert there.profile(np.array([60.0]))[0] * 6.0**3 > 1.6 * there.profile(np.array([11.0]))[0] * 1.1**3
    assert replace(there, strength=0.0).fraction_beyond(9.2) == 0.0


def test_ground_wings_have_an_outer_radius():
    of, known = frame(np.random.default_rng(4), Wings(0.09, 3.0), "des_r")
    found = wings.measure(of, known, np.arange(16), NOISE, 20)
    assert found.outer_radius == pytest.approx(250.0)
    assert Wings(0.09, 3.0, outer_radius=250.0).fraction_beyond(10.0) == pytest.approx(0.18 * np.pi * (0.1 - 0.004))


def test_points_without_wings():
    of, known = frame(np.random.default_rng(4), Wings(0.0, 3.0))
    found = wings.measure(of, known, np.arange(16), NOISE, 20)
    # The typical wings have a weight of a few per cent.
    assert 0.0 <= found.strength < 0.15
    assert found.error < 0.05 * wings.typical(of).strength


def test_the_wings_in_a_passband_of_a_user_are_those_of_vis():
    frame_of_user = Frame(
        np.zeros((2, 2), np.float32), (), None, {**header("euclid_vis"), "FILTER": "mine"}, WCS(naxis=2)
    )
    assert wings.typical(frame_of_user) == typical("euclid_vis")


@pytest.mark.parametrize(("band", "unsure"), [("euclid_vis", 0.1), ("des_r", 0.5)])
def test_faint_frames_have_typical_wings(band, unsure):
    of, known = frame(np.random.default_rng(4), Wings(0.0, 3.0), band)
    alone, usual = wings.measure(of, known, np.arange(1), NOISE, 20), wings.typical(of)
    assert alone == usual
    assert usual.error == unsure * usual.strength
    # Wings of faint stars are invisible.
    faint = wings.measure(of, known, np.arange(16, 30), NOISE, 20)
    assert faint.strength == pytest.approx(usual.strength * 20.0 ** (faint.slope - usual.slope), rel=0.3)


# Pupil of Euclid (Liaudat et al. 2023), mm: radius, radius and y of the central stop; width and half length of the
# bars, and their centres and angles from x towards y (radian).
RADIUS, STOP, STOP_Y, WIDTH, HALF_LENGTH = 600.0, 197.5, 51.0, 12.0, 350.0
BARS = ((260.0, 240.0, 0.29287), (-330.0, 130.0, -0.69621), (70.0, -330.0, -1.75859))


def pupil(step, n):
    """Return the transmission of the pupil, each sample the mean over 5 x 5 points."""
    fine = (np.arange(5 * n) - 5 * (n // 2) - 2.0) * step / 5.0
    x, y = fine[None, :], fine[:, None]
    clear = (np.hypot(x, y) < RADIUS) & (np.hypot(x, y - STOP_Y) > STOP)
    for bar_x, bar_y, angle in BARS:
        along = np.cos(angle) * (x - bar_x) + np.sin(angle) * (y - bar_y)
        across = np.cos(angle) * (y - bar_y) - np.sin(angle) * (x - bar_x)
        clear &= (np.abs(across) > WIDTH / 2) | (np.abs(along) > HALF_LENGTH)
    return clear.reshape(n, 5, n, 5).mean(axis=(1, 3))


@cache
def growth(transform):
    """Return distances in radian per mm of wavelength, and the fraction of the light within, by a Fourier transform.

    The same samples of the pupil give images whose size is proportional to the wavelength.
    """
    step = 4.0 * RADIUS * 1.02 / transform
    n = 2 * int(np.ceil(RADIUS / step) + 1)
    image = np.abs(scipy.fft.fft2(pupil(step, n), (transform, transform))) ** 2
    axis = np.fft.fftfreq(transform) * transform
    distance = np.hypot(axis, axis[:, None]).ravel()
    order = np.argsort(distance)
    grown = np.cumsum(image.ravel()[order])
    return distance[order] / (transform * step), grown / grown[-1]


def light_between(waves, radii, transform):
    """Return the mean fraction of the light between radii (arcsec) for wavelengths in mm."""
    distance, grown = growth(transform)
    angles = np.radians(np.array(radii) / 3600.0)
    return np.diff(np.mean([grown[np.searchsorted(distance, angles / wave)] for wave in waves], axis=0))


@pytest.mark.parametrize(
    ("band", "first", "last"),
    [("euclid_vis", 550, 900), ("euclid_y", 950, 1212), ("euclid_j", 1168, 1567), ("euclid_h", 1522, 2021)],
)
def test_the_wings_of_space_are_the_fourier_transform_of_the_pupil(band, first, last):
    """The light between 1, 2, 4 and 6.5 arcsec agrees with that of 39 wavelengths between the edges of the band.

    The transform has soft edges and finite samples, which change far light by 3 %.
    """
    there = typical(band)
    radii = np.array([1.0, 2.0, 4.0, 6.5]) * (1.0 if band == "euclid_vis" else 1.7)
    ours = -np.diff([there.fraction_beyond(10.0 * radius) for radius in radii])
    waves = 1e-6 * (first + (np.arange(39) + 0.5) / 39 * (last - first))
    transformed = light_between(waves, radii, 2048)
    print(band, ours / transformed)
    assert ours == pytest.approx(transformed, rel=0.04)


def test_the_table_is_that_of_its_script():
    """Some rows are computed again."""
    pupil_of_mission = pupil_wings.Pupil(pupil_wings.resolve())
    for band, at in (("euclid_vis", 7), ("euclid_h", 20), ("euclid_j", 40)):
        radius, value = wings.read_table()[band][at]
        waves = pupil_wings.band_wavelengths(band)
        assert pupil_wings.profile(pupil_of_mission, waves, radius) == pytest.approx(value, rel=1e-3)


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ("1,2e-3\n1.2,-1e-3", "line 3, column euclid_vis: must be a number above 0, got '-1e-3'"),
        ("1,2e-3\n1.2,", "line 3, column euclid_vis: must be a number above 0, got ''"),
        ("1,2e-3\n1.2", "line 3, column euclid_vis: must be a number above 0, got ''"),
        ("1,2e-3\n1.2,nan", "line 3, column euclid_vis: must be a number above 0, got 'nan'"),
        ("1,2e-3\n1.6,1e-3", "line 3, column radius: must be above the radius before, by at most 50%, got 1.6 after 1"),
        ("1,2e-3\n1,1e-3", "line 3, column radius: must be above the radius before, by at most 50%, got 1 after 1"),
        ("1,2e-3", "the columns must be radius and names of filters, with at least two rows"),
    ],
)
def test_tables_with_gaps_or_negative_values_are_refused(tmp_path, rows, message):
    path = tmp_path / "wings.csv"
    path.write_text(f"radius,euclid_vis\n{rows}\n")
    with pytest.raises(BadInput, match=re.escape(f"{path}: {message}")):
        wings.read_table(path)
