"""Calibration stars of VIS: five that bleed or are white dwarfs, and one outside the field that gives stray light."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import optimize

from lake_schema.mission.configuration import resolve
from tests.truesky import nightly
from tests.truesky.render import calibrated, fields
from truesky.render.camera import astrometry, detectors
from truesky.render.channels.aim import Aim
from truesky.render.exposure import standard_stars
from truesky.render.products import headers, truth_table
from truesky.request.accuracy import SURVEY

MISSION = resolve()
SIDE = 256
FIVE = np.array([(0.25, 0.25), (0.75, 0.25), (0.5, 0.5), (0.25, 0.75), (0.75, 0.75)]) * (SIDE - 1)
PER_DETECTOR = ("bleeding", "white_dwarf")
# Effects are off, so that electrons stay in their pixels and are read without errors.
QUIET = dict.fromkeys(
    (
        "cosmic_rays", "readout_cosmic_rays", "poisson", "read_noise", "hot_pixels", "dark_current", "brighter_fatter",
        "parallel_cti", "serial_cti", "nonlinearity", "crosstalk", "detector_crosstalk", "bias_structure",
        "bias_drift", "row_noise", "pixel_response", "illumination", "ghosts", "shutter", "pixel_area",
    ),
    False,
)  # fmt: skip


def rendered(kind, magnitude, name="3-4", forced=None, truth=("noise_free", "saturation", "sky"), **parameters):
    """Render a field without other sources; return it and its header."""
    mission = MISSION.with_overrides({f"survey.{kind}.magnitude": (magnitude, "mag"), **parameters})
    detector = replace(detectors.detector("vis", name, mission), nx=SIDE, ny=SIDE, injection_rows=0)
    target = "white dwarf DA" if kind == "white_dwarf" else "Vega"
    row = {
        "channel": "VIS", "camera": "vis", "band": "euclid_vis", "image_type": kind, "target": target, "ra": 53.117,
        "dec": -27.808, "exposure_time_s": 561.0, "sky": 0.25,
    }  # fmt: skip
    none = fields.galaxies([], []), fields.stars([], [])
    tables = none[0], fields.fluxes(none[0], "euclid_vis", 0.0), none[1], fields.fluxes(none[1], "euclid_vis", 0.0)
    one = fields.rendered(row, detector, tables, mission, SURVEY, forced=QUIET | (forced or {}), truth=truth)
    return one, {keyword: value for keyword, value, _ in headers.science_cards(one)}


@nightly.parametrize(("kind", "magnitude"), [("bleeding", 15.0), ("white_dwarf", 19.0)], (1,))
def test_five_are_on_a_detector(kind, magnitude):
    one, header = rendered(kind, magnitude)
    rows = truth_table.truth(one)
    found = np.stack([rows[name].to_numpy() for name in "xy"], axis=1)
    order, expected = (np.lexsort(np.rint(places).T) for places in (found, FIVE))
    np.testing.assert_allclose(found[order], FIVE[expected], atol=1e-5)
    np.testing.assert_allclose(
        rows["expected"].to_numpy(), 10 ** (0.4 * (one.zero_point - magnitude)) * 561.0, rtol=1e-5
    )
    assert (header["TARGMAG"], header["TARGBAND"]) == (magnitude, "euclid_vis")
    assert (one.maps["saturation"].sum() > 50) == (kind == "bleeding")


def test_none_lies_on_rows_that_are_not_read():
    mission, whole = MISSION, detectors.detector("vis", "3-4", MISSION)
    for kind in PER_DETECTOR:
        aim = Aim.from_exposure(fields.exposure(image_type=kind, target="Vega", ra=53.117, dec=-27.808), whole)
        _, row = astrometry.pixel_of_sky(aim.wcs, *standard_stars.star_positions(aim, mission))
        assert len(row) == 5
        assert (np.abs(row - (whole.ny - 1) / 2) > 300).all()


def test_length_of_a_bleed_trail_follows_from_the_excess_charge():
    """In each column, the full pixels hold the charge that fell on them, and no electron is lost."""
    one, _ = rendered("bleeding", 14.0)
    full = one.maps["saturation"] > 0
    wells = calibrated.of_pixels(one.scene, "full_well", "electron")
    fallen = one.noise_free + 0.25 * 561.0
    columns = np.flatnonzero(full.sum(axis=0) > 20)
    assert len(columns) >= 10
    for half in (slice(0, SIDE // 2), slice(SIDE // 2, SIDE)):
        for column in columns:
            rows = np.flatnonzero(full[half, column])
            if not len(rows):
                continue
            assert len(rows) == rows[-1] - rows[0] + 1
            # The pixels at the two ends take the rest of the charge.
            reach = slice(max(rows[0] - 1, 0), rows[-1] + 2)
            assert len(rows) == pytest.approx(fallen[half, column][reach].sum() / wells[half, column][0], abs=2.0)
    image = calibrated.adu_to_electrons(one.science, one.scene)
    assert image.sum() == pytest.approx(fallen.sum(), rel=2e-3)


def test_a_star_beside_the_field_measures_the_halo():
    """The star is more than 30 arcsec outside the frame. Its light gives the fraction and the scale of the halo."""
    detector = replace(detectors.detector("vis", "1-3", MISSION), nx=SIDE, ny=SIDE, injection_rows=0)
    distance = (detector.y + 0.1 * SIDE / 2 + 36.0) / 3600
    own = {"survey.stray_light.distance": (distance, "deg")}
    one, header = rendered("stray_light", 2.0, "1-3", **own)
    without, _ = rendered("stray_light", 30.0, "1-3", **own)
    assert header["TARGDIST"] == pytest.approx(distance)
    halo = (one.maps["sky"] - without.maps["sky"]).astype(float)
    aim = Aim.from_exposure(one.exposure, detector)
    star = astrometry.pixel_of_sky(aim.wcs, *standard_stars.star_positions(aim, one.scene.mission))
    assert not (0 <= star[0][0] < SIDE and 0 <= star[1][0] < SIDE)
    y, x = np.mgrid[:SIDE, :SIDE]
    r = 0.1 * np.hypot(x - star[0][0], y - star[1][0])
    assert r.min() > 30.0
    light = 10 ** (0.4 * (one.zero_point - 2.0)) * 561.0

    def profile(r, fraction, scale):
        return light * fraction * 0.01 / (2 * np.pi * scale**2) * (1 + (r / scale) ** 2) ** -1.5

    fraction, scale = optimize.curve_fit(profile, r.ravel(), halo.ravel(), (1e-3, 30.0))[0]
    assert fraction == pytest.approx(MISSION.value("vis.halo.fraction"), rel=0.01)
    assert scale == pytest.approx(MISSION.value("vis.halo.radius", "arcsec"), rel=0.01)
    # The image contains the halo, and also the diffraction spikes.
    gain = calibrated.of_pixels(one.scene, "gain", "electron / adu")
    excess = ((one.science.astype(float) - without.science) * gain).mean()
    assert excess > halo.mean() > 5.0
