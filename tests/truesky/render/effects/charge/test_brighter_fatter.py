"""Brighter-fatter: charge only moves, stars widen in proportion to their peaks, flats lose variance as predicted."""

from dataclasses import replace
from pathlib import Path

import galsim
import numpy as np
import pytest

from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import resolve
from tests.truesky.render.fields import small
from truesky.render.effects.charge import brighter_fatter
from truesky.render.effects.scene import Scene
from truesky.request import accuracy

SHIFT, SOFT, FULL = 1.2e-7, 0.5, 2e5
# Equal displacements of borders between columns and between rows.
EVEN = (SHIFT, SHIFT)


def widths(image):
    y, x = np.mgrid[: image.shape[0], : image.shape[1]]
    total = image.sum()
    dx, dy = x - (image * x).sum() / total, y - (image * y).sum() / total
    return np.sqrt([(image * dx * dx).sum() / total, (image * dy * dy).sum() / total])


def star(peak):
    y, x = np.mgrid[:25, :25]
    return np.rint(peak * np.exp(-((x - 12.2) ** 2 + (y - 11.9) ** 2) / (2 * 0.7**2)))


def test_a_star_at_full_well_is_one_to_two_per_cent_wider():
    growth = {}
    for peak in (5e4, 2e5):
        image = star(peak)
        mean = np.mean(
            [brighter_fatter.apply(image, EVEN, SOFT, FULL, 0.0, 0, np.random.default_rng(i)) for i in range(50)],
            axis=0,
        )
        growth[peak] = widths(mean) / widths(image) - 1
    assert (growth[2e5] > 0.01).all()
    assert (growth[2e5] < 0.02).all()
    np.testing.assert_allclose(growth[5e4], growth[2e5] / 4, rtol=0.1)


def test_variance_of_a_flat_falls_as_predicted():
    level = 1e5
    flat = np.random.default_rng(1).poisson(level, (1200, 1200)).astype(float)
    out = brighter_fatter.apply(flat, EVEN, SOFT, FULL, 0.0, 0, np.random.default_rng(2))
    assert out.sum() == flat.sum()
    lost = 1 - out.var() / flat.var()
    assert lost == pytest.approx(brighter_fatter.variance_slope(EVEN, SOFT) * level, rel=0.1)
    # The neighbours of a pixel get the part of its fluctuation that it loses.
    rest = out - out.mean()
    assert (rest[:, 1:] * rest[:, :-1]).mean() > 0.0015 * level
    assert (rest[1:] * rest[:-1]).mean() > 0.0015 * level


def test_rows_and_columns_are_alike():
    image = star(1e5)
    one = np.mean(
        [brighter_fatter.apply(image, EVEN, SOFT, FULL, 0.0, 0, np.random.default_rng(i)) for i in range(60)], 0
    )
    two = np.mean(
        [brighter_fatter.apply(image.T, EVEN, SOFT, FULL, 0.0, 0, np.random.default_rng(i)) for i in range(60)], 0
    )
    assert np.abs(one - two.T).max() < 1.0


def covariances(shifts, soft, level, side=3000):
    """Return the covariances of neighbours in a row and in a column of a flat, divided by the squared mean, 1/e-."""
    flat = np.random.default_rng(1).poisson(level, (side, side)).astype(float)
    out = brighter_fatter.apply(flat, shifts, soft, FULL, 0.0, 0, np.random.default_rng(2))
    assert out.sum() == flat.sum()
    rest = out - out.mean()
    return (rest[:, 1:] * rest[:, :-1]).mean() / level**2, (rest[1:] * rest[:-1]).mean() / level**2


@pytest.mark.parametrize("ratio", [1.0, 1.66])
def test_covariances_of_flats_in_rows_and_columns_are_those_of_the_borders(ratio):
    """Flats of LSSTCam with 2e4 electrons, in which second-order terms are small.

    Sample of 3000 x 3000 pixels; significance 6e-7 (5 standard errors) plus 5 % for terms of higher order.
    """
    level, side, soft = 2e4, 3000, 0.3
    shifts = brighter_fatter.border_shifts(7.75e-7, ratio)
    assert np.mean(shifts) == pytest.approx(7.75e-7, rel=1e-12, abs=0.0)
    found = covariances(shifts, soft, level, side)
    expected = brighter_fatter.covariance_slopes(shifts, soft)
    error = 5.0 / (level * side)
    for one, other in zip(found, expected, strict=True):
        assert one == pytest.approx(other, rel=0.05, abs=error)
    # The mean of both directions does not depend on the ratio.
    even = brighter_fatter.covariance_slopes((7.75e-7, 7.75e-7), soft)
    assert np.mean(expected) == pytest.approx(np.mean(even), rel=1e-12, abs=0.0)


def border_ratio(model):
    """Return the displacement of borders between rows over that between columns in a sensor model of GalSim.

    The model has the vertices of 9 x 9 pixels of 10 um with 1e5 electrons in the central one.
    """
    x0, y0, angle, x, y = np.loadtxt(Path(galsim.meta_data.share_dir) / "sensors" / f"{model}.dat", skiprows=1).T
    centre = np.median(x0)
    of_pixel = (x0 == centre) & (y0 == centre)
    across, up, angle = (np.abs(values[of_pixel]) for values in (x - centre, y - centre, angle - np.pi))
    # Leave out corners, which belong to both borders.
    steep = np.abs(np.tan(angle))
    return (5.0 - up[steep > 1.01]).mean() / (5.0 - across[steep < 0.99]).mean()


def test_the_ratio_of_lsstcam_is_that_of_the_sensor_models():
    ratios = [border_ratio(model) for model in ("lsst_e2v_50_8", "lsst_itl_50_8")]
    assert np.ptp(ratios) < 0.1
    assert resolve().value("ext.lsstcam.bfe.shift_ratio", "") == pytest.approx(np.mean(ratios), abs=0.01)


def test_lsstcam_has_larger_covariances_in_columns_than_in_rows():
    """Sensors of LSST have ratios of 2 to 3 (GalSim's models of both makers have 2.4 and more); VIS is assumed even.

    Flats of 5e4 electrons, sample of 3000 x 3000 pixels; significance 6e-7: 5 standard errors of the ratio are 0.4.
    """
    mission, parameters = resolve(), {}
    for section in ("ext.lsstcam", "vis"):
        kind = small("lsstcam", "R22_S11", 64) if section != "vis" else small("vis", "3-4", 64)
        scene = Scene(mission, section, 30.0, 50.0, 1e5, kind)
        parameters[section] = brighter_fatter.EFFECT.parameters(scene)
    (shifts, soft, *_), (even, *_) = parameters["ext.lsstcam"], parameters["vis"]
    assert even[0] == even[1]
    in_rows, in_columns = covariances(shifts, soft, 5e4)
    linear = brighter_fatter.covariance_slopes(shifts, soft)
    assert linear[1] / linear[0] == pytest.approx(2.76, abs=0.01)
    assert in_columns / in_rows == pytest.approx(2.76, abs=0.4)


def test_kernel_falls_off():
    weights = brighter_fatter.kernel(SHIFT, SOFT)
    assert weights.shape == (5, 2)
    assert weights[2, 0] == SHIFT
    assert (np.diff(weights[2:, 0]) < 0).all()
    np.testing.assert_array_equal(weights, weights[::-1])


def test_charge_above_full_well_does_not_repel():
    image = star(1e9)
    out = brighter_fatter.apply(image, EVEN, SOFT, FULL, 0.0, 0, np.random.default_rng(1))
    assert out.min() >= 0
    assert out.sum() == image.sum()


def through(light, between):
    """As a detector with rows of charge injection does it, all borders followed."""
    detector = replace(small("vis", "3-4", 2), nx=light.shape[1], ny=len(light), injection_rows=between)
    one = Scene(resolve(), "vis", 560.53, 0.25, 1e5, detector)
    *parameters, _, rows = brighter_fatter.EFFECT.parameters(one)
    return brighter_fatter.EFFECT.apply(light, *parameters, 0.0, rows, rng=np.random.default_rng(5))


def test_rows_of_charge_injection_hold_nothing_that_repels():
    """Neither half knows what shone between them, or on the other; each loses to them as its charge says.

    Sample of 2000 columns; significance 6e-7 of each row's mean (5 standard errors).
    """
    level, rng = 1e5, np.random.default_rng(1)
    flat = rng.poisson(level, (40, 2000)).astype(float)
    lit = flat.copy()
    lit[19:21], lit[22:] = 1.9e5, 0.0
    out, other = (through(light, 4) for light in (flat, lit))
    np.testing.assert_array_equal(out[:18], other[:18])
    assert out.sum() == flat.sum()
    change = (out - flat).mean(axis=1)
    # The field of one side alone at the border, half of it on average while light falls; less what comes from behind.
    weights = brighter_fatter.kernel(SHIFT, SOFT)
    lost = 0.5 * weights.sum() * level**2
    passed = 0.5 * weights[:, 1].sum() * level**2
    error = 5 * np.sqrt(0.05 * level / 2000)
    for last, before, beside in ((17, 16, 18), (22, 23, 21)):
        assert change[last] == pytest.approx(passed - lost, rel=0.02, abs=error)
        assert change[before] == pytest.approx(-passed, rel=0.05, abs=error)
        assert change[beside] == pytest.approx(lost, rel=0.02, abs=error)
    assert 0.008 * level < -change[17] < 0.01 * level
    assert np.abs(change[[2, 10, 30, 37]]).max() < error
    # Where there are no such rows the halves are neighbours.
    assert np.abs((through(flat, 0) - flat).mean(axis=1)).max() < error


def test_negligible_charge_does_not_move():
    """Faint pixels stay as they are; about a bright star the same electrons cross as if all were followed."""
    light = np.random.default_rng(3).poisson(140.0, (300, 400)).astype(float)
    light[100:125, 200:225] += star(1.5e5)
    light[297:, 397:] += 5e4
    every, some = (
        brighter_fatter.apply(light, EVEN, SOFT, FULL, dim, 0, np.random.default_rng(4)) for dim in (0.0, 700.0)
    )
    assert some.sum() == light.sum()
    np.testing.assert_array_equal(every[105:120, 205:220], some[105:120, 205:220])
    np.testing.assert_array_equal(every[298:, 398:], some[298:, 398:])
    assert (some != light)[100:125, 200:225].sum() > 20
    np.testing.assert_array_equal(some[:90], light[:90])
    left_out = every - some
    assert 0 < np.sqrt(np.mean(left_out**2)) < 0.1 * np.sqrt(140.0 + 4.4**2)
    assert np.abs(left_out).max() <= 1.0


@pytest.mark.parametrize("preset", ["draft", "survey", "reference"])
def test_the_threshold_is_within_the_accuracy(preset):
    """Errors of a star just below the threshold: its size, and charge that would cross the borders of its pixels."""
    wanted = accuracy.preset(preset)
    scene = Scene(resolve(), "vis", 560.53, 0.25, 1e4, accuracy=wanted)
    shifts, softening, full, dim, _ = brighter_fatter.EFFECT.parameters(scene)
    bright = star(2e5)
    mean = np.mean(
        [brighter_fatter.apply(bright, shifts, softening, full, 0.0, 0, np.random.default_rng(i)) for i in range(50)],
        axis=0,
    )
    growth = (widths(mean) ** 2).sum() / (widths(bright) ** 2).sum() - 1
    assert 0 < growth * dim / 2e5 <= wanted.shape
    # Pixels of as much that lose over four borders, to empty neighbours: so little that it is not noticed.
    frame = np.zeros((400, 400))
    frame[2::5, 2::5] = np.floor(dim)
    left_alone, followed = (
        brighter_fatter.apply(frame, shifts, softening, full, least, 0, np.random.default_rng(6))
        for least in (dim, 0.0)
    )
    np.testing.assert_array_equal(left_alone, frame)
    noticed = wanted.background * scene.pixel_noise
    lost = (frame - followed)[2::5, 2::5].mean()
    assert 0 < lost <= noticed
    # Nor is more followed than need be: by the accuracy that a background asks for, or a star's size.
    assert lost > 0.1 * noticed or growth * dim / 2e5 > 0.3 * wanted.shape


def test_a_pixel_never_gives_more_than_it_can_spare():
    """At the largest shift borders would move past whole pixels: each gives a fifth over each of four."""
    frame = np.zeros((9, 9))
    frame[4, 4] = 1e5
    out = brighter_fatter.apply(frame, (1e-4, 1e-4), SOFT, FULL, 0.0, 0, np.random.default_rng(1))
    assert out.min() >= 0
    assert out.sum() == frame.sum()
    # Charge crosses one border after the other, each time a fraction of the remaining charge.
    assert out[4, 4] == pytest.approx(1e5 * (1 - brighter_fatter.MAX_CROSSING) ** 4, abs=4)
    assert out[4, 3] == brighter_fatter.MAX_CROSSING * 1e5


@pytest.mark.parametrize(
    "wrong",
    [
        ((-1.0, 1e-7), 0.5, 2e5, 0.0), ((1e-7, np.nan), 0.5, 2e5, 0.0), (EVEN, -1.0, 2e5, 0.0), (EVEN, 0.5, 0.0, 0.0),
        (EVEN, 0.5, 2e5, np.nan),
    ],
)  # fmt: skip
def test_nonsense_is_refused(wrong):
    with pytest.raises(OutOfRange, match=r"brighter|full well"):
        brighter_fatter.apply(np.ones((3, 3)), *wrong, 0, np.random.default_rng(1))
