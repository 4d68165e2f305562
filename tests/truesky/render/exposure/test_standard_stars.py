"""Standard stars: five on every detector, with magnitudes of the mission database and colours of their spectra."""

import numpy as np
import pytest

from lake_schema.errors import BadInput
from lake_schema.fits import images, joined
from tests.truesky import nightly
from tests.truesky.render import fields, infrared
from tests.truesky.render.fields import MISSION, small
from truesky.fluxes import passbands
from truesky.fluxes.libraries import templates
from truesky.render.channels.aim import Aim
from truesky.render.exposure import persistence
from truesky.render.exposure.records import PreviousExposure, Rows, Variant
from truesky.render.products import exposure_files, fits_files, headers, truth_table
from truesky.render.psf import euclid
from truesky.request.accuracy import SURVEY

DETECTOR = small("nisp", "DET22", 160)
PLACES = np.array([(0.25, 0.25), (0.75, 0.25), (0.5, 0.5), (0.25, 0.75), (0.75, 0.75)]) * 159


def exposed(target, band="euclid_y", **more):
    return {**infrared.exposed(DETECTOR, kind="standard_star", band=band), "target": target, **more}


def tables(row, mags=(), x=(), y=()):
    """With the spectra of the catalogue's stars, all O9V."""
    bodies, light, points, stars = infrared.tables(DETECTOR, row, mags, x, y)
    for name, kind in (("sed", np.int16), ("mag_h", np.float32), ("a_v", np.float32)):
        points = points.append_column(name, [np.zeros(len(points), kind)])
    return bodies, light, points, stars


def rendered(target, band="euclid_y", mags=(), x=(), y=()):
    row = exposed(target, band)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(euclid, "nisp_psf", lambda d, found, *_: infrared.psf_of(d, band))
        return fields.rendered(row, DETECTOR, tables(row, mags, x, y), MISSION, SURVEY)


def f_nu(target, band):
    """Return the mean f_nu of a spectrum in a band in arbitrary units, from photons counted per wavelength."""
    library, curve = templates.stellar_library(), passbands.load(band)
    flux = np.interp(curve.wavelength, library.wavelength, library.flux[library.names.index(target)])
    return (flux * curve.response * curve.wavelength).sum() / (curve.response / curve.wavelength).sum()


def test_the_star_is_named_once_in_a_file_of_the_exposure(tmp_path):
    rows, writers = fits_files.products(rendered("Vega"), ())
    writers[rows["path"][0].as_py()](tmp_path / "one.fits")
    files, kept = [(name, tmp_path / "one.fits") for name in ("DET22", "DET23")], exposure_files._kept_keywords("nisp")
    exposure_files._write(files, (), joined.no_cards, kept, (), tmp_path / "all.fits")
    first, *arrays = images.read_images(tmp_path / "all.fits")
    assert "Vega" in [value for key, value, _ in first.cards if key == "TARGET"]
    assert "TARGET" not in {key for unit in arrays for key, *_ in unit.cards}


@nightly.parametrize("target", ["Vega", "white dwarf DA"], (1,))
def test_they_are_where_and_as_bright_as_the_mission_says(target):
    """With the field's own sources; Y_E = 17.5, in H by their spectrum."""
    light = {}
    for band in ("euclid_y", "euclid_h"):
        one = rendered(target, band, [20.0], [40.0], [100.0])
        rows = truth_table.truth(one)
        own = (rows["id"].to_numpy() & 0x3FFFF) == 1
        assert own.sum() == 5
        assert len(rows) == 6
        assert (rows["id"].to_numpy() >> 60 == 5).all()
        found = np.stack([rows[name].to_numpy()[own] for name in "xy"], axis=1)
        order, expected = (np.lexsort(places.T) for places in (np.rint(found), np.rint(PLACES)))
        np.testing.assert_allclose(found[order], PLACES[expected], atol=1e-5)
        light[band] = rows["expected"].to_numpy()[own]
        for x, y in np.rint(PLACES).astype(int).tolist():
            assert one.noise_free[y - 6 : y + 7, x - 6 : x + 7].sum() == pytest.approx(light[band][0], rel=0.1)
        assert ("TARGET", target, "calibration source") in headers.science_cards(one)
        np.testing.assert_allclose(
            light[band],
            10 ** (0.4 * (one.zero_point - 17.5)) * infrared.TIME * f_nu(target, band) / f_nu(target, "euclid_y"),
            rtol=1e-5,
        )
        # Hot: more of their photons are blue.
        photons = one.sources.photons[np.isin(one.sources.ids, rows["id"].to_numpy()[own])]
        assert (np.diff(photons, axis=1) < 0).all()
    # AB colours of an A0 star and of a hot white dwarf.
    assert f_nu(target, "euclid_h") < 0.7 * f_nu(target, "euclid_y")


def test_other_images_have_none_and_other_targets_are_refused():
    assert len(infrared.rendered([20.0], [40.0], [40.0], DETECTOR).sources) == 1
    with pytest.raises(BadInput, match="exposure 1: target must be one of Vega, white dwarf DA"):
        rendered("Sirius")


def test_they_leave_persistence():
    """Where they were, with no star of the catalogue about."""
    row = exposed("Vega", mjd=infrared.MJD - 134 / 86400, exposure_id=9)
    aim, variant = Aim.from_exposure(fields.exposure(**row), DETECTOR), Variant(MISSION, SURVEY, {})
    rows = Rows(*tables(row))
    before = PreviousExposure(aim.exposure, lambda: persistence.draw_charge_map(aim, rows, variant, infrared.SEED))
    now = Aim.from_exposure(fields.exposure(**infrared.exposed(DETECTOR)), DETECTOR)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(euclid, "nisp_psf", lambda d, found, *_: infrared.psf_of(d, "euclid_y"))
        left = persistence.total_charge(now, (before,), variant, infrared.SEED)
    x, y = np.rint(PLACES).astype(int).T
    assert (left[y, x] > 20.0).all()
    assert np.median(left) < 1.5
