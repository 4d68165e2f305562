"""Galaxies of a library: a stamp of a profile is drawn like the profile, and invalid libraries are refused."""

from dataclasses import replace

import galsim
import numpy as np
import pyarrow as pa
import pytest
from astropy.io import fits

from lake_schema.errors import BadInput
from lake_schema.store.provenance import file_sha256
from tests.truesky import nightly
from tests.truesky.render.drawing.test_structure import with_structure
from tests.truesky.render.exposure.test_render import SIDE
from tests.truesky.render.fields import galaxies, moments
from truesky.render.products import keys, truth_table
from truesky.render.sources import galaxy_shapes, galaxy_stamps
from truesky.render.sources.galaxy_stamps import GalaxyStamps
from truesky.request.structure import Stamps

# (Sersic index, axis ratio, deg from the columns towards the rows) of stamps with a half-light radius of 12 pixels.
KINDS = [(1.0, 0.6, 20.0), (1.0, 1.0, 0.0), (2.0, 0.8, 110.0), (1.0, 0.3, 75.0)]
RADIUS = 12.0


def stamp(index, ratio, angle, side=192):
    """Return a drawing by galsim, without a PSF except the pixels of the stamp."""
    body = galsim.Sersic(index, half_light_radius=RADIUS * np.sqrt(ratio))
    turned = body.shear(q=ratio, beta=angle * galsim.degrees)
    return turned.drawImage(nx=side, ny=side, scale=1.0, dtype=float).array


@pytest.fixture(scope="module")
def cube(tmp_path_factory):
    path = tmp_path_factory.mktemp("library") / "library.fits"
    scaled = [float(10**n) * stamp(*kind) for n, kind in enumerate(KINDS)]
    fits.writeto(path, np.array(scaled, np.float32))
    return path


def library(path):
    return galaxy_stamps.read(path, file_sha256(path))


def stamps(path, seed=1, **wanted):
    wanted = Stamps(path, **wanted)
    return galaxy_stamps.from_file(wanted, seed, file_sha256(path))


def rows(stamp, **columns):
    """Return galaxies with a column of stamp numbers."""
    found = galaxies(np.full(len(stamp), 10.0), np.full(len(stamp), 20.0), **columns)
    return found.append_column("stamp", pa.array(stamp, pa.int32()))


def test_a_library_is_measured(cube):
    found = library(cube)
    np.testing.assert_allclose(found.radius, RADIUS, rtol=0.01)
    np.testing.assert_allclose(found.ratio, [ratio for _, ratio, _ in KINDS], atol=0.01)
    apart = np.degrees(found.angle) - [angle for *_, angle in KINDS]
    assert np.abs((apart + 90.0) % 180.0 - 90.0)[[0, 2, 3]].max() < 0.2
    np.testing.assert_allclose(found.images.sum(axis=(1, 2)), 1.0, rtol=1e-5)
    # The stamp of a bulge is the most concentrated.
    assert found.inner.argmax() == 2


@nightly.parametrize(
    ("number", "body"),
    [
        (1, {"bulge_fraction": 0.0, "disk_half_light_radius": 1.0, "inclination": 0.0}),
        (2, {"bulge_fraction": 1.0, "bulge_half_light_radius": 1.0, "bulge_axis_ratio": 0.8}),
    ],
    (0,),
)
def test_a_stamp_of_a_profile_is_drawn_as_the_profile(cube, number, body, monkeypatch):
    """Position, flux, size, orientation and shear agree. The pixels of a stamp are a twelfth of the radius."""
    body |= {"bulge_sersic_index": 2.0, "position_angle": 35.0, "kappa": 0.05, "gamma1": 0.1, "gamma2": 0.07}
    direct, _ = with_structure("VIS", None, body)

    def listed(ra, dec, **columns):
        return galaxies(ra, dec, **columns).append_column("stamp", pa.array([number], pa.int32()))

    monkeypatch.setattr("tests.truesky.render.drawing.test_structure.galaxies", listed)
    drawn, _ = with_structure("VIS", None, body, stamps=stamps(cube))
    assert truth_table.truth(drawn)["method"].to_pylist() == [truth_table.PICTURE]
    assert drawn.sources.ids.tolist() == direct.sources.ids.tolist()
    assert drawn.sources.electrons[0] == direct.sources.electrons[0]
    images = [one.noise_free.astype(float) for one in (drawn, direct)]
    assert images[0].sum() == pytest.approx(images[1].sum(), rel=2e-3)
    assert np.abs(images[0] - images[1]).max() < 0.01 * images[1].max() * (1.0 if number == 1 else 5.0)
    bright = [np.where(image > 0.02 * images[1].max(), image, 0.0) for image in images]
    (centre, second), (at, wanted) = (moments(image) for image in bright)
    np.testing.assert_allclose(centre, at, atol=0.02)
    np.testing.assert_allclose(second, wanted, atol=0.015 * np.trace(wanted))
    # A galaxy without a stamp number is drawn as a profile, bit by bit.
    monkeypatch.setattr("tests.truesky.render.drawing.test_structure.galaxies", galaxies)
    np.testing.assert_array_equal(with_structure("VIS", None, body, stamps=stamps(cube))[0].science, direct.science)
    assert images[0].shape == (SIDE, SIDE)


def test_a_stamp_lies_along_the_row_s_position_angle(cube):
    """The major axis has the position angle and the length in the row, whatever its direction in the file is."""
    table = rows([0, 2, 3], position_angle=[10.0, 80.0, 140.0], disk_half_light_radius=[1.0, 2.0, 0.5])
    number, found = galaxy_stamps.assign_pictures(table, galaxy_shapes.shapes(table), stamps(cube))
    assert number.tolist() == [0, 1, 2]
    own = library(cube)
    for picture, which, angle, radius in zip(found, (0, 2, 3), (10.0, 80.0, 140.0), (1.0, 2.0, 0.5), strict=True):
        along = own.radius[which] * np.array([np.cos(own.angle[which]), np.sin(own.angle[which])])
        west, north = picture.matrix @ along
        assert np.hypot(west, north) == pytest.approx(radius, rel=1e-6)
        # The angle counts from north through east.
        assert np.degrees(np.arctan2(-west, north)) % 180.0 == pytest.approx(angle, abs=1e-4)


def test_the_nearest_in_shape_are_drawn_by_the_galaxy_s_identifier(tmp_path):
    ratios = np.linspace(0.2, 1.0, 16)
    path = tmp_path / "many.fits"
    fits.writeto(path, np.array([stamp(1.0, ratio, 0.0, 64) for ratio in ratios], np.float32))
    n = 300
    table = rows([None] * n, inclination=np.full(n, 30.0), disk_half_light_radius=np.r_[np.full(n - 1, 1.0), 0.1])
    shape, wanted = galaxy_shapes.shapes(table), stamps(path, nearest=True)
    number, found = galaxy_stamps.assign_pictures(table, shape, wanted)
    assert number[-1] == -1
    which = [int(np.argmax([np.array_equal(p.image, image) for image in wanted.library.images])) for p in found]
    # Eight stamps are used about equally often. They are nearly as round as the inclined disc.
    assert set(which) == set(range(8, 16)) or set(which) == set(range(9, 16)) | {7}
    assert np.bincount(which)[min(which) :].min() > 15
    some = np.arange(0, n, 7)
    again, fewer = galaxy_stamps.assign_pictures(table.take(some), shape.take(some), wanted)
    pairs = [(fewer[a].image, found[b].image) for a, b in zip(again, number[some], strict=True) if b >= 0]
    assert all(np.array_equal(*pair) for pair in pairs)
    _, other = galaxy_stamps.assign_pictures(table, shape, replace(wanted, seed=2))
    assert any(not np.array_equal(a.image, b.image) for a, b in zip(found, other, strict=True))
    # Unless the nearest stamps are requested, only galaxies with a stamp number have a picture.
    assert not galaxy_stamps.assign_pictures(table, shape, stamps(path))[1]


def test_bad_libraries_are_refused(tmp_path, cube):
    good = np.array([stamp(*kind, 64) for kind in KINDS[:2]], np.float32)
    hole, dark, noisy, point = (good.copy() for _ in range(4))
    hole[1, 3, 4] = np.nan
    dark[0] *= -1.0
    noisy[1, ::2] -= 0.02 * noisy[1].max()
    point[1] = 0.0
    point[1, 32, 32] = 1.0
    path = tmp_path / "bad.fits"
    for data, said in (
        (good[0], "is an image of 2 axes, but must have three: columns, rows, stamps"),
        (good[:, :8], "its stamps have 64 x 8 pixels, but 16 to 1024 per side is allowed"),
        (hole, "stamp 1 contains values that are not numbers"),
        (dark, "stamp 0 sums to -"),
        (noisy, "stamp 1: negative pixels exceed 0.01 of its light"),
        (point, "stamp 1: half-light radius is "),
    ):
        fits.writeto(path, data, overwrite=True)
        with pytest.raises(BadInput, match=rf"bad.fits: {said}") as refused:
            keys.stamp_files(path)
        assert "\n" not in str(refused.value)
    path.write_text("no FITS")
    with pytest.raises(BadInput, match=r"bad.fits: is not a FITS file"):
        keys.stamp_files(path)
    with pytest.raises(BadInput, match=r"structure.stamps.file: .*nowhere.fits: no such file"):
        keys.stamp_files(tmp_path / "nowhere.fits")
    table = rows([1, 4])
    with pytest.raises(BadInput, match=r"galaxy \d+: stamp 4 does not exist, .*library.fits has stamps 0 to 3"):
        galaxy_stamps.assign_pictures(table, galaxy_shapes.shapes(table), stamps(cube))
    with pytest.raises(BadInput, match=r"library.fits: has changed since the rendering began"):
        galaxy_stamps.from_file(Stamps(cube), 1, "another")


def test_galaxy_larger_than_the_largest_stamp_is_drawn_as_a_profile(cube):
    table = rows([0, 0], disk_half_light_radius=[1.0, 40.0])
    own = GalaxyStamps(library(cube), Stamps(cube), 1)
    number, found = galaxy_stamps.assign_pictures(table, galaxy_shapes.shapes(table), own)
    assert number.tolist() == [0, -1]
    assert len(found) == 1
