"""File formats of a ground detector: one array, one array per amplifier, electrons."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from lake_schema.fits.images import Image
from tests.truesky import nightly
from tests.truesky.render.channels.test_readout import put
from tests.truesky.render.exposure.test_render import render
from tests.truesky.render.fields import MISSION
from tests.truesky.render.products import test_tools as tools
from truesky.render.camera import astrometry, detectors
from truesky.render.camera.sections import Section, steps_of_text
from truesky.render.channels import ground, readout
from truesky.render.effects.scene import Scene
from truesky.render.planning import ground_surveys
from truesky.render.products import read_back
from truesky.request import schema
from truesky.request.exposures.observations import Observation

EXPOSED = {"position_angle": 33.0, "exposure_id": 12, "airmass": 1.25, "sky": 30.0}


@cache
def rendered(way, kind="science"):
    return render("EXT", kind=kind, exposed=EXPOSED, way=way)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Return readout -> file."""
    return {way: put(rendered(way), tmp_path_factory.mktemp(way))["science"] for way in schema.READOUTS}


def test_requests_know_the_ways():
    assert ("raw", *ground.CHANNEL.alternative_readouts) == schema.READOUTS


def test_amplifiers_have_the_pixels_and_the_scans_of_the_one_image(files):
    with fits.open(files["raw"]) as one, fits.open(files["amplifiers"], checksum=True) as units:
        units.verify("exception")
        whole, raw = one[0].header, one[0].data
        first, *arrays = units
        assert first.data is None
        assert [unit.header["EXTNAME"] for unit in arrays] == [
            *(f"Segment1{n}" for n in range(8)), *(f"Segment0{n}" for n in reversed(range(8)))
        ]  # fmt: skip
        together = np.zeros_like(rendered("raw").science)
        for n, unit in enumerate(arrays, 1):
            header = unit.header
            assert header["AMPNAME"] == whole[f"AMP{n}"]
            column_step, row_step = steps_of_text(header["CCDSEC"])
            together[Section.from_text(header["CCDSEC"]).slices] = unit.data[
                Section.from_text(header["DATASEC"]).slices
            ][::row_step, ::column_step]
            bias = unit.data[Section.from_text(header["BIASSEC"]).slices]
            in_one_array = raw[Section.from_text(whole[f"BSEC{n}"]).slices]
            np.testing.assert_array_equal(bias[::row_step, ::column_step], in_one_array)
            assert header["GAIN"] == pytest.approx(whole[f"GAIN{n}"])
            assert header["RDNOISE"] == pytest.approx(whole[f"RDN{n}"])
            layout = rendered("raw").scene.layout
            assert unit.data.shape == (layout.height + layout.scan_rows, layout.scan_columns + layout.width)
            # Amplifiers of e2v: C1x are read from the upper right corner, C0x from the lower left one.
            assert (column_step, row_step) == ((-1, -1) if header["AMPNAME"][1] == "1" else (1, 1))
            assert header["DATASEC"] == header["TRIMSEC"] == f"[11:{10 + layout.width},1:{layout.height}]"
            assert header["BIASSEC"] == f"[{11 + layout.width}:{64 + layout.width},1:{layout.height}]"
            # LSSTCam counts DETSEC on the sensor.
            assert header["DETSEC"] == header["CCDSEC"]
            assert header["BITPIX"] == 32
            assert "BZERO" not in header
        np.testing.assert_array_equal(together, raw[Section.from_text(whole["DATASEC"]).slices])
        np.testing.assert_array_equal(together, rendered("raw").science)
        assert whole["DETSIZE"] == f"[1:{layout.nx},1:{layout.ny}]"
        # Each pixel of the sensor belongs to one amplifier.
        place = [Section.from_text(unit.header["DETSEC"]) for unit in arrays]
        assert (
            sum(p.nx * p.ny for p in place)
            == together.size
            == len({(p.x, p.y) for p in place}) * place[0].nx * place[0].ny
        )


@pytest.mark.parametrize("camera", ["megacam", "decam", "gpc1"])
def test_columns_and_rows_without_an_amplifier_are_read_back(camera):
    """A detector of 257 x 193 pixels is divided into equal amplifiers, which leave the last column or row unread."""
    one = replace(detectors.detectors(camera, MISSION)[0], nx=257, ny=193)
    scene = Scene(MISSION, one.section, 30.0, 1.0, 1.0, one)
    assert scene.layout.unread_pixels.any()
    light = np.arange(257.0 * 193.0).reshape(193, 257) % 4000.0
    (array,) = readout._amplifiers(
        scene.layout.split(light), scene, one.name, astrometry.wcs(one, 0.0, 0.0, 0.0)
    ).extensions
    cards = (*array.cards, ("DATASEC", array.sections.data.text, ""), ("BIAS", 0.0, ""))
    for read in (readout._amplifier_pixels, readout._amplifier_electrons):
        pixels = read([Image(array.data, cards)])
        assert pixels.shape == (193, 257)
        assert not pixels[scene.layout.unread_pixels].any()
        assert pixels.max() > 0.0


@pytest.mark.parametrize("way", ["raw", "amplifiers"])
def test_what_is_read_back_is_the_same(files, way):
    image = read_back.frame(files[way])
    np.testing.assert_array_equal(image.data, rendered("raw").science)
    system = astrometry.from_cards(image.cards)
    np.testing.assert_allclose(system.wcs.crpix, rendered("raw").wcs.wcs.crpix, rtol=1e-12)
    # Only files with an array per amplifier contain overscan rows, so the mean bias levels differ slightly.
    electrons = read_back.electrons(files[way]).data
    np.testing.assert_allclose(electrons, read_back.electrons(files["raw"]).data, atol=3.0)


def test_each_amplifier_looks_where_its_pixels_do(files):
    system = rendered("raw").wcs
    for header, pixels in tools.arrays(files["amplifiers"]):
        data, place = Section.from_text(header["DATASEC"]), Section.from_text(header["CCDSEC"])
        assert pixels[data.slices].shape == (place.ny, place.nx)
        here = WCS(header).all_pix2world([data.x + 3.0], [data.y + 5.0], 0)
        x, y = (
            first + (n if step > 0 else size - 1 - n)
            for first, size, step, n in zip(
                (place.x, place.y), (place.nx, place.ny), steps_of_text(header["CCDSEC"]), (3, 5), strict=True
            )
        )
        there = system.all_pix2world([x], [y], 0)
        np.testing.assert_allclose(here, there, atol=1e-9)


def test_electrons_are_what_the_raw_frame_was_before_it_was_read(files):
    one = rendered("electrons")
    assert not {d.name for d in one.decisions} & {"amplifiers", "read_noise", "adc", "crosstalk"}
    with fits.open(files["electrons"], checksum=True) as (unit,):
        unit.verify("exception")
        header, pixels = unit.header, unit.data
        assert (header["BUNIT"], header["GAIN"], header["RDNOISE"], header["BIAS"]) == ("electron", 1.0, 0.0, 0.0)
        assert header["SATURATE"] == pytest.approx(one.scene.value("full_well", "electron"))
        assert pixels.dtype.name == "float32"
        assert (header["DATASEC"], header["CCDSEC"]) == (f"[1:{one.scene.nx},1:{one.scene.ny}]",) * 2
    np.testing.assert_array_equal(read_back.electrons(files["electrons"]).data, pixels)
    np.testing.assert_array_equal(pixels, np.rint(pixels))
    faint = one.noise_free < 100.0
    left = (read_back.electrons(files["raw"]).data - pixels)[faint]
    scene = rendered("raw").scene
    noise = np.hypot(*(np.mean(scene.amplifier_values(*key)) / part for key, part in (
        (("read_noise", "electron"), 1.0), (("gain", "electron / adu"), np.sqrt(12.0)))))  # fmt: skip
    assert left.std() == pytest.approx(noise, rel=0.1)
    assert abs(np.median(left)) < 0.5 * noise
    assert np.median(pixels[faint]) == pytest.approx(scene.sky_electrons + scene.dark_electrons, rel=0.02)


@pytest.mark.parametrize("way", ["raw", "amplifiers", "electrons"])
def test_headers_are_in_the_words_of_the_survey(files, way):
    header = fits.getheader(files[way])
    assert (header["RAFTBAY"], header["CCDSLOT"], header["DETNUM"]) == ("R22", "S11", 94)
    assert header["LSST_NUM"] == "E2V-CCD250-382"
    assert (header["IMGTYPE"], header["TIMESYS"], header["EXPTIME"]) == ("SKYEXP", "TAI", header["SHUTTIME"])
    assert (header["ROTPA"], header["AMSTART"]) == (33.0, 1.25)
    assert (header["RASTART"], header["DECSTART"]) == (header["RA"], header["DEC"])
    kind = {"amplifiers": "amp", "electrons": "eimage"}.get(way)
    assert header.get("FILENAME") == (f"{kind}_00000012-0-r-R22_S11-det094.fits" if kind else None)


def test_the_rotation_of_a_table_of_pointings_turns_the_camera(tmp_path):
    table = tmp_path / "p.csv"
    table.write_text("ra,dec,position_angle,mjd,band\n-10.0,-20.5,-50.0,60905.25,lsst_r\n")
    (planned,) = ground_surveys.read(table, Observation(("EXT",), survey="lsst"), MISSION)
    one = render("EXT", exposed={**EXPOSED, "position_angle": planned.position_angle})
    header = fits.getheader(put(one, tmp_path)["science"])
    assert header["ROTPA"] == 310.0
    # Position angle of the camera's y axis, along the columns of a sensor, from north through east.
    assert np.degrees(np.arctan2(header["CD1_2"], header["CD2_2"])) == pytest.approx(-50.0, abs=0.01)


@nightly.parametrize("camera", ["lsstcam", "hsc"], (1,))
def test_ccdproc_reduces_amplifiers_by_their_headers(camera, tmp_path):
    one = tools.stars_on(camera, 5.0, way="amplifiers")
    path = tools.put(one, tmp_path).path
    found, steps = np.zeros(one.science.shape), 0
    for text, image in tools.reduced(path):
        assert image.unit == "electron"
        column_step, row_step = steps_of_text(text)
        found[Section.from_text(text).slices] = image.data[::row_step, ::column_step]
        steps += 1
    assert steps == len(one.scene.layout.amplifiers)
    sky = (one.scene.sky_rate + one.scene.dark_rate) * one.scene.exposure_time_s
    left = found - np.asarray(one.noise_free, float)
    assert np.median(left) == pytest.approx(sky, rel=0.02)
