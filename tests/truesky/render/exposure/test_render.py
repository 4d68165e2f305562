"""One detector from tables to images: fluxes, places, noise, and that neighbours change nothing."""

import csv
from dataclasses import replace
from functools import cache
from importlib.resources import files

import numpy as np
import pyarrow as pa
import pytest

from lake_schema import units
from lake_schema.errors import BadInput
from lake_schema.ids import kind_from_id
from tests.truesky import nightly
from tests.truesky.render import calibrated, fields, nominal
from tests.truesky.render.fields import MISSION, fluxes, galaxies, small, stars
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, detectors
from truesky.render.camera.pointing import boresight_for
from truesky.render.channels import vis
from truesky.render.drawing import cost, stamps
from truesky.render.effects.light import calibration_lamp, ghosts
from truesky.render.effects.scene import Lights, Scene
from truesky.render.exposure import truth_maps
from truesky.render.planning import planned_exposures, variants
from truesky.request import schema
from truesky.request.accuracy import DRAFT, SURVEY
from truesky.request.from_toml import from_table

SIDE = 256
CASES = {"VIS": ("vis", "3-4", "euclid_vis", 0.24, 0.0), "EXT": ("lsstcam", "R22_S11", "lsst_r", 33.0, 0.73)}


@cache
def field(channel, n=30):
    """(task, exposure, galaxies, stars) of a small detector with sources laid on a grid of pixels."""
    camera, name, band, sky, seeing = CASES[channel]
    detector = small(camera, name, SIDE)
    ra, dec, angle = boresight_for(detector, 53.1, -27.8, 12.0)
    # VIS has the radiation damage of its launch.
    mjd = 60126.0 if channel == "VIS" else 60950.0
    exposed = {
        "exposure_id": 3, "channel": channel, "camera": camera, "band": band, "image_type": "science",
        "ra": ra, "dec": dec, "position_angle": angle, "mjd": mjd, "exposure_time_s": 100.0,
        "sky": sky, "seeing": seeing,
        "zero_point": planned_exposures.zero_point_of("vis" if channel == "VIS" else "ext.lsstcam", band, MISSION),
    }  # fmt: skip
    rng = np.random.default_rng(2)
    system = astrometry.wcs(detector, ra, dec, angle)
    x, y = rng.uniform(-40, SIDE + 40, (2, 2 * n))
    where = astrometry.sky_of_pixel(system, x, y)
    body = galaxies(
        where[0][:n], where[1][:n], bulge_fraction=rng.random(n), inclination=80 * rng.random(n),
        position_angle=180 * rng.random(n), disk_half_light_radius=0.4, bulge_sersic_index=1.5,
    )  # fmt: skip
    return {"detector": name}, exposed, body, stars(where[0][n:], where[1][n:])


def render(channel, body=None, points=None, flux=3.0, seed=1, accuracy=SURVEY, kind="science", **options):
    _, exposed, all_bodies, all_points = field(channel)
    exposed = {**exposed, "image_type": kind, "sky": 0.0 if kind in ("bias", "dark") else exposed["sky"]}
    exposed |= options.pop("exposed", {})
    body = all_bodies if body is None else body
    points = all_points if points is None else points
    camera, name, band = CASES[channel][:3]
    tables = body, fluxes(body, band, flux), points, fluxes(points, band, flux)
    detector = options.pop("detector", small(camera, name, SIDE))
    return fields.rendered(exposed, detector, tables, MISSION, accuracy, seed, **options)


@pytest.mark.parametrize(
    ("section", "band", "zero_point"),
    [
        ("vis", "euclid_vis", 25.93),
        ("nisp", "euclid_y", 25.00),
        ("nisp", "euclid_j", 25.18),
        ("nisp", "euclid_h", 25.11),
        ("ext.lsstcam", "lsst_r", 28.36),
        ("ext.decam", "des_g", 26.93),
    ],
)
def test_zero_points(section, band, zero_point):
    assert planned_exposures.zero_point_of(section, band, MISSION) == pytest.approx(zero_point, abs=0.01)


@pytest.mark.parametrize(
    ("section", "band", "tolerance"),
    [
        *(("ext.lsstcam", f"lsst_{b}", 0.1) for b in "ugrizy"),
        *(("ext.decam", f"des_{b}", 0.25) for b in "griz"),
        *(("ext.megacam", f"cfis_{b}", 0.1) for b in "ur"),
        ("ext.jpcam", "jedis_g", 0.70),
        ("ext.gpc1", "ps1_i", 0.15),
        ("ext.hsc", "hsc_z", 0.35),
    ],
)
def test_published_zero_points_are_those_of_throughput_and_area(section, band, tolerance):
    """Within what calibrations and telescopes differ by; JPCam's curve leaves out the telescope and the sky."""
    width = passbands.log_width(passbands.load(band))
    derived = units.zero_point(MISSION.value(f"{section}.collecting_area", "cm2"), width)
    assert MISSION.value(f"{section}.{band}.zero_point") == pytest.approx(derived, abs=tolerance)


def test_every_throughput_is_the_one_of_the_fluxes():
    """Each band has one curve: flux tables are integrated over the passband that the mission database names."""
    with (files("truesky.fluxes") / "passbands.csv").open() as stream:
        used = {row["name"]: row["source"] for row in csv.DictReader(stream)}
    named = {m.key.split(".")[-2]: m.file for m in MISSION.models if m.key.endswith(".throughput")}
    assert set(named) >= {
        "euclid_vis",
        "euclid_y",
        "euclid_j",
        "euclid_h",
        "lsst_u",
        "des_z",
        "cfis_u",
        "ps1_i",
        "hsc_z",
    }
    for band, file in named.items():
        assert used[band] == "speclite:" + file.rpartition("/")[2].removesuffix(".ecsv")
    for grism, curve in (("RGS000", "nisp_red"), ("RGS180", "nisp_red"), ("BGS000", "nisp_blue")):
        band = passbands.load(curve)
        half = band.wavelength[band.response > 0.5 * band.response.max()]
        for end, found in (("first_nm", half[0]), ("last_nm", half[-1])):
            ends = {10.0 * float(row[end]) for row in MISSION.rows("nisp.traces") if row["grism"] == grism}
            assert sorted(ends) == pytest.approx([found], rel=2e-3)


def test_published_saturation_magnitude():
    """A fifth of the light in the central pixel fills the well at I_E = 17.8 in VIS's nominal exposure."""
    zero_point = planned_exposures.zero_point_of("vis", "euclid_vis", MISSION)
    t = MISSION.value("vis.exposure_time", "s")
    assert zero_point + 2.5 * np.log10(t * 0.20 / MISSION.value("vis.full_well")) == pytest.approx(17.80, abs=0.03)


@nightly.parametrize("channel", CASES, (1,))
def test_noise_free_totals_are_the_table_s(channel):
    """Each source alone: galaxies to 1 %, stars to 0.5 %."""
    _, exposed, body, points = field(channel)
    band = CASES[channel][2]
    rate = 10 ** (
        0.4 * (planned_exposures.zero_point_of("vis" if channel == "VIS" else "ext.lsstcam", band, MISSION) - 23.9)
    )
    inside = astrometry.pixel_of_sky(
        astrometry.wcs(
            small(CASES[channel][0], CASES[channel][1], SIDE),
            exposed["ra"],
            exposed["dec"],
            exposed["position_angle"],
        ),
        *(np.concatenate([body[axis].to_numpy(), points[axis].to_numpy()]) for axis in ("ra", "dec")),
    )
    central = np.flatnonzero((np.abs(np.array(inside) - SIDE / 2) < 60).all(0))[::2]
    assert {i < len(body) for i in central} == {True, False}
    for i in central:
        flux = 0.05 if i % 2 else 5.0
        n = len(body)
        one = render(
            channel,
            body.slice(i, 1) if i < n else body.slice(0, 0),
            points.slice(i - n, 1) if i >= n else points.slice(0, 0),
            flux,
        )
        assert len(one.sources) == 1
        total = float(one.noise_free.sum(dtype=float))
        assert total == pytest.approx(flux * rate * 100.0, rel=0.01 if i < n else 0.005)


@pytest.mark.parametrize("channel", CASES)
def test_the_image_is_the_truth_with_the_predicted_noise(channel):
    one = render(channel, truth=("cosmic_rays",))
    scene = one.scene
    applied = {d.name for d in one.decisions if d.applied}
    # LSST's converters have 18 bits.
    assert one.raw.dtype == one.science.dtype == {"VIS": np.uint16, "EXT": np.int32}[channel]
    assert applied == {
        "VIS": {
            "intra_pixel", "background", "pixel_area", "illumination", "shutter", "pixel_response", "poisson",
            "brighter_fatter", "dark_current", "hot_pixels", "cosmic_rays", "quadrants", "readout_cosmic_rays",
            "nonlinearity", "crosstalk", "bias_structure", "bias_drift", "row_noise", "read_noise", "adc",
        },
        "EXT": {
            "background", "illumination", "pixel_response", "tree_rings", "edge_displacement", "poisson",
            "brighter_fatter", "dark_current", "hot_pixels", "cosmic_rays", "amplifiers",
            "serial_loss", "nonlinearity", "crosstalk", "bias_structure", "read_noise", "adc",
        },
    }[channel]  # fmt: skip
    read_noise = calibrated.of_pixels(scene, "read_noise", "electron") * ("read_noise" in applied)
    expected = one.noise_free + scene.sky_electrons + scene.dark_electrons * ("dark_current" in applied)
    variance = expected + read_noise**2 + calibrated.of_pixels(scene, "gain", "electron / adu") ** 2 / 12
    found = calibrated.electrons(one.raw, scene, 1, applied)
    found = np.where(one.maps["cosmic_rays"] > 0, np.nan, found)
    pull = (found - expected) / np.sqrt(variance)
    # Dark columns, cosmic rays.
    assert np.isfinite(pull).mean() > 0.95
    assert np.nanmean(pull) == pytest.approx(0.0, abs=5 / SIDE)
    assert np.nanstd(pull) == pytest.approx(1.0, abs=5 / SIDE)


def test_switching_one_effect_off_keeps_the_random_numbers_of_others():
    """Without cosmic rays, pixels that none hit are the same, bit by bit."""
    base = render("VIS", forced={"crosstalk": False}, truth=("cosmic_rays",))
    hit = base.maps["cosmic_rays"] > 0
    off = {"cosmic_rays": False, "readout_cosmic_rays": False, "crosstalk": False}
    without = render("VIS", forced=off, truth=("cosmic_rays",))
    assert hit.any()
    assert not without.maps["cosmic_rays"].any()
    np.testing.assert_array_equal(base.science[~hit], without.science[~hit])


GHOSTS_STAR = 5.0
# Conditions that show that an effect is in the first image of a detector and not in the second. Both contain a
# saturated star in column 60, a faint star, and the ghost of a star next to the detector.
SHOWS = {
    "ghosts": lambda on, off: change(on, off).sum() == pytest.approx(ghost_of(GHOSTS_STAR), rel=0.05),
    # Charge is held back, and let go of later, or not before the last row is read.
    "parallel_cti": lambda on, off: change(on, off).min() < 0 < change(on, off).max() and change(on, off).sum() < 0,
    "bleeding": lambda on, off: (on.science[:, 60] > 50_000).sum() > 100 + (off.science[:, 60] > 50_000).sum(),
    "dark_current": lambda on, off: change(on, off).mean() == pytest.approx(on.scene.dark_electrons, abs=0.015),
    # Twice rounded to 3.48 e-.
    "read_noise": lambda on, off: change(on, off).std() == pytest.approx(np.hypot(4.4, 3.48 / 6**0.5), rel=0.03),
    "intra_pixel": lambda on, off: (
        change(on, off)[50:70, 180:200].min() < -20 < 20 < change(on, off)[50:70, 180:200].max()
    ),
}


def change(on, off):
    """e- of pixels that are not full."""
    difference = calibrated.of_pixels(on.scene, "gain", "electron / adu") * (on.science.astype(float) - off.science)
    return np.where(np.maximum(on.science, off.science) < 40_000, difference, 0.0)


def ghost_of(mag):
    rate = 10 ** (0.4 * (planned_exposures.zero_point_of("vis", "euclid_vis", MISSION) - mag))
    return MISSION.value("vis.ghost.flux_ratio") * rate * nominal.TIME


@nightly.parametrize("name", SHOWS, (0, 2, 4))
def test_each_effect_can_be_forced_on_and_off(name):
    detector = small("vis", "3-4", SIDE)
    # The ghost of the star beside the detector is in its middle.
    middle = Lights(np.array([SIDE / 2]), np.array([SIDE / 2]), np.ones(1))
    moved = ghosts.offset(Scene(MISSION, "vis", nominal.TIME, 0.2, 0.0, detector), "ghost", 1, middle)
    beside = [SIDE / 2 - float(shift[0]) for shift in moved]
    mags, x, y = [GHOSTS_STAR, 12.0, 18.0], [beside[0], 60.3, 190.2], [beside[1], 100.4, 60.7]
    off, on = (nominal.rendered(detector, mags, x, y, forced={name: wish}) for wish in (False, True))
    for one, wish in ((off, False), (on, True)):
        (decision,) = (d for d in one.decisions if d.name == name)
        assert (decision.applied, decision.forced) == (wish, True)
    assert SHOWS[name](on, off)
    assert not SHOWS[name](on, on)


@pytest.mark.parametrize("kind", ["bias", "dark", "flat", "charge_injection", "self_calibration"])
def test_image_types(kind):
    """Each type has its content: a level, few electrons, the lamp, filled rows, or the sky."""
    truth = ("cosmic_rays", "saturation", "sky", "stars")
    one = render("VIS", kind=kind, truth=truth)
    looks, names = kind in ("flat", "self_calibration"), [d.name for d in one.decisions]
    assert set(one.maps) == {"noise_free", *truth_maps.available_maps(truth, names, looks)}
    assert ("sky" in one.maps) == ("stars" in one.maps) == looks
    if looks:
        # With the starlight that strays, where that is noticed.
        stray = any(d.applied for d in one.decisions if d.name == "straylight") * one.scene.lights.electrons.sum()
        assert one.maps["sky"].min() >= one.scene.sky_electrons * (1 - 5e-3)
        # A pixel may cover a larger area of the sky than at the boresight.
        assert one.maps["sky"].max() <= one.scene.sky_electrons * (1 + 5e-3) + stray
    applied = {d.name for d in one.decisions if d.applied}
    found = calibrated.electrons(one.raw, one.scene, 1, applied - {"pixel_response"})
    found = np.where(one.maps["cosmic_rays"] > 0, np.nan, found)
    middle = np.nanmedian(found)
    assert one.raw.shape == (4, SIDE // 2 + 20, 51 + SIDE // 2 + 29)
    if kind in ("bias", "dark"):
        assert len(one.sources) == 0
        assert middle == pytest.approx(0.0, abs=0.2)
        assert np.nanstd(found) == pytest.approx(np.hypot(4.4, 3.48 / 12**0.5), rel=0.03)
    elif kind == "flat":
        assert len(one.sources) > 10
        lamp = 20_000 * calibration_lamp.efficiency_of_scene(one.scene, 1)
        assert middle == pytest.approx(lamp + one.scene.sky_electrons, rel=0.05)
    elif kind == "charge_injection":
        half = np.nanmean(found, axis=1)[: SIDE // 2]
        assert half[:100].max() < 10  # fewer rows than `off`: nothing is injected
    else:
        np.testing.assert_array_equal(one.science, render("VIS").science)


def test_sources_are_drawn_in_order_of_id():
    """The order of the rows, and rows beyond the margin, change no bit."""
    _, _, body, points = field("VIS")
    base = render("VIS")
    assert (np.diff(base.sources.ids) > 0).all()
    shuffled = render(
        "VIS",
        body.take(np.random.default_rng(1).permutation(len(body))),
        points.take(np.arange(len(points))[::-1]),
    )
    np.testing.assert_array_equal(base.science, shuffled.science)
    np.testing.assert_array_equal(base.noise_free, shuffled.noise_free)
    far = stars([53.1, 233.1, 53.1, 0.0], [-26.0, 27.8, -27.9, 90.0])
    far = far.set_column(0, "id", pa.array(far["id"].to_numpy() + (1 << 30)))
    crowd = render("VIS", points=pa.concat_tables([points, far]))
    np.testing.assert_array_equal(base.science, crowd.science)
    assert len(crowd.sources) == len(base.sources)


def test_the_seed_changes_the_noise_alone():
    base, other = render("VIS"), render("VIS", seed=2)
    np.testing.assert_array_equal(base.noise_free, other.noise_free)
    assert (base.science != other.science).mean() > 0.5


@pytest.mark.parametrize(
    "changed",
    [
        pytest.param({"noise_seed": 5}, id="seed"),
        pytest.param({"exposed": {"realisation": 2}}, id="realisation", marks=pytest.mark.nightly),
    ],
)
def test_the_same_sky_with_other_noise(changed):
    """Sources and fixed patterns of the detector stay; the noise of every pixel is different and independent.

    Sample of all dark pixels; significance 6e-5 of their correlation (4 standard errors).
    """
    base, other = render("VIS"), render("VIS", **changed)
    np.testing.assert_array_equal(base.noise_free, other.noise_free)
    assert (base.science != other.science).mean() > 0.5
    off = dict.fromkeys(schema.EFFECTS, False) | dict.fromkeys(schema.ALWAYS_ON, True)
    noisy = off | dict.fromkeys(("background", "poisson", "read_noise"), True)
    rendered = [render("VIS", forced=noisy, **more) for more in ({}, changed)]
    shots = [calibrated.adu_to_electrons(one.science, one.scene) for one in rendered]
    dark = base.noise_free < 5.0
    assert abs(np.corrcoef(*(shot[dark] for shot in shots))[0, 1]) < 4.0 / np.sqrt(dark.sum())
    own = off | dict.fromkeys(("background", "pixel_response", "hot_pixels"), True)
    np.testing.assert_array_equal(*(render("VIS", forced=own, **more).science for more in ({}, changed)))
    same = {"noise_seed": 1, "exposed": {"realisation": 1}}
    np.testing.assert_array_equal(base.science, render("VIS", **same).science)


def test_without_any_effect_the_image_is_the_truth_in_whole_numbers():
    for channel, keep in (("VIS", ()), ("EXT", ()), ("VIS", ("background",))):
        asked = {"effects": {"on": list(keep), "off": ["all"]}}
        request = from_table({"name": "x", "seed": 1, "area": {"cone": {"ra": 0, "dec": 0, "radius": 1}}, **asked})
        one = render(channel, forced=variants.forced_effects(request))
        needed = {"adc", "quadrants", "amplifiers"} & {decision.name for decision in one.decisions}
        assert {decision.name for decision in one.decisions if decision.applied} == needed | set(keep)
        light = one.noise_free.astype(float) + bool(keep) * one.scene.sky_electrons
        gain, bias = (calibrated.of_pixels(one.scene, *key) for key in (("gain", "electron / adu"), ("bias", "adu")))
        assert np.abs(one.science - bias - light / gain).max() == pytest.approx(0.5, abs=1e-2)


def test_a_source_just_outside_still_shines_in():
    one = render("VIS", flux=3000.0)
    kinds = kind_from_id(one.sources.ids)
    outside = (one.sources.column < -0.5) | (one.sources.column > SIDE - 0.5)
    assert (outside & (kinds == 5)).any()
    alone = stamps.draw(one.sources.take(outside), np.full(outside.sum(), 256), one.psf, SIDE, SIDE)
    assert alone.sum() > 0


def test_rows_that_are_not_read_count_for_nothing():
    """Light on the rows between a detector's halves is not drawn for anybody, nor does it decide on an effect."""
    detector = replace(small("vis", "3-4", SIDE), ny=SIDE + 4, injection_rows=4)
    _, exposed, body, _ = field("VIS")
    system = astrometry.wcs(detector, exposed["ra"], exposed["dec"], exposed["position_angle"])
    lon, lat = astrometry.sky_of_pixel(system, np.array([100.0]), np.array([SIDE / 2 + 1.5]))
    body, points = body.slice(0, 0), stars(lon, lat)
    one = render("VIS", body, points, flux=100.0, detector=detector)
    assert one.noise_free[SIDE // 2 : SIDE // 2 + 4].max() == 0.0
    total = one.noise_free.sum(dtype=float)
    assert 0 < total < 0.3 * one.sources.electrons[0]
    # The map has wings from beyond the stamp besides.
    assert 0.9 * total < one.drawn_electrons[0] < total * (1 + 1e-6)
    assert one.scene.peak_electrons == pytest.approx(float(one.noise_free.max()), rel=1e-6)


def test_sources_with_only_wings_on_the_detector_are_not_listed():
    """A galaxy whose stamp is next to the detector has light in the image, but is not listed as drawn."""
    _, exposed, _, points = field("VIS")
    detector = small("vis", "3-4", SIDE)
    system = astrometry.wcs(detector, exposed["ra"], exposed["dec"], exposed["position_angle"])
    lon, lat = astrometry.sky_of_pixel(system, np.array([-600.0]), np.array([100.0]))
    giant = galaxies(lon, lat, bulge_fraction=1.0, bulge_sersic_index=4.0, bulge_half_light_radius=4.0)
    one = render("VIS", giant, points.slice(0, 0), flux=300.0)
    assert one.noise_free.sum() > 10.0
    assert len(one.sources) == len(one.sizes) == len(one.drawn_electrons) == 0
    both = render("VIS")
    assert (both.drawn_electrons > 0).all()


def test_sources_of_no_flux_are_left_out():
    assert len(render("VIS", flux=0.0).sources) == 0
    empty = render("EXT", field("EXT")[2].slice(0, 0), field("EXT")[3].slice(0, 0))
    assert empty.noise_free.max() == 0.0
    assert empty.science.std() > 0


def test_draft_is_close_to_survey():
    fine, coarse = render("VIS"), render("VIS", accuracy=DRAFT)
    assert np.abs(fine.noise_free - coarse.noise_free).max() < DRAFT.background * fine.scene.pixel_noise * 2


def test_a_scene_that_needs_too_much_memory_is_refused(monkeypatch):
    """Before anything is drawn; in one line."""
    monkeypatch.setattr(stamps, "draw", None)
    monkeypatch.setattr(cost, "memory", lambda *scene: (2.2 - vis.CHANNEL.cost.base_gb) * 1e9)
    with pytest.raises(BadInput, match=r"exposure 3, detector 3-4: \d+ sources take 2\.2 GB, a task may use 2"):
        render("VIS")


def test_a_scene_that_would_not_end_is_refused(monkeypatch):
    monkeypatch.setattr(stamps, "draw", None)
    monkeypatch.setattr(cost, "seconds", lambda *scene: 9e4)
    with pytest.raises(
        BadInput, match=r"exposure 3, detector 3-4: \d+ sources take 25\.0 h, a task may use 6: choose a lower accuracy"
    ):
        render("VIS")


def test_bad_tables_are_refused():
    _, exposed, body, points = field("VIS")
    good = (body, fluxes(body, "euclid_vis", 1.0), points, fluxes(points, "euclid_vis", 1.0))

    def attempt(*tables, exposed=exposed):
        return fields.rendered(exposed, small("vis", "3-4", 32), tables, MISSION, SURVEY)

    with pytest.raises(BadInput, match="must have the same rows"):
        attempt(body, good[1].slice(1), points, good[3])
    with pytest.raises(BadInput, match="f_nu_euclid_vis"):
        attempt(body, fluxes(body, "lsst_r", 1.0), points, good[3])
    with pytest.raises(BadInput, match="electrons"):
        attempt(body, fluxes(body, "euclid_vis", float("nan")), points, good[3])
    with pytest.raises(BadInput, match="occurs more than once"):
        attempt(*(pa.concat_tables([t, t]) for t in good))
    with pytest.raises(BadInput, match="NISP"):
        attempt(*good, exposed={**exposed, "channel": "NISP"})
    with pytest.raises(BadInput, match="euclid"):
        attempt(*good, exposed={**exposed, "band": "euclid"})


def test_the_passband_is_the_one_of_the_fluxes():
    """One curve a band: the zero point uses what the flux tables were integrated over."""
    width = passbands.log_width(passbands.load("euclid_vis"))
    found = planned_exposures.zero_point_of("vis", "euclid_vis", MISSION)
    assert found == pytest.approx(units.zero_point(9926.0, width))


def test_a_lamp_s_light_is_moved_and_squeezed_like_a_star_s():
    """A flat of 20 000 electrons has the same nonlinearity and charge transfer as a star, without light of the sky."""
    body, points = (table.slice(0, 0) for table in field("VIS")[2:])
    # As many rows as there are: of fewer traps less is seen than the accuracy allows to leave out.
    tall = replace(detectors.detector("vis", "3-4", MISSION), nx=16)

    def margins(kind, **forced):
        # Tracks are bright, too: without them the lamp alone is.
        forced |= {"cosmic_rays": False, "readout_cosmic_rays": False}
        one = render("VIS", body, points, kind=kind, detector=tall, forced=forced)
        assert all(d.applied for d in one.decisions if d.margin > 1.0 and not d.forced)
        return {d.name: d.margin for d in one.decisions}

    for kind, named in (("flat", "calibration_lamp"), ("charge_injection", "charge_injection")):
        lit, dark = margins(kind), margins(kind, **{named: False})
        assert min(lit[name] for name in ("nonlinearity", "crosstalk", "parallel_cti", named)) > 1.0
        # A flat is open to the sky.
        assert all(lit[name] > 10.0 * dark[name] for name in ("nonlinearity", "crosstalk", "parallel_cti"))


def test_a_star_is_drawn_where_it_is_on_the_day():
    """100 mas/yr to the east, 1000 to the north, ten years after 2015.5; the one without a motion stays."""
    (_, exposed, _, points), n = field("VIS"), 30
    still = render("VIS")
    motion = np.zeros((2, n), np.float32)
    motion[:, :10] = np.array([[100.0], [1000.0]])
    unknown = np.arange(n) >= 20
    moving = points.append_column("pm_ra", pa.array(motion[0], mask=unknown))
    moving = moving.append_column("pm_dec", pa.array(motion[1], mask=unknown))
    moved = render("VIS", points=moving)
    years = (exposed["mjd"] + 50 / 86400 - 51544.5) / 365.25 - 15.5
    shared, one, other = np.intersect1d(still.sources.ids, moved.sources.ids, return_indices=True)
    star = np.searchsorted(points["id"].to_numpy(), shared).clip(max=n - 1)
    is_star = points["id"].to_numpy()[star] == shared
    fast = is_star & (star < 10)
    assert fast.sum() > 4
    step = np.hypot(
        moved.sources.column[other] - still.sources.column[one], moved.sources.row[other] - still.sources.row[one]
    )
    assert step[fast] == pytest.approx(years * np.hypot(0.1, 1.0) / 0.1, rel=0.01)
    assert step[~fast].max() < 1e-6
    assert 7 < years < 9
