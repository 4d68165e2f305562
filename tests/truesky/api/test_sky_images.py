"""Images of single places, and sources added to the images of a lake."""

import copy
import os
import pickle
import signal

import galsim.des
import numpy as np
import pandas as pd
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.table import Table
from astropy.wcs import WCS

import truesky
from lake_schema.errors import BadInput
from lake_schema.store import publish
from tests import requests
from tests.extremes.test_detector_sizes import write_camera
from truesky.api.sky_images import SkyImage
from truesky.catalogue import build_galaxies, build_stars
from truesky.commands.__main__ import main
from truesky.fluxes import compute_fluxes
from truesky.render import plan_exposures, render_exposures
from truesky.request.from_toml import parse

RA, DEC = 53.117, -27.808
PLACE = SkyCoord(RA, DEC, unit="deg")
REQUEST = f"""
[sources]
only = "table"
band = "lsst_r"
galaxies = "galaxies.csv"
stars = "stars.csv"
[fluxes]
bands = ["euclid_vis", "euclid_h", "lsst_r"]
[[pointing]]
channel = "EXT"
camera = "lsstcam"
band = "lsst_r"
ra = {RA}
dec = {DEC}
centre_on = "R22_S11"
detectors = ["R22_S11"]
mjd = 60905.25
[products]
truth = ["noise_free"]
"""
NEW = {"ra": [RA, RA + 0.001], "dec": [DEC, DEC - 0.001], "mag": [20.0, 21.0], "half_light_radius": [0.4, 0.5]}


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    """A lake with galaxies and stars of a table, and one image."""
    folder, rng = tmp_path_factory.mktemp("places"), np.random.default_rng(3)
    places = {"ra": RA + rng.uniform(-0.15, 0.15, 4000), "dec": DEC + rng.uniform(-0.15, 0.15, 4000)}
    mags = {"mag": rng.uniform(18.0, 26.0, 4000)}
    pd.DataFrame({**places, **mags, "half_light_radius": rng.uniform(0.2, 1.0, 4000)})[:3000].to_csv(
        folder / "galaxies.csv", index=False
    )
    pd.DataFrame({**places, **mags})[3000:].to_csv(folder / "stars.csv", index=False)
    with truesky.open(made(folder, REQUEST, 0.2)) as opened:
        yield opened


@pytest.fixture(scope="module")
def small_lake(tmp_path_factory):
    """A lake with one image of a camera that has one detector of 600 x 560 pixels."""
    folder, rng = tmp_path_factory.mktemp("small"), np.random.default_rng(3)
    places = {"ra": RA + rng.uniform(-0.02, 0.02, 80), "dec": DEC + rng.uniform(-0.02, 0.02, 80)}
    mags = {"mag": rng.uniform(18.0, 26.0, 80)}
    pd.DataFrame({**places, **mags, "half_light_radius": 0.5}).to_csv(folder / "galaxies.csv", index=False)
    pd.DataFrame({**places, **mags})[60:].to_csv(folder / "stars.csv", index=False)
    write_camera(folder / "mini", 600, 560)
    text = REQUEST.replace('"lsstcam"', '"mini"').replace("R22_S11", "chip").replace('"lsst_r"', '"des_r"')
    with truesky.open(made(folder, f'{text}[mission]\ncameras = ["mini"]\n', 0.05)) as opened:
        yield opened


def made(folder, text, radius):
    """Make all tables of a request and return the folder of their lake."""
    wanted, root = parse(requests.written(folder, text, requests.FIELD.format(radius), seed=7)), folder / "lake"
    root.mkdir()
    for module in (build_galaxies, build_stars, compute_fluxes, plan_exposures, render_exposures):
        for step in module.steps(root, wanted):
            publish.make_version(root, step.plan, step.run_task)
    return root


@pytest.fixture(scope="module")
def whole(lake):
    """Noise-free image of the detector in the lake."""
    return lake.image(lake.images("noise_free")["path"][0])


def test_an_image_is_a_part_of_the_image_in_the_lake(lake, whole):
    drawn = lake.render(RA + 0.01, DEC - 0.02, size=30.0, exposure=1)
    column, row = drawn.first_pixel
    part = whole.data[row : row + 150, column : column + 150]
    assert drawn.electrons.shape == drawn.raw.shape == part.shape
    noise = np.sqrt(drawn.exposure["sky"] * drawn.exposure["exposure_time_s"])
    assert np.abs(drawn.electrons - part).max() < noise / 320.0
    x, y = drawn.wcs.all_world2pix([RA + 0.01], [DEC - 0.02], 0)
    assert abs(x[0] - 74.5) < 0.51
    assert abs(y[0] - 74.5) < 0.51
    truth = lake.truth(1, "R22_S11").set_index("id").loc[drawn.truth["id"]]
    np.testing.assert_allclose(drawn.truth["x"] + column, truth["x"], atol=1e-7)
    np.testing.assert_allclose(drawn.truth["expected"], truth["expected"], rtol=1e-12)


@pytest.mark.parametrize("band", ["euclid_vis", "euclid_h", "lsst_r"])
def test_a_nominal_exposure_has_the_place_in_the_middle(lake, band):
    drawn = lake.render(RA, DEC, size=12.0, band=band)
    ny, nx = drawn.electrons.shape
    x, y = drawn.wcs.all_world2pix([RA], [DEC], 0)
    assert abs(x[0] - (nx - 1) / 2) < 0.51
    assert abs(y[0] - (ny - 1) / 2) < 0.51
    # North is up and east is left, also on detectors that are mounted upside down.
    x, y = drawn.wcs.all_world2pix([RA, RA + 1e-3], [DEC + 1e-3, DEC], 0) - np.array([[x[0]], [y[0]]])
    assert (y[0] > 10, abs(x[0]) < 0.05, x[1] < -10, abs(y[1]) < 0.05) == (True,) * 4
    assert drawn.exposure["band"] == band
    assert set(drawn.errors) == {"flux", "shape", "position", "background"}
    # The median is the sky, since few pixels have sources.
    sky = drawn.exposure["sky"] * drawn.exposure["exposure_time_s"]
    assert np.median(drawn.signal) == pytest.approx(sky, rel=0.3)
    again = lake.render(RA, DEC, size=12.0, band=band)
    assert np.array_equal(again.raw, drawn.raw)
    other = lake.render(RA, DEC, size=12.0, band=band, seed=99)
    assert not np.array_equal(other.raw, drawn.raw)
    assert np.array_equal(other.electrons, drawn.electrons)
    assert lake.render(RA, DEC, size=12.0, band=band, noise=False).raw is None


def test_sources_are_left_out_and_added(lake):
    drawn = lake.render(RA, DEC, size=30.0, exposure=1, noise=False)
    brightest = drawn.truth.sort_values("expected").iloc[-1]
    without = lake.render(RA, DEC, size=30.0, exposure=1, noise=False, without=[int(brightest["id"])])
    assert set(drawn.truth["id"]) - set(without.truth["id"]) == {brightest["id"]}
    assert (drawn.electrons - without.electrons).sum() == pytest.approx(brightest["drawn"], rel=0.02)
    added = lake.render(RA, DEC, size=30.0, exposure=1, noise=False, extra=NEW)
    zero_point, seconds = (drawn.exposure[name] for name in ("zero_point", "exposure_time_s"))
    expected = seconds * 10 ** (0.4 * (zero_point - np.array(NEW["mag"])))
    new = added.truth[~added.truth["id"].isin(drawn.truth["id"])]
    np.testing.assert_allclose(new["expected"], expected, rtol=1e-4)
    # The stamps of the new sources contain nearly all of their light.
    assert (added.electrons - drawn.electrons).sum() == pytest.approx(expected.sum(), rel=0.01)
    star = pd.DataFrame({"ra": [RA], "dec": [DEC], "mag": [19.0]})
    both = lake.render(RA, DEC, size=30.0, exposure=1, noise=False, extra={"galaxies": NEW, "stars": star})
    assert len(both.truth) == len(added.truth) + 1
    np.testing.assert_array_equal(
        lake.render(RA, DEC, size=30.0, exposure=1, noise=False, extra=Table(star.to_dict("list"))).electrons,
        lake.render(RA, DEC, size=30.0, exposure=1, noise=False, extra=star).electrons,
    )


@pytest.mark.parametrize(
    ("kind", "detector"), [("small_lake", "chip"), pytest.param("lake", "R22_S11", marks=pytest.mark.nightly)]
)
def test_a_frame_with_sources_is_that_of_a_catalogue_with_them(request, tmp_path, kind, detector):
    lake = request.getfixturevalue(kind)
    path = lake.images()["path"][0]
    stored = lake.image(path)
    frame = lake.frame(1, detector)
    assert np.array_equal(frame.raw, stored.data)
    new = frame.with_sources(NEW)
    assert len(new.added_rows) == 2
    x, y = new.added_rows["x"], new.added_rows["y"]
    changed = np.argwhere(new.raw != stored.data)
    # All effects see the sources; most changed pixels are at the sources, others on the way to the amplifiers.
    near = np.hypot(changed[:, 1] - x[0], changed[:, 0] - y[0]) < 100.0
    assert near.mean() > 0.3
    # The drawing of all other sources is shared. A frame that shares nothing is the same.
    alone = lake.frame(1, detector).with_sources(NEW)
    assert np.array_equal(alone.raw, new.raw)
    assert np.array_equal(alone.noise_free, new.noise_free)
    assert alone.truth.equals(new.truth)
    assert set(new.maps) == {"noise_free"}
    file = new.write(tmp_path / "new.fits")
    with fits.open(file) as units, fits.open(lake._explorer._version("products").sidecar_path(path)) as before:
        assert [unit.shape for unit in units] == [unit.shape for unit in before]
        assert units[0].header["EXPOSURE"] == before[0].header["EXPOSURE"] == 1
    with pytest.raises(BadInput, match="additional sources already"):
        new.with_sources(NEW)
    with pytest.raises(BadInput, match=r"rendered for detector 9-9 of exposure 1; it has .* of exposure"):
        lake.frame(1, "9-9")


def test_the_psf_is_what_galsim_draws_from_the_psf_file(lake):
    """Their light, peaks and sizes agree; the file has coarser samples, which causes most of the difference."""
    path = lake._explorer._version("products").sidecar_path(lake.images()["path"][0])
    file = path.with_name(path.name.replace("_science.fits", ".psf"))
    light = fits.getheader(file, 1)["PSFLIGHT"]
    drawn = lake.render(RA + 0.02, DEC, size=20.0, exposure=1, noise=False)
    psf = drawn.psf()
    ny, nx = drawn.electrons.shape
    middle = len(psf.image) // 2
    assert len(psf.image) % 2 == 1
    # The PSF is centred on a pixel; GalSim counts pixels from 1.
    place = galsim.PositionD(drawn.first_pixel[0] + (nx + 1) / 2, drawn.first_pixel[1] + (ny + 1) / 2)
    model = galsim.des.DES_PSFEx(str(file)).getPSF(place).withFlux(light)
    theirs = model.drawImage(nx=41, ny=41, scale=1.0, method="no_pixel").array
    ours = psf.image[middle - 20 : middle + 21, middle - 20 : middle + 21]
    assert ours.sum() == pytest.approx(theirs.sum(), rel=0.003)
    np.testing.assert_allclose(ours, theirs, atol=0.01 * theirs.max())
    moments = [galsim.hsm.FindAdaptiveMom(galsim.Image(image.astype(float))) for image in (ours, theirs)]
    assert moments[0].moments_sigma == pytest.approx(moments[1].moments_sigma, rel=0.003)
    assert moments[0].observed_shape.e1 == pytest.approx(moments[1].observed_shape.e1, abs=0.002)
    assert moments[0].observed_shape.e2 == pytest.approx(moments[1].observed_shape.e2, abs=0.002)


def test_the_psf_of_an_image(lake):
    drawn = lake.render(RA, DEC, size=20.0, exposure=1, noise=False)
    psf = drawn.psf()
    assert psf.samples == 1
    assert psf.image.sum() == psf.light == pytest.approx(1.0, abs=0.05)
    middle = len(psf.image) // 2
    assert np.unravel_index(psf.image.argmax(), psf.image.shape) == (middle, middle)
    fine = drawn.psf(RA, DEC, oversampled=True)
    assert fine.samples > 1
    assert fine.light == pytest.approx(psf.light, abs=0.02)
    # A star in the image has the PSF of its spectrum.
    star = int(
        lake.render(RA, DEC, size=20.0, exposure=1, extra={"ra": [RA], "dec": [DEC], "mag": [16.0]}).truth["id"].max()
    )
    with pytest.raises(BadInput, match=f"source {star} was not drawn in this image"):
        drawn.psf(source=star)


def test_an_image_is_written(lake, tmp_path):
    drawn = lake.render(RA, DEC, size=20.0, exposure=1)
    with fits.open(drawn.write(tmp_path / "stamp.fits"), checksum=True) as units:
        assert [unit.name for unit in units[1:]] == ["ELECTRONS", "RAW", "TRUTH"]
        np.testing.assert_array_equal(units["RAW"].data, drawn.raw)
        ra, dec = WCS(units["RAW"].header).all_pix2world([10.0], [20.0], 0)
        np.testing.assert_allclose((ra[0], dec[0]), [float(at[0]) for at in drawn.wcs.all_pix2world([10.0], [20.0], 0)])
        assert len(units["TRUTH"].data) == len(drawn.truth)
        assert units[0].header["GAIN"] == drawn.gain


PLACES = {"ra": RA + 0.004 * np.arange(20), "dec": np.full(20, DEC), "size": 6.0 + np.arange(20)}


def as_drawn(image):
    """Everything of an image that must not depend on the process that draws it."""
    return image.electrons, image.raw, image.truth, image.exposure, image.first_pixel, image.psf().image


def test_stamps_are_the_images_of_their_places(lake, tmp_path):
    """Any order, other places before them, and a copy by pickle give the same images."""
    pd.DataFrame(PLACES)[:3].to_csv(tmp_path / "places.csv", index=False)
    stamps = list(lake.stamps(tmp_path / "places.csv", band="lsst_r", processes=1))
    # Another object, which has read no rows and has no PSF yet, draws them in the opposite order.
    with truesky.open(lake._explorer.root) as fresh:
        backwards = [
            fresh.render(*(float(PLACES[name][k]) for name in ("ra", "dec", "size")), band="lsst_r") for k in (2, 1, 0)
        ]
        for stamp, other in zip(stamps, backwards[::-1], strict=True):
            for one, two in zip(as_drawn(stamp), as_drawn(other), strict=True):
                assert np.array_equal(one, two)
            copied = pickle.loads(pickle.dumps(stamp))
            for one, two in zip(as_drawn(stamp), as_drawn(copied), strict=True):
                assert np.array_equal(one, two)
            files = [image.write(tmp_path / f"{name}.fits") for name, image in (("one", stamp), ("two", copied))]
            assert files[0].read_bytes() == files[1].read_bytes()
            assert np.array_equal(copy.deepcopy(stamp).psf().image, stamp.psf().image)


def test_a_table_without_rows_has_no_stamps(lake):
    for processes in (1, 2):
        assert list(lake.stamps({"ra": [], "dec": []}, band="lsst_r", processes=processes)) == []


def test_other_columns_of_a_table_of_places_are_ignored(lake):
    table = pd.DataFrame({"ra": [RA], "dec": [DEC], "name": ["NGC 1"], "seed": [np.nan], "z": [0.1]})
    (stamp,) = lake.stamps(table, size=5.0, band="lsst_r", processes=1)
    assert np.array_equal(stamp.raw, lake.render(RA, DEC, size=5.0, band="lsst_r").raw)


def test_nominal_images_of_a_square_degree_share_the_psf(lake):
    one, two = (lake.render(RA, DEC + shift, size=5.0, band="lsst_r", noise=False) for shift in (0.0, 0.02))
    assert np.array_equal(one.psf().image, two.psf().image)


@pytest.mark.nightly
def test_processes_draw_the_same_stamps(lake, tmp_path):
    one, two = (list(lake.stamps(PLACES, band="lsst_r", processes=count)) for count in (1, 2))
    assert len(one) == len(two) == 20
    for number, (stamp, other) in enumerate(zip(one, two, strict=True)):
        for value, same in zip(as_drawn(stamp), as_drawn(other), strict=True):
            assert np.array_equal(value, same)
        files = [image.write(tmp_path / f"{number}_{k}.fits") for k, image in enumerate((stamp, other))]
        assert files[0].read_bytes() == files[1].read_bytes()
    # Images before one that cannot be drawn are returned.
    edge = {"ra": np.full(12, RA), "dec": np.append(np.full(11, DEC), northern_edge(lake))}
    images = lake.stamps(edge, size=5.0, band="lsst_r", processes=2)
    for _ in range(11):
        next(images)
    with pytest.raises(BadInput, match=r"table, row 12: ra .*: cut by the edge of the catalogue"):
        next(images)


def test_the_command_names_its_options(lake, tmp_path, capsys):
    pd.DataFrame({"ra": [RA], "dec": [DEC]}).to_csv(tmp_path / "places.csv", index=False)
    words = ["stamps", str(lake._explorer.root), str(tmp_path / "places.csv"), str(tmp_path / "stamps")]
    for option, problem in (
        (["--band", "VIS"], "--band: 'VIS' is not allowed: did you mean euclid_vis?"),
        (["--band", "lsst_r", "--exposure", "9"], "--exposure 9: the lake has no exposure with this number; it has 1"),
        (["--size", "-1"], "--size = -1.0 is outside [0.0, 3600.0] arcsec"),
    ):
        assert main([*words, *option]) == 2
        assert capsys.readouterr().err == f"truesky stamps: {problem}\n"
        assert not (tmp_path / "stamps").exists()


def test_exchanged_arguments_and_other_columns_are_named(lake, tmp_path, capsys):
    root, places, out = str(lake._explorer.root), str(tmp_path / "places.csv"), str(tmp_path / "stamps")
    pd.DataFrame({"RA": [RA], "DEC": [DEC]}).to_csv(places, index=False)
    assert main(["stamps", root, places, out]) == 2
    problem = "has no columns ra, dec; did you mean RA, DEC? Rename them"
    assert capsys.readouterr().err == f"truesky stamps: {places}: {problem}\n"
    with pytest.raises(SystemExit):
        main(["stamps", places, root, out, "--size", "5"])
    call = f"truesky stamps {root} {places} {out} --size 5"
    assert capsys.readouterr().err == f"truesky stamps: the lake comes before the places: write {call}\n"


def test_the_command_writes_stamps(lake, tmp_path, capsys):
    pd.DataFrame(PLACES)[:2].to_csv(tmp_path / "places.csv", index=False)
    words = ["stamps", str(lake._explorer.root), str(tmp_path / "places.csv"), str(tmp_path / "new" / "stamps")]
    options = ["--band", "lsst_r", "--processes", "1", "--effects", "poisson", "read_noise"]
    assert main([*words, *options]) == 0
    assert "2 images, listed in stamps.csv" in capsys.readouterr().out
    rows = pd.read_csv(tmp_path / "new" / "stamps" / "stamps.csv")
    np.testing.assert_allclose(rows["ra"], PLACES["ra"][:2], atol=0.2 / 3600.0)
    for row, size in zip(rows.itertuples(), PLACES["size"], strict=False):
        with fits.open(tmp_path / "new" / "stamps" / row.file) as units:
            assert units["RAW"].shape == (round(size / 0.2),) * 2
            assert len(units["TRUTH"].data) == row.sources
    assert main([*words, *options]) == 2
    assert "exists already; give the name of a new folder" in capsys.readouterr().err
    # A place that cannot be drawn leaves nothing behind.
    pd.DataFrame({"ra": [RA, 10.0], "dec": [DEC, 10.0]}).to_csv(tmp_path / "places.csv", index=False)
    assert main([*words[:3], str(tmp_path / "other"), *options, "--size", "4"]) == 2
    assert "places.csv, row 2: ra 10.00000, dec 10.00000: outside the area" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"places.csv", "new"}


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_stopped_command_leaves_nothing(lake, tmp_path, capsys, monkeypatch, number, status):
    pd.DataFrame(PLACES)[:2].to_csv(tmp_path / "places.csv", index=False)
    monkeypatch.setattr(SkyImage, "write", lambda image, path: os.kill(os.getpid(), number))
    words = ["stamps", str(lake._explorer.root), str(tmp_path / "places.csv"), str(tmp_path / "stamps")]
    with pytest.raises(SystemExit) as ended:
        main([*words, "--band", "lsst_r", "--processes", "1"])
    assert ended.value.code == status
    assert f"stopped; {tmp_path / 'stamps'} was not written" in capsys.readouterr().err
    assert {path.name for path in tmp_path.iterdir()} == {"places.csv"}


@pytest.mark.parametrize(
    ("table", "options", "message"),
    [
        ({"ra": [RA]}, {}, "table: has no column dec"),
        ({"RAJ2000": [RA], "DEJ2000": [DEC]}, {}, r"no columns ra, dec; did you mean RAJ2000, DEJ2000\? "),
        ({"ra": [RA], "dec": [DEC], "sizes": [3.0]}, {}, "table: column 'sizes': did you mean size"),
        ({"RA": [RA], "DEC": [DEC]}, {}, r"^table: has no columns ra, dec; did you mean RA, DEC\? Rename them$"),
        ([(RA, DEC)], {}, r"^table must be a table, .*, got list; for example: \{.ra.: \[53.1\], .dec.: \[-27.8\]\}$"),
        ({"ra": [RA, np.nan], "dec": [DEC, DEC]}, {}, "table, row 2: ra is missing"),
        ({"ra": [RA], "dec": [95.0]}, {}, "table, row 1: dec = 95.0 is outside"),
        ({"ra": [RA], "dec": [DEC], "seed": [1.5]}, {}, "table, row 1: seed = 1.5: must be a whole number"),
        ({"ra": [RA], "dec": [DEC]}, {"accuracy": "fast"}, "accuracy = 'fast' is not one of quicklook"),
        (
            {"ra": [RA], "dec": [DEC]},
            {"band": "euclid_vs"},
            "^band: 'euclid_vs' is not allowed: did you mean euclid_vis",
        ),
        ({"ra": [RA], "dec": [DEC]}, {"processes": 0}, "processes"),
        ({"ra": [RA], "dec": [DEC]}, {"sizes": 3}, r"lake.stamps has no argument sizes: did you mean size\? .*: table"),
        ({"ra": [RA], "dec": [DEC], "seed": [2.0**53]}, {}, r"table, row 1: seed = .* must be below 2\^53"),
        ({"ra": [RA], "dec": [DEC], "size": [np.inf]}, {}, "table, row 1: size"),
        ({"ra": [RA, 10.0], "dec": [DEC, 10.0]}, {}, r"table, row 2: ra 10.0.*, which is near ra 5.*, dec -2"),
        ({"ra": [RA], "dec": [DEC]}, {"exposure": 9}, "^exposure 9: the lake has no exposure with this number"),
        ({"ra": [RA], "dec": [DEC]}, {"effects": ["ghosts"]}, "^effects: 'ghosts' cannot be applied to a window"),
        ({"ra": [RA], "dec": [DEC, DEC]}, {}, "columns ra, dec have different numbers of rows: 1, 2$"),
        (3, {}, "table must be a table"),
    ],
)
def test_bad_tables_of_places_are_refused(lake, table, options, message):
    with pytest.raises(BadInput, match=message) as caught:
        lake.stamps(table, **{"size": 5.0, "band": "lsst_r", **options})
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"ra": 10.0, "dec": 10.0}, "ra 10.00000, dec 10.00000: outside the area of the catalogue"),
        ({"ra": 10.0, "dec": 10.0}, "outside the area of the catalogue, which is near ra 5.*, dec -2"),
        ({"ra": DEC, "dec": RA}, "outside the area of the catalogue: are ra and dec exchanged"),
        ({"ra": PLACE}, "ra must be a number in degrees, got a SkyCoord: write c.ra.deg, c.dec.deg"),
        ({"dec": PLACE.dec}, f"dec must be a number in degrees, got .*: write {DEC}"),
        ({"noise": "no"}, "noise = 'no' must be True or False"),
        ({"size": 0.0}, "size = 0: must be 0.2 to 801 arcsec, at most a detector"),
        ({"size": np.nan}, "size"),
        ({"size": "30 arcsec"}, "^size must be a number of arcsec, got '30 arcsec': write 30$"),
        ({"ra": DEC, "dec": 153.1}, r"^dec = 153.1 is outside \[-90.0, 90.0\]: are ra and dec exchanged\?$"),
        ({"band": "euclid_vs"}, "band: 'euclid_vs' is not allowed: did you mean euclid_vis"),
        ({"band": "nisp_red"}, "band nisp_red: spectra through a grism cannot be drawn"),
        ({"band": "lsst_i"}, "band lsst_i: the lake has fluxes in .*; add the band to fluxes.bands"),
        ({"camera": "lsscam"}, "camera: 'lsscam' is not allowed: did you mean lsstcam"),
        ({"camera": "vis"}, "band: 'lsst_r' is not one of euclid_vis"),
        ({"exposure": 9}, "exposure 9: the lake has no exposure with this number; it has 1$"),
        ({"exposure": "VIS"}, r"^exposure must be the number of a planned exposure, got 'VIS'; lake.table\("),
        (
            {"exposure_time": 600.0},
            "^lake.render has no argument exposure_time: the exposure time is that of the camera.*; allowed: ra, dec",
        ),
        ({"sizes": 3.0}, r"^lake.render has no argument sizes: did you mean size\? allowed: ra, dec, size, band, cam"),
        ({"band": ["euclid_vis", "lsst_r"]}, "^band must be the name of one passband, .*: call lake.render once for"),
        ({"exposure": 1, "ra": 53.4, "dec": DEC}, "on none of the 1 planned detectors"),
        ({"ra": "x"}, "ra = 'x' must be a number in degrees, or hours"),
        ({"accuracy": "fast"}, "accuracy = 'fast' is not one of quicklook"),
        ({"without": [3]}, "without: there is no source or arc 3 in this image or around it"),
        ({"without": [3.0]}, "without = 3.0 is not a whole number"),
        ({"without": 12345}, r"^without = 12345 is not a list of whole numbers: write without=\[12345\]$"),
        ({"without": "all"}, "^without = 'all' is not a list of whole numbers$"),
        ({"effects": ["ghosts"]}, "effects: 'ghosts' cannot be applied to a window"),
        (
            {"effects": "none", "ra": 10.0},
            r"""^effects must be a list such as \["poisson"\], got 'none'; effects=\[\] for none$""",
        ),
        ({"date": "2001-02-30"}, "date"),
        ({"extra": {"ra": [RA], "dec": [DEC]}}, "^extra: column mag is missing"),
        ({"extra": "nowhere.csv"}, "^extra: nowhere.csv: no such file"),
        ({"extra": {"ra": [RA], "dec": [DEC], "mag": [99.0]}}, "^extra: column mag of row 1 is 99, but must be"),
    ],
)
def test_bad_options_are_refused(lake, options, message):
    with pytest.raises(BadInput, match=message) as caught:
        lake.render(**{"ra": RA, "dec": DEC, "size": 10.0, "band": "lsst_r", **options})
    assert "\n" not in str(caught.value)


def test_an_image_that_does_not_exist_is_refused(lake):
    with pytest.raises(BadInput, match=r"has no file a.fits; Lake.images\(\) lists the paths of the images"):
        lake.image("a.fits")


def northern_edge(lake):
    """Return a declination at which an image is cut by the edge of the catalogue."""
    for dec in np.arange(DEC + 0.1, DEC + 1.0, 0.02):
        try:
            lake.render(RA, dec, size=5.0, band="lsst_r", noise=False)
        except BadInput:
            return dec
    raise AssertionError("no edge")


def test_a_place_at_the_edge_of_the_catalogue_is_refused(lake):
    with pytest.raises(BadInput, match=r"cut by the edge of the catalogue, which has \d+ % of the surroundings"):
        lake.render(RA, northern_edge(lake), size=5.0, band="lsst_r", noise=False)


def test_missing_arguments_are_named(lake):
    for call, message in (
        (lambda: lake.render(PLACE, size=10.0), "ra must be a number in degrees, got a SkyCoord: write c.ra.deg"),
        (lambda: lake.render(ra=RA), "dec is missing: write lake.render"),
        (lambda: lake.cone("galaxies", PLACE, 0.1), "ra must be a number in degrees, got a SkyCoord: write c.ra.deg"),
        (lambda: lake.cone("galaxies", RA, DEC), "radius is missing: write lake.cone"),
        (lambda: truesky.frame("image.fits"), "psf is missing: write truesky.frame"),
    ):
        with pytest.raises(BadInput, match=message):
            call()
