"""Chromatic response: how a pixel's quantum efficiency departs, with the wavelength, from that of all pixels.

The efficiency of pixel p is that of the passband times

    1 + s_p f1(lambda) + c_p f2(lambda)

beside its grey part, which is `pixel_response`; never less than 0.  The mission database has f1, a slope, and f2, a
curvature, by wavelength; s and c are maps of the detector, each the sum of a smooth map and of one from pixel to pixel.
Light whose photons have the shares w in wavelengths meets sum w f.  That of flat f_nu meets the means of f over the
band: all light in a band sees this difference of the pixels, and a flat of another band has another.  What a light
meets besides is F, its sum w f less these means. Sources are drawn three times: as they are, and with each photon times
f1, and times f2, less the means.

What F changes by less than is noticed in its source's brightest pixel is not drawn again.

EFFECT, LAMP   the light of the sky and its sources, and of a lamp, as the pixels see it
maps       s and c of a detector
means      f1 and f2 over a band
table      f1 and f2 in the parts of a band;  spectrum : at every wavelength
colours    F1 and F2 of lights;  of_lines : of light at given wavelengths
tints      the light of sources, each photon times f1, and times f2
changes    the most that the colour of each source changes
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from lake_schema.arrays import Float, Float32
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import MissionConfiguration
from truesky.fluxes import passbands
from truesky.fluxes.passbands import Passband
from truesky.numerics import matrices
from truesky.numerics.compiling import jit
from truesky.render.camera.lamps import LAMPS
from truesky.render.effects import pixel_random
from truesky.render.effects.effect import Effect
from truesky.render.effects.light import calibration_lamp, illumination
from truesky.render.effects.scene import Frame, Scene
from truesky.render.psf.sub_bands import sub_bands
from truesky.render.sky import diffuse_light

# Nodes of a smooth map along a side of the detector; between them it is bilinear.
_NODES = 9
# By what part of the rms of f over a band the light in a PSF's middle, and in its wings, differs in colour from all of
# it: measured of NISP's, 0.07 to 0.1.
_PSF_COLOUR = 0.1


def apply(
    frame: Frame,
    chromatic_light: Frame,
    mean_components: Float,
    slope: float,
    curvature: float,
    rng: np.random.Generator,
) -> Frame:
    """frame [ny, nx] expected e- -> as the pixels see it.

    lit  : [2, ny, nx] e- of the frame's light, each photon of it times f1, and times f2, told from their means
    even : [2] these means, as of `means`
    slope, curvature, rng : as of `maps`
    """
    out = np.array(frame, float)
    up, across = _node_positions(out.shape)
    for component, nodes, rms, key in _draw_patterns(slope, curvature, rng):
        _add_pattern(
            out,
            np.ascontiguousarray(chromatic_light[component] + mean_components[component] * frame),
            nodes,
            up,
            across,
            rms,
            key,
        )
    return np.asarray(np.maximum(out, 0.0, out=out))


def draw_maps(shape: tuple[int, int], slope: float, curvature: float, rng: np.random.Generator) -> Frame:
    """float64[2, ny, nx]: s and c of every pixel, normally distributed; half of their variance is of the smooth map.

    shape : ny, nx;  slope, curvature : rms of s and c
    rng   : random numbers of the detector's pixels
    """
    out = np.zeros((2, *shape))
    up, across = _node_positions(shape)
    for component, nodes, rms, key in _draw_patterns(slope, curvature, rng):
        _add_pattern(out[component], np.ones(shape), nodes, up, across, rms, key)
    return out


def _draw_patterns(slope: float, curvature: float, rng: np.random.Generator) -> list[tuple[int, Float, float, Any]]:
    """(0 or 1, nodes of its smooth map, rms, key of the random numbers of its pixels) of s, and of c."""
    patterns = []
    for component, (name, value) in enumerate((("slope", slope), ("curvature", curvature))):
        if not 0.0 <= value <= 0.5:
            raise OutOfRange(f"chromatic response, {name}", value, 0.0, 0.5)
        nodes = rng.standard_normal((_NODES, _NODES))
        # To the mean and the rms that are asked for, of so few numbers.
        nodes = (nodes - nodes.mean()) / nodes.std()
        patterns.append((component, nodes, value * float(np.sqrt(0.5)), pixel_random.draw_key(rng)))
    return patterns


def _node_positions(shape: tuple[int, ...]) -> tuple[Float, Float]:
    """Of each row and of each column its place among the nodes."""
    up, across = (np.linspace(0.0, _NODES - 1.0, max(n, 2))[:n] for n in shape)
    return up, across


@jit
def _add_pattern(out: Any, light: Any, nodes: Any, up: Any, across: Any, rms: float, key: Any) -> None:
    """Adds light times the map."""
    ny, nx = out.shape
    for y in range(ny):
        j = min(int(up[y]), len(nodes) - 2)
        v = up[y] - j
        for x in range(nx):
            i = min(int(across[x]), len(nodes) - 2)
            u = across[x] - i
            low = (1.0 - u) * nodes[j, i] + u * nodes[j, i + 1]
            high = (1.0 - u) * nodes[j + 1, i] + u * nodes[j + 1, i + 1]
            # Of numbers between nodes the variance is 4/9 of that at the nodes, in both directions together.
            smooth = 1.5 * ((1.0 - v) * low + v * high)
            out[y, x] += light[y, x] * rms * (smooth + pixel_random.normal(pixel_random.pixel_bits(key, y * nx + x)))


def _components_in_sub_bands(section: str, band: Passband, mission: MissionConfiguration) -> Float:
    """float64[PARTS, 2]: f1 and f2 in the parts of a band."""
    parts = sub_bands(band)
    return np.array([_mean(section, part.wavelength, part.response / part.wavelength, mission) for part in parts])


def band_means(section: str, band: Passband, mission: MissionConfiguration) -> Float:
    """float64[2]: f1 and f2 that light of flat f_nu meets in a band.

    section, mission : of the camera in the mission database;  band : a passband
    """
    return np.asarray(np.mean(_components_in_sub_bands(section, band, mission), axis=0))


def sub_band_components(section: str, band: Passband, mission: MissionConfiguration) -> Float:
    """float64[PARTS, 2]: f1 and f2 in the parts of a band, told from their means over it.

    section, mission : of the camera in the mission database;  band : a passband
    """
    components = _components_in_sub_bands(section, band, mission)
    return np.asarray(components - np.mean(components, axis=0))


def component_spectra(section: str, wavelength: Float, band: Passband, mission: MissionConfiguration) -> Float:
    """float64[w, 2]: f1 and f2 told from their means over a band.

    wavelength : [w] A;  section, mission : of the camera in the mission database;  band : a passband
    """
    nodes, *components = np.array(mission.numbers(f"{section}.response.components")).T
    values = np.stack([np.interp(1e-4 * wavelength, nodes, f) for f in components], axis=1)
    return np.asarray(values - band_means(section, band, mission))


def colour_of_lines(
    section: str, band: Passband, wavelength: Float, photons: Float, mission: MissionConfiguration
) -> Float:
    """float64[2]: F1 and F2 of light of which a band detects `photons` [n] at wavelengths [n] A, as of `colours`.

    section, mission    : of the camera in the mission database;  band : a passband
    wavelength, photons : of the light
    """
    return np.asarray(_mean(section, wavelength, photons, mission) - band_means(section, band, mission))


def _mean(section: str, wavelength: Float, photons: Float, mission: MissionConfiguration) -> Float:
    nodes, *components = np.array(mission.numbers(f"{section}.response.components")).T
    return np.array([np.average(np.interp(1e-4 * wavelength, nodes, f), weights=photons) for f in components])


def source_colours(shares: Float, components: Float) -> Float:
    """float64[n, 2]: F1 and F2 of lights.

    shares : [n, PARTS] of their photons in the parts of a band;  components : of `table`
    """
    return np.asarray(matrices.matmul(shares, components))


def weighted_light(
    electrons: Float, shares: Float, components: Float, draw: Callable[[Float, Float], Frame]
) -> Float32:
    """float32[2, ny, nx]: the light of sources, each photon of it times f1, and times f2.

    Blue light is concentrated in the middle of the PSF: what two colours change of a pixel is not the colour of the
    source alone.
    electrons : [n] of each;  shares, components : as of `colours`
    draw      : (electrons, 0 or more, and shares of the sources) -> [ny, nx] their light
    """
    drawn = draw(electrons, shares)
    out = np.empty((2, *drawn.shape), np.float32)
    for k in (0, 1):
        # No part has less than no light.
        lowest = float(components[:, k].min())
        weighted = shares * (components[:, k] - lowest)
        weight = weighted.sum(axis=1)
        weighted_shares = np.divide(weighted, weight[:, None], out=shares.copy(), where=weight[:, None] > 0.0)
        out[k] = draw(electrons * weight, weighted_shares) + lowest * drawn
    return out


def colour_changes(peak: Float, colours: Float, components: Float, strength: tuple[float, float]) -> Float:
    """[n] the most that the colour of each source changes in a pixel, e- rms.

    peak : [n] e- in the brightest pixel of each;  own, components : of `colours` and `table`
    strength : slope and curvature, rms of the maps
    """
    largest = np.abs(colours) + _PSF_COLOUR * components.std(axis=0)
    return np.asarray(peak * np.hypot(*(largest * np.array(strength)).T))


def map_strength(scene: Scene) -> tuple[float, float]:
    """rms of s and of c."""
    return scene.value("response.slope", ""), scene.value("response.curvature", "")


def band_of_scene(scene: Scene) -> Passband:
    """The exposure's passband; without one, the first of the camera's."""
    return scene.band or passbands.load(LAMPS[scene.section][1][0])


# ---------------------------------------------------------------------------------------------- the sky, and a lamp


def _colour_of_light(scene: Scene, photons: Float) -> Float:
    """F1 and F2 of light of which the band detects photons [n] by wavelength; 0 where it detects none."""
    band = band_of_scene(scene)
    if not photons.sum() > 0.0:
        return np.zeros(2)
    return colour_of_lines(scene.section, band, band.wavelength, photons, scene.mission)


def _sky_colour(scene: Scene) -> Float:
    """e- of the sky times F1, and F2.  Error: of its light all but the thermal is taken as the Sun's."""
    if not scene.sky_rate > 0.0:
        return np.zeros(2)
    photons = diffuse_light.photons(scene.section, scene.sky_rate, band_of_scene(scene), scene.mission)
    return scene.sky_electrons * _colour_of_light(scene, photons)


def _band_means_of_scene(scene: Scene) -> Float:
    return band_means(scene.section, band_of_scene(scene), scene.mission)


def _change_rms(scene: Scene, light: Float) -> float:
    """e- rms that the maps change of light [2], e- times f1, and f2."""
    return float(np.hypot(*(np.array(map_strength(scene)) * light)))


def _parameters(scene: Scene) -> tuple[Frame | Float32, Float, float, float]:
    chromatic_light = np.empty((2, scene.ny, scene.nx), np.float32)
    chromatic_light[:] = _sky_colour(scene)[:, None, None]
    if scene.chromatic_light is not None:
        chromatic_light += scene.chromatic_light
    return chromatic_light, _band_means_of_scene(scene), *map_strength(scene)


def _contribution(scene: Scene) -> float:
    brightest = scene.peak_electrons + scene.sky_electrons
    return max(
        scene.chromatic_electrons, _change_rms(scene, brightest * _band_means_of_scene(scene)), _sky_change(scene)
    )


def _sky_change(scene: Scene) -> float:
    """What a source changes is not there again in the next dither."""
    return _change_rms(scene, _sky_colour(scene) + scene.sky_electrons * _band_means_of_scene(scene))


def _lamp_colour(scene: Scene) -> Float:
    """e- of a lamp, where it shines straight, times F1, and F2."""
    band = band_of_scene(scene)
    level = calibration_lamp.EFFECT.contribution(scene)
    return level * _colour_of_light(
        scene, calibration_lamp.detected_photons(band, scene.lamp, scene.section, scene.mission)
    )


def _lamp_parameters(scene: Scene) -> tuple[Float32, Float, float, float]:
    columns, rows = calibration_lamp.pattern(scene, scene.lamp, scene.nx, scene.ny)
    shape = illumination.apply(np.ones((scene.ny, scene.nx)), columns, rows)
    return (
        (_lamp_colour(scene)[:, None, None] * shape).astype(np.float32),
        _band_means_of_scene(scene),
        *map_strength(scene),
    )


def _lamp_change(scene: Scene) -> float:
    return _change_rms(
        scene, _lamp_colour(scene) + calibration_lamp.EFFECT.contribution(scene) * _band_means_of_scene(scene)
    )


# Most of the cost of the first is for the light that is drawn again.
EFFECT = Effect("chromatic_response", apply, _parameters, _contribution, fixed=True, systematic=_sky_change, cost=5e-2)
LAMP = Effect(
    "lamp_response", apply, _lamp_parameters, _lamp_change, fixed=True, random_stream=EFFECT.name, cost=1.5e-2
)
