"""The quadrants of VIS as an observer measures them in frames: gain, read noise, full well, drift and noise of rows."""

import numpy as np
import pytest
from astropy.io import fits
from scipy.ndimage import binary_dilation

from lake_schema.mission.configuration import resolve
from tests.truesky.render import nominal
from tests.truesky.render.fields import MISSION, small
from truesky.render.drawing.settings import settings_for
from truesky.render.effects.readout import quadrants
from truesky.render.products import fits_files, headers
from truesky.render.psf import euclid
from truesky.request.accuracy import SURVEY

PRESCAN, OVERSCAN, ROWS = 51, 29, 20
# Largest distance in pixels at which the covariance of pixels is measured: along rows and columns, and in other
# directions. Farther pixels would add more noise than covariance.
LAG, SQUARE = 8, 3
# Effects that an observer has corrected.
CLEAN = nominal.off("bias_structure", *nominal.COSMIC_RAYS)
CORRECTED = nominal.off("nonlinearity", "crosstalk", "detector_crosstalk", "parallel_cti", "serial_cti", "hot_pixels")


def frame(kind, number, seconds, side=1024, forced=None, mission=MISSION):
    detector = small("vis", "3-4", side)
    psf = nominal.psf_with_transforms(small("vis", "3-4", 256), settings_for(SURVEY).colours)
    with pytest.MonkeyPatch.context() as patch:
        # No source is drawn. All frames share a PSF, because its computation takes longer than a frame.
        patch.setattr(euclid, "vis_psf", lambda *_: psf)
        return nominal.rendered(
            detector, [], [], [], kind=kind, number=number, seconds=seconds, forced=forced, truth=("cosmic_rays",),
            mission=mission, sky=0.0 if kind == "bias" else nominal.SKY,
        )  # fmt: skip


def of_header(one, keyword):
    """Return a number of the headers of the four extensions."""
    cards = [{key: value for key, value, _ in headers.amplifier_cards(one, number)} for number in range(4)]
    return np.array([card[keyword] for card in cards])


def above_overscan(one):
    """Return the pixels of the four quadrants in ADU above the mean of the overscan of their quadrant."""
    raw = one.raw.astype(float)[:, :-ROWS]
    level = raw[:, :, -(OVERSCAN // 2) :].mean(axis=(1, 2), keepdims=True)
    return (raw - level)[:, :, PRESCAN:-OVERSCAN]


def clean_pixels(*frames):
    """Return a mask of the pixels of the four quadrants far from true cosmic rays."""
    hit = np.any([one.maps["cosmic_rays"] > 0 for one in frames], axis=0)
    return quadrants.apply(binary_dilation(hit, iterations=3).astype(float), 0, 0, 0) == 0.0


def neighbours(lags):
    """Return offsets (rows, columns) along rows and columns, and in a square, one of each two opposite ones."""
    square = min(lags, SQUARE)
    offsets = [(row, column) for row in range(square + 1) for column in range(-square, square + 1)]
    offsets += [offset for lag in range(square + 1, lags + 1) for offset in ((lag, 0), (0, lag))]
    return [(row, column) for row, column in offsets if row > 0 or column > 0]


def variance(difference, good, lags):
    """Return the variance of pixels, plus the covariances with the pixels around."""
    values = np.where(good, difference - difference[good].mean(), 0.0)
    total = (values**2).sum() / good.sum()
    ny, nx = values.shape
    for row, column in neighbours(lags):
        here = np.s_[row:, max(column, 0) : nx + min(column, 0)]
        there = np.s_[: ny - row, max(-column, 0) : nx - max(column, 0)]
        total += 2.0 * (values[here] * values[there]).sum() / (good[here] & good[there]).sum()
    return total


def gains(pairs, level, side, lags):
    """Return the gain of each quadrant from the noise of pairs of flats, divided by that of its header.

    Relative to the variance, the covariances are the same in all quadrants, and their mean is used.
    """
    mission = resolve(overrides={"vis.flat.signal": (level, "electron")})
    signals, variances, shares = [], [], []
    for pair in range(pairs):
        one, other = (frame("flat", 2 * pair + i, 10.0, side, CORRECTED, mission) for i in (1, 2))
        gain, noise = of_header(one, "GAIN"), of_header(one, "RDNOISE")
        first, second, good = above_overscan(one), above_overscan(other), clean_pixels(one, other)
        signals.append([(first + second)[q][good[q]].mean() for q in range(4)])
        variances.append([variance((first - second)[q], good[q], 0) for q in range(4)])
        shares += [variance((first - second)[q], good[q], lags) / variances[-1][q] for q in range(4)]
    of_reading = 2.0 * (noise / gain) ** 2 + 2.0 / 12.0
    of_light = np.mean(variances, axis=0) * np.mean(shares) - of_reading
    return np.mean(signals, axis=0) / of_light / gain


def test_photon_transfer_gives_the_gain_of_each_quadrant():
    """Flats of 3000 electrons, in which charge repels so little that the variance alone is right within 0.2 %.

    Sample of 4 pairs of 512 x 512 pixels; significance 2e-3 for all quadrants (3.6 standard errors).
    """
    assert gains(4, 3000.0, 1024, 0) == pytest.approx(1.0, abs=0.005)


@pytest.mark.nightly
def test_photon_transfer_with_covariances_gives_the_gain_of_each_quadrant():
    """Flats of 20000 electrons: repelled charge takes variance away, and the covariances to lag 8 give it back.

    Sample of 3 pairs of four quadrants of 2048 x 2048 pixels; significance 3e-3 (3 standard errors).
    """
    assert gains(3, 20_000.0, 4096, LAG) == pytest.approx(1.0, abs=0.005)


def test_pairs_of_biases_give_the_read_noise_of_each_quadrant():
    """Sample of 512 x 512 pixels; significance 1e-5 for all quadrants (5 standard errors)."""
    one, other = (frame("bias", number, 0.0, forced=CORRECTED) for number in (1, 2))
    good, gain = clean_pixels(one, other), of_header(one, "GAIN")
    difference = above_overscan(one) - above_overscan(other)
    found = []
    for q in range(4):
        # The noise of rows is removed with the mean of each row.
        values = np.where(good[q], difference[q], np.nan)
        values -= np.nanmean(values, axis=1, keepdims=True)
        found.append(gain[q] * np.sqrt(np.nanvar(values) / 2.0 - 1.0 / 12.0))
    np.testing.assert_allclose(found, of_header(one, "RDNOISE"), rtol=0.007)
    assert np.ptp(found) > 0.3


def test_a_full_flat_shows_the_full_well_of_each_quadrant():
    mission = resolve(overrides={"vis.flat.signal": (5e5, "electron"), "vis.bias": (1000.0, "adu")})
    one = frame("flat", 1, 10.0, 256, {**CORRECTED, **nominal.off(*nominal.COSMIC_RAYS)}, mission)
    scene = one.scene
    wells, gain = scene.amplifier_values("full_well", "electron"), scene.amplifier_values("gain", "electron / adu")
    assert np.ptp(wells) > 5e3
    plateau = np.median(above_overscan(one), axis=(1, 2)) * gain
    # The overscan has the mean of the settling and of the drift of the bias.
    np.testing.assert_allclose(plateau, np.floor(wells), atol=15.0)
    lowest = (of_header(one, "SATURATE") - 1000.0) * gain
    assert (lowest < plateau).all()
    np.testing.assert_allclose(lowest, plateau, rtol=0.01)


def test_headers_have_the_values_of_their_quadrant(tmp_path):
    """Extension 3-4.E has the line 3-4,E of the table."""
    one = frame("bias", 1, 0.0, 256, CORRECTED)
    rows, writers = fits_files.products(one, ())
    writers[rows["path"][0].as_py()](tmp_path / "own.fits")
    table = {(row["detector"], row["amplifier"]): row for row in MISSION.rows("vis.amplifier_values")}
    with fits.open(tmp_path / "own.fits") as units:
        assert [unit.name for unit in units[1:]] == ["3-4.E", "3-4.F", "3-4.G", "3-4.H"]
        assert not {"GAIN", "RDNOISE", "BIAS", "SATURATE"} & set(units[0].header)
        for unit in units[1:]:
            values = table["3-4", unit.name[-1]]
            for keyword, column in (("GAIN", "gain"), ("RDNOISE", "read_noise"), ("BIAS", "bias")):
                assert unit.header[keyword] == pytest.approx(float(values[column]), rel=1e-6)
            # Prescan and overscan are near the bias level of the header, apart from drift and settling.
            assert unit.data.mean() == pytest.approx(unit.header["BIAS"], abs=3.0)


def overscan_levels(number, **overrides):
    """Return the overscan level of each quadrant, and of each of its rows, in ADU, without the fixed pattern."""
    mission = MISSION.with_overrides({f"vis.{key}": (value, "adu") for key, value in overrides.items()})
    one = frame("bias", number, 0.0, 512, {**CORRECTED, **CLEAN}, mission)
    columns = one.raw.astype(float)[:, :, -OVERSCAN:] - one.scene.amplifier_values("bias", "adu")[:, None, None]
    return columns.mean(axis=(1, 2)), one


def test_the_bias_drifts_from_day_to_day_and_with_no_number_it_does_not():
    """Frames are a day apart, four correlation times: offsets are as different as two random numbers."""
    levels = np.array([overscan_levels(number, bias_row_noise=0.0)[0] for number in range(1, 9)])
    assert levels.std() == pytest.approx(0.5, rel=0.4)
    assert abs(np.diff(levels, axis=0)).mean() > 0.25
    still = np.array([overscan_levels(number, bias_drift=0.0, bias_row_noise=0.0)[0] for number in (1, 2)])
    # The noise of a mean of 276 x 29 pixels is 0.014 ADU.
    assert np.abs(still).max() < 0.07


def test_rows_share_an_offset_with_their_overscan():
    """An observer who subtracts the overscan of each row also removes the noise of rows from the pixels."""
    _, one = overscan_levels(1, bias_row_noise=3.0)
    pixels, overscan = one.raw[:, :, PRESCAN:-OVERSCAN].mean(axis=2), one.raw[:, :, -OVERSCAN:].mean(axis=2)
    for q in range(4):
        assert pixels[q].std() == pytest.approx(3.0, rel=0.15)
        assert np.corrcoef(pixels[q], overscan[q])[0, 1] > 0.98
    _, without = overscan_levels(1, bias_row_noise=0.0)
    assert without.raw[:, :, PRESCAN:-OVERSCAN].mean(axis=2).std(axis=1).max() < 0.12
    # A number of 0 and an effect that is switched off give the same frame.
    off = frame("bias", 1, 0.0, 512, {**CORRECTED, **CLEAN, "row_noise": False})
    np.testing.assert_array_equal(off.raw, without.raw)
