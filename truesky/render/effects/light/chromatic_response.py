"""Chromatic response: the wavelength dependence of the quantum efficiency differs from pixel to pixel.

The efficiency of pixel p is that of the passband multiplied by::

    1 + s_p f1(lambda) + c_p f2(lambda)

and at least 0. The grey part of the response is in `pixel_response`. The mission database contains f1, a slope, and f2,
a curvature, as functions of wavelength. The maps s and c of a detector are each the sum of a smooth map and a map with
independent pixels.

Light whose photons have the fractions w in wavelengths has the response sum w f. For light with flat f_nu this is the
mean of f over the band. It is common to all light in the band and differs from band to band, also in flats. The
additional response of a light is its colour F, sum w f minus this mean. Sources are drawn three times: normally, and
with each photon multiplied by f1 and by f2, minus their means. A source is not drawn again if its colour changes its
brightest pixel by less than is noticeable.
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

# Nodes of a smooth map along each side of the detector. The map is bilinear between them.
_NODES = 9
# Difference in colour between the core or wings of a PSF and its total light, as a fraction of the rms of f over a
# band. The PSFs of NISP have 0.07 to 0.1.
_PSF_COLOUR = 0.1


def apply(
    frame: Frame,
    chromatic_light: Frame,
    mean_components: Float,
    slope: float,
    curvature: float,
    rng: np.random.Generator,
) -> Frame:
    """Apply the chromatic response to a frame.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    chromatic_light : float array, shape (2, ny, nx)
        Light of the frame in electrons, with each photon multiplied by f1 and by f2, minus their means over the band.
    mean_components : float array, shape (2,)
        Means of f1 and f2 over the band, see `band_means`.
    slope, curvature : float
        Same as in `draw_maps`.
    rng : numpy.random.Generator
        Random numbers of the detector, the same in every exposure.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons, 0 or more.
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
    """Draw the maps s and c of a detector from normal distributions; the smooth map has half of their variance.

    Parameters
    ----------
    shape : (int, int)
        Rows and columns.
    slope, curvature : float
        Standard deviations of s and c, 0 to 0.5.
    rng : numpy.random.Generator
        Random numbers of the detector, the same in every exposure.

    Returns
    -------
    float64 array, shape (2, ny, nx)
        The maps s and c.
    """
    out = np.zeros((2, *shape))
    up, across = _node_positions(shape)
    for component, nodes, rms, key in _draw_patterns(slope, curvature, rng):
        _add_pattern(out[component], np.ones(shape), nodes, up, across, rms, key)
    return out


def _draw_patterns(slope: float, curvature: float, rng: np.random.Generator) -> list[tuple[int, Float, float, Any]]:
    """Return (index, nodes of the smooth map, standard deviation, key of random numbers) for s (0) and c (1)."""
    patterns = []
    for component, (name, value) in enumerate((("slope", slope), ("curvature", curvature))):
        if not 0.0 <= value <= 0.5:
            raise OutOfRange(f"chromatic response, {name}", value, 0.0, 0.5)
        nodes = rng.standard_normal((_NODES, _NODES))
        # The sample is small: scale it to a mean of exactly 0 and a standard deviation of exactly 1.
        nodes = (nodes - nodes.mean()) / nodes.std()
        patterns.append((component, nodes, value * float(np.sqrt(0.5)), pixel_random.draw_key(rng)))
    return patterns


def _node_positions(shape: tuple[int, ...]) -> tuple[Float, Float]:
    """Return the positions of rows and of columns in units of nodes."""
    up, across = (np.linspace(0.0, _NODES - 1.0, max(n, 2))[:n] for n in shape)
    return up, across


@jit
def _add_pattern(out: Any, light: Any, nodes: Any, up: Any, across: Any, rms: float, key: Any) -> None:
    """Add light times the map to `out`."""
    ny, nx = out.shape
    for y in range(ny):
        j = min(int(up[y]), len(nodes) - 2)
        v = up[y] - j
        for x in range(nx):
            i = min(int(across[x]), len(nodes) - 2)
            u = across[x] - i
            low = (1.0 - u) * nodes[j, i] + u * nodes[j, i + 1]
            high = (1.0 - u) * nodes[j + 1, i] + u * nodes[j + 1, i + 1]
            # Bilinear interpolation reduces the mean variance to 4/9 of the variance at the nodes.
            smooth = 1.5 * ((1.0 - v) * low + v * high)
            out[y, x] += light[y, x] * rms * (smooth + pixel_random.normal(pixel_random.pixel_bits(key, y * nx + x)))


def _components_in_sub_bands(section: str, band: Passband, mission: MissionConfiguration) -> Float:
    """Return f1 and f2 in the sub-bands of a band, float64[n, 2]."""
    parts = sub_bands(band)
    return np.array([_mean(section, part.wavelength, part.response / part.wavelength, mission) for part in parts])


def band_means(section: str, band: Passband, mission: MissionConfiguration) -> Float:
    """Means of f1 and f2 over a band, for light with flat f_nu.

    Parameters
    ----------
    section : str
        Section of the camera in the mission database.
    band : Passband
        Passband.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float64 array, shape (2,)
        Means of f1 and f2.
    """
    return np.asarray(np.mean(_components_in_sub_bands(section, band, mission), axis=0))


def sub_band_components(section: str, band: Passband, mission: MissionConfiguration) -> Float:
    """Mean f1 and f2 in each sub-band of a band, minus their means over the band.

    Parameters
    ----------
    section : str
        Section of the camera in the mission database.
    band : Passband
        Passband.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float64 array, shape (n, 2)
        f1 and f2 of each sub-band.
    """
    components = _components_in_sub_bands(section, band, mission)
    return np.asarray(components - np.mean(components, axis=0))


def component_spectra(section: str, wavelength: Float, band: Passband, mission: MissionConfiguration) -> Float:
    """Values of f1 and f2 at wavelengths, minus their means over a band.

    Parameters
    ----------
    section : str
        Section of the camera in the mission database.
    wavelength : float array, shape (w,)
        Wavelengths in Angstrom.
    band : Passband
        Passband.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float64 array, shape (w, 2)
        f1 and f2 at each wavelength.
    """
    nodes, *components = np.array(mission.numbers(f"{section}.response.components")).T
    values = np.stack([np.interp(1e-4 * wavelength, nodes, f) for f in components], axis=1)
    return np.asarray(values - band_means(section, band, mission))


def colour_of_lines(
    section: str, band: Passband, wavelength: Float, photons: Float, mission: MissionConfiguration
) -> Float:
    """Colours F1 and F2 of light at given wavelengths.

    Parameters
    ----------
    section : str
        Section of the camera in the mission database.
    band : Passband
        Passband.
    wavelength : float array, shape (n,)
        Wavelengths of the light in Angstrom.
    photons : float array, shape (n,)
        Photons that the band detects at each wavelength, in arbitrary units.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float64 array, shape (2,)
        F1 and F2, minus the means of f1 and f2 over the band.
    """
    return np.asarray(_mean(section, wavelength, photons, mission) - band_means(section, band, mission))


def _mean(section: str, wavelength: Float, photons: Float, mission: MissionConfiguration) -> Float:
    nodes, *components = np.array(mission.numbers(f"{section}.response.components")).T
    return np.array([np.average(np.interp(1e-4 * wavelength, nodes, f), weights=photons) for f in components])


def source_colours(shares: Float, components: Float) -> Float:
    """Return the colours F1 and F2 of sources, float64[n, 2].

    `shares` [n, sub-bands] are the fractions of their photons in each sub-band, and `components` is the result of
    `sub_band_components`.
    """
    return np.asarray(matrices.matmul(shares, components))


def weighted_light(
    electrons: Float, shares: Float, components: Float, draw: Callable[[Float, Float], Frame]
) -> Float32:
    """Draw the light of sources with each photon multiplied by f1 and by f2.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Electrons of each source.
    shares : float array, shape (n, sub-bands)
        Fractions of the photons in each sub-band.
    components : float array, shape (sub-bands, 2)
        Result of `sub_band_components`.
    draw : callable
        Function (electrons, shares) -> image of the sources, shape (ny, nx). The electrons must be 0 or more.

    Returns
    -------
    float32 array, shape (2, ny, nx)
        Weighted light in electrons.

    Notes
    -----
    Blue light is concentrated in the core of the PSF. The change of a pixel therefore depends on the shape of the PSF
    and not only on the colour of the source.
    """
    drawn = draw(electrons, shares)
    out = np.empty((2, *drawn.shape), np.float32)
    for k in (0, 1):
        # Subtract the lowest weight so that no sub-band has negative light.
        lowest = float(components[:, k].min())
        weighted = shares * (components[:, k] - lowest)
        weight = weighted.sum(axis=1)
        weighted_shares = np.divide(weighted, weight[:, None], out=shares.copy(), where=weight[:, None] > 0.0)
        out[k] = draw(electrons * weight, weighted_shares) + lowest * drawn
    return out


def colour_changes(peak: Float, colours: Float, components: Float, strength: tuple[float, float]) -> Float:
    """Largest change of a pixel by the colour of each source.

    Parameters
    ----------
    peak : float array, shape (n,)
        Electrons in the brightest pixel of each source.
    colours : float array, shape (n, 2)
        Result of `source_colours`.
    components : float array, shape (sub-bands, 2)
        Result of `sub_band_components`.
    strength : (float, float)
        Standard deviations of the maps s and c.

    Returns
    -------
    float array, shape (n,)
        Change in electrons rms.
    """
    largest = np.abs(colours) + _PSF_COLOUR * components.std(axis=0)
    return np.asarray(peak * np.hypot(*(largest * np.array(strength)).T))


def map_strength(scene: Scene) -> tuple[float, float]:
    """Return the standard deviations of s and c."""
    return scene.value("response.slope", ""), scene.value("response.curvature", "")


def band_of_scene(scene: Scene) -> Passband:
    """Return the passband of the exposure, or the first of the camera if the exposure has none."""
    return scene.band or passbands.load(LAMPS[scene.section][1][0])


# ------------------------------------------------------------------------------------------------------ sky and lamp


def _colour_of_light(scene: Scene, photons: Float) -> Float:
    """Return F1 and F2 of light with these detected photons by wavelength, or 0 without photons."""
    band = band_of_scene(scene)
    if not photons.sum() > 0.0:
        return np.zeros(2)
    return colour_of_lines(scene.section, band, band.wavelength, photons, scene.mission)


def _sky_colour(scene: Scene) -> Float:
    """Return the electrons of the sky multiplied by F1 and F2.

    All light except thermal emission is assumed to have the colour of the Sun.
    """
    if not scene.sky_rate > 0.0:
        return np.zeros(2)
    photons = diffuse_light.photons(scene.section, scene.sky_rate, band_of_scene(scene), scene.mission)
    return scene.sky_electrons * _colour_of_light(scene, photons)


def _band_means_of_scene(scene: Scene) -> Float:
    return band_means(scene.section, band_of_scene(scene), scene.mission)


def _change_rms(scene: Scene, light: Float) -> float:
    """Return the change by the maps in electrons rms, from light in electrons multiplied by f1 and f2."""
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
    """Return the change of the sky in electrons rms; changes of sources average out between dithers."""
    return _change_rms(scene, _sky_colour(scene) + scene.sky_electrons * _band_means_of_scene(scene))


def _lamp_colour(scene: Scene) -> Float:
    """Return the electrons of a lamp multiplied by F1 and F2, where its pattern is 1."""
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


# Most of the cost of `EFFECT` is for sources that are drawn again.
EFFECT = Effect("chromatic_response", apply, _parameters, _contribution, fixed=True, systematic=_sky_change, cost=5e-2)
LAMP = Effect(
    "lamp_response", apply, _lamp_parameters, _lamp_change, fixed=True, random_stream=EFFECT.name, cost=1.5e-2
)
