"""Positions of detectors and sky positions of their pixels: layouts, parity, pointing, poles, the FITS header."""

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from hypothesis import given
from hypothesis import strategies as st

from lake_schema import sky
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from truesky.render.camera import astrometry
from truesky.render.camera.astrometry import jacobian, pixel_of_sky, sky_of_pixel, wcs
from truesky.render.camera.detectors import detector, detectors
from truesky.render.camera.pointing import boresight_for
from truesky.render.effects.scene import Scene

# Ideal cameras: no distortion, and all detectors at their nominal positions.
MISSION = resolve(
    overrides={
        f"{camera}.fpa.{key}": (0.0, unit)
        for camera in ("vis", "nisp")
        for key, unit in (("distortion", ""), ("metrology_shift", "pix"), ("metrology_rotation", "deg"))
    }
    | {f"ext.lsstcam.fpa.distortion_r{power}": (0.0, f"1 / mm{power}") for power in (2, 4)}
)
VIS, LSST, NISP = (detectors(camera, MISSION) for camera in ("vis", "lsstcam", "nisp"))
BENT = detectors("vis", resolve())
BENT_NISP = detectors("nisp", resolve())
SKY = st.tuples(st.floats(0, 360, exclude_max=True), st.floats(-90, 90), st.floats(-180, 180))
STRAIGHT = st.sampled_from([VIS[0], VIS[15], VIS[35], LSST[0], LSST[94], LSST[188]])
BENT_GROUND = [detectors(camera, resolve())[0] for camera in ("lsstcam", "hsc", "decam")]
ANY_DETECTOR = st.one_of(
    STRAIGHT, st.sampled_from([BENT[0], BENT[15], BENT[35], BENT_NISP[0], BENT_NISP[10], *BENT_GROUND])
)


# ------------------------------------------------------------------------------------------------ layouts


def test_vis_fills_the_published_field():
    assert len(VIS) == len({d.name for d in VIS}) == 36
    width = max(d.x for d in VIS) - min(d.x for d in VIS) + 409.6
    height = max(d.y for d in VIS) - min(d.y for d in VIS) + 413.2
    assert width / 3600 == pytest.approx(0.7003, abs=5e-4)
    assert height / 3600 == pytest.approx(0.7781, abs=5e-4)


def test_rows_between_the_halves_of_a_vis_detector_are_not_read():
    """A VIS detector has 2 x 2066 rows with four charge injection rows between them: 4136 rows from edge to edge."""

    def half_rows(detector):
        return Scene(MISSION, detector.section, 1.0, 0.0, 0.0, detector).half_rows

    assert {(d.nx, d.ny, d.injection_rows, half_rows(d)) for d in VIS} == {(4096, 4136, 4, 2066)}
    assert {(d.injection_rows, half_rows(d)) for d in LSST} == {(0, 2002), (0, 2000)}


@pytest.mark.parametrize("name", ["nx", "ny", "charge_injection_rows"])
def test_a_vis_detector_has_four_equal_quadrants(name):
    assert len(detectors("vis", resolve(overrides={f"vis.fpa.{name}": (2.0, "pix")}))) == 36
    for odd, why in ((3.0, ": must be an even number"), (4.5, " is not a whole number")):
        with pytest.raises(BadInput, match=rf"vis\.fpa\.{name} = {odd:g}{why}"):
            detectors("vis", resolve(overrides={f"vis.fpa.{name}": (odd, "pix")}))


def test_vis_rows_count_from_the_top_and_the_right_half_is_upside_down():
    by_name = {d.name: d for d in VIS}
    assert by_name["1-1"].y > 0 > by_name["6-1"].y
    assert by_name["1-1"].x < 0 < by_name["1-6"].x
    assert {d.rotation for d in VIS if int(d.name[2]) <= 3} == {0.0}
    assert {d.rotation for d in VIS if int(d.name[2]) >= 4} == {180.0}


def test_lsstcam_has_189_sensors_about_the_central_one():
    assert len(LSST) == len({d.name for d in LSST}) == 189
    assert LSST[94].name == "R22_S11"
    assert (LSST[94].x, LSST[94].y) == (0.0, 0.0)
    # The second index runs along x, the first along y.
    assert detector("lsstcam", "R23_S11", MISSION).x == pytest.approx(127.0 * 20.00587)
    # Rafts of the two makers differ in size.
    assert {(d.nx, d.ny) for d in LSST} == {(4096, 4004), (4072, 4000)}
    assert detector("lsstcam", "R22_S21", MISSION).y == pytest.approx(42.25 * 20.00587)
    # Gaps between neighbours: 129 and 221 pixels.
    pixel = LSST[94].pixel_scale
    assert detector("lsstcam", "R22_S12", MISSION).x / pixel - 4096 == pytest.approx(129, abs=0.5)
    assert detector("lsstcam", "R22_S21", MISSION).y / pixel - 4004 == pytest.approx(221, abs=0.5)


def test_nisp_fills_the_published_field():
    assert [d.name for d in NISP][:5] == ["DET11", "DET12", "DET13", "DET14", "DET21"]
    assert len(NISP) == 16
    width, height = (max(getattr(d, axis) for d in NISP) - min(getattr(d, axis) for d in NISP) + 612 for axis in "xy")
    assert width / 3600 == pytest.approx(0.7222, abs=1e-4)
    assert height / 3600 == pytest.approx(0.7645, abs=1e-4)
    assert {d.rotation for d in NISP if d.y > 0} == {0.0}
    assert {d.rotation for d in NISP if d.y < 0} == {180.0}


@pytest.mark.parametrize(
    ("camera", "count", "diameter"),
    [("decam", 62, 2.2), ("megacam", 40, 1.4), ("jpcam", 14, 3.1), ("gpc1", 60, 3.3), ("hsc", 103, 1.8)],
)
def test_ground_cameras_fill_their_fields(camera, count, diameter):
    found = detectors(camera, MISSION)
    assert len(found) == len({d.name for d in found}) == count
    corner = max(np.hypot(d.x, d.y) + d.half_diagonal for d in found)
    assert 2 * corner / 3600 == pytest.approx(diameter, rel=0.12)


def test_decam_s_long_axis_runs_east_west():
    d = detector("decam", "N4", MISSION)
    system = wcs(d, 30.0, 0.0, 0.0)
    ra, dec = sky_of_pixel(system, [1023.5, 1023.5], [0.0, 4095.0])
    assert abs(ra[1] - ra[0]) == pytest.approx(4095 * 0.264 / 3600, rel=2e-3)
    assert abs(dec[1] - dec[0]) < 1e-3


@pytest.mark.parametrize("layout", [VIS, LSST, NISP, BENT_NISP])
def test_no_two_detectors_overlap(layout):
    x, y = (np.array([getattr(d, axis) for d in layout]) for axis in "xy")
    dx, dy = np.abs(x[:, None] - x), np.abs(y[:, None] - y)
    d = layout[0]
    apart = (dx >= d.nx * d.pixel_scale) | (dy >= d.ny * d.pixel_scale)
    assert apart[~np.eye(len(layout), dtype=bool)].all()


def test_unknown_cameras_and_detectors_are_refused():
    with pytest.raises(BadInput, match="wfc"):
        detectors("wfc", MISSION)
    with pytest.raises(BadInput, match="7-1"):
        detector("vis", "7-1", MISSION)


# ------------------------------------------------------------------------------------------------ parity


@pytest.mark.parametrize("d", [VIS[0], VIS[35], LSST[0], LSST[94]])
def test_east_is_left_when_north_is_up(d):
    """In the Pleiades, Atlas is 23' east and 3' south of Alcyone."""
    alcyone, atlas = (56.87115, 24.10514), (57.29059, 24.05342)
    system = wcs(d, *alcyone, 0.0)
    (x1, x2), (y1, y2) = pixel_of_sky(system, *np.transpose([alcyone, atlas]))
    sign = -1 if d.rotation == 180.0 else 1
    assert sign * (x2 - x1) < 0
    assert sign * (y2 - y1) < 0
    assert np.hypot(x2 - x1, y2 - y1) * d.pixel_scale == pytest.approx(
        3600 * float(sky.separation(*alcyone, *atlas)), rel=1e-4
    )


@given(SKY, STRAIGHT)
def test_the_sky_is_never_mirrored(pointing, d):
    system = wcs(d, *boresight_for(d, *pointing))
    j = jacobian(system, [(d.nx - 1) / 2], [(d.ny - 1) / 2])[0]
    # The Jacobian of (u west, v north) with respect to (column, row) is a rotation.
    assert np.linalg.det(j) == pytest.approx(d.pixel_scale**2, rel=2e-3)
    assert np.linalg.det(j) > 0


@given(st.floats(-180, 180))
def test_position_angle_of_the_columns(angle):
    """The y axis of the focal plane points to the position angle, which counts from north through east."""
    d = LSST[94]
    system = wcs(d, 150.0, 2.0, angle)
    ra, dec = sky_of_pixel(system, [(d.nx - 1) / 2] * 2, [(d.ny - 1) / 2, (d.ny - 1) / 2 + 10])
    here, up = SkyCoord(ra[0], dec[0], unit="deg"), SkyCoord(ra[1], dec[1], unit="deg")
    difference = here.position_angle(up).deg - angle
    assert (difference + 180) % 360 - 180 == pytest.approx(0.0, abs=1e-6)


# ------------------------------------------------------------------------------------------------ pointing


@given(SKY, ANY_DETECTOR)
def test_a_pointing_puts_the_detector_on_its_target(pointing, d):
    ra, dec, angle = pointing
    system = wcs(d, *boresight_for(d, ra, dec, angle))
    x, y = pixel_of_sky(system, [ra], [dec])
    assert np.hypot(x[0] - (d.nx - 1) / 2, y[0] - (d.ny - 1) / 2) < 1e-6
    if abs(dec) < 89.9 and not d.distortion_terms:
        # At the target, the axes of the detector have the requested position angle.
        j = jacobian(system, x, y)[0]
        measured = np.degrees(np.arctan2(-j[0, 1], j[1, 1])) - d.rotation
        assert (measured - angle + 180) % 360 - 180 == pytest.approx(0.0, abs=1e-4)


@pytest.mark.parametrize("dec", [90.0, -90.0, 89.999999])
@pytest.mark.parametrize("d", [VIS[0], LSST[94], LSST[3]])
def test_poles(d, dec):
    system = wcs(d, *boresight_for(d, 77.0, dec, 30.0))
    corners = astrometry.corners(d, system)
    assert np.isfinite(corners).all()
    assert np.ptp(sky.separation(77.0, dec, *corners.T)) < 1e-3
    x, y = pixel_of_sky(system, *corners.T)
    np.testing.assert_allclose(np.sort(x), [-0.5, -0.5, d.nx - 0.5, d.nx - 0.5], atol=1e-6)
    np.testing.assert_allclose(np.sort(y), [-0.5, -0.5, d.ny - 0.5, d.ny - 0.5], atol=1e-6)


@given(
    SKY,
    ANY_DETECTOR,
    st.lists(st.tuples(st.floats(-400, 4500), st.floats(-400, 4500)), min_size=1, max_size=20),
)
def test_pixel_to_sky_and_back(pointing, d, pixels):
    system = wcs(d, *boresight_for(d, *pointing))
    x, y = np.transpose(pixels)
    ra, dec = sky_of_pixel(system, x, y)
    assert ((ra >= 0) & (ra < 360)).all()
    back = pixel_of_sky(system, ra, dec)
    np.testing.assert_allclose(back, [x, y], atol=1e-6)


def test_right_ascension_wraps():
    d = VIS[14]
    system = wcs(d, *boresight_for(d, 0.0, 10.0, 0.0))
    ra = astrometry.corners(d, system)[:, 0]
    assert ((ra < 0.1) | (ra > 359.9)).all()
    assert (ra < 0.1).any()
    assert (ra > 359.9).any()
    x, _ = pixel_of_sky(system, [359.999, 0.001], [10.0, 10.0])
    assert abs(x[0] - x[1]) == pytest.approx(0.002 * 3600 * np.cos(np.radians(10)) / 0.1, rel=1e-3)


# ------------------------------------------------------------------------------------------------ header


@given(SKY, ANY_DETECTOR, st.floats(0, 4000), st.floats(0, 4000))
def test_jacobian_against_the_sky(pointing, d, x, y):
    """The Jacobian agrees with great circles by astropy over half a pixel in both directions.

    Declinations above 80 deg are left out, because the direction of north is not defined at the poles.
    """
    ra, dec, angle = pointing
    system = wcs(d, *boresight_for(d, ra, max(min(dec, 80.0), -80.0), angle))
    j = jacobian(system, [x], [y])[0]
    here = SkyCoord(*sky_of_pixel(system, [x], [y]), unit="deg")
    for axis, step in enumerate([(0.5, 0.0), (0.0, 0.5)]):
        ends = [SkyCoord(*sky_of_pixel(system, [x + s * step[0]], [y + s * step[1]]), unit="deg") for s in (-1, 1)]
        offsets = [[o.to_value("arcsec")[0] for o in here.spherical_offsets_to(end)] for end in ends]
        east, north = np.subtract(offsets[1], offsets[0])
        np.testing.assert_allclose(j[:, axis], [-east, north], atol=2e-7)


@given(SKY, ANY_DETECTOR)
def test_the_header_is_the_whole_truth(pointing, d):
    """From the header cards alone, astropy gives the same position for every pixel."""
    system = wcs(d, *boresight_for(d, *pointing))
    header = fits.Header([fits.Card(*card) for card in astrometry.cards(system)])
    for other in (WCS(header), astrometry.from_cards(astrometry.cards(system))):
        x, y = np.array([0.0, d.nx - 1.0]), np.array([0.0, d.ny - 1.0])
        theirs = SkyCoord(*other.all_pix2world(x, y, 0), unit="deg")
        ours = SkyCoord(*sky_of_pixel(system, x, y), unit="deg")
        assert ours.separation(theirs).to_value("mas").max() < 1e-3


def test_a_header_without_a_world_is_refused():
    with pytest.raises(BadInput, match="CTYPE1"):
        astrometry.from_cards((("EXPTIME", 1.0, ""),))


@pytest.mark.parametrize(
    ("keyword", "value"),
    [("CRVAL1", "east"), ("CRPIX2", np.nan), ("CUNIT1", "parsecs"), ("CD1_1", 0.0), ("A_ORDER", 10**9)],
)
def test_a_header_with_a_wrong_value_is_refused(keyword, value):
    system = wcs(BENT[0], 10.0, -30.0, 0.0)
    cards = [(key, value if key == keyword else old, "") for key, old, _ in astrometry.cards(system)]
    if keyword == "CD1_1":
        cards = [(key, 0.0 if key == "CD1_2" else old, "") for key, old, _ in cards]
    assert keyword in [key for key, _, _ in cards]
    with pytest.raises(BadInput, match="WCS of the header cannot be used"):
        astrometry.from_cards(cards)


@given(SKY, STRAIGHT)
def test_footprints(pointing, d):
    system = wcs(d, *boresight_for(d, *pointing))
    corners = astrometry.corners(d, system)
    # The corners are half a diagonal from the centre, except for the curvature of the projection.
    reach = sky.separation(*astrometry.centre(d, system), *corners.T) * 3600
    np.testing.assert_allclose(reach, d.half_diagonal, rtol=3e-3)
    words = astrometry.s_region(d, system).split()
    assert words[:2] == ["POLYGON", "ICRS"]
    np.testing.assert_allclose(np.array(words[2:], float), corners.ravel(), atol=1e-7)
