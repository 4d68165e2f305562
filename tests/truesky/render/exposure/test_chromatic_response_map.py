"""Spectra with a different response to the colour of each column, compared with drawings of every part of the band."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema.mission.configuration import resolve
from tests.truesky.render import fields, infrared, spectroscopic
from truesky.render.channels.aim import Aim
from truesky.render.dispersing import draw as dispersing
from truesky.render.effects.light import chromatic_response
from truesky.render.effects.scene import NOTICEABLE
from truesky.render.exposure import chromatic_response_map, scene_factory
from truesky.render.exposure.records import Rows, Variant
from truesky.render.exposure.visible_spectra import visible_spectra
from truesky.request.accuracy import SURVEY

STRIP = spectroscopic.strip()
# Larger than the mission's, that a few sources are noticed by far.
SLOPE, CURVATURE = 0.05, 0.02
MISSION = resolve(
    overrides={
        "env.solar_system.density": (0.0, "deg-2"),
        "nisp.response.slope": (SLOPE, ""),
        "nisp.response.curvature": (CURVATURE, ""),
    }
)
# Stars with a first order on the strip, one with a zeroth order, and stars that are not noticeable.
MAGS = np.array([15.0, 17.0, 19.0, 15.0, 23.0, 24.0])
X, Y = np.array([-120.0, 40.0, -60.0, 900.0, 20.0, -30.0]), np.array([30.0, 60.0, 75.0, 48.0, 20.0, 85.0])


def lit(mags=MAGS, x=X, y=Y, mission=MISSION):
    """(scene, aim, light, frame, tally) of stars before the detector's effects."""
    row = spectroscopic.exposed(STRIP, mission=mission)
    aim = Aim.from_exposure(fields.exposure(**row), STRIP)
    scene = scene_factory.from_aim(aim, Variant(mission, SURVEY, {}))
    light = visible_spectra(aim, Rows(*infrared.tables(STRIP, row, mags, x, y)), scene, infrared.SEED)
    tally = dispersing.Tally.empty(len(light.sources), len(light.dispersed.orders))
    frame = dispersing.draw(light.sources, light.dispersed, light.psf, (STRIP.ny, STRIP.nx), scene.pixel_noise, tally)
    return scene, aim, light, frame, tally


def slowly(scene, aim, light, step=300.0):
    """Draw the light times f1 and f2, shape (2, ny, nx), part by part of the band, far into the wings of all sources.

    The weight of a part rises from one wavelength to the next and falls again, so that f is linear between them.
    """
    orders, shape = light.dispersed.orders, (STRIP.ny, STRIP.nx)
    wavelength = orders[0].wavelength
    nodes = np.arange(wavelength[0], wavelength[-1] + step, step)
    settings = replace(light.dispersed.settings, edge=0.03, faint=0.03)
    total = np.zeros((2, *shape))
    for at, f in zip(nodes, chromatic_response.component_spectra("nisp", nodes, aim.band, MISSION), strict=True):
        some = np.clip(1.0 - np.abs(wavelength - at) / step, 0.0, None)
        own = tuple(replace(order, response=order.response * some) for order in orders)
        part = replace(light.dispersed, orders=own, settings=settings)
        total += f[:, None, None] * dispersing.draw(light.sources, part, light.psf, shape, scene.pixel_noise)
    return total


def test_pixels_see_the_colour_of_every_column():
    scene, aim, light, frame, tally = lit()
    found = chromatic_response_map.with_dispersed_light(scene, aim, light, tally, {})
    exact = slowly(scene, aim, light)
    response = chromatic_response.draw_maps(frame.shape, SLOPE, CURVATURE, np.random.default_rng(3))
    fast, slow = (response[0] * part[0] + response[1] * part[1] for part in (found.chromatic_light, exact))
    noise = np.sqrt(scene.pixel_noise**2 + frame)
    print(f"change {np.abs(slow / noise).max():.2f} sigma, wrong by {np.abs((fast - slow) / noise).max():.3f}")
    assert np.abs(slow / noise).max() > 1.0
    assert np.abs((fast - slow) / noise).max() < NOTICEABLE
    assert np.abs(fast - slow).max() < 0.03 * np.abs(slow).max()
    # The predicted largest change is close to the actual one, for maps with 5 sigma.
    assert found.chromatic_electrons < 5 * np.abs(slow).max() < 25 * found.chromatic_electrons


def test_a_column_of_a_star_is_seen_as_its_wavelength_is():
    """By the trace alone: what a pixel of a straight red trace sees is f of the wavelength that lies there."""
    scene, aim, light, frame, tally = lit(MAGS[:1], 320.0, 48.0)
    found = chromatic_response_map.with_dispersed_light(scene, aim, light, tally, {})
    first = next(order for order in light.dispersed.orders if order.trace.order == 1)
    wavelength = np.arange(13000.0, 18000.0, 250.0)
    x, _ = first.trace.offsets(float(light.sources.column[0]), float(light.sources.row[0]), wavelength)
    wavelength = wavelength[(light.sources.column[0] + x > 5) & (light.sources.column[0] + x < STRIP.nx - 6)]
    assert len(wavelength) > 8
    f = chromatic_response.component_spectra("nisp", wavelength, aim.band, MISSION)
    column, row = float(light.sources.column[0]), float(light.sources.row[0])
    x, y = first.trace.offsets(column, row, wavelength)
    for k, at in enumerate(zip(np.rint(column + x).astype(int), np.rint(row + y).astype(int), strict=True)):
        box = slice(at[1] - 2, at[1] + 3), slice(at[0] - 2, at[0] + 3)
        seen = found.chromatic_light[:, *box].sum(axis=(1, 2)) / frame[box].sum()
        assert seen == pytest.approx(f[k], abs=0.01)


def test_faint_spectra_are_not_drawn_again():
    mission = resolve(overrides={"env.solar_system.density": (0.0, "deg-2")})
    scene, aim, light, _, tally = lit(MAGS[-2:], X[-2:], Y[-2:], mission)
    assert tally.peak.max() > 0.0
    assert chromatic_response_map.with_dispersed_light(scene, aim, light, tally, {}).chromatic_light is None
    bright = lit(MAGS[:1], X[:1], Y[:1], mission)
    assert chromatic_response_map.with_dispersed_light(*bright[:3], bright[4], {}).chromatic_light is not None
    off = replace(bright[0], forced={"chromatic_response": False})
    assert chromatic_response_map.with_dispersed_light(off, *bright[1:3], bright[4], {}).chromatic_light is None


def test_an_exposure_sees_them():
    """A frame with the effect, and without: another by about what the maps change."""
    quiet = dict.fromkeys(
        ("ramp_cosmic_rays", "drift", "group_noise", "dark_map", "pixel_response", "ramp_nonlinearity", "ipc"), False
    )
    both = [
        spectroscopic.rendered(
            MAGS[0], X[0], Y[0], mission=MISSION, sky=0.0, forced={**quiet, "chromatic_response": on}
        )
        for on in (False, True)
    ]
    before, after = (infrared.electrons(one) for one in both)
    frame = both[1].noise_free
    bright = frame > 0.3 * frame.max()
    ratio = (after[bright] - before[bright]) / frame[bright]
    expected = SLOPE * np.abs(both[1].scene.chromatic_light[0][bright] / frame[bright]).mean()
    assert 0.3 * expected < ratio.std() < 5.0 * expected
