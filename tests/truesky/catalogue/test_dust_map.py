"""The dust map: reddening by latitude and distance, its structure, and external maps."""

import dataclasses

import healpy as hp
import numpy as np
import pytest
from astropy.io import fits
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import sky
from lake_schema.errors import BadInput
from truesky.catalogue import dust_map
from truesky.request.files import DustMap

LAYER = dust_map.layer()
R_V = 3.1


def test_reddening_away_from_the_plane(dust):
    """A median E(B-V) of about 0.03 above 30 deg."""
    _, b = hp.pix2ang(512, np.arange(dust.size), lonlat=True)
    assert np.median(dust[np.abs(b) > 30]) / R_V == pytest.approx(0.027, abs=0.004)
    assert dust.min() > 0.0
    assert dust.max() <= np.float32(3.0 * R_V)


def test_the_cosecant_law_is_the_mean_of_all_maps():
    """E(B-V) = 0.020 / sin b: 0.020 at the poles, 0.040 at 30 deg."""
    small = dataclasses.replace(dust_map.cosecant(), nside=16, l_max=32)
    mean = np.mean([dust_map.make_map(seed, small) for seed in range(60)], axis=0) / R_V
    _, b = hp.pix2ang(16, np.arange(mean.size), lonlat=True)
    assert mean[np.abs(b) > 75].mean() == pytest.approx(0.0203, rel=0.06)
    assert mean[np.abs(np.abs(b) - 30) < 2].mean() == pytest.approx(0.040, rel=0.06)


def test_the_field_has_its_width_and_slope(dust):
    _, b = hp.pix2ang(512, np.arange(dust.size), lonlat=True)
    field = np.log(dust * np.maximum(np.abs(np.sin(np.radians(b))), 0.01))
    uncut = field[np.abs(b) > 5]
    assert uncut.std() == pytest.approx(0.40, abs=0.02)
    field[np.abs(b) <= 5] = uncut.mean()
    power = hp.anafast(field - uncut.mean(), lmax=300, iter=0)
    ell = np.arange(20, 301)
    assert np.polyfit(np.log(ell), np.log(power[20:301]), 1)[0] == pytest.approx(-2.6, abs=0.2)


def test_maps_differ_by_seed_and_repeat():
    small = dataclasses.replace(dust_map.cosecant(), nside=32, l_max=64)
    one = dust_map.make_map(1, small)
    assert np.array_equal(one, dust_map.make_map(1, small))
    assert not np.array_equal(one, dust_map.make_map(2, small))
    # numpy's global generator has no part in it.
    np.random.seed(0)  # noqa: NPY002
    assert np.array_equal(one, dust_map.make_map(1, small))


def test_the_map_is_read_in_galactic_coordinates():
    latitude = np.abs(hp.pix2ang(64, np.arange(hp.nside2npix(64)), lonlat=True)[1]).astype(np.float32)
    # North Galactic pole, Galactic centre, and M31 (l = 121.17, b = -21.57).
    ra, dec = np.array([192.85948, 266.40500, 10.68471]), np.array([27.12825, -28.93617, 41.26875])
    assert dust_map.a_v(latitude, ra, dec) == pytest.approx([90.0, 0.0, 21.57], abs=1.0)


def test_no_dust_in_front_of_the_nearest_stars_and_all_of_it_before_the_farthest():
    total = np.array([0.3])
    assert dust_map.a_v_at(total, np.array([0.0]), 40.0, LAYER, 0.01) == 0.0
    assert dust_map.a_v_at(total, np.array([1e5]), 40.0, LAYER, 0.01) == pytest.approx(0.3)
    half = np.array([np.log(2.0) * LAYER.height])
    assert dust_map.a_v_at(total, half, 90.0, LAYER, 0.01) == pytest.approx(0.15)


@given(st.floats(0.0, 30.0), st.floats(0.0, 1e5), st.floats(1.0, 10.0), st.floats(-90.0, 90.0))
def test_extinction_grows_with_distance(total, distance, times, b):
    ways = np.array([distance, distance * times])
    near, far = dust_map.a_v_at(np.full(2, total), ways, b, LAYER, 0.01)
    assert 0.0 <= near <= far * (1 + 1e-12)
    assert far <= total


# ------------------------------------------------------------------------------------------------ external maps


def synthetic_map(nside=64, frame="G"):
    """Return a synthetic E(B-V) that increases towards (l, b) = (40, 30) deg."""
    lon, lat = hp.pix2ang(nside, np.arange(hp.nside2npix(nside)), lonlat=True)
    if frame == "C":
        lon, lat = sky.galactic(lon, lat)
    return 0.02 + 0.5 * np.exp(-((sky.separation(lon, lat, 40.0, 30.0) / 25.0) ** 2))


def written_map(path, values, nest=False, coord="G", **cards):
    hp.write_map(path, values, nest=nest, coord=coord, column_names=["EBV"], overwrite=True, dtype=np.float64)
    with fits.open(path, mode="update") as units:
        for card, value in cards.items():
            if value is None:
                del units[1].header[card]
            else:
                units[1].header[card] = value
    return DustMap(path, "EBV")


@pytest.mark.parametrize("nest", [False, True])
@pytest.mark.parametrize("coord", ["G", "C"])
def test_an_external_map_is_read_in_its_ordering_and_coordinates(tmp_path, nest, coord):
    values = synthetic_map(frame=coord)
    given = written_map(tmp_path / "map.fits", hp.reorder(values, r2n=True) if nest else values, nest, coord)
    ra, dec = sky.equatorial(np.array([40.0, 60.0, 200.0]), np.array([30.0, 40.0, -70.0]))
    expected = 3.1 * (0.02 + 0.5 * np.exp(-((sky.separation(*sky.galactic(ra, dec), 40.0, 30.0) / 25.0) ** 2)))
    assert dust_map.a_v(dust_map.read(given), ra, dec) == pytest.approx(expected, rel=0.02)


def test_a_fine_map_is_averaged(tmp_path, monkeypatch):
    coarse = dataclasses.replace(dust_map.cosecant(), nside=16)
    monkeypatch.setattr(dust_map, "cosecant", lambda: coarse)
    found = dust_map.read(written_map(tmp_path / "map.fits", synthetic_map(64)))
    assert found.size == hp.nside2npix(16)
    assert found.mean() == pytest.approx(3.1 * synthetic_map(64).mean(), rel=1e-6)


@pytest.mark.parametrize(
    ("cards", "more", "said"),
    [
        ({"ORDERING": "NESTED"}, {}, "smooth only as RING"),
        ({"ORDERING": "ROUND"}, {}, "ORDERING is 'ROUND'"),
        ({"ORDERING": None}, {}, "no ORDERING"),
        ({"COORDSYS": None}, {}, "no COORDSYS"),
        ({"COORDSYS": "E"}, {}, "COORDSYS is 'E'"),
        ({}, {"ordering": "NESTED"}, "ORDERING is 'RING', but ingest.dust.ordering is 'NESTED'"),
        ({"NSIDE": 32}, {}, "header says NSIDE = 32"),
        ({}, {"column": "TAU"}, "no column TAU"),
    ],
)
def test_a_map_with_a_wrong_header(tmp_path, cards, more, said):
    given = written_map(tmp_path / "map.fits", synthetic_map(), **cards)
    with pytest.raises(BadInput, match=said):
        dust_map.read(dataclasses.replace(given, **more))


@pytest.mark.parametrize("value", [np.nan, -1.6375e30, -0.1, 500.0])
def test_an_invalid_pixel_is_named(tmp_path, value):
    values = synthetic_map()
    values[1234] = value
    with pytest.raises(BadInput, match=r"map\.fits: column EBV of row 1235 is"):
        dust_map.read(written_map(tmp_path / "map.fits", values))
