"""Sources that are added to a calibrated frame of another telescope."""

import re
import warnings
from pathlib import Path

import galsim
import galsim.des
import numpy as np
import pandas as pd
import pyarrow as pa
import pytest
from astropy.io import fits
from astropy.table import QTable, Table

import truesky
from lake_schema.errors import BadInput
from lake_schema.tables.galaxies import DISK_SCALE_HEIGHT
from tests.truesky.api.given_frame_files import LINEAR, NX, NY, SIP, TPV, frame_file, psf_file
from truesky.commands import __main__ as command
from truesky.render.injection import add_sources
from truesky.render.injection.source_light import SourceLight

ROOT = Path(__file__).resolve().parents[3]
STAR = {"ra": [150.003], "dec": [2.198], "mag": [20.0]}
DISC = {**STAR, "disk_half_light_radius": [0.9], "disk_axis_ratio": [0.5], "position_angle": [35.0]}
BULGE = {
    **STAR, "bulge_fraction": [1.0], "bulge_half_light_radius": [0.5], "bulge_sersic_index": [3.0],
    "bulge_axis_ratio": [0.7], "position_angle": [-50.0],
}  # fmt: skip
FLUX = 1e4


def profiles():
    """Return galsim's star, disc and bulge, with u to the west and v to the north."""
    sin2 = (1 - 0.5**2) / (1 - DISK_SCALE_HEIGHT**2)
    inclination = np.arcsin(np.sqrt(sin2)) * galsim.radians
    disc = galsim.InclinedExponential(inclination, half_light_radius=0.9, scale_h_over_r=DISK_SCALE_HEIGHT)
    bulge = galsim.Sersic(3.0, half_light_radius=0.5 * 0.7**0.5).shear(q=0.7, beta=0 * galsim.degrees)
    return None, disc.rotate(125 * galsim.degrees), bulge.rotate(40 * galsim.degrees)


def centroid(image):
    y, x = np.indices(image.shape)
    return np.array([(image * x).sum(), (image * y).sum()]) / image.sum()


@pytest.fixture
def given(tmp_path):
    return truesky.frame(frame_file(tmp_path / "a.fits"), psf=psf_file(tmp_path))


@pytest.mark.parametrize("cards", [SIP, TPV, LINEAR], ids=["SIP", "TPV", "TAN"])
def test_sources_are_those_of_galsim(tmp_path, cards):
    """Star, disc and bulge through the header's WCS and galsim's reader of PSFEx."""
    file, psf = frame_file(tmp_path / "a.fits", cards), psf_file(tmp_path)
    given = truesky.frame(file, psf=psf)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        system = galsim.FitsWCS(header=fits.getheader(file))
    place = system.toImage(galsim.CelestialCoord(STAR["ra"][0] * galsim.degrees, STAR["dec"][0] * galsim.degrees))
    star = galsim.des.DES_PSFEx(str(psf), wcs=system).getPSF(place)
    for rows, profile in zip((STAR, DISC, BULGE), profiles(), strict=True):
        new = given.with_sources(rows, noise=False)
        body = star if profile is None else galsim.Convolve(profile, star)
        image = galsim.Image(NX, NY, wcs=system, dtype=float)
        body.withFlux(FLUX).drawImage(image, method="no_pixel", center=place)
        np.testing.assert_allclose(new.truth[["x", "y"]].to_numpy()[0], (place.x - 1, place.y - 1), atol=1e-5)
        assert new.image.sum(dtype=float) == pytest.approx(image.array.sum(), rel=1e-4)
        assert new.truth["flux"][0] == pytest.approx(FLUX, rel=1e-12, abs=0.0)
        print(
            "NUM",
            new.image.sum(dtype=float),
            image.array.sum(),
            np.abs(new.image - image.array).max() / image.array.max(),
            centroid(new.image.astype(float)) - centroid(image.array),
        )
        assert np.abs(new.image - image.array).max() < 1e-3 * image.array.max()
        assert np.abs(centroid(new.image.astype(float)) - centroid(image.array)).max() < 0.005


def test_the_image_of_a_psf_is_drawn_around_a_star(tmp_path):
    """A Gaussian as a number, and as a FITS image."""
    side, step, fwhm = 101, 0.1, 0.9
    y, x = (np.mgrid[:side, :side] - side // 2) * step
    light = np.exp(-0.5 * (x**2 + y**2) / (fwhm / 2.3548200450309493) ** 2)
    # A Gaussian given as a number is round in pixels, whose size is the root of their area.
    pixel = 3600.0 * np.sqrt(abs(LINEAR["CD1_1"] * LINEAR["CD2_2"] - LINEAR["CD1_2"] * LINEAR["CD2_1"]))
    cards = fits.Header(
        {"PSFFRAME": "PIXELS", "CDELT1": step / pixel, "CDELT2": step / pixel, "CUNIT1": "pixel", "PIXEL": True}
    )
    fits.PrimaryHDU(light / light.sum(), cards).writeto(tmp_path / "psf.fits")
    file = frame_file(tmp_path / "a.fits", LINEAR)
    by_width, by_image = (
        truesky.frame(file, psf=psf).with_sources(STAR, noise=False) for psf in (0.9, tmp_path / "psf.fits")
    )
    for new in (by_width, by_image):
        assert new.image.sum(dtype=float) == pytest.approx(FLUX, rel=1e-4)
    assert np.abs(by_width.image - by_image.image).max() < 1e-3 * by_width.image.max()


def test_a_frame_without_the_light_of_a_source_is_the_frame(tmp_path):
    pixels = np.random.default_rng(5).normal(100.0, 7.0, (NY, NX))
    files = [frame_file(tmp_path / f"{i}.fits", pixels=image) for i, image in enumerate((pixels, 0.0 * pixels))]
    full, light = (truesky.frame(file, psf=0.8).with_sources(DISC, noise=False).image for file in files)
    assert light.max() > 200.0
    np.testing.assert_allclose(full - light, pixels, rtol=0.0, atol=1e-10)


def test_the_noise_is_that_of_the_gain(tmp_path, monkeypatch):
    """Variance of 200 stars of 1e4 counts: the standard error is 0.9 %, from 200 times 134 pixels that a star fills."""
    gain, given = 2.5, truesky.frame(frame_file(tmp_path / "a.fits", GAIN=2.5), psf=2.0)
    expected = given.with_sources(STAR, noise=False).image.astype(float)
    # The expected light is always the same, so it is drawn only once.
    row, column = (int(at.min()) for at in np.nonzero(expected))
    light = SourceLight(column, row, gain * expected[row : row + 120, column : column + 120])
    monkeypatch.setattr(add_sources, "draw_source", lambda *arguments: light)
    new = [given.with_sources(STAR, seed=seed) for seed in range(200)]
    variance = np.mean([(each.image - expected) ** 2 for each in new], axis=0)
    assert light.electrons.sum() == pytest.approx(FLUX * gain, rel=1e-3)
    assert variance.sum() == pytest.approx(expected.sum() / gain, rel=0.03)
    assert np.std([each.truth["drawn"][0] for each in new]) == pytest.approx((FLUX / gain) ** 0.5, rel=0.2)


def test_light_and_noise_do_not_depend_on_other_sources(given):
    """A source in the first row is drawn alike with and without other rows, and another seed gives other noise."""
    rows = {"ra": [150.003, 149.999, 150.0], "dec": [2.198, 2.2, 2.203], "mag": [20.0, 15.0, 24.0]}
    first, all_rows = ({name: values[:n] for name, values in rows.items()} for n in (1, 3))
    alone, together = given.with_sources(first), given.with_sources(all_rows)
    assert alone.truth.equals(together.truth.iloc[:1])
    assert alone.image.tobytes() == given.with_sources(first).image.tobytes()
    assert alone.truth["drawn"][0] != given.with_sources(first, seed=2).truth["drawn"][0]
    galaxies = {**first, "half_light_radius": [0.5]}
    both = given.with_sources({"galaxies": galaxies, "stars": rows})
    assert both.truth["kind"].tolist() == ["galaxies", "stars", "stars", "stars"]
    np.testing.assert_array_equal(both.truth["drawn"][1:], together.truth["drawn"])


def test_weights_flags_and_bad_pixels(tmp_path):
    pixels = np.full((NY, NX), 10.0, np.float32)
    given = truesky.frame(frame_file(tmp_path / "a.fits", LINEAR, pixels), psf=0.8)
    column, row = given.with_sources(STAR, noise=False).truth[["x", "y"]].round().astype(int).to_numpy()[0]
    pixels[row, column + 1], pixels[row + 1, column], pixels[row - 1, column] = np.nan, 7e4, 59_990.0
    weights = np.full((NY, NX), 0.04, np.float32)
    weights[row, column - 1] = 0.0
    others = fits.ImageHDU(weights, name="WHT"), fits.ImageHDU(np.full((NY, NX), 2, np.uint8), name="FLG")
    file = frame_file(tmp_path / "b.fits", LINEAR, pixels, others)
    given = truesky.frame(file, psf=0.8, weight="WHT", flags="FLG")
    new, expected = given.with_sources(STAR), given.with_sources(STAR, noise=False)
    light = expected.image.astype(float) - pixels
    assert np.isnan(new.image[row, column + 1])
    assert new.image[row + 1, column] == np.float32(7e4)
    assert new.image[row - 1, column] == 6e4
    assert (new.flags[row - 1, column], new.flags[row + 1, column], new.flags[row, column]) == (10, 2, 2)
    assert np.sum(new.flags != 2) == 1
    assert new.weight[row, column - 1] == 0.0
    assert new.weight[row, column] == pytest.approx(1.0 / (25.0 + light[row, column] / 2.0), rel=1e-5)
    assert new.weight[row + 1, column] == np.float32(0.04)
    np.testing.assert_array_equal(expected.weight, weights)
    assert new.truth["drawn"][0] < 0.9 * FLUX
    with pytest.raises(BadInput, match=r"saturated_flag = 256 is outside \[1, 255\]"):
        given.with_sources(STAR, saturated_flag=256)
    # The given frame is unchanged.
    np.testing.assert_array_equal(given.image, pixels)
    assert (given.flags == 2).all()


def test_the_file_is_the_original_with_the_sources(tmp_path):
    extra = fits.BinTableHDU(Table({"a": [1, 2]}), name="OLD")
    file = frame_file(tmp_path / "a.fits", pixels=np.full((NY, NX), 5, np.uint16), others=[extra], OBSERVER="Tycho")
    fits.PrimaryHDU(np.full((NY, NX), 0.1, np.float32), fits.Header({"OBSERVER": "Brahe"})).writeto(tmp_path / "w.fits")
    given = truesky.frame(file, psf=0.8, weight=tmp_path / "w.fits")
    rows = {"ra": [150.003, 151.0], "dec": [2.198, 2.2], "mag": [20.0, 20.0], "id": [77, 78]}
    new = given.with_sources(rows)
    assert new.outside == 1
    assert new.truth["on_frame"].tolist() == [True, False]
    assert new.truth["drawn"][1] == 0.0
    written = new.write(tmp_path / "new.fits")
    assert [path.name for path in written] == ["new.fits", "new.weight.fits"]
    with fits.open(written[0], checksum=True) as hdus:
        assert [hdu.name for hdu in hdus] == ["PRIMARY", "OLD", "INJECTED"]
        np.testing.assert_array_equal(hdus[0].data, new.image)
        assert hdus[0].header["OBSERVER"] == "Tycho"
        assert hdus[0].header["A_2_0"] == SIP["A_2_0"]
        assert hdus["OLD"].data["a"].tolist() == [1, 2]
        assert hdus["INJECTED"].data["id"].tolist() == [77, 78]
        assert hdus["INJECTED"].data["drawn"].tolist() == new.truth["drawn"].tolist()
        assert (hdus["INJECTED"].header["INJGAIN"], hdus["INJECTED"].header["INJOUT"]) == (2.0, 1)
    with fits.open(written[1]) as hdus:
        np.testing.assert_array_equal(hdus[0].data, new.weight)
        assert hdus[0].header["OBSERVER"] == "Brahe"
    # Sources can be added again, to the same file. The table is that of the new sources.
    again = truesky.frame(written[0], psf=0.8).with_sources(STAR)
    again.write(written[0])
    assert [hdu.name for hdu in fits.open(written[0])] == ["PRIMARY", "OLD", "INJECTED"]
    np.testing.assert_array_equal(fits.getdata(written[0]), again.image)


@pytest.mark.parametrize(
    ("cards", "zero_point"),
    [
        ({"MAGZERO": 27.0}, 27.0),
        ({"PHOTZP": 26.0}, 26.0),
        ({"MAGZPT": 25.0, "EXPTIME": 100.0}, 30.0),
        ({"ZEROPNT": 25.0, "EXPTIME": 100.0}, 30.0),
        ({"MAGZPT": 25.0, "EXPTIME": 100.0, "BUNIT": "electron / s"}, 25.0),
        ({"MAGZERO": 27.0, "MAGZPT": 25.0, "EXPTIME": 100.0}, 27.0),
    ],
    ids=str,
)
def test_zero_points_of_headers(tmp_path, cards, zero_point):
    file = frame_file(tmp_path / "a.fits", **{"MAGZERO": None, **cards})
    assert truesky.frame(file, psf=1.0).zero_point == pytest.approx(zero_point)
    given = truesky.frame(file, psf=1.0, zero_point=20.0, gain=3.0, saturation=99.0)
    assert (given.zero_point, given.gain, given.saturation) == (20.0, 3.0, 99.0)


def test_kinds_of_tables_give_the_same_sources(given, tmp_path):
    rows = {**STAR, "half_light_radius": [0.5], "axis_ratio": [0.6], "position_angle": [20.0]}
    Table(rows).write(tmp_path / "rows.csv")
    quantities = QTable({**rows, "position_angle": [20 / 57.29577951308232], "mag": [20.0]})
    quantities["position_angle"].unit = "rad"
    e = (1 - 0.6) / (1 + 0.6)
    angle = np.radians(2 * 20.0)
    shears = {**STAR, "half_light_radius": [0.5], "e1": [e * np.cos(angle)], "e2": [e * np.sin(angle)]}
    tables = [
        rows,
        pd.DataFrame(rows),
        pa.table(rows),
        Table(rows),
        quantities,
        tmp_path / "rows.csv",
        {"galaxies": rows},
    ]
    images = [given.with_sources(table, noise=False).image for table in tables]
    images.append(given.with_sources(shears, noise=False, ellipticity="shear", axes="north_east").image)
    for image in images[1:]:
        np.testing.assert_allclose(image, images[0], rtol=1e-5, atol=1e-3)


def test_magnification_makes_galaxies_brighter(given):
    row = given.with_sources({**DISC, "kappa": [0.1], "gamma1": [0.05], "gamma2": [0.0]}, noise=False).truth.iloc[0]
    assert row["flux"] == pytest.approx(FLUX / (0.9**2 - 0.05**2), rel=1e-9)


@pytest.mark.parametrize(
    ("rows", "text"),
    [
        ({**STAR, "tef": [1.0]}, r'rows: unknown column tef .*teff'),
        ({"ra": [1.0], "dec": [2.0]}, "rows: column mag is missing"),
        ({**STAR, "mag": [99.0]}, r"rows: column mag of row 1 is 99, but must be from -5 to 60"),
        ({**STAR, "mag": [np.nan]}, "rows: column mag of row 1 is NaN, but must be a number from"),
        ({**STAR, "ra": [1.0, 2.0]}, "rows: columns ra, dec, mag have different numbers of rows: 2, 1, 1$"),
        ({**STAR, "ra": 150.1}, r"^rows: column ra must be one number per row, got one number: write \[150.1\]$"),
        ({"ra": [1.0], "dec": [2.0], "flux": [9.0]}, r"mag is missing; compute it .*: mag = zero_point - 2.5 log10\(f"),
        ({**STAR, "mag": ["x"]}, "rows: column mag must hold numbers"),
        ({**STAR, "a_v": [0.3]}, "rows: column a_v of row 1 is 0.3, but must be 0: give magnitudes"),
        ({**STAR, "id": [0.5]}, "rows: column id of row 1 is 0.5, but must be a whole number"),
        ({**DISC, "stamp": [3]}, "rows: column stamp of row 1 is 3, but must be -1"),
        (
            {"galaxies": {**STAR, "e1": [0.1], "e2": [0.0]}},
            "galaxies: columns e1 and e2 require the argument ellipticity, .*: shear, d",
        ),
        ({"galaxies": {**STAR, "kappa": [1.0], "gamma1": [0.0], "gamma2": [0.0]}}, "galaxies: .* near a caustic"),
        (3, "rows must be a table, a mapping of columns or a file, got int; for example: {.ra.: .53.1."),
        ("nowhere.csv", "^rows: nowhere.csv: no such file"),
    ],
)  # fmt: skip
def test_wrong_rows_are_refused(given, rows, text):
    with pytest.raises(BadInput, match=text):
        given.with_sources(rows)


@pytest.mark.parametrize(
    ("cards", "options", "text"),
    [
        ({"MAGZERO": None}, {}, "none of the cards MAGZERO, PHOTZP, MAGZPT, ZEROPNT: give zero_point"),
        ({"MAGZERO": None, "MAGZPT": 25.0}, {}, "MAGZPT is .* no card EXPTIME: give zero_point"),
        ({"GAIN": None}, {}, "has no card GAIN: give gain, the electrons per count"),
        ({"GAIN": 0.0}, {}, "GAIN = 0.0 must be a number in"),
        ({}, {"gain": -1.0}, "gain = -1"),
        ({"CTYPE1": None}, {}, "has no WCS: the cards CTYPE1 and CTYPE2 are missing"),
        ({"CTYPE1": "GLON-TAN", "CTYPE2": "GLAT-TAN"}, {}, "must be RA and DEC"),
        ({"CD1_1": 0.0, "CD1_2": 0.0}, {}, "its WCS cannot be used"),
        ({"A_2_0": 1e-2}, {}, "its WCS cannot be inverted"),
        ({}, {"psf": 0.1}, "psf: the FWHM of the PSF, 0.1 arcsec, is below one pixel"),
        ({}, {"psf": "nowhere.psf"}, "^psf: nowhere.psf: no such file"),
        ({}, {"psf": "0.8 arcsec"}, "^psf must be a number of arcsec or a file, got '0.8 arcsec': write 0.8$"),
        ({}, {"psf": "2.5pix"}, "^psf must be a number of arcsec or a file, got '2.5pix'$"),
        ({}, {"psf": "0.8"}, "psf = '0.8' is a number in quotes: write psf=0.8 for the FWHM"),
        ({}, {"extension": 4}, "has no extension 4; it has 0 to 0"),
        ({}, {"extension": "SCI"}, "has no extension 'SCI'"),
        ({}, {"weight": "WHT"}, "has no extension 'WHT'"),
    ],
)  # fmt: skip
def test_wrong_frames_are_refused(tmp_path, cards, options, text):
    file = frame_file(tmp_path / "a.fits", **cards)
    with pytest.raises(BadInput, match=text) as error:
        truesky.frame(file, **{"psf": 0.8, **options})
    assert len(error.value.messages) == 1


def test_wrong_files_are_refused(tmp_path):
    file = frame_file(tmp_path / "a.fits")
    with pytest.raises(BadInput, match="POLZERO1 = 1000 and POLSCAL1 = 2000 are not those of a frame of 256 x 240"):
        truesky.frame(file, psf=psf_file(tmp_path, centre=(1000.0, 1000.0), span=(2000.0, 2000.0)))
    for value, text in (
        (-1.0, "1 weights are negative or not finite, the first at column 4, row 3"),
        (np.nan, "1 weig"),
    ):
        weights = np.ones((NY, NX))
        weights[3, 4] = value
        fits.PrimaryHDU(weights).writeto(tmp_path / "w.fits", overwrite=True)
        with pytest.raises(BadInput, match=text):
            truesky.frame(file, psf=0.8, weight=tmp_path / "w.fits")
    fits.PrimaryHDU(np.ones((5, 6))).writeto(tmp_path / "w.fits", overwrite=True)
    for name in ("weight", "flags"):
        with pytest.raises(BadInput, match=f"{name}: .* has 6 x 5 pixels, but the image has 256 x 240 pixels"):
            truesky.frame(file, psf=0.8, **{name: tmp_path / "w.fits"})
    with pytest.raises(BadInput, match="flags must be integers"):
        truesky.frame(file, psf=0.8, flags=0)
    cube = frame_file(tmp_path / "c.fits", pixels=np.zeros((2, NY, NX), np.float32))
    with pytest.raises(BadInput, match="extension 0 is an image of 3 axes, but must be an image of 2 axes"):
        truesky.frame(cube, psf=0.8)
    packed = fits.CompImageHDU(np.zeros((NY, NX), np.float32))
    fits.HDUList([fits.PrimaryHDU(), packed]).writeto(tmp_path / "p.fits")
    with pytest.raises(BadInput, match="extension 1 is compressed: unpack the file with funpack"):
        truesky.frame(tmp_path / "p.fits", psf=0.8)
    new = truesky.frame(file, psf=0.8).with_sources(STAR)
    with pytest.raises(BadInput, match="its folder does not exist"):
        new.write(tmp_path / "none" / "x.fits")
    (tmp_path / "folder.fits").mkdir()
    with pytest.raises(BadInput, match="exists and is not a file"):
        new.write(tmp_path / "folder.fits")
    with pytest.raises(BadInput, match=r"x\.png: the name of the file must end in \.fits or \.fit"):
        new.write(tmp_path / "x.png")
    frame_file(file, pixels=np.zeros((5, 6), np.float32))
    with pytest.raises(BadInput, match="extension 0 has changed: it must be an image of the same size"):
        new.write(tmp_path / "x.fits")


def test_the_command_writes_the_same_file(tmp_path, capsys):
    file, psf = frame_file(tmp_path / "a.fits", MAGZERO=None), psf_file(tmp_path)
    Table(STAR).write(tmp_path / "rows.csv")
    words = ["inject", str(file), str(tmp_path / "rows.csv"), str(tmp_path / "out.fits"), "--psf", str(psf)]
    assert command.main(words) == 2
    assert "truesky inject: " in (text := capsys.readouterr().err)
    assert "give --zero-point" in text
    assert command.main([*words[:3], str(file), "--psf", "0.8", "--zero-point", "29"]) == 2
    assert "is the file IMAGE: write the new image to another file" in capsys.readouterr().err
    assert command.main([*words, "--zero-point", "29", "--gain", "3", "--seed", "4"]) == 0
    assert capsys.readouterr().out.startswith("added 1 sources; 0 are outside the frame\n")
    expected = truesky.frame(file, psf=psf, zero_point=29.0, gain=3.0).with_sources(STAR, seed=4)
    np.testing.assert_array_equal(fits.getdata(tmp_path / "out.fits"), expected.image)
    assert command.main([*words, "--zero-point", "29", "--no-noise"]) == 0
    assert fits.getdata(tmp_path / "out.fits").sum(dtype=float) == pytest.approx(10**3.6, rel=1e-3)


@pytest.mark.parametrize(
    ("cards", "words", "problems"),
    [
        ({}, "a.fits rows.csv b.fits --psf 0.8arcsec",
         ["--psf must be a number of arcsec or a file, got '0.8arcsec': write 0.8"]),
        ({}, "a.fits rows.csv b.fits --psf a.psf", ["--psf: a.psf: no such file"]),
        ({}, "a.fits rows.csv b.png --psf 0.8", ["b.png: the name of the file must end in .fits or .fit"]),
        ({}, "a.fits far.csv b.fits --psf 0.8",
         ["far.csv: no source is on the frame, whose middle is at ra 150.00012, dec 2.20039; "
          "row 1 is at ra 10.00000, dec 2.19800"]),
        ({}, "rows.csv a.fits b.fits --psf 0.8",
         ["the image comes before the rows: write truesky inject a.fits rows.csv b.fits --psf 0.8"]),
        ({}, "a.fits none.csv b.fits --psf 0.8", ["ROWS: none.csv: no such file"]),
        ({}, "a.fits rows.csv b.fits --psf 0.8 --ellipticity g",
         ["--ellipticity: 'g' is not one of shear, distortion, conformal, flattening"]),
        ({"MAGZERO": None, "GAIN": None}, "a.fits rows.csv b.fits --psf 0.8",
         ["a.fits: has none of the cards MAGZERO, PHOTZP, MAGZPT, ZEROPNT: give --zero-point, the AB magnitude of "
          "one count", "a.fits: has no card GAIN: give --gain, the electrons per count"]),
    ],
)  # fmt: skip
def test_mistakes_at_the_command_are_named_by_its_options(tmp_path, monkeypatch, capsys, cards, words, problems):
    monkeypatch.chdir(tmp_path)
    frame_file("a.fits", **cards)
    Table(STAR).write("rows.csv")
    Table({**STAR, "ra": [10.0]}).write("far.csv")
    before = set(tmp_path.iterdir())
    try:
        status = command.main(["inject", *words.split()])
    except SystemExit as ended:
        status = ended.code
    assert status == 2
    assert capsys.readouterr().err.splitlines() == [f"truesky inject: {problem}" for problem in problems]
    assert set(tmp_path.iterdir()) == before


def test_the_example_of_the_page_works(tmp_path, monkeypatch, capsys):
    """The blocks of docs/injection.md; the command writes the same file as Python."""
    monkeypatch.chdir(tmp_path)
    page, names = (ROOT / "docs" / "injection.md").read_text(), {}
    for code in re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL):
        exec(code, names)
    printed, (shown,) = capsys.readouterr().out, re.findall(r"^```\n( +id .*?)^```", page, re.MULTILINE | re.DOTALL)
    # All columns but the noisy counts.
    lines, expected = ([line.split()[:6] for line in text.splitlines()[1:]] for text in (printed, shown))
    assert lines == expected
    written = fits.getdata("injected.fits")
    (line,) = re.findall(r"^```sh\ntruesky (.*)\n```", page, re.MULTILINE)
    assert command.main(line.split()) == 0
    np.testing.assert_array_equal(fits.getdata("injected.fits"), written)
