"""Distortion of the optics, and mounting rotation of detectors: as large as the mission says, undone, or absent."""

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from hypothesis import given
from hypothesis import strategies as st

from jobs.render.camera import astrometry, distortion
from jobs.render.camera.astrometry import pixel_of_sky, sky_of_pixel, wcs
from jobs.render.camera.detectors import detectors
from jobs.render.camera.pointing import boresight_for, sky_of_plane
from lake_schema.errors import BadInput
from lake_schema.mission.configuration import resolve

MISSION = resolve()
VIS, NISP = detectors("vis", MISSION), detectors("nisp", MISSION)
CAMERAS = pytest.mark.parametrize("camera", [VIS, NISP], ids=["vis", "nisp"])
# Half of the field of each, arcsec.
HALF = {"vis": (1260, 1400), "nisp": (1300, 1376)}


def field(camera, n):
    return np.meshgrid(*(np.linspace(-half, half, n) for half in HALF[camera[0].section]))


def scales(x, y, terms, step=0.05):
    """Singular values of the distortion's derivative, from differences."""
    columns = [
        np.subtract(distortion.bent(x + a, y + b, terms), distortion.bent(x - a, y - b, terms)) / (2 * step)
        for a, b in ((step, 0.0), (0.0, step))
    ]
    return np.linalg.svd(np.moveaxis(np.array(columns), (0, 1), (-1, -2)), compute_uv=False)


@CAMERAS
def test_the_scale_changes_by_as_much_as_the_mission_says(camera):
    terms = camera[0].bending
    change = scales(*field(camera, 41), terms) - 1.0
    said = MISSION.value(f"{camera[0].section}.fpa.distortion")
    assert np.abs(change).max() == pytest.approx(said, rel=0.01)
    np.testing.assert_allclose(scales(np.zeros(1), np.zeros(1), terms), 1.0, atol=1e-9)
    assert distortion.bent(0.0, 0.0, terms) == (0.0, 0.0)


@CAMERAS
def test_it_is_a_cubic_about_the_telescope_s_axis(camera):
    """Which the field lies beside: D = k r^2 r, less what shifts and scales the whole field."""
    axis = MISSION.value("plm.vis_field_offset_y", "arcsec")
    x, y = field(camera, 9)

    def cubic(x, y):
        return np.stack([x, y + axis]) * (x**2 + (y + axis) ** 2)

    # The cubic's own shift and scales at the centre.
    slope = np.array([axis**2 * x, 3 * axis**2 * y])
    wanted = cubic(x, y) - cubic(0.0, 0.0)[:, None, None] - slope
    found = np.array(distortion.bent(x, y, camera[0].bending)) - np.stack([x, y])
    strength = (found * wanted).sum() / (wanted**2).sum()
    np.testing.assert_allclose(found, strength * wanted, atol=2e-3 * np.abs(found).max())


@given(st.sampled_from(VIS + NISP), st.floats(-1, 1), st.floats(-1, 1), st.floats(-180, 180))
def test_the_header_s_polynomial_is_the_focal_plane_s(d, across, up, angle):
    """What a place of the focal plane sees: by the polynomial there, and by the detector's SIP."""
    pointing = (150.0, 2.0, angle)
    turn = np.radians(d.rotation)
    x, y = across * HALF[d.section][0], up * HALF[d.section][1]
    across, up = x - d.x, y - d.y
    column = (np.cos(turn) * across + np.sin(turn) * up) / d.pixel_scale + (d.nx - 1) / 2
    row = (np.cos(turn) * up - np.sin(turn) * across) / d.pixel_scale + (d.ny - 1) / 2
    here = SkyCoord(*sky_of_pixel(wcs(d, *pointing), [column], [row]), unit="deg")
    there = SkyCoord(*sky_of_plane(*distortion.bent([x], [y], d.bending), *pointing), unit="deg")
    assert here.separation(there).to_value("mas")[0] < 1e-3


@given(st.sampled_from(VIS + NISP), st.floats(-4000, 8000), st.floats(-4000, 8000))
def test_the_inverse_is_exact(d, column, row):
    """To a hundredth of a milliarcsecond, and a thousand times better; and as astropy's own."""
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
    assert not any(d.bending for d in straight)
    cards = dict((keyword, value) for keyword, value, _ in astrometry.cards(wcs(straight[0], 10.0, 20.0, 0.0)))
    assert cards["CTYPE1"] == "RA---TAN"
    assert not any(keyword.startswith("A_") for keyword in cards)
    moved = np.array([[b.x - a.x, b.y - a.y, b.rotation - a.rotation] for a, b in zip(on_grid, straight, strict=True)])
    rms = np.sqrt(np.mean(moved**2, axis=0))
    scale = straight[0].pixel_scale
    np.testing.assert_allclose(rms, [2 * scale, 2 * scale, 0.02], rtol=1e-2)
    assert {round(d.rotation, 12) for d in on_grid} == {0.0, 180.0}
    # One pixel along the grid is one pixel.
    np.testing.assert_allclose(np.diff([d.x for d in on_grid[:columns]]), pitch, rtol=1e-12)


def test_what_cannot_be_undone_is_refused():
    folded = resolve(overrides={"vis.fpa.distortion": (-0.5, "")})
    d = detectors("vis", folded)[0]
    system = wcs(d, 10.0, 20.0, 0.0)
    with pytest.raises(BadInput, match="seen twice, or nowhere"):
        pixel_of_sky(system, *sky_of_plane(np.linspace(-5500, 5500, 60), np.linspace(-5500, 5500, 60),
                                                        10.0, 20.0, 0.0))  # fmt: skip
