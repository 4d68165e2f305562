"""Arcs of strong lenses in the exposures: galsim's quintic interpolation is the reference; places are on the sky."""

import tracemalloc
from dataclasses import replace

import galsim
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from lake_schema.tables.strong_lenses import STRONG_LENSES
from tests.truesky import nightly
from tests.truesky.render.exposure.test_render import SIDE, field, render
from tests.truesky.render.fields import galaxies, moments, one_source, psf_of, small
from truesky.render.camera.astrometry import sky_of_pixel, wcs
from truesky.render.camera.pointing import boresight_for
from truesky.render.drawing import arcs, cost, reference, stamp_sizes, stamps
from truesky.render.drawing.settings import settings_for
from truesky.render.products import truth_table
from truesky.render.sources.lensed_arcs import Picture
from truesky.request.accuracy import REFERENCE, SURVEY

NOISE = 12.0


def ring(side=40, seed=3):
    """An uneven ring, faint at its edges as arcs are."""
    y, x = (np.mgrid[:side, :side] - 0.5 * (side - 1)) / side
    light = np.exp(-0.5 * ((np.hypot(x, y) - 0.2) / 0.06) ** 2) * (1.2 + np.cos(np.arctan2(y, x) - 0.7))
    light *= 1 + 0.3 * np.random.default_rng(seed).random(light.shape)
    return Picture.from_sky_image((light / light.sum()).astype(np.float32), 0.05)


def pictured(camera, name, picture, electrons, column=80.3, row=77.6):
    detector = small(camera, name)
    system = wcs(detector, *boresight_for(detector, 10.0, 20.0, 33.0))
    point = one_source(detector, system, electrons, column, row)
    return replace(point, picture=np.array([0]), pictures=(picture,))


def drawn(source, psf, accuracy=SURVEY):
    settings, wide = settings_for(accuracy), np.array([source.pictures[0].diagonal / psf.pixel_scale])
    sizes = stamp_sizes.stamp_sizes(source.electrons, source.shape, source.shapes, psf, NOISE, settings, wide)
    neglected = stamp_sizes.neglected_flux(source.electrons, NOISE, settings)
    return stamps.draw(source, sizes, psf, 160, 160, neglected=neglected), int(sizes[0])


@given(st.integers(8, 33), st.integers(8, 33), st.integers(0, 99))
def test_the_transform_is_that_of_the_pixels_under_the_interpolant(rows, columns, seed):
    rng = np.random.default_rng(seed)
    image = rng.random((rows, columns)).astype(np.float32)
    picture = Picture.from_sky_image(image / image.sum(), 0.05)
    jacobian, k = 0.1 * (np.eye(2) + 0.3 * rng.random((2, 2))), rng.uniform(-8, 8, (2, 40))
    west, north = 0.05 * np.linalg.inv(jacobian).T @ k
    y, x = np.mgrid[:rows, :columns] - 0.5 * np.array([rows - 1, columns - 1])[:, None, None]
    waves = np.exp(-1j * (north[:, None, None] * y - west[:, None, None] * x))
    kernel = galsim.Quintic()
    theirs = [kernel.kval(abs(a)) * kernel.kval(abs(b)) for a, b in zip(west, north, strict=True)]
    exact = (waves * picture.image).sum(axis=(1, 2)) * theirs
    np.testing.assert_allclose(arcs.transform(picture, jacobian, *k), exact, atol=1e-6)


@pytest.mark.parametrize(("camera", "name"), [("vis", "2-3"), ("vis", "2-4"), ("lsstcam", "R22_S11")])
@pytest.mark.parametrize(("side", "electrons"), [(40, 2e4), (61, 2e4), (40, 3e7)])
def test_a_picture_is_what_galsim_draws(camera, name, side, electrons):
    """Also in double precision; to what galsim's own interpolation in Fourier space is good for."""
    source, psf = pictured(camera, name, ring(side), electrons), psf_of(camera)
    ours, _ = drawn(source, psf, REFERENCE)
    theirs = np.roll(reference.draw_reference(source, 0, psf, 160), (78 - 80, 80 - 80), (0, 1))
    assert np.abs(ours - theirs)[8:-8, 8:-8].max() < 2e-4 * theirs.max()
    assert ours.sum() == pytest.approx(electrons, rel=1e-5)


@nightly.parametrize(("size", "electrons"), [(320, 1e5), (512, 1e9)], (0,))
def test_memory_is_what_was_predicted(size, electrons):
    source = pictured("vis", "2-3", ring(200), electrons)
    stamps.draw(source, np.array([96]), psf_of("vis"), 64, 64)
    tracemalloc.start()
    try:
        stamps.draw(source, np.array([size]), psf_of("vis"), 256, 256)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < cost.memory(source.electrons, np.array([size]), 256, 256, source.picture) < 2.0 * peak + 5e7


# ------------------------------------------------------------------------------------------------ in an exposure


def lens(source, ra, dec, blobs, side=80):
    """A row of strong_lenses with blobs of 0.1" at (east, north) arcsec of the lens."""
    north, east = (np.mgrid[:side, :side] - 0.5 * (side - 1)) * 0.05
    image = sum(
        weight * np.exp(-0.5 * ((east - e) ** 2 + (north - n) ** 2) / 0.1**2) / (2 * np.pi * 0.1**2) * 0.05**2
        for e, n, weight in blobs
    )
    columns = {
        "id": np.array([(4 << 60) + 7]),
        "source_id": np.array([source]),
        "ra": np.array([ra]),
        "dec": np.array([dec]),
        "stamp_side": np.array([side], np.int16),
        "stamp": pa.array([image.ravel().astype(np.float32)], STRONG_LENSES.column("stamp").arrow_type),
    }
    return pa.table(columns)


def lensed(channel, blobs, body, **options):
    """One lens at the middle of a small detector, its source far off the frame."""
    _, exposed, _, points = field(channel)
    camera, name = ("vis", "3-4") if channel == "VIS" else ("lsstcam", "R22_S11")
    detector = small(camera, name, SIDE)
    system = wcs(detector, exposed["ra"], exposed["dec"], exposed["position_angle"])
    ra, dec = sky_of_pixel(system, [128.0], [128.0])
    row = lens(int(body["id"][0].as_py()), float(ra[0]), float(dec[0]), blobs)
    return render(channel, body, points.slice(0, 0), lenses=row, **options), (float(ra[0]), float(dec[0]))


def far_galaxy(channel, **columns):
    exposed = field(channel)[1]
    return galaxies(exposed["ra"], exposed["dec"] + 3.0, **columns)


@nightly.parametrize("channel", ["VIS", "EXT"], (1,))
def test_arcs_are_where_the_lens_has_them_and_as_bright(channel):
    """A blob north-east of the lens, of 5 times the source's flux: read off the frame by its header."""
    found, (ra, dec) = lensed(channel, [(1.0, 0.6, 5.0)], far_galaxy(channel), flux=30.0)
    assert len(found.sources) == 1
    image = found.noise_free.astype(float)
    expected = 30.0 * 5.0 * exposure_rate(found) * 100.0
    assert found.sources.electrons[0] == pytest.approx(expected, rel=1e-5)
    assert image.sum() == pytest.approx(expected, rel=5e-3)
    centre, _ = moments(np.where(image > 1e-3 * image.max(), image, 0.0))
    at, up = sky_of_pixel(found.wcs, centre[:1], centre[1:])
    east, north = (at[0] - ra) * np.cos(np.radians(dec)) * 3600, (up[0] - dec) * 3600
    assert (east, north) == (pytest.approx(1.0, abs=0.02), pytest.approx(0.6, abs=0.02))
    assert truth_table.truth(found)["method"].to_pylist() == [truth_table.PICTURE]


def exposure_rate(found):
    """Electrons a second of a microjansky."""
    return 10 ** (0.4 * (found.zero_point - 23.9))


def test_the_source_s_own_magnification_is_not_counted_twice():
    plain, _ = lensed("EXT", [(0.5, 0.0, 4.0)], far_galaxy("EXT"))
    magnified, _ = lensed("EXT", [(0.5, 0.0, 4.0)], far_galaxy("EXT", kappa=0.2))
    assert magnified.sources.electrons[0] == pytest.approx(plain.sources.electrons[0] * (1 - 0.2) ** 2, rel=1e-6)


def test_everything_else_is_drawn_as_without():
    _, exposed, body, points = field("EXT")
    other, _ = lensed("EXT", [(0.0, 0.0, 1.0)], body)
    detector = small("lsstcam", "R22_S11", SIDE)
    system = wcs(detector, exposed["ra"], exposed["dec"], exposed["position_angle"])
    ra, dec = sky_of_pixel(system, [-1e4], [128.0])
    away = lens(int(body["id"][0].as_py()), float(ra[0]), float(dec[0]), [(0.0, 0.0, 1.0)])
    base = render("EXT", body, points.slice(0, 0))
    np.testing.assert_array_equal(base.science, render("EXT", body, points.slice(0, 0), lenses=away).science)
    assert (np.diff(other.sources.ids) > 0).all()
    assert len(other.sources) == len(base.sources) + 1


def test_bad_lenses_are_refused():
    _, exposed, body, points = field("EXT")
    row = lens(12345, exposed["ra"], exposed["dec"], [(0.0, 0.0, 1.0)])
    with pytest.raises(BadInput, match=r"strong lens \d+: its source 12345 is not among the galaxies"):
        render("EXT", body, points, lenses=row)
    row = lens(int(body["id"][0].as_py()), exposed["ra"], exposed["dec"], [(0.0, 0.0, 1.0)])
    for stamp, said in (([1.0, 2.0], "got 2 pixels"), ([np.nan] * 6400, "sum nan"), ([0.0] * 6400, "sum 0")):
        bad = row.set_column(5, "stamp", pa.array([stamp], STRONG_LENSES.column("stamp").arrow_type))
        with pytest.raises(BadInput, match=said):
            render("EXT", body, points, lenses=bad)
