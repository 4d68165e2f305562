"""Test stacks of dithers: light and positions are conserved, cosmic rays are rejected, and the noise is correct."""

from functools import cache
from pathlib import Path

import numpy as np
import pytest
import sep

from lake_schema.errors import BadInput, OutOfRange
from tests.truesky.render import nominal
from tests.truesky.render.fields import small
from truesky.reduction import files, resampling, stack, stacking
from truesky.reduction.calibration import COSMIC_RAY, ReducedImage
from truesky.render.camera import astrometry

SIDE, SCALE, RADIUS = 260, 0.1, 18.0
# Arcsec; none a whole pixel.
DITHERS = ((0.0, 0.0), (3.13, -2.57), (-1.41, 4.83), (5.27, 2.19))
STARS = ((80.3, 90.8), (170.6, 75.1), (95.2, 175.9), (165.4, 170.2))
SKY, NOISE = 130.0, 4.5


@cache
def dithers(pointed=DITHERS):
    """Return (expected electrons of stars of 19 mag, WCS) of each dither, and the positions of the stars in degrees."""
    detector = small("vis", "3-4", SIDE)
    ra, dec, angle = nominal.pointing(detector)
    first = astrometry.wcs(detector, ra, dec, angle)
    where = astrometry.sky_of_pixel(first, *np.array(STARS).T)
    found = []
    for number, (east, north) in enumerate(pointed, start=1):
        aim = ra + east / 3600.0 / np.cos(np.radians(dec)), dec + north / 3600.0, angle
        system = astrometry.wcs(detector, *aim)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(nominal, "pointing", lambda _, aim=aim: aim)
            x, y = astrometry.pixel_of_sky(system, *where)
            one = nominal.rendered(detector, [19.0] * len(x), x, y, number=number, sky=0.0)
        found.append((one.noise_free.astype(float), system))
    return found, where


def as_reduced(electrons, weight=None):
    """Convert electrons to an image in electrons per second."""
    weight = np.full(electrons.shape, 1.0 / (SKY + NOISE**2)) if weight is None else weight
    rate, weight = electrons / nominal.TIME, weight * nominal.TIME**2
    return ReducedImage(rate.astype(np.float32), weight.astype(np.float32), np.zeros(rate.shape, np.uint8))


def fluxes(image, x, y):
    return sep.sum_circle(np.ascontiguousarray(image, float), x, y, RADIUS, subpix=0)[0]


def centroid(image, x, y):
    """Return the centroid with a Gaussian window of 1.5 pixels, iterated until it converges."""
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    at = np.array([x, y], float)
    for _ in range(30):
        window = image * np.exp(-0.5 * ((columns - at[0]) ** 2 + (rows - at[1]) ** 2) / 1.5**2)
        off = np.array([(window * (columns - at[0])).sum(), (window * (rows - at[1])).sum()]) / window.sum()
        at += 2.0 * off
    return at


def test_no_light_is_lost_and_nothing_moves():
    images, where = dithers()
    made, grid, _ = stack.stack_images([(as_reduced(light), system) for light, system in images], SCALE)
    x, y = astrometry.pixel_of_sky(grid.wcs, *where)
    found = fluxes(made.reduced.image, x, y)
    single = np.mean(
        [fluxes(light, *astrometry.pixel_of_sky(system, *where)) / nominal.TIME for light, system in images], axis=0
    )
    np.testing.assert_allclose(found, single, rtol=1e-3)
    # Nothing is rejected, even at the centre of an undersampled star.
    assert not (made.reduced.flags & COSMIC_RAY).any()
    # Stars inside the frames, all with the same asymmetric PSF.
    seen = np.zeros((len(x), 2))
    for light, system in images:
        places = [centroid(light, *at) for at in zip(*astrometry.pixel_of_sky(system, *where), strict=True)]
        sky = astrometry.sky_of_pixel(system, *np.array(places).T)
        seen += np.array(astrometry.pixel_of_sky(grid.wcs, *sky)).T / len(images)
    found = [centroid(made.reduced.image.astype(float), *at) for at in zip(x, y, strict=True)]
    np.testing.assert_allclose(found, seen, atol=0.02)
    np.testing.assert_allclose(found, np.array([x, y]).T, atol=0.15)


def test_all_light_of_an_image_is_on_the_grid():
    (light, system), *_ = dithers()[0]
    grid = resampling.covering_grid([(system, light.shape)], 0.13)
    pixmap, area = resampling.pixel_map(system, light.shape, grid)
    ra, dec = astrometry.sky_of_pixel(system, [3.0, 200.0], [7.0, 100.0])
    np.testing.assert_allclose(pixmap[[7, 100], [3, 200]].T, astrometry.pixel_of_sky(grid.wcs, ra, dec), atol=1e-6)
    found = resampling.resample(as_reduced(light), pixmap, area, grid.shape)
    assert float((found.image * (found.cover > 0)).astype(float).sum()) * nominal.TIME >= light.sum() * 0.999
    whole = found.cover > 0.999
    assert float(found.image[whole].sum()) * nominal.TIME == pytest.approx(light.sum(), rel=2e-3)


def noisy(seed, hits=0.0):
    """Return dithers with sky, shot noise and read noise, and cosmic rays in a fraction of the pixels."""
    rng, out = np.random.default_rng(seed), []
    for light, system in dithers()[0]:
        counted = rng.poisson(light + SKY) + rng.normal(0.0, NOISE, light.shape)
        counted += (rng.random(light.shape) < hits) * rng.exponential(3000.0, light.shape)
        out.append((as_reduced(counted, 1.0 / (light + SKY + NOISE**2)), system))
    return out


def test_noise_agrees_with_weight_and_correlation():
    """The scatter of sums over many pixels agrees with the weight; single pixels scatter less, as in the header.

    The sample has at least 300 sums; the significance is 3e-3 of their variance (3 standard errors).
    """
    made, *_ = stack.stack_images(noisy(1), SCALE)
    truth, *_ = stack.stack_images([(as_reduced(light + SKY), system) for light, system in dithers()[0]], SCALE)
    deep = (made.reduced.weight > 3.0 * np.median(nominal.TIME**2 / (SKY + NOISE**2))) & (truth.reduced.flags == 0)
    off = np.where(deep, made.reduced.image.astype(float) - truth.reduced.image, np.nan)
    pull = off * np.sqrt(made.reduced.weight)
    ny, nx = (n // 8 * 8 for n in pull.shape)
    sums = pull[:ny, :nx].reshape(ny // 8, 8, nx // 8, 8).sum(axis=(1, 3)) / 8.0
    count = np.isfinite(sums).sum()
    assert count > 300
    blocks, pixels = np.nanvar(sums), np.nanvar(pull)
    # Neighbours outside a block share its noise, too: a little less than the sum over many.
    assert blocks == pytest.approx(0.93, abs=3.0 * np.sqrt(2.0 / count))
    assert np.nanvar(off / np.sqrt(made.variance)) == pytest.approx(1.0, abs=0.03)
    assert stacking.noise_correlation(made) == pytest.approx(blocks / pixels, rel=0.2)
    assert 1.7 < blocks / pixels < 2.6


def test_cosmic_rays_are_rejected():
    hit, *_ = stack.stack_images(noisy(1, hits=0.01), SCALE)
    clean, *_ = stack.stack_images(noisy(1), SCALE)
    flagged = (hit.reduced.flags & COSMIC_RAY) > 0
    assert 0.02 < flagged.mean() < 0.4
    assert ((clean.reduced.flags & COSMIC_RAY) > 0).mean() < 2e-3
    deep = hit.reduced.weight > 0.7 * np.median(clean.reduced.weight[clean.reduced.weight > 0])
    pull = (hit.reduced.image - clean.reduced.image) * np.sqrt(clean.reduced.weight)
    assert np.percentile(np.abs(pull[deep]), 99.0) < 5.0
    assert abs(np.mean(pull[deep])) < 0.1


def test_of_two_images_the_fainter_is_used():
    light = np.zeros((2, 9, 9))
    light[0, 4, 4] = 100.0
    there = np.ones(light.shape, bool)
    found = stacking.outliers(light, np.ones(light.shape), there)
    assert found.sum() == 1
    assert found[0, 4, 4]
    there[1] = False
    assert not stacking.outliers(light, np.ones(light.shape), there).any()


def test_the_effective_psf_agrees_with_a_star_in_the_stack():
    images, where = dithers()
    made, grid, weights = stack.stack_images([(as_reduced(light), system) for light, system in images], SCALE)
    profile = nominal.psf_of(small("vis", "3-4", SIDE)).profile
    parts = [
        stacking.Contribution(system, light.shape, profile, SCALE, weight)
        for (light, system), weight in zip(images, weights, strict=True)
    ]
    x, y = (float(v[0]) for v in astrometry.pixel_of_sky(grid.wcs, *where))
    psf = stacking.effective_psf(parts, grid, x, y)
    n, half = stacking.PSF_SAMPLES, stacking.PSF_SIDE // 2
    assert psf.shape == (n * stacking.PSF_SIDE,) * 2
    assert psf.sum() / n**2 == pytest.approx(0.97, abs=0.03)
    assert np.unravel_index(np.argmax(psf), psf.shape) == (n * half + n // 2,) * 2
    # The star of the stack, pixel by pixel, from the samples about it.
    from scipy.interpolate import RectBivariateSpline

    column, row = round(x), round(y)
    stamp = made.reduced.image[row - 8 : row + 9, column - 8 : column + 9].astype(float)
    offsets = (np.arange(n * stacking.PSF_SIDE) - (n * half + n // 2)) / n
    spline = RectBivariateSpline(offsets, offsets, psf)
    expected = spline(np.arange(-8, 9) + row - y, np.arange(-8, 9) + column - x)
    flux = fluxes(made.reduced.image, [x], [y])[0] / fluxes(psf, [n * half + 1.0], [n * half + 1.0])[0]
    scaled = expected * stamp.sum() / expected.sum()
    assert flux > 0
    np.testing.assert_allclose(scaled, stamp, atol=0.03 * stamp.max())


def test_bad_grids_are_refused():
    (light, system), *_ = dithers()[0]
    with pytest.raises(OutOfRange, match="scale"):
        resampling.covering_grid([(system, light.shape)], 0.0)
    far = system.deepcopy()
    far.wcs.crval = [system.wcs.crval[0], system.wcs.crval[1] + 5.0]
    far.wcs.set()
    with pytest.raises(BadInput, match="too far apart"):
        resampling.covering_grid([(system, light.shape), (far, light.shape)], SCALE)
    assert resampling.covering_grid([(system, light.shape)], 1.0).shape[0] < 60


CARDS = (
    ("INSTRUME", "vis", ""), ("CHANNEL", "VIS", ""), ("FILTER", "euclid_vis", ""), ("ZEROPNT", 25.0, ""),
    ("IMAGETYP", "science", ""), ("EXPOSURE", 1, ""), ("DETECTOR", "3-4", ""), ("EXPTIME", 560.0, ""),
    ("GAIN", 1.0, ""), ("PIXSCALE", 0.1, ""),
)  # fmt: skip


def image_file(path, **changes):
    """Write a small calibrated image; `changes` replaces cards, None removes a card."""
    detector = small("vis", "3-4", SIDE)
    cards = [(key, changes.get(key, value), text) for key, value, text in CARDS]
    cards = (*(card for card in cards if card[1] is not None), *astrometry.cards(astrometry.wcs(detector, 53, -28, 0)))
    ones = np.ones((20, 20), np.float32)
    files.write_image(path, ReducedImage(ones, ones, np.zeros(ones.shape, np.uint8)), cards)
    return str(path)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"IMAGETYP": "stack", "EXPOSURE": None}, "is a stack: use the images from which it was made"),
        *(({keyword: None}, f"has no card {keyword}") for keyword, *_ in CARDS),
        ({"EXPTIME": 0.0}, "EXPTIME = 0.0 must be a number above 0"),
        ({"PIXSCALE": "0.1"}, "PIXSCALE = '0.1' must be a number above 0"),
    ],
)
def test_files_other_than_calibrated_images_are_refused(tmp_path, capsys, changes, words):
    path = image_file(tmp_path / "a.fits", **changes)
    assert stack.main([path, "--out", str(tmp_path / "b.fits")]) == 2
    said = capsys.readouterr().err
    assert (words in said, said.count("\n")) == (True, 1)


@pytest.mark.parametrize(
    ("name", "problem"), [("*.fits", "no file matches this pattern"), ("none.fits", "no such file")]
)
def test_missing_images_are_refused_with_their_origin(tmp_path, capsys, name, problem):
    assert stack.main([str(tmp_path / name), "--out", str(tmp_path / "b.fits")]) == 2
    remedy = "give calibrated images, which truesky reduce LAKE --out FOLDER writes"
    assert capsys.readouterr().err == f"truesky stack: {tmp_path / name}: {problem}; {remedy}\n"


def test_a_scale_of_zero_is_refused(tmp_path, capsys):
    path = image_file(tmp_path / "a.fits")
    assert stack.main([path, "--out", str(tmp_path / "b.fits"), "--scale", "0"]) == 2
    assert "arcsec = 0.0 is outside" in capsys.readouterr().err
    assert not (tmp_path / "b.fits").exists()


def test_message_names_an_image_missing_in_the_lake(tmp_path, monkeypatch):
    """The lake has the exposure and the detector, but not together."""
    monkeypatch.setattr(stack.lake_frames, "from_lake", lambda root, names, numbers, request: {("vis", "3-4"): []})
    image = files.read_image(Path(image_file(tmp_path / "a.fits")))
    with pytest.raises(BadInput, match=r"table products has no image of exposure 1, detector 3-4"):
        stack._find_frames(tmp_path, [image], None)
