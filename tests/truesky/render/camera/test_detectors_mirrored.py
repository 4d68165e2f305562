"""A mirrored detector sees the same light as the same detector that is only rotated, with its rows in reverse order.

The detector that is only rotated is the reference of each test. Its own geometry is tested elsewhere.
"""

from dataclasses import replace

import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from lake_schema.errors import BadInput
from lake_schema.mission import camera_folder, camera_template
from lake_schema.mission.configuration import resolve
from lake_schema.tables.exposures import ExposureRow
from tests.truesky.render import fields
from tests.truesky.render.fields import MISSION
from tests.truesky.render.products import test_tools as tools
from truesky.fluxes import passbands
from truesky.render.camera import astrometry, detectors, pointing
from truesky.render.effects.light import illumination, pixel_area, satellite_trails
from truesky.render.effects.scene import Scene
from truesky.render.psf import from_file, ground

# Mirrored CCDs: of both halves of DECam and HSC, and of HSC one of the four that are turned by another 90 deg.
MIRRORED = [("decam", "S29"), ("decam", "N4"), ("hsc", "1_07"), ("hsc", "0_05"), ("hsc", "1_42"), ("hsc", "0_14")]
BANDS = {"decam": "des_g", "hsc": "hsc_g"}
POINTING = 10.0, -20.0, 33.0


def pair(camera, name, **changed):
    """Return the mirrored detector, and the one whose rows run in the opposite direction."""
    one = replace(detectors.detector(camera, name, MISSION), **changed)
    assert one.is_mirrored
    return one, replace(one, is_mirrored=False)


def row_of(camera, **changed):
    known = {"airmass": 1.6, "zenith": 75.0, **changed}
    return ExposureRow(1, "EXT", camera, BANDS[camera], "science", *POINTING, 6e4, 30.0, 1.0, 0.9, 28.0, "x", **known)


@pytest.mark.parametrize(("camera", "name"), MIRRORED)
def test_only_the_direction_of_rows_differs(camera, name):
    mirrored, turned = pair(camera, name)
    np.testing.assert_array_equal(mirrored.axes, turned.axes * [1.0, -1.0])
    assert np.linalg.det(mirrored.axes) == pytest.approx(-1.0)
    # Angles: the direction of rows is at 90 deg on the detector.
    for one in (mirrored, turned):
        along, up = (float(np.degrees(np.arctan2(*axis[::-1]))) for axis in one.axes.T)
        for angle, expected in ((along, 0.0), (up, 90.0)):
            turns = np.array([one.own_degrees(angle), np.degrees(one.own_radians(np.radians(angle)))]) - expected
            np.testing.assert_allclose((turns + 180.0) % 360.0 - 180.0, 0.0, atol=1e-9)
        assert (one.row_angle - (up - 90.0) + 180.0) % 360.0 - 180.0 == pytest.approx(0.0, abs=1e-9)
        assert one.upside_down == (one.axes[1, 1] < 0.0)
        x, y = one.to_focal_plane(3.0, -7.0)
        np.testing.assert_allclose(one.from_focal_plane(x - one.x, y - one.y), [3.0, -7.0], atol=1e-9)


@pytest.mark.parametrize(("camera", "name"), MIRRORED)
def test_a_pixel_sees_the_same_sky(camera, name):
    """The WCS includes the distortion."""
    mirrored, turned = pair(camera, name)
    columns, rows = (np.linspace(0.0, n - 1.0, 7) for n in (mirrored.nx, mirrored.ny))
    found = astrometry.sky_of_pixel(astrometry.wcs(mirrored, *POINTING), columns, rows)
    expected = astrometry.sky_of_pixel(astrometry.wcs(turned, *POINTING), columns, mirrored.ny - 1.0 - rows)
    np.testing.assert_allclose(found, expected, rtol=0.0, atol=1e-10)


@pytest.mark.parametrize(("camera", "name"), MIRRORED)
def test_corners_are_those_of_the_wcs(camera, name):
    mirrored, _ = pair(camera, name)
    x, y = pointing.outline([mirrored])
    sky = np.stack(pointing.sky_of_plane(x[0, 1:], y[0, 1:], *POINTING), axis=1)
    corners = astrometry.corners(mirrored, astrometry.wcs(mirrored, *POINTING))
    np.testing.assert_allclose(sky, corners, rtol=0.0, atol=1e-9)


@pytest.mark.parametrize(("camera", "name"), MIRRORED)
def test_light_falls_on_the_same_places(camera, name):
    """Vignetting, sky area of pixels, and trails of satellites."""
    mirrored, turned = (Scene(MISSION, one.section, 30.0, 3.0, 1e4, one) for one in pair(camera, name))
    maps = []
    for scene in (mirrored, turned):
        columns, rows = illumination.pattern(scene, scene.nx, scene.ny, 0.1, (0.02, -0.03))
        _, u, v, stretch = pixel_area.parameters(scene)
        area = pixel_area.area_change(u[::89], v[:: 25 if camera == "hsc" else 15], stretch)
        maps.append((1.0 + columns + rows[:, None], area))
    (light, area), (expected_light, expected_area) = maps
    np.testing.assert_allclose(light, expected_light[::-1], rtol=1e-12)
    # The sampled rows are symmetric about the middle.
    np.testing.assert_allclose(area, expected_area[::-1], rtol=0.0, atol=1e-12)
    trails = [
        satellite_trails._path(0.7, 300.0, 4000.0, scene.detector, (scene.ny, scene.nx)) for scene in (mirrored, turned)
    ]
    np.testing.assert_allclose(trails[0][0], trails[1][0], atol=1e-6)
    np.testing.assert_allclose(trails[0][1], mirrored.ny - 1.0 - trails[1][1], atol=1e-6)


@pytest.mark.parametrize(("camera", "name"), [MIRRORED[0], MIRRORED[2]])
def test_the_psf_is_mirrored(camera, name):
    """The PSF has the wavefront, its change across the detector, the air's ellipticity, refraction and spikes."""
    band, images = passbands.load(BANDS[camera]), []
    for one in pair(camera, name):
        air = ground.exposure_air(row_of(camera), one, band, MISSION)
        images.append((air, ground.atmospheric_psf(air, one, band, MISSION, 9)))
    (air, psf), (expected_air, expected) = images
    assert abs(expected_air.shear[1]) > 1e-4
    assert air.shear == pytest.approx((expected_air.shear[0], -expected_air.shear[1]))
    assert np.exp(1j * air.zenith) == pytest.approx(np.exp(-1j * expected_air.zenith), abs=1e-12)
    found, wanted = psf.planes.images, expected.planes.images
    assert np.abs(wanted - wanted[:, ::-1]).max() > 1e-3 * wanted.max()
    np.testing.assert_allclose(found, wanted[:, ::-1], rtol=0.0, atol=2e-6 * wanted.max())
    # The images of the change across the detector belong to powers of column and row.
    assert psf.planes.powers == expected.planes.powers
    drift, change = psf.planes.drift, expected.planes.drift
    signs = np.array([(-1.0) ** j for _, j, _ in psf.planes.powers])[:, None, None]
    np.testing.assert_allclose(drift, signs * change[:, ::-1], rtol=0.0, atol=1e-5 * np.abs(change).max())


def test_the_spider_is_mirrored_as_the_sky():
    """Spikes have the same angle to the focal plane (DECam) or to the zenith (HSC)."""
    for camera, name in MIRRORED:
        band = passbands.load(BANDS[camera])
        angles = []
        for one in pair(camera, name):
            air = ground.exposure_air(row_of(camera), one, band, MISSION)
            angles.append(one.handedness * ground.edges(air, one, band, MISSION).bars[:, 0] + np.radians(one.rotation))
        np.testing.assert_allclose(np.exp(2j * angles[0]), np.exp(2j * angles[1]), atol=1e-9)


@pytest.mark.parametrize(("camera", "name"), MIRRORED)
def test_a_psf_of_the_user_is_mirrored(camera, name, tmp_path):
    """A cube of the user has the axes of the focal plane."""
    side, step = 81, 0.1
    v, u = (np.mgrid[:side, :side] - side // 2) * step
    light = np.exp(-0.5 * ((u - 0.2) ** 2 / 0.25 + (v + 0.1) ** 2 / 0.09 + 0.8 * u * v))
    path = tmp_path / "psf.fits"
    unit = fits.PrimaryHDU((light / light.sum()).astype(np.float32))
    unit.header.update({"PSFFRAME": "CAMERA", "CDELT1": step, "CDELT2": step, "CUNIT1": "arcsec"})
    unit.writeto(path)
    mirrored, turned = (
        from_file.read(path, one, None, astrometry.wcs(one, *POINTING)).planes.images for one in pair(camera, name)
    )
    np.testing.assert_allclose(mirrored, turned[:, ::-1], rtol=0.0, atol=1e-6 * turned.max())
    # The centroid of the light lies where it does in the focal plane.
    one, _ = pair(camera, name)
    image = mirrored[0].astype(float)
    y, x = np.mgrid[: len(image), : len(image)] - len(image) // 2
    centre = np.array([(image * x).sum(), (image * y).sum()]) / image.sum()
    light = light / light.sum()
    wanted = np.array(one.from_focal_plane((light * u).sum(), (light * v).sum()))
    np.testing.assert_allclose(centre / np.hypot(*centre), wanted / np.hypot(*wanted), atol=0.02)


# ------------------------------------------------------------------------------------------------ rendered frames


def sky_ellipticity(pixels, system):
    """Return the ellipticity (e1, e2) of a bright source at the middle of an image, in axes to the west and the north.

    `system` is an astropy WCS. The angle of the major axis is counted from west to north.
    """
    light = pixels - np.median(pixels)
    light[light < 5.0 * 1.48 * np.median(np.abs(light))] = 0.0
    _, second = fields.moments(light)
    to_sky = np.array([[-1.0, 0.0], [0.0, 1.0]]) @ system.pixel_scale_matrix
    (xx, xy), (_, yy) = to_sky @ second @ to_sky.T
    return np.array([xx - yy, 2.0 * xy]) / (xx + yy)


@pytest.mark.parametrize(("gamma1", "gamma2"), [(0.0, 0.15), (-0.12, 0.08)])
def test_shear_has_the_same_handedness_in_mirrored_frames(gamma1, gamma2):
    """A round galaxy with shear has the same ellipticity on the sky in frames of mirrored and unmirrored CCDs."""
    found = []
    ccds = ("megacam", "ccd20"), ("megacam", "ccd02"), ("decam", "S29"), ("hsc", "1_12"), ("hsc", "0_05")
    for camera, name in ccds:
        one = fields.small(camera, name, 256)
        ra, dec, angle = pointing.boresight_for(one, 53.1, -27.8, 0.0)
        band, none = tools.BANDS[camera], fields.stars([], [])
        galaxy = fields.galaxies(53.1, -27.8, disk_half_light_radius=2.5, gamma1=gamma1, gamma2=gamma2)
        exposed = {
            "channel": "EXT", "camera": camera, "band": band, "ra": ra, "dec": dec, "position_angle": angle,
            "seeing": 0.7, "sky": 1.0,
        }  # fmt: skip
        tables = galaxy, fields.fluxes(galaxy, band, 3e4), none, fields.fluxes(none, band, 0.0)
        effects = ("background", "poisson", "read_noise")
        quiet = {
            effect.name: effect.name in effects
            for effect in tools.registry.CHANNELS["EXT"].effects["science"]
            if effect.optional
        }
        image = fields.rendered(exposed, one, tables, tools.SURE, tools.SURVEY, forced=quiet)
        found.append(sky_ellipticity(np.asarray(image.readout.pixels, float), image.wcs))
    found = np.array(found)
    assert np.hypot(*found[0]) > 0.1
    np.testing.assert_allclose(found, found[:1] + np.zeros_like(found), atol=0.02)


@pytest.mark.parametrize(("camera", "name"), MIRRORED[::2])
def test_source_extractor_finds_stars_in_mirrored_frames(camera, name, tmp_path):
    """Their positions by the head file, and by the header of the raw frame, are those of the catalogue."""
    field = tools.put(tools.stars_on(camera, 0.05, fields.small(camera, name, tools.SIDE)), tmp_path)
    path = tools.with_one_wcs(field.path)
    ((header, pixels),) = tools.arrays(path)
    assert np.linalg.det(WCS(header).pixel_scale_matrix) > 0.0
    data = tools.window(header["DATASEC"]) if "DATASEC" in header else (slice(0, tools.SIDE), slice(0, tools.SIDE))
    x, y = tools.measured(pixels[data])
    assert tools.off(field, *WCS(header).all_pix2world(x + data[1].start, y + data[0].start, 0)) < 5.0
    with fits.open(tools.extracted(path)) as tables:
        places = [np.concatenate([table.data[key] for table in tables[1:]]) for key in tools.COLUMNS[:2]]
    assert tools.off(field, *places) < 5.0


# ------------------------------------------------------------------------------------------------ camera of the user


def test_a_camera_of_the_user_may_be_mirrored(tmp_path):
    """The column is optional: without it, no detector is mirrored."""
    folder = tmp_path / "mine"
    camera_template.write_like("decam", folder)
    text = (folder / "layout.csv").read_text()

    def found():
        mission = resolve(cameras=(camera_folder.read(folder),))
        return detectors.detectors("mine", mission)

    assert all(one.is_mirrored for one in found())
    lines = [line if line.startswith("#") else line.rpartition(",")[0] for line in text.splitlines()]
    (folder / "layout.csv").write_text("\n".join(lines) + "\n")
    assert not any(one.is_mirrored for one in found())


@pytest.mark.parametrize(
    ("flip", "why"), [("2", "is not between 0 and 1"), ("yes", "is not a number"), ("", "is missing")]
)
def test_a_wrong_flip_is_refused(flip, why, tmp_path):
    folder = tmp_path / "mine"
    camera_template.write_like("decam", folder)
    path = folder / "layout.csv"
    path.write_text(path.read_text().replace("63.748,185.592,270.01,1", f"63.748,185.592,270.01,{flip}"))
    with pytest.raises(BadInput, match=rf"layout\.csv line 5: flip.* {why}"):
        camera_folder.read(folder)
