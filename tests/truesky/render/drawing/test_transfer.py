"""Transfer by PSF and pixels: each relevant frequency once, at the right place; others are left out harmlessly."""

from dataclasses import replace

import galsim
import numpy as np
import pytest

from tests.truesky.render.fields import galaxies, one_source, psf_of, small
from truesky.render.camera import astrometry
from truesky.render.drawing import stamps, transfer
from truesky.render.psf import model
from truesky.render.psf.model import SAMPLES, Planes
from truesky.render.psf.seeing import moffat_psf
from truesky.render.sources import galaxy_shapes, source_list


def planes_psf(widths=(0.09, 0.13), place=0.0):
    """Return a PSF of Gaussians by wavelength; `place` sets how much wider they are on the right of the detector."""
    axis = (np.arange(129 * SAMPLES) - 129 * SAMPLES // 2) * 0.1 / SAMPLES
    r2 = axis[:, None] ** 2 + axis**2
    images = [np.exp(-0.5 * r2 / w**2) for w in widths]
    images = np.stack([image / image.sum() for image in images]).astype(np.float32)
    drift = (place * (images[1] - images[0]))[None]
    planes = Planes(np.array([6000.0, 8000.0])[: len(widths)], images, drift, (79.5, 79.5), ((1, 0, 0),))
    return model.from_profile(model.galsim_profile(images.mean(axis=0), 0.1 / SAMPLES), 0.1, planes)


def test_places_on_a_detector_are_in_units_of_its_own_sides():
    """The detector has 200 columns and 100 rows. Its borders are at -1 and 1, and its middle is at 0.

    Positions beyond a border have the value of the border.
    """
    psf = replace(planes_psf().planes, half=(99.5, 49.5), powers=((1, 0, 0), (0, 1, 0)))
    column, row = np.array([-0.5, 99.5, 199.5, 149.5, 300.0]), np.array([99.5, 49.5, -0.5, 74.5, -40.0])
    found = transfer.basis_weights(replace(planes_psf(), planes=psf), None, column, row)
    np.testing.assert_allclose(found[:, 2:], [[-1, 1], [0, 0], [1, -1], [0.5, 0.5], [1, -1]], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found[:, :2], 0.5, rtol=1e-12)


@pytest.mark.parametrize("size", [32, 56, 64])
@pytest.mark.parametrize("reach", [2.0, 4.0, 7.5])
def test_a_grid_holds_each_frequency_once(size, reach):
    grid = transfer.grid(size, reach)
    step = 2 * np.pi / size
    ix, iy = (np.rint(k / step).astype(int) for k in (grid.kx, grid.ky))
    most = int(reach / step)
    x, y = np.meshgrid(*[np.arange(-most - 1, most + 2)] * 2)
    wanted = (np.hypot(x, y) * step <= reach) & (x % size <= size // 2)
    assert sorted(zip(ix, iy, strict=True)) == sorted(zip(x[wanted], y[wanted], strict=True))
    # Runs are consecutive, stay in one half plane, and contain the positions of their samples.
    for (first, left, up), after in zip(grid.runs[:-1], grid.runs[1:, 0], strict=True):
        assert (ix[first:after] == np.arange(left, left + after - first)).all()
        assert (iy[first:after] == up).all()
        assert left % size + (after - first) - 1 <= size // 2
    # All samples of a piece are outside its inner edge, and pieces are in order of this edge.
    assert (np.diff(grid.inner) >= 0).all()
    for p, inner in enumerate(grid.inner):
        first, last = grid.runs[grid.pieces[p], 0], grid.runs[grid.pieces[p + 1], 0]
        assert np.hypot(grid.kx, grid.ky)[first:last].min() >= inner - 1e-5


def test_planes_are_the_transform_of_the_psf_s_image():
    psf = planes_psf()
    some = transfer.transfer(psf, 64, 6.0)
    k2 = some.grid.kx.astype(float) ** 2 + some.grid.ky.astype(float) ** 2
    pixel = np.sinc(some.grid.kx / (2 * np.pi)) * np.sinc(some.grid.ky / (2 * np.pi))
    for plane, width in zip(some.planes, (0.9, 1.3), strict=False):
        np.testing.assert_allclose(plane[0], np.exp(-0.5 * k2 * width**2) * pixel, atol=2e-6)
        np.testing.assert_allclose(plane[1], 0.0, atol=2e-6)


def test_psf_in_planes_and_as_a_profile_draw_the_same_image():
    """Weights for colour and position agree with one image made of them, and many sources with each alone."""
    psf, n = planes_psf(place=0.5), 20
    rng = np.random.default_rng(3)
    form = galaxy_shapes.shapes(galaxies(rng.random(n), rng.random(n), inclination=50.0, disk_half_light_radius=0.3))
    red = rng.random(n)
    some = source_list.Sources(
        np.arange(n), 30 + 100 * rng.random(n), 30 + 100 * rng.random(n), np.tile(0.1 * np.eye(2), (n, 1, 1)),
        np.full(n, 1e5), np.where(np.arange(n) % 3 == 0, -1, np.arange(n)), form, np.column_stack([1 - red, red]),
    )  # fmt: skip
    whole = stamps.draw(some, np.full(n, 64), psf, 160, 160)
    alone = sum(stamps.draw(some.take(np.array([i])), np.array([64]), psf, 160, 160) for i in range(n))
    np.testing.assert_allclose(whole, alone, atol=2e-6 * whole.max())
    width = (1 - red) * 0.09**2 + red * 0.13**2 + 0.5 * (some.column - 79.5) / 80 * (0.13**2 - 0.09**2)
    for i in (0, 3, 6):
        image = stamps.draw(some.take(np.array([i])), np.array([64]), psf, 160, 160)
        y, x = np.mgrid[:160, :160]
        second = (image * ((x - some.column[i]) ** 2 + (y - some.row[i]) ** 2)).sum() / image.sum()
        assert second * 0.01 == pytest.approx(2 * (width[i] + 0.01 / 12), rel=1e-3)


@pytest.mark.parametrize("index", [1.0, 4.0])
def test_what_is_left_out_is_below_its_floor(index):
    """Samples beyond the reach of a source, however small it is, change no pixel by more than allowed."""
    detector = small("vis", "3-4")
    system = astrometry.wcs(detector, 10.0, 20.0, 0.0)
    source = one_source(
        detector, system, 1e4, bulge_fraction=0.7, bulge_sersic_index=index, bulge_half_light_radius=1.0
    )
    whole = stamps.draw(source, np.array([128]), psf_of("vis"), 160, 160)
    for floor in (1e-5, 1e-4, 1e-3, 1e-2):
        less = stamps.draw(source, np.array([128]), psf_of("vis"), 160, 160, neglected=np.array([floor]))
        assert np.isfinite(less).all()
        assert np.abs(less - whole).max() < 0.5 * floor * 1e4


def test_max_transfer_is_an_upper_limit_of_the_seeing_disc_s_transform():
    psf = psf_of("lsstcam")
    passing = transfer.max_transfer(psf)
    k = (np.arange(len(passing)) + 0.5) * transfer.STEP
    profile = galsim.Convolve(psf.profile.dilate(5.0), galsim.Pixel(1.0))
    for at, most in zip(k, passing, strict=True):
        assert abs(profile.kValue(at, 0.0)) <= most * 1.1


@pytest.mark.parametrize("beta", [2.5, 3.0])
@pytest.mark.parametrize("size", [32, 40, 64])
def test_wings_that_come_in_are_not_in_the_middle(size, beta):
    """Aliased wings of a seeing disc are near the border of the stamp: less than a tenth is in the middle.

    The reference is a stamp so large that it has no aliased wings.
    """
    detector, seeing = small("lsstcam", "R22_S11"), moffat_psf(0.7, beta, 0.2)
    source = one_source(detector, astrometry.wcs(detector, 10.0, 20.0, 0.0), 1e9, 80.0, 80.0)
    image, whole = (stamps.draw(source, np.array([n]), seeing, 160, 160) for n in (size, 1024))
    assert image.sum() == pytest.approx(1e9, rel=1e-9)
    steps = [n * size for n in range(-8, 9)]
    came_in = 1e9 * 0.04 * sum(seeing.profile.xValue(0.2 * x, 0.2 * y) for x in steps for y in steps if x or y)
    y, x = np.mgrid[:160, :160] - 80
    assert np.abs(image - whole)[np.hypot(x, y) <= size / 8].max() < 0.1 * came_in
    stamp = (np.abs(x + 0.5) < size / 2) & (np.abs(y + 0.5) < size / 2)
    assert (image / whole)[stamp].min() > 0.999


@pytest.mark.parametrize("shear", [0.0, 0.07, -0.3])
def test_a_sheared_spectrum_is_the_series_at_sheared_frequencies(shear):
    """The image fills its period, or is smaller."""
    rng = np.random.default_rng(3)
    for side, period in ((9, 16), (11, 11)):
        image = rng.random((side, side))
        found = transfer.sheared_spectrum(image, period, 5, shear)
        at, ku = np.arange(side) - side // 2, 2 * np.pi * np.fft.fftfreq(period)[:, None]
        kv = 2 * np.pi * np.arange(5) / period
        kx, ky = np.broadcast_arrays(ku - shear * kv, kv)
        wanted = np.einsum("uvy,yx,uvx->uv", np.exp(-1j * ky[..., None] * at), image, np.exp(-1j * kx[..., None] * at))
        np.testing.assert_allclose(found, wanted, atol=1e-9)
