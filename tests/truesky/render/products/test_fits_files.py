"""FITS files of a detector and their rows of `products`."""

from dataclasses import asdict, replace

import numpy as np
import pytest
from astropy.io import fits as astropy_fits
from astropy.wcs import WCS

from lake_schema.fits import images
from lake_schema.mission.configuration import resolve
from lake_schema.store import validate
from lake_schema.tables.products import CONTENTS, PRODUCTS
from tests.truesky import nightly
from tests.truesky.render import nominal
from tests.truesky.render.exposure.test_render import render
from tests.truesky.render.fields import small
from truesky.reduction import amplifiers
from truesky.render.camera import astrometry, detectors, observatories
from truesky.render.dispersing import draw
from truesky.render.effects.readout import charge_transfer
from truesky.render.effects.scene import Scene
from truesky.render.products import fits_files, head_files, headers, read_back
from truesky.request import accuracy


@pytest.fixture(scope="module")
def rendered():
    return render("VIS")


@pytest.fixture(scope="module")
def written(rendered, tmp_path_factory):
    folder = tmp_path_factory.mktemp("products")
    rows, writers = fits_files.products(rendered, ("noise_free",))
    for path, writer in writers.items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        writer(folder / path)
    return folder, rows


def test_rows_are_as_declared(rendered, written):
    folder, rows = written
    assert validate.find_violations(rows, PRODUCTS) == []
    assert rows["content"].to_pylist() == ["science", "noise_free"]
    for row in rows.to_pylist():
        assert (folder / row["path"]).is_file()
        assert row["sources"] == len(rendered.sources) > 10
        assert row["mission"] == rendered.scene.mission.fingerprint


def test_requested_truth_maps_are_written(rendered):
    rows, writers = fits_files.products(rendered, truth=())
    assert rows["content"].to_pylist() == ["science"]
    (path,) = rows["path"].to_pylist()
    assert list(writers) == [path, path.replace(".fits", ".head")]


@pytest.mark.parametrize("content", [name for name, _ in CONTENTS if name != "science"])
def test_the_unit_of_a_truth_map_fits_its_card(rendered, content):
    """Comments that are too long for a card are refused when the file is written."""
    keyword, unit, comment = headers.truth_cards(rendered, content)[-1]
    assert keyword == "BUNIT"
    assert unit in ("electron", "adu", "")
    assert len(f"{keyword:8}= {unit!r:20} / {comment}") <= 80


def test_head_file_has_the_wcs_of_the_image(rendered, written):
    """The head file has the same WCS as each array of the file, in file order and in the convention of the tools."""
    folder, rows = written
    assert rows.num_rows == 2
    for path in rows["path"].to_pylist():
        with astropy_fits.open(folder / path) as units:
            arrays = [unit.header for unit in units if unit.header["NAXIS"]]
        *blocks, rest = (folder / path).with_suffix(".head").read_text().split("END\n")
        assert (len(blocks), rest) == (len(arrays), "")
        for block, header in zip(blocks, arrays, strict=True):
            said = astropy_fits.Header.fromstring(block, sep="\n")
            assert {"CTYPE1", "CRVAL1", "CRPIX1", "CD1_1", "PV1_4", "RADESYS", "EQUINOX"} <= set(said)
            assert not any(key.startswith(("A_", "B_")) for key in said)
            assert (header["CTYPE1"], said["CTYPE1"]) == ("RA---TAN-SIP", "RA---TPV")
            x, y = [1.0, header["NAXIS1"] / 3], [header["NAXIS2"] / 2, 5.0]
            ours, theirs = (WCS(one).all_pix2world(x, y, 0) for one in (header, said))
            np.testing.assert_allclose(theirs, ours, atol=1e-10)


def test_images_without_wcs_have_no_head_file(rendered):
    assert head_files.text([images.Image(np.zeros((4, 4), np.uint8), (("EXPTIME", 1.0, ""),))]) == ""
    cube = images.Image(np.zeros((2, 4, 4), np.uint8), astrometry.cards(rendered.wcs))
    assert head_files.text([images.Image(None, astrometry.cards(rendered.wcs)), cube]) == ""


@pytest.mark.parametrize("convention", ["sip", "tpv"])
def test_default_convention_of_the_distortion(rendered, monkeypatch, convention, tmp_path):
    known = observatories.for_camera("vis")
    assert known.convention == "sip"
    monkeypatch.setitem(observatories._OBSERVATORIES, "vis", replace(known, convention=convention))
    rows, writers = fits_files.products(rendered, ())
    writers[rows["path"][0].as_py()](tmp_path / "one.fits")
    for number in range(5):
        assert astropy_fits.getheader(tmp_path / "one.fits", number)["CTYPE1"].endswith(convention.upper())


def test_headers_with_tpv_have_the_same_wcs(rendered, tmp_path):
    """The WCS of every image is the same in both conventions."""
    rows, writers = fits_files.products(rendered, ("noise_free",), wcs="tpv")
    d = rendered.detector
    for number, path in enumerate(rows["path"].to_pylist()):
        writers[path](tmp_path / f"{number}.fits")
        with astropy_fits.open(tmp_path / f"{number}.fits") as units:
            assert not any(key.startswith(("A_", "B_")) for unit in units for key in unit.header)
            assert {unit.header["CTYPE1"] for unit in units if "CTYPE1" in unit.header} == {"RA---TPV"}
            header = units[0].header
        centre = WCS(header).all_pix2world([(d.nx - 1) / 2], [(d.ny - 1) / 2], 0)
        np.testing.assert_allclose(np.ravel(centre), astrometry.centre(d, rendered.wcs), atol=1e-9)


def test_files_read_back(rendered, written):
    folder, rows = written
    paths = [folder / path for path in rows["path"].to_pylist()]
    science, noise_free = read_back.frame(paths[0]).data, images.read_images(paths[1])[0].data
    np.testing.assert_array_equal(science, rendered.science)
    np.testing.assert_array_equal(noise_free, rendered.noise_free)
    assert science.dtype == np.uint16
    assert noise_free.dtype == np.float32


def test_the_header_calibrates_the_image(rendered, written):
    folder, rows = written
    header = astropy_fits.getheader(folder / rows["path"][0].as_py())
    electrons = read_back.electrons(folder / rows["path"][0].as_py()).data
    diffuse = (header["SKYRATE"] + header["DARKRATE"]) * header["EXPTIME"]
    # Remaining differences: the first columns settle, and the response of the amplifier is not linear.
    assert np.median(electrons - rendered.noise_free) - diffuse == pytest.approx(0.0, abs=2.0)
    for key, value in (
        ("BUNIT", "adu"),
        ("FILTER", "euclid_vis"),
        ("SEED", "1"),
        ("DATE-OBS", "2023-07-01T00:00:00.000"),
    ):
        assert header[key] == value
    assert header["ZEROPNT"] == pytest.approx(25.93, abs=0.01)
    assert header["MISSION"] == rendered.scene.mission.fingerprint
    names = [d.name for d in rendered.decisions]
    assert [header[f"EFFECT{i}"].split(":")[0] for i in range(1, len(names) + 1)] == names
    assert header["DARKRATE"] == rendered.scene.dark_rate > 0.0
    assert "dark_current: on" in header[f"EFFECT{names.index('dark_current') + 1}"]


def test_header_has_allowed_and_expected_errors(rendered, written):
    """All four errors, of drawing and of charge transfer."""
    folder, rows = written
    header = astropy_fits.getheader(folder / rows["path"][0].as_py())
    applied = [decision.name for decision in rendered.decisions if decision.applied]
    made = [asdict(accuracy.expected_errors(rendered.accuracy))]
    made += [charge_transfer.source_errors(rendered.scene, name) for name in applied]
    short = {"flux": "FLUX", "shape": "SHAPE", "position": "POS", "background": "BACK"}
    for name, value in asdict(rendered.accuracy).items():
        assert header[f"ACC{short[name]}"] == value
        reached = sum(cause.get(name, 0.0) ** 2 for cause in made) ** 0.5
        assert header[f"ERR{short[name]}"] == pytest.approx(reached, abs=0.0)
        assert 0.0 < header[f"ERR{short[name]}"] <= value


def test_header_of_spectra_has_the_errors_of_spectra(rendered):
    """Without charge transfer, which has errors of its own."""
    still = tuple(replace(decision, applied=False) for decision in rendered.decisions)
    cards = headers._accuracy_cards(replace(rendered, spectra={}, decisions=still))
    values = {key: value for key, value, _ in cards}
    named = draw.expected_errors(rendered.accuracy)
    assert (values["ERRFLUX"], values["ERRPOS"], values["ERRBACK"]) == tuple(named.values())
    assert values["ERRSHAPE"] == accuracy.expected_errors(rendered.accuracy).shape
    # Those of images are smaller than the allowed one, and those of bright spectra larger.
    assert values["ERRBACK"] > values["ACCBACK"]


@pytest.mark.parametrize("preset", accuracy.PRESETS)
def test_total_error_is_within_the_allowed_error(preset):
    """On a whole detector at the end of the mission, with both directions of transfer."""
    wanted = accuracy.PRESETS[preset]
    mission = resolve()
    scene = Scene(mission, "vis", 560.0, 0.25, 1e5, detectors.detector("vis", "3-4", mission), accuracy=wanted)
    made = [asdict(accuracy.expected_errors(wanted))]
    made += [charge_transfer.source_errors(scene, name) for name in ("parallel_cti", "serial_cti")]
    for name, value in asdict(wanted).items():
        assert sum(cause.get(name, 0.0) ** 2 for cause in made) ** 0.5 <= value, name
    assert charge_transfer.source_errors(scene, "bleeding") == {}


@nightly.parametrize("forced", [{}, nominal.off("nonlinearity"), {"parallel_cti": True, "serial_cti": True}], (1,))
def test_pixels_above_saturate_are_saturated(tmp_path, forced):
    """A star of 8 mag: all saturated pixels, and almost no others, are at or above SATURATE."""
    one = nominal.rendered(small("vis", "3-4", 256), [8.0], [100.3], [90.2], forced=forced, truth=("saturation",))
    rows, writers = fits_files.products(one, ("saturation",))
    path = rows["path"][0].as_py()
    (tmp_path / path).parent.mkdir(parents=True)
    writers[path](tmp_path / path)
    found = read_back.frame(tmp_path / path)
    level = amplifiers.to_pixels(
        next(value for key, value, _ in headers.amplifier_values(one) if key == "SATURATE"), one.scene
    )
    full = one.maps["saturation"] > 0
    assert full.sum() > 2000
    assert np.all((found.data >= level)[full])
    assert np.sum((found.data >= level)[~full]) < 0.02 * full.sum()
    # The lowest saturated pixel is not far above the level.
    assert ((found.data - level)[full] / level[full]).min() < 0.01


def test_quadrants_are_extensions_with_separate_wcs(rendered, written):
    folder, rows = written
    with astropy_fits.open(folder / rows["path"][0].as_py(), checksum=True) as units:
        assert [unit.name for unit in units[1:]] == ["3-4.E", "3-4.F", "3-4.G", "3-4.H"]
        ra, dec = astrometry.sky_of_pixel(rendered.wcs, [40.0, 200.0, 200.0, 40.0], [30.0, 30.0, 210.0, 210.0])
        for number, unit in enumerate(units[1:]):
            assert unit.data.shape == rendered.raw.shape[1:]
            x, y = WCS(unit.header).all_world2pix(ra[number], dec[number], 0)
            at = [(40, 30), (200, 30), (200, 210), (40, 210)][number]
            assert unit.data[round(float(y)), round(float(x))] == rendered.science[at[1], at[0]]


def test_gap_between_the_halves_of_a_detector(tmp_path):
    """A star in each half is in its quadrant at the position of the header; a star in the gap is nowhere."""
    detector = replace(small("vis", "3-4", 260), injection_rows=4)
    quiet = nominal.off(*nominal.COSMIC_RAYS, *nominal.CHARGE)
    one = nominal.rendered(
        detector, [19.0, 19.0, 19.0], [60.0, 190.0, 190.0], [40.0, 215.0, 129.5], forced=quiet,
        truth=("noise_free", "stars", "sky", "ghosts", "saturation", "cosmic_rays"),
    )  # fmt: skip
    assert one.raw.shape[1] == 128 + 20
    assert one.science.shape == (260, 260)
    for between in (one.science, *one.maps.values()):
        assert between.shape == (260, 260)
        assert not between[128:132].any()
    rows, writers = fits_files.products(one, ())
    path = tmp_path / "science.fits"
    writers[rows["path"][0].as_py()](path)
    ra, dec = astrometry.sky_of_pixel(one.wcs, one.sources.column[:2], one.sources.row[:2])
    with astropy_fits.open(path) as units:
        assert units[0].header["INJROWS"] == 4
        for star, number in ((0, 1), (1, 3)):
            unit = units[number]
            x, y = WCS(unit.header).all_world2pix(ra[star], dec[star], 0)
            column, row = round(float(x)), round(float(y))
            part = unit.data[row - 9 : row + 10, column - 9 : column + 10].astype(float) - np.median(unit.data)
            axis = np.arange(-9, 10)
            window = part * np.exp(-0.5 * (axis**2 + axis[:, None] ** 2) / 2.0**2)
            found = (window * axis).sum() / window.sum(), (window * axis[:, None]).sum() / window.sum()
            assert found == pytest.approx((x - column, y - row), abs=0.1)
    np.testing.assert_array_equal(read_back.frame(path).data, one.science)
    assert not read_back.electrons(path).data[128:132].any()


def test_astropy_finds_the_sources_where_they_were_drawn(rendered, written):
    folder, rows = written
    for path in rows["path"].to_pylist():
        system = WCS(astropy_fits.getheader(folder / path))
        s = rendered.sources
        ra, dec = system.all_pix2world(s.column, s.row, 0)
        again = astrometry.pixel_of_sky(rendered.wcs, ra, dec)
        np.testing.assert_allclose(again, [s.column, s.row], atol=1e-6)


def test_the_same_exposure_gives_the_same_bytes(written, tmp_path):
    folder, rows = written
    _, writers = fits_files.products(render("VIS"), ("noise_free",))
    for path, writer in writers.items():
        writer(tmp_path / "again.fits")
        assert (tmp_path / "again.fits").read_bytes() == (folder / path).read_bytes()
    assert len(rows) == 2
