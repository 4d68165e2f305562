"""NISP-S: content of a file, positions of the light, selection of sources, and invalid settings."""

from dataclasses import replace
from functools import cache

import numpy as np
import pyarrow as pa
import pytest

from lake_schema.errors import BadInput
from lake_schema.fits import images
from lake_schema.mission.configuration import resolve
from tests.truesky import nightly
from tests.truesky.render import fields, infrared, spectroscopic
from tests.truesky.render.infrared import SEED
from tests.truesky.render.spectroscopic import MISSION, QUIET, TIME, strip
from truesky.fluxes import passbands
from truesky.render.camera import detectors
from truesky.render.channels import registry
from truesky.render.channels.aim import Aim
from truesky.render.exposure import persistence, single_source_spectra, visible_spectra
from truesky.render.exposure.records import Rows, Variant
from truesky.render.products import fits_files, read_back, truth_table
from truesky.request.accuracy import DRAFT

CHANNEL = registry.CHANNELS["NISP-S"]
BAND = passbands.load("nisp_red")


@cache
def one():
    return spectroscopic.rendered([18.0, 21.0], [290.2, 350.7], [30.6, 70.1], truth=("cosmic_rays", "sky", "stars"))


def test_the_file(tmp_path):
    """The slope has 16 bits and chi^2 8 bits, both with a border of reference pixels. The header names the grism."""
    found = one()
    _, writers = fits_files.products(found, ())
    (science,) = (path for path in writers if path.endswith("science.fits"))
    writers[science](tmp_path / "science.fits")
    read = images.read_images(tmp_path / "science.fits")
    assert [(unit.name, unit.data.shape, unit.data.dtype) for unit in read[1:]] == [
        ("DET22.SCI", (104, 648), np.uint16),
        ("DET22.CHI2", (104, 648), np.uint8),
    ]
    header = {key: value for key, value, _ in read[0].cards}
    assert (header["READMODE"], header["NG"], header["NR"], header["ND"]) == ("MACC", 15, 16, 11)
    assert (header["GRISM"], header["GRISMPA"], header["FILTER"]) == ("RGS000", 0.0, "nisp_red")
    assert (header["EXPTIME"], header["RDNOISE"]) == (
        pytest.approx(549.6, abs=0.1),
        pytest.approx(np.hypot(13.0 * 8**-0.5, 6.7), abs=0.05),
    )
    np.testing.assert_array_equal(read_back.frame(tmp_path / "science.fits").data, found.science)
    # chi^2 has 13 degrees of freedom, and the noise of reads is correlated. Cosmic rays and bright pixels increase it.
    quality = read[2].data[4:-4, 4:-4][found.maps["cosmic_rays"] == 0]
    assert 10.0 < quality.mean() < 16.0
    assert quality.max() > 30
    np.testing.assert_array_equal(found.maps["stars"], found.noise_free)


def test_an_order_has_the_light_of_the_table_where_its_trace_runs():
    """The light of the first order of a star in the middle of the strip is complete, and lies on its trace."""
    found = one()
    detector, row = strip(), fields.exposure(**spectroscopic.exposed(strip()))
    total = 10 ** (-0.4 * (18.0 - row.zero_point)) * TIME
    assert found.drawn_electrons[0] == pytest.approx(total, rel=0.03)
    (first,) = (trace for trace in CHANNEL.dispersion.traces(row, detector, MISSION, SEED) if trace.order == 1)
    x, y = first.offsets(290.2, 30.6, BAND.wavelength)
    photons = BAND.response / BAND.wavelength
    columns = np.arange(640)
    light = found.noise_free[:60].sum(axis=0)
    centre = 290.2 + np.average(x, weights=photons)
    assert np.average(columns, weights=light) == pytest.approx(centre, abs=2.0)
    middle = int(290.2 + x[len(x) // 2])
    rows = np.average(np.arange(96), weights=found.noise_free[:, middle - 5 : middle + 6].sum(axis=1) + 0.0)
    assert rows == pytest.approx(30.6 + y[len(y) // 2], abs=4.0)


def test_first_orders_of_sources_outside_the_detector_fall_on_it():
    """The star is 250 pixels before the first column, outside the margin of images."""
    beside = spectroscopic.rendered([18.0], [-250.0], [48.0])
    assert len(beside.sources) == 1
    assert beside.noise_free.sum() > 1e3
    # This star is far on the other side: only its second order reaches the detector.
    second = spectroscopic.rendered([16.0], [-1200.0], [48.0])
    assert second.noise_free.sum() > 1e3
    assert len(spectroscopic.rendered([16.0], [5000.0], [48.0]).sources) == 0


def test_margin_contains_the_first_order_and_spectra_are_searched_up_to_any_order():
    whole = detectors.detector("nisp", "DET22", MISSION)
    exposure = fields.exposure(**spectroscopic.exposed(whole))
    assert CHANNEL.margin("nisp", MISSION) == pytest.approx(60.0 + 293 * 0.3, rel=0.02)
    assert registry.CHANNELS["NISP-P"].margin("nisp", MISSION) == 60.0
    assert 2019 * 0.3 < visible_spectra.margin_arcsec(exposure, whole, MISSION, BAND, SEED) < 1200.0
    assert visible_spectra.margin_arcsec(replace(exposure, image_type="dark"), whole, MISSION, BAND, SEED) == 0.0


def wheel_errors(rows, seed):
    """Return the wheel errors [n] (deg), from the direction of the first order of each exposure."""
    found = []
    for row in rows:
        (first,) = (trace for trace in CHANNEL.dispersion.traces(row, strip(), MISSION, seed) if trace.order == 1)
        along, across = first.polynomials(0.0, 0.0)
        found.append(np.degrees(np.arctan2(across[1:].sum(), along[1:].sum())) - row.grism_angle)
    return np.array(found)


def test_wheel_error_differs_between_exposures_but_not_between_realisations():
    rows = [fields.exposure(**spectroscopic.exposed(strip(), mjd=infrared.MJD + i)) for i in range(200)]
    tilts = wheel_errors(rows, SEED)
    assert np.std(tilts) == pytest.approx(0.1, rel=0.2)
    again = replace(rows[0], realisation=3)
    np.testing.assert_array_equal(wheel_errors([again], SEED), tilts[:1])


def test_wheel_errors_depend_on_the_seed_and_on_the_setting():
    """200 pairs of independent errors: the standard error of a correlation is 0.07."""
    rows = [fields.exposure(**spectroscopic.exposed(strip(), mjd=infrared.MJD + i)) for i in range(200)]
    turned = [replace(row, grism_angle=-4.0) for row in rows]
    one, seed, angle = wheel_errors(rows, SEED), wheel_errors(rows, SEED + 1), wheel_errors(turned, SEED)
    assert np.std(seed) == pytest.approx(0.1, rel=0.2)
    assert abs(np.corrcoef(one, seed)[0, 1]) < 0.25
    assert abs(np.corrcoef(one, angle)[0, 1]) < 0.25


def test_spectra_are_drawn_where_the_seed_s_wheel_puts_them():
    row = spectroscopic.exposed(strip())
    stars, seeds = infrared.tables(strip(), row, [16.0], [290.2], [48.0]), (SEED, SEED + 1)
    drawn = [fields.rendered(row, strip(), stars, MISSION, DRAFT, seed).noise_free for seed in seeds]
    # Mean rows 250 pixels along the spectrum.
    found = [np.average(np.arange(96), weights=light[:, 530:550].sum(axis=1)) for light in drawn]
    turned = np.concatenate([wheel_errors([fields.exposure(**row)], seed) for seed in seeds])
    assert abs(turned[1] - turned[0]) > 0.05
    assert found[1] - found[0] == pytest.approx(250.0 * np.radians(turned[1] - turned[0]), abs=0.1)


def test_turned_grisms_darken_the_side_that_they_are_turned_to():
    """A tilt of 4 deg dims sources by 10 % at 0.385 deg from the centre. Without a tilt, nothing is dimmed."""
    (top, bottom) = (detectors.detector("nisp", name, MISSION) for name in ("DET12", "DET42"))
    x, y = np.full(2, 1000.0), np.array([0.0, 2039.0])
    for grism, angle, loses in (("RGS000", 0.0, 0), ("RGS000", -4.0, -1), ("RGS180", 184.0, -1), ("RGS180", 180.0, 0)):
        rows = [fields.exposure(**spectroscopic.exposed(one, grism, angle)) for one in (top, bottom)]
        left = [CHANNEL.dispersion.vignetting(*pair, x, y, MISSION) for pair in zip(rows, (top, bottom), strict=True)]
        assert [one.min() < 1.0 for one in left] == [loses > 0, loses < 0]
        assert np.min(left) >= 0.9
    exact = CHANNEL.dispersion.vignetting(
        fields.exposure(**spectroscopic.exposed(top, "RGS000", 4.0)),
        replace(top, x=0.0, y=0.385 * 3600, rotation=0.0),
        np.array([(top.nx - 1) / 2]), np.array([(top.ny - 1) / 2]), MISSION,
    )  # fmt: skip
    assert exact == pytest.approx(0.9, abs=1e-3)


def test_the_paper_s_selection_is_one_value_of_a_parameter():
    chosen = resolve(overrides={"env.solar_system.density": (0.0, "deg-2"), "nisp.spectra.selection": (1.0, "")})
    mags, x, y = [22.5, 23.5], [300.0, 310.0], [30.0, 60.0]
    assert len(spectroscopic.rendered(mags, x, y).sources) == 2
    assert len(spectroscopic.rendered(mags, x, y, mission=chosen).sources) == 1


@nightly.parametrize(
    ("flux", "kappa", "a_v", "chosen"),
    [(0.9e-16, 0.0, 0.0, 0), (1.1e-16, 0.0, 0.0, 1), (0.8e-16, 0.2, 0.0, 1), (1.1e-16, 0.0, 3.0, 0)],
    (0, 2),
)
def test_a_line_is_as_bright_as_it_is_seen(flux, kappa, a_v, chosen):
    """H alpha at 1.6 um is magnified by 1.56, or dimmed to 60 % by dust. The galaxy is fainter than 23 mag."""
    own = resolve(overrides={"env.solar_system.density": (0.0, "deg-2"), "nisp.spectra.selection": (1.0, "")})
    body = {"z_obs": 16000.0 / 6564.614 - 1.0, "flux_halpha": flux, "kappa": kappa, "a_v": a_v}
    assert len(spectroscopic.rendered([23.2], [300.0], [48.0], mission=own, body=body).sources) == chosen


def test_capacitance_between_pixels_or_none():
    """With the capacitance of the mission, a part of the light of a bright star is in neighbouring pixels."""
    none = resolve(overrides={"env.solar_system.density": (0.0, "deg-2"), "nisp.ipc_spectroscopic": (0.0, "")})
    peaks = [
        infrared.electrons(spectroscopic.rendered([16.0], [300.0], [48.0], forced=QUIET, mission=own)).max()
        for own in (MISSION, none)
    ]
    assert peaks[0] < 0.995 * peaks[1]


def test_a_pixel_is_sky_dark_and_noise():
    off = ("dispersed_sky", "ramp_cosmic_rays", "dark_map", "pixel_response")
    found = spectroscopic.rendered(forced=dict.fromkeys(off, False))
    signal = infrared.electrons(found)
    assert signal.mean() == pytest.approx(TIME, rel=0.01)
    assert signal.std() == pytest.approx(np.hypot(found.scene.pixel_noise, 1.92 * 12**-0.5), rel=0.08)


def test_light_of_a_source_does_not_depend_on_neighbours_or_their_order():
    mags, x, y = [18.0, 19.0, 20.0], [250.0, 300.0, 350.0], [20.0, 48.0, 70.0]
    row, variant = spectroscopic.exposed(strip()), Variant(MISSION, DRAFT, {})
    aim = Aim.from_exposure(fields.exposure(**row), strip())
    frames = [
        next(single_source_spectra.draw_sources(aim, Rows(*infrared.tables(strip(), row, *one)), variant, 1)).frame
        for one in zip(mags, x, y, strict=True)
    ]
    together = spectroscopic.rendered(mags, x, y, accuracy=DRAFT)
    np.testing.assert_array_equal(together.noise_free, sum(frames).astype(np.float32))
    assert together.drawn_electrons.sum() == pytest.approx(sum(float(frame.sum()) for frame in frames), rel=1e-6)


def test_layers_of_orders_add_up_to_the_frame():
    """The strip contains the first order of one star, and the second order of another."""
    layers = ("order_1", "order_0", "order_2", "order_m1")
    mags, x, y = [18.0, 16.0], [300.0, -1100.0], [30.0, 60.0]
    found = spectroscopic.rendered(mags, x, y, truth=layers)
    np.testing.assert_array_equal(found.noise_free, spectroscopic.rendered(mags, x, y).noise_free)
    np.testing.assert_allclose(sum(found.maps[name].astype(float) for name in layers), found.noise_free, atol=1e-3)
    assert found.maps["order_1"][:45].sum() > 0.99 * found.maps["order_1"].sum() > 1e4
    assert found.maps["order_2"][45:].sum() > 0.99 * found.maps["order_2"].sum() > 1e3
    assert found.maps["order_0"].sum() == found.maps["order_m1"].sum() == 0.0


def test_a_star_s_spectrum_is_where_the_star_is_on_the_day():
    """A proper motion of 300 mas/yr shifts the star and its trace by ten pixels in the ten years since 2015.5."""
    row = spectroscopic.exposed(strip())
    body, none, points, f_nu = infrared.tables(strip(), row, [18.0], [290.2], [30.6])
    moving = points.append_column("pm_ra", pa.array([0.0])).append_column("pm_dec", pa.array([300.0]))
    still, moved = (
        fields.rendered(row, strip(), (body, none, stars, f_nu), MISSION, DRAFT) for stars in (points, moving)
    )
    step = np.hypot(moved.sources.column[0] - still.sources.column[0], moved.sources.row[0] - still.sources.row[0])
    assert step == pytest.approx(10.1, abs=0.3)
    first, then = (truth_table.spectra(found).to_pylist()[0] for found in (still, moved))
    assert np.hypot(then["x_first"] - first["x_first"], then["y_first"] - first["y_first"]) == pytest.approx(
        step, abs=0.1
    )


def test_image_types():
    dark = spectroscopic.rendered(kind="dark", sky=0.0, forced={"ramp_cosmic_rays": False})
    assert np.median(infrared.electrons(dark)) == pytest.approx(0.02 * TIME, abs=2.0)
    flat = spectroscopic.rendered(kind="flat", lamp=4, sky=0.0)
    assert np.median(infrared.electrons(flat)) > 1e4


def test_a_planetary_nebula_is_at_five_places_and_its_light_in_lines():
    """The ratio of the brightest to the median column of the trace is 1.5 times larger than for a white dwarf."""
    whole, contrast = strip(nx=1400, ny=300), []
    body, points = fields.galaxies([], []), fields.stars([], [])
    for name in ("sed", "mag_h", "a_v"):
        points = points.append_column(name, pa.array([], pa.int64() if name == "sed" else pa.float64()))
    nothing = body, fields.fluxes(body, BAND.name, 0.0), points, fields.fluxes(points, BAND.name, 0.0)
    for kind, target in (("planetary_nebula", "planetary nebula"), ("standard_star", "white dwarf DA")):
        row = spectroscopic.exposed(whole, kind=kind, target=target)
        found = fields.rendered(row, whole, nothing, MISSION, DRAFT)
        assert len(found.sources) == 5
        first = (row for row in truth_table.spectra(found).to_pylist() if row["order"] == 1)
        row = max(first, key=lambda one: one["drawn"])
        low, high = sorted((round(row["x_first"]), round(row["x_last"])))
        middle = round(0.5 * (row["y_first"] + row["y_last"]))
        light = found.noise_free[middle - 8 : middle + 9, max(low, 0) + 20 : high - 20].sum(axis=0)
        contrast.append(light.max() / np.median(light))
    assert contrast[0] > 1.5 * contrast[1]


def test_spectra_before_an_image_leave_their_mean_sky():
    spectrum = fields.exposure(**spectroscopic.exposed(strip()))
    assert persistence.is_drawn(spectrum)
    assert persistence.is_drawn(replace(spectrum, image_type="flat"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"grism": None}, "a spectrum requires a grism and its angle"),
        ({"grism": "RGS270"}, "'RGS270' is not one of"),
        ({"angle": 90.0}, "turns RGS000 by 90 deg, more than 45"),
        ({"psf": "psf.fits"}, "spectra do not support PSF files, got psf.fits"),
    ],
)
def test_impossible_spectra_are_refused(change, said):
    with pytest.raises(BadInput, match=said):
        spectroscopic.rendered([18.0], [300.0], [48.0], **change)


def test_a_star_of_ab_2_in_order_0_fills_its_pixels():
    """Pixels of order 0 are saturated, but less than half of the strip is."""
    found = spectroscopic.rendered([2.0], [1400.0], [48.0], truth=("saturation", "order_0"))
    (row,) = (row for row in truth_table.spectra(found).to_pylist() if row["order"] == 0)
    column, line = (round(row[f"{axis}_first"] / 2 + row[f"{axis}_last"] / 2) for axis in "xy")
    assert found.maps["saturation"][line, column] == 1
    assert found.maps["order_0"].sum() == pytest.approx(row["drawn"], rel=1e-5)
    assert row["drawn"] > 1e8
    signal, full = infrared.electrons(found), found.scene.value("full_well", "electron")
    assert -100.0 < signal.min() < signal.max() < 1.5 * full
    assert found.maps["saturation"].mean() < 0.5


def test_a_grism_that_is_turned_by_30_deg_puts_order_0_elsewhere():
    found = spectroscopic.rendered([2.0], [1400.0], [48.0], angle=30.0, truth=("order_0",))
    assert found.maps["order_0"].sum() == 0.0
    straight = spectroscopic.rendered([2.0], [1400.0], [48.0], truth=("order_0",))
    assert straight.maps["order_0"].sum() > 1e8
