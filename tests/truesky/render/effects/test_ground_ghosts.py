"""Ghosts of bright stars in ground cameras: their light, positions and sizes."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import resolve
from truesky.fluxes import passbands
from truesky.render.camera import detectors
from truesky.render.camera.windows import Window
from truesky.render.effects.light import ground_ghosts
from truesky.render.effects.scene import Lights, Scene
from truesky.request.accuracy import SURVEY

MISSION = resolve()


def scene(camera, name, band, lights, mission=MISSION):
    detector = detectors.detector(camera, name, mission)
    made = Scene(mission, detector.section, 30.0, 40.0, 1e5, detector, lights=lights, accuracy=SURVEY)
    return replace(made, band=passbands.load(band))


def star(column, row, electrons=1e12):
    return Lights(np.array([column]), np.array([row]), np.array([electrons]))


def test_an_annulus_has_its_light_and_its_place():
    """The reference samples every pixel 400 times."""
    annuli = ground_ghosts.Annuli(*(np.array([value]) for value in (31.3, 27.8, 14.6, 2.5)))
    found = ground_ghosts.apply(np.zeros((60, 64)), annuli, 0.4)
    fine = (np.arange(20) + 0.5) / 20 - 0.5
    x, y = (np.add.outer(np.arange(n), fine).ravel() - at for n, at in ((64, 31.3), (60, 27.8)))
    r = np.hypot(x, y[:, None])
    wanted = 2.5 * ((r < 14.6) & (r > 0.4 * 14.6)).reshape(60, 20, 64, 20).mean(axis=(1, 3))
    assert found.sum() == pytest.approx(wanted.sum(), rel=2e-3)
    assert found.sum() == pytest.approx(2.5 * np.pi * 14.6**2 * (1 - 0.4**2), rel=2e-3)
    np.testing.assert_allclose(found, wanted, atol=0.25 * 2.5)
    assert np.abs(found - wanted).mean() < 0.01
    with pytest.raises(OutOfRange, match="ghost hole"):
        ground_ghosts.apply(np.zeros((4, 4)), annuli, 1.0)


@pytest.mark.parametrize(
    ("camera", "name", "band", "thickness", "focal_ratio"),
    # Thickness (mm) of the filter's glass and focal ratio, of the observatories' descriptions.
    [("lsstcam", "R22_S11", "lsst_r", 17.9, 1.234), ("lsstcam", "R22_S11", "lsst_u", 26.2, 1.234),
     ("hsc", "0_03", "hsc_z", 15.0, 2.25)],
)  # fmt: skip
def test_the_filter_s_ghost_is_as_wide_as_its_glass_is_thick(camera, name, band, thickness, focal_ratio):
    """Two reflections lengthen the way of the light by twice the thickness, as in air of thickness / index."""
    made = scene(camera, name, band, star(1000.0, 2000.0))
    annuli, hole = ground_ghosts.parameters(made)
    radius = thickness / 1.46 / focal_ratio / MISSION.value(f"ext.{camera}.fpa.pixel_size", "mm / pix")
    widths = np.abs(annuli.radius / radius - 1.0)
    assert widths.min() < 0.15
    at = widths.argmin()
    # The filter is flat: its ghost is near the star.
    assert np.hypot(annuli.column[at] - 1000.0, annuli.row[at] - 2000.0) < 0.05 * np.hypot(4096, 4096)
    assert 0.3 < hole < 0.7
    light = np.pi * annuli.radius[at] ** 2 * (1.0 - hole**2) * annuli.level[at]
    assert light == pytest.approx(1e12 * 0.01**2, rel=1e-6)


def test_ghosts_lie_on_the_line_through_the_star_and_the_axis():
    """Seen from any detector, also one that is turned, the same star has the same ghosts in the focal plane."""
    found = []
    for name in ("R22_S11", "R12_S01", "R43_S21"):
        detector = detectors.detector("lsstcam", name, MISSION)
        # A star at (1500, 900) arcsec in the focal plane.
        column, row = detector.pixel_place([1500.0], [900.0])
        made = scene("lsstcam", name, "lsst_r", Lights(column, row, np.array([1e13])))
        annuli, _ = ground_ghosts.parameters(made)
        x, y = detector.focal_plane_place(annuli.column, annuli.row)
        np.testing.assert_allclose(1500.0 * y, 900.0 * x, atol=1e-6 * 1500**2)
        found.append({(round(a, 6), round(r, 6)) for a, r in zip(x.tolist(), annuli.radius.tolist(), strict=True)})
    assert len(found[0]) > 0
    assert all(some <= found[0] | found[1] | found[2] for some in found)


@pytest.mark.parametrize(("camera", "name", "band"), [("decam", "S29", "des_r"), ("hsc", "0_05", "hsc_z")])
def test_a_mirrored_detector_has_its_ghosts_in_mirrored_rows(camera, name, band):
    """The same detector that is only rotated sees the same ghosts, with its rows in reverse order."""
    made = scene(camera, name, band, star(700.0, 1200.0, 1e13))
    last_row = made.detector.ny - 1.0
    turned = replace(
        made, detector=replace(made.detector, is_mirrored=False), lights=star(700.0, last_row - 1200.0, 1e13)
    )
    (found, _), (expected, _) = ground_ghosts.parameters(made), ground_ghosts.parameters(turned)
    assert made.detector.is_mirrored
    assert len(found.row) > 2
    np.testing.assert_allclose(found.row, last_row - expected.row, atol=1e-6)
    for values in ("column", "radius", "level"):
        np.testing.assert_allclose(getattr(found, values), getattr(expected, values), rtol=1e-9)


def test_a_window_shows_the_part_of_the_detector_s_ghosts():
    whole = scene("decam", "N4", "des_r", star(900.0, 1800.0))
    part = replace(whole, window=Window(700, 1500, 400, 300), lights=star(200.0, 300.0))
    frames = [
        ground_ghosts.apply(np.zeros(shape), *ground_ghosts.parameters(one))
        for one, shape in ((whole, (whole.ny, whole.nx)), (part, (300, 400)))
    ]
    np.testing.assert_allclose(frames[1], frames[0][1500:1800, 700:1100], rtol=1e-12)
    assert frames[1].max() > 0.0


def test_faint_stars_and_cameras_without_a_table_have_no_ghosts():
    limit = ground_ghosts.min_noticeable_electrons(scene("decam", "N4", "des_r", Lights()))
    for electrons, count in ((0.9 * limit, 0), (1.1 * limit, 1)):
        made = scene("decam", "N4", "des_r", star(900.0, 1800.0, electrons))
        assert len(ground_ghosts.parameters(made)[0].level) == count
        assert ground_ghosts.EFFECT.is_needed(made) == bool(count)
    none = scene("megacam", "ccd04", "cfis_r", star(900.0, 1800.0))
    assert ground_ghosts.min_noticeable_electrons(none) == np.inf
    assert len(ground_ghosts.parameters(none)[0].level) == 0
    assert not ground_ghosts.EFFECT.is_needed(none)
