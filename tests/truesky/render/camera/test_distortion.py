"""Distortion of the optics and mounting errors of detectors: their size, their inverse, and switching them off."""

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.io import fits
from astropy.wcs import WCS
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve
from lake_schema.mission.parameter import CAMERAS as GROUND
from truesky.render.camera import astrometry, distortion, observatories, tpv
from truesky.render.camera.astrometry import pixel_of_sky, sky_of_pixel, wcs
from truesky.render.camera.detectors import detectors
from truesky.render.camera.pointing import boresight_for, outline, sky_of_plane

MISSION = resolve()
VIS, NISP = detectors("vis", MISSION), detectors("nisp", MISSION)
CAMERAS = pytest.mark.parametrize("camera", [VIS, NISP], ids=["vis", "nisp"])
FARTHEST = [max(detectors(camera, MISSION), key=lambda d: np.hypot(d.x, d.y)) for camera in GROUND]
# Half width and half height of the tested field of each camera, arcsec.
HALF = {"vis": (1260, 1400), "nisp": (1300, 1376)}
HALF |= {d.section: (abs(d.x) + 500, abs(d.y) + 500) for d in FARTHEST}


def field(camera, n):
    return np.meshgrid(*(np.linspace(-half, half, n) for half in HALF[camera[0].section]))


def scales(x, y, terms, step=0.05):
    """Return the singular values of the derivative of the distortion, from finite differences."""
    columns = [
        np.subtract(distortion.distort(x + a, y + b, terms), distortion.distort(x - a, y - b, terms)) / (2 * step)
        for a, b in ((step, 0.0), (0.0, step))
    ]
    return np.linalg.svd(np.moveaxis(np.array(columns), (0, 1), (-1, -2)), compute_uv=False)


@CAMERAS
def test_the_scale_changes_by_as_much_as_the_mission_says(camera):
    terms = camera[0].distortion_terms
    change = scales(*field(camera, 41), terms) - 1.0
    said = MISSION.value(f"{camera[0].section}.fpa.distortion")
    assert np.abs(change).max() == pytest.approx(said, rel=0.01)
    np.testing.assert_allclose(scales(np.zeros(1), np.zeros(1), terms), 1.0, atol=1e-9)
    assert distortion.distort(0.0, 0.0, terms) == (0.0, 0.0)


@CAMERAS
def test_it_is_a_cubic_about_the_telescope_s_axis(camera):
    """The field of view is off the axis of the telescope. The distortion about this axis is D = k r^2 r.

    The shift and the scale at the centre of the field are subtracted from it.
    """
    axis = MISSION.value("plm.vis_field_offset_y", "arcsec")
    x, y = field(camera, 9)

    def cubic(x, y):
        return np.stack([x, y + axis]) * (x**2 + (y + axis) ** 2)

    # Linear part of the cubic at the centre of the field.
    slope = np.array([axis**2 * x, 3 * axis**2 * y])
    wanted = cubic(x, y) - cubic(0.0, 0.0)[:, None, None] - slope
    found = np.array(distortion.distort(x, y, camera[0].distortion_terms)) - np.stack([x, y])
    strength = (found * wanted).sum() / (wanted**2).sum()
    np.testing.assert_allclose(found, strength * wanted, atol=2e-3 * np.abs(found).max())


@pytest.mark.parametrize(
    ("camera", "radius", "seen"),
    # Field angle at a radius (mm) from the axis, relative to a perfect camera with the scale on the axis. The values
    # follow from the description of each camera. For HSC, they are means of its polynomial of ninth order in ten
    # directions.
    [
        ("lsstcam", 317.0, 1 - 8.337e-9 * 317.0**2 - 1.41e-15 * 317.0**4),
        ("hsc", 150.0, 0.9890356 / 0.9995944),
        ("hsc", 240.0, 0.9709013 / 0.9995944),
    ],
)
def test_a_ground_camera_sees_what_its_description_says(camera, radius, seen):
    one = detectors(camera, MISSION)[0]
    plate = one.pixel_scale / MISSION.value(f"ext.{camera}.fpa.pixel_size", "mm / pix")
    for angle in (0.0, 0.4, 2.0):
        x, y = radius * plate * np.array([np.cos(angle), np.sin(angle)])
        found = np.hypot(*distortion.distort(x, y, one.distortion_terms))
        # The tolerance of HSC is 0.1 arcsec at the edge; the polynomials of the others are exact.
        assert found / (radius * plate) == pytest.approx(seen, abs=4e-5 if camera == "hsc" else 1e-7)


@pytest.mark.parametrize(
    ("camera", "error", "scale"), [("decam", 0.02, 1e-5), ("lsstcam", 0.06, 4e-4), ("hsc", 0.06, 5e-3)]
)
def test_chief_rays_of_batoid_are_where_the_distortion_puts_them(camera, error, scale):
    """Angles on the sky and positions in the focal plane, traced by scripts/trace_optics.py.

    The scales at the axis of LSSTCam and HSC are those of their camera descriptions, not of batoid.
    """
    one, lines = (
        detectors(camera, MISSION)[0],
        (Path(__file__).parent / "batoid_distortion.csv").read_text().splitlines(),
    )
    rows = [row for row in csv.DictReader(lines[1:]) if row["camera"] == camera]
    x, y, across, up = (np.array([float(row[key]) for row in rows]) for key in ("x_arcsec", "y_arcsec", "x_mm", "y_mm"))
    assert np.hypot(x, y).max() > {"decam": 0.9, "lsstcam": 1.5, "hsc": 0.6}[camera] * 3600
    plate = one.pixel_scale / MISSION.value(f"ext.{camera}.fpa.pixel_size", "mm / pix")
    found = np.array(distortion.distort(across * plate, up * plate, one.distortion_terms))
    ratio = np.sqrt((x**2 + y**2).sum() / (found**2).sum())
    assert ratio == pytest.approx(1.0, abs=scale)
    assert np.hypot(*(found * ratio - [x, y])).max() < error


def test_megacam_sees_less_at_the_edge():
    """The scale is 0.187 arcsec per pixel at the centre, and 0.185 half a degree away."""
    one = detectors("megacam", MISSION)[0]
    edge = scales(np.array([1800.0]), np.array([0.0]), one.distortion_terms)[0]
    assert one.pixel_scale == pytest.approx(0.187)
    assert one.pixel_scale * np.sqrt(edge.prod()) == pytest.approx(0.185, abs=1e-3)


@pytest.mark.parametrize("d", FARTHEST, ids=GROUND)
def test_a_ground_camera_s_header_is_where_sources_are_drawn(d, tmp_path):
    """astropy reads the header in the convention of the camera's pipeline.

    The detector is the one with the largest distortion.
    """
    camera = d.section.removeprefix("ext.")
    ra, dec, angle = boresight_for(d, 53.1, -27.8, 12.0)
    system = wcs(d, ra, dec, angle)
    cards = astrometry.cards(system)
    if observatories.for_camera(camera).convention == "tpv":
        cards = tpv.from_sip(cards)
    fits.PrimaryHDU(header=fits.Header([fits.Card(*card) for card in cards])).writeto(tmp_path / "one.fits")
    theirs = WCS(fits.getheader(tmp_path / "one.fits"))
    lon, lat = (axis.ravel() for axis in np.meshgrid(np.linspace(52.9, 53.3, 9), np.linspace(-28.0, -27.6, 9)))
    column, row = pixel_of_sky(system, lon, lat)
    here = (column > -0.5) & (column < d.nx - 0.5) & (row > -0.5) & (row < d.ny - 0.5)
    assert here.sum() > 5
    there = SkyCoord(*theirs.all_pix2world(column, row, 0), unit="deg")
    assert there.separation(SkyCoord(lon, lat, unit="deg")).to_value("mas")[here].max() < 1e-2
    # Without the distortion, the positions would be arcseconds off.
    flat = pixel_of_sky(wcs(replace(d, distortion_terms=()), ra, dec, angle), lon, lat)
    assert np.hypot(flat[0] - column, flat[1] - row)[here].min() * d.pixel_scale > 2.0


@pytest.mark.parametrize("d", FARTHEST, ids=GROUND)
def test_the_outline_of_a_field_is_its_detectors(d):
    pointing = (150.0, 2.0, 33.0)
    x, y = (axis[0] for axis in outline([d]))
    corners = SkyCoord(*astrometry.corners(d, wcs(d, *pointing)).T, unit="deg")
    planned = SkyCoord(*sky_of_plane(x[1:], y[1:], *pointing), unit="deg")
    assert corners.separation(planned).to_value("mas").max() < 1e-3


@given(st.sampled_from([*VIS, *NISP, *FARTHEST]), st.floats(-1, 1), st.floats(-1, 1), st.floats(-180, 180))
def test_the_header_s_polynomial_is_the_focal_plane_s(d, across, up, angle):
    """A position in the focal plane has the same sky position by its polynomial and by the SIP of the detector."""
    pointing = (150.0, 2.0, angle)
    turn = np.radians(d.rotation)
    x, y = across * HALF[d.section][0], up * HALF[d.section][1]
    across, up = x - d.x, y - d.y
    column = (np.cos(turn) * across + np.sin(turn) * up) / d.pixel_scale + (d.nx - 1) / 2
    row = (np.cos(turn) * up - np.sin(turn) * across) / d.pixel_scale + (d.ny - 1) / 2
    here = SkyCoord(*sky_of_pixel(wcs(d, *pointing), [column], [row]), unit="deg")
    there = SkyCoord(*sky_of_plane(*distortion.distort([x], [y], d.distortion_terms), *pointing), unit="deg")
    assert here.separation(there).to_value("mas")[0] < 1e-3


@given(st.sampled_from([*VIS, *NISP, *FARTHEST]), st.floats(-4000, 8000), st.floats(-4000, 8000))
def test_the_inverse_is_exact(d, column, row):
    """Pixel to sky and back is accurate to 1e-5 mas, and agrees with the inverse of astropy."""
    system = wcs(d, *boresight_for(d, 53.1, -27.8, 12.0))
    sky = sky_of_pixel(system, [column], [row])
    found = pixel_of_sky(system, *sky)
    assert np.hypot(found[0][0] - column, found[1][0] - row) * 1e3 * d.pixel_scale < 1e-5
    np.testing.assert_allclose(found, system.all_world2pix(*sky, 0, tolerance=1e-9), atol=1e-7)


def test_what_no_camera_sees_is_left_where_it_is():
    system = wcs(VIS[20], *boresight_for(VIS[20], 53.1, -27.8, 0.0))
    far = pixel_of_sky(system, [63.1, 233.1], [-27.8, 27.8])
    np.testing.assert_array_equal(far, system.wcs_world2pix([63.1, 233.1], [-27.8, 27.8], 0))


@pytest.mark.parametrize(("camera", "columns", "pitch"), [("vis", 6, 409.6 + 12.7), ("nisp", 4, 612.0 + 50.6)])
def test_it_can_be_switched_off(camera, columns, pitch):
    unbent = {f"{camera}.fpa.distortion": (0.0, "")}
    moves = {f"{camera}.fpa.metrology_{kind}": (0.0, unit) for kind, unit in (("shift", "pix"), ("rotation", "deg"))}
    straight, on_grid = (detectors(camera, resolve(overrides=o)) for o in (unbent, unbent | moves))
    assert not any(d.distortion_terms for d in straight)
    cards = dict((keyword, value) for keyword, value, _ in astrometry.cards(wcs(straight[0], 10.0, 20.0, 0.0)))
    assert cards["CTYPE1"] == "RA---TAN"
    assert not any(keyword.startswith("A_") for keyword in cards)
    moved = np.array([[b.x - a.x, b.y - a.y, b.rotation - a.rotation] for a, b in zip(on_grid, straight, strict=True)])
    rms = np.sqrt(np.mean(moved**2, axis=0))
    scale = straight[0].pixel_scale
    np.testing.assert_allclose(rms, [2 * scale, 2 * scale, 0.02], rtol=1e-2)
    assert {round(d.rotation, 12) for d in on_grid} == {0.0, 180.0}
    # Detectors at nominal positions have the nominal pitch.
    np.testing.assert_allclose(np.diff([d.x for d in on_grid[:columns]]), pitch, rtol=1e-12)


@pytest.mark.parametrize("far", [1.3, 2.0, 6.0, 40.0])
def test_positions_beyond_the_invertible_radius_are_unchanged(far):
    """The distortion of HSC cannot be inverted beyond 1.7 deg from the axis, where there are no detectors."""
    system = wcs(FARTHEST[-1], 150.0, 2.0, 0.0)
    place = [150.0], [2.0 + far]
    inside = far < 1.4
    column, row = pixel_of_sky(system, *place)
    straight = system.wcs_world2pix(*place, 0)
    assert np.allclose((column, row), straight, atol=1e-6) != inside
    if inside:
        np.testing.assert_allclose(sky_of_pixel(system, column, row), place, rtol=1e-12)
    # These positions are far from all detectors.
    assert max(abs(column[0]), abs(row[0])) > 7000


def test_what_cannot_be_undone_is_refused():
    folded = resolve(overrides={"ext.hsc.fpa.distortion_r2": (-1e-5, "1 / mm2")})
    with pytest.raises(BadInput, match="camera hsc: its distortion is so strong"):
        detectors("hsc", folded)
