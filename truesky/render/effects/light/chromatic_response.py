"""Chromatic response: how the quantum efficiency depends on wavelength differs from pixel to pixel.

The efficiency of pixel p at the wavelength lambda is that of the passband multiplied by::

    1 + s_p f1(lambda) + c_p f2(lambda)

The product is at least 0. Differences between pixels that do not depend on wavelength are in the module
`pixel_response`. The mission database contains f1, a slope, and f2, a curvature, as dimensionless functions of
wavelength. The maps s and c have one value per pixel. Each is the sum of a smooth map and a map with independent
pixels.

Let w(lambda) be the fraction of the detected photons of a source of light at each wavelength, and f one of f1 and f2.
The mean of f over the photons is the sum of w f over all wavelengths. For light with flat f_nu this is called the mean
over the band. It applies to all light in the band, also to flats, and differs from band to band. The colour F of a
light is the mean of f over its photons minus the mean over the band: F1 for f1 and F2 for f2.

Sources are drawn three times: normally, with each photon multiplied by f1 minus its mean, and with each photon
multiplied by f2 minus its mean. A source is drawn only once if its colour changes its brightest pixel too little to be
noticed.
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

# Number of nodes (grid points) along each side of the detector at which the smooth part of a response map is drawn. It
# is interpolated bilinearly between them.
_NODES = 9
# The core or the wings of a PSF have another colour than its total light. This is the assumed difference in the mean of
# the response functions f1 or f2, as a fraction of their rms over a band. The PSFs of NISP have 0.07 to 0.1.
_PSF_COLOUR = 0.1


def apply(
    frame: Frame,
    chromatic_light: Frame,
    mean_components: Float,
    slope: float,
    curvature: float,
    rng: np.random.Generator,
) -> Frame:
    """Multiply each pixel of a frame by its chromatic response.

    The response at a wavelength is 1 + s f1 + c f2. The slope f1 and the curvature f2 are functions of wavelength, and
    the maps s and c have a value for each pixel.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Expected electrons.
    chromatic_light : float array, shape (2, ny, nx)
        Light of the frame in electrons, with each photon multiplied by f1 (first plane) and by f2 (second plane), minus
        their means over the band. The module docstring defines f1 and f2.
    mean_components : float array, shape (2,)
        Means of f1 and f2 over the band for light with flat f_nu, see `band_means`.
    slope, curvature : float
        Standard deviations of the maps s and c from pixel to pixel, 0 to 0.5.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that the maps do not change.

    Returns
    -------
    float array, shape (ny, nx)
        Expected electrons. Negative results are set to 0.

    Raises
    ------
    OutOfRange
        If `slope` or `curvature` is outside its limits.
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
    """Draw the maps s and c of a detector, which describe its chromatic response, from normal distributions.

    The quantum efficiency of a pixel is multiplied by 1 + s f1 + c f2, where f1 and f2 are functions of wavelength.
    Half of the variance of each map is in a smooth part, the other half in independent pixels.

    Parameters
    ----------
    shape : (int, int)
        Number of rows and columns of the detector.
    slope, curvature : float
        Standard deviations of the maps s and c from pixel to pixel, 0 to 0.5.
    rng : numpy.random.Generator
        Random generator of the detector, in the same state in every exposure, so that the maps do not change.

    Returns
    -------
    float64 array, shape (2, ny, nx)
        The map s (multiplies the slope f1) and the map c (multiplies the curvature f2).

    Raises
    ------
    OutOfRange
        If `slope` or `curvature` is outside its limits.
    """
    out = np.zeros((2, *shape))
    up, across = _node_positions(shape)
    for component, nodes, rms, key in _draw_patterns(slope, curvature, rng):
        _add_pattern(out[component], np.ones(shape), nodes, up, across, rms, key)
    return out


def _draw_patterns(slope: float, curvature: float, rng: np.random.Generator) -> list[tuple[int, Float, float, Any]]:
    """Draw the numbers that define the response maps s and c of a detector's pixels, one tuple per map.

    A map is the sum of a smooth part and a part with independent pixels, both with the same standard deviation. A tuple
    is (0 for s or 1 for c, smooth part, standard deviation of each part, key). The smooth part is given at a grid of
    nodes, float64[_NODES, _NODES], with mean 0 and standard deviation 1. The key (uint64) gives the random numbers of
    the independent pixels. `slope` and `curvature` are the standard deviations of s and c; OutOfRange is raised if one
    is outside 0 to 0.5.
    """
    patterns = []
    for component, (name, value) in enumerate((("slope", slope), ("curvature", curvature))):
        if not 0.0 <= value <= 0.5:
            raise OutOfRange(f"chromatic response, {name}", value, 0.0, 0.5)
        nodes = rng.standard_normal((_NODES, _NODES))
        # The number of nodes is small: scale their values to a mean of exactly 0 and a standard deviation of exactly 1.
        nodes = (nodes - nodes.mean()) / nodes.std()
        patterns.append((component, nodes, value * float(np.sqrt(0.5)), pixel_random.draw_key(rng)))
    return patterns


def _node_positions(shape: tuple[int, ...]) -> tuple[Float, Float]:
    """Return the positions of all rows and of all columns of a detector, in units of the distance between two nodes.

    The nodes are the `_NODES` x `_NODES` grid points of a smooth response map. Position 0 is the first node, on the
    first row or column, and `_NODES` - 1 the last node, on the last one. `shape` is the number of rows and columns.
    """
    up, across = (np.linspace(0.0, _NODES - 1.0, max(n, 2))[:n] for n in shape)
    return up, across


@jit
def _add_pattern(out: Any, light: Any, nodes: Any, up: Any, across: Any, rms: float, key: Any) -> None:
    """Add `light` (electrons) multiplied by a response map (s or c, one value per pixel) to `out`, in place.

    The map is a smooth part, interpolated between `nodes` (grid points), plus independent random pixels drawn with
    `key`. `rms` is the standard deviation of each of the two parts. `up` and `across` are the positions of the rows and
    the columns in units of the distance between two nodes.
    """
    ny, nx = out.shape
    for y in range(ny):
        j = min(int(up[y]), len(nodes) - 2)
        v = up[y] - j
        for x in range(nx):
            i = min(int(across[x]), len(nodes) - 2)
            u = across[x] - i
            low = (1.0 - u) * nodes[j, i] + u * nodes[j, i + 1]
            high = (1.0 - u) * nodes[j + 1, i] + u * nodes[j + 1, i + 1]
            # Bilinear interpolation reduces the variance to 4/9 of that at the nodes, in the mean over pixels. 1.5
            # restores it.
            smooth = 1.5 * ((1.0 - v) * low + v * high)
            out[y, x] += light[y, x] * rms * (smooth + pixel_random.normal(pixel_random.pixel_bits(key, y * nx + x)))


def _components_in_sub_bands(section: str, band: Passband, mission: MissionConfiguration) -> Float:
    """Return the means of the response functions f1 and f2 over each of n sub-bands of a passband, float64[n, 2].

    The functions describe how the quantum efficiency of a pixel varies with wavelength: as 1 + s f1 + c f2, with s and
    c of the pixel. The means are for light with flat f_nu. `section` is the camera's prefix in the mission database.
    """
    parts = sub_bands(band)
    return np.array([_mean(section, part.wavelength, part.response / part.wavelength, mission) for part in parts])


def band_means(section: str, band: Passband, mission: MissionConfiguration) -> Float:
    """Return the means of the response functions f1 (slope) and f2 (curvature) over a band, for light with flat f_nu.

    The functions describe how the quantum efficiency of a pixel varies with wavelength: as 1 + s f1 + c f2.

    Parameters
    ----------
    section : str
        Prefix of the camera's parameters in the mission database, such as "nisp".
    band : Passband
        Passband over which the functions are averaged.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float64 array, shape (2,)
        Means of f1 and f2.
    """
    return np.asarray(np.mean(_components_in_sub_bands(section, band, mission), axis=0))


def sub_band_components(section: str, band: Passband, mission: MissionConfiguration) -> Float:
    """Return the response functions f1 and f2 averaged over each sub-band of a band, minus their means over the band.

    The functions describe how the quantum efficiency of a pixel varies with wavelength: as 1 + s f1 + c f2.

    Parameters
    ----------
    section : str
        Prefix of the camera's parameters in the mission database, such as "nisp".
    band : Passband
        Passband. Its sub-bands are the narrow bands in which the PSF is treated as constant.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float64 array, shape (n, 2)
        Values of f1 (slope) and f2 (curvature) in each of the n sub-bands. Their mean over the sub-bands is 0.
    """
    components = _components_in_sub_bands(section, band, mission)
    return np.asarray(components - np.mean(components, axis=0))


def component_spectra(section: str, wavelength: Float, band: Passband, mission: MissionConfiguration) -> Float:
    """Return the response functions f1 (slope) and f2 (curvature) at given wavelengths, minus their means over a band.

    The functions describe how the quantum efficiency of a pixel varies with wavelength: as 1 + s f1 + c f2.

    Parameters
    ----------
    section : str
        Prefix of the camera's parameters in the mission database, such as "nisp".
    wavelength : float array, shape (w,)
        Wavelengths in Angstrom.
    band : Passband
        Passband over which the means are taken.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float64 array, shape (w, 2)
        Values of f1 and f2 minus their means. Wavelengths outside the range of the database get the value at its end.
    """
    nodes, *components = np.array(mission.numbers(f"{section}.response.components")).T
    values = np.stack([np.interp(1e-4 * wavelength, nodes, f) for f in components], axis=1)
    return np.asarray(values - band_means(section, band, mission))


def colour_of_lines(
    section: str, band: Passband, wavelength: Float, photons: Float, mission: MissionConfiguration
) -> Float:
    """Return the colours F1 and F2 of light that consists of given wavelengths.

    The functions f1 and f2 describe how the quantum efficiency of a pixel varies with wavelength: as 1 + s f1 + c f2. A
    colour is the mean of f1 or f2 over the photons of the light, minus the mean over the band.

    Parameters
    ----------
    section : str
        Prefix of the camera's parameters in the mission database, such as "nisp".
    band : Passband
        Passband of the exposure.
    wavelength : float array, shape (n,)
        Wavelengths of the light in Angstrom.
    photons : float array, shape (n,)
        Photons that the band detects at each wavelength, in arbitrary units. Their sum must not be 0.
    mission : MissionConfiguration
        Mission database.

    Returns
    -------
    float64 array, shape (2,)
        Colours F1 and F2 of the light.
    """
    return np.asarray(_mean(section, wavelength, photons, mission) - band_means(section, band, mission))


def _mean(section: str, wavelength: Float, photons: Float, mission: MissionConfiguration) -> Float:
    nodes, *components = np.array(mission.numbers(f"{section}.response.components")).T
    return np.array([np.average(np.interp(1e-4 * wavelength, nodes, f), weights=photons) for f in components])


def source_colours(shares: Float, components: Float) -> Float:
    """Return the colours F1 and F2 of n sources, float64[n, 2].

    The quantum efficiency of a pixel varies with wavelength as 1 + s f1 + c f2, with s and c of the pixel. A colour is
    the mean of f1 or f2 over the photons of a source, minus the mean over the band.

    `shares` [n, sub-bands] are the fractions of each source's photons in the sub-bands of the passband. `components`
    [sub-bands, 2] are f1 and f2 in the sub-bands minus their means over the band, the result of `sub_band_components`.
    """
    return np.asarray(matrices.matmul(shares, components))


def weighted_light(
    electrons: Float, shares: Float, components: Float, draw: Callable[[Float, Float], Frame]
) -> Float32:
    """Draw two images of sources: one with each photon multiplied by a response function f1, the other by f2.

    The functions describe how the quantum efficiency of a pixel varies with wavelength: as 1 + s f1 + c f2. Their means
    over the band are subtracted.

    Parameters
    ----------
    electrons : float array, shape (n,)
        Electrons of each source.
    shares : float array, shape (n, sub-bands)
        Fractions of each source's photons in the sub-bands of the passband.
    components : float array, shape (sub-bands, 2)
        Response functions f1 and f2 in the sub-bands, minus their means: the result of `sub_band_components`.
    draw : callable
        Function (electrons, shares) that returns an image of the sources, shape (ny, nx). It is only called with
        electrons of 0 or more.

    Returns
    -------
    float32 array, shape (2, ny, nx)
        Light weighted by f1 and by f2 in electrons. Pixels may be negative.

    Notes
    -----
    Blue light is concentrated in the core of the PSF. The weighted light of a pixel therefore depends on the shape of
    the PSF, and not only on the colour of the source.
    """
    drawn = draw(electrons, shares)
    out = np.empty((2, *drawn.shape), np.float32)
    for k in (0, 1):
        # Photons are weighted with a response function minus its mean, which is negative in some sub-bands. `draw` must
        # not get negative light. Therefore the lowest weight is subtracted from all weights before, and the unweighted
        # image times this weight is added afterwards.
        lowest = float(components[:, k].min())
        weighted = shares * (components[:, k] - lowest)
        weight = weighted.sum(axis=1)
        weighted_shares = np.divide(weighted, weight[:, None], out=shares.copy(), where=weight[:, None] > 0.0)
        out[k] = draw(electrons * weight, weighted_shares) + lowest * drawn
    return out


def colour_changes(peak: Float, colours: Float, components: Float, strength: tuple[float, float]) -> Float:
    """Return the largest change of a pixel that the colour of each source causes through the chromatic response.

    Parameters
    ----------
    peak : float array, shape (n,)
        Electrons in the brightest pixel of each of the n sources.
    colours : float array, shape (n, 2)
        Colours F1 and F2 of the sources, the result of `source_colours`.
    components : float array, shape (sub-bands, 2)
        Response functions f1 and f2 in the sub-bands, minus their means: the result of `sub_band_components`.
    strength : (float, float)
        Standard deviations of the maps s and c, which multiply f1 and f2 in each pixel.

    Returns
    -------
    float array, shape (n,)
        Change in electrons rms, for a random pixel response.
    """
    largest = np.abs(colours) + _PSF_COLOUR * components.std(axis=0)
    return np.asarray(peak * np.hypot(*(largest * np.array(strength)).T))


def map_strength(scene: Scene) -> tuple[float, float]:
    """Return the standard deviations of the chromatic response maps s and c of the scene's detector.

    The quantum efficiency of a pixel is multiplied by 1 + s f1 + c f2, with functions f1 and f2 of wavelength.
    """
    return scene.value("response.slope", ""), scene.value("response.curvature", "")


def band_of_scene(scene: Scene) -> Passband:
    """Return the passband of the exposure. An exposure without passband uses the camera's first built-in passband."""
    return scene.band or passbands.load(LAMPS[scene.section][1][0])


def _colour_of_light(scene: Scene, photons: Float) -> Float:
    """Return the colours F1 and F2 of light: means of functions f1 and f2 over its photons, minus those over the band.

    The quantum efficiency of a pixel varies with wavelength as 1 + s f1 + c f2. `photons` are the detected photons at
    each wavelength of the scene's passband, in arbitrary units. Without photons the colours are 0.
    """
    band = band_of_scene(scene)
    if not photons.sum() > 0.0:
        return np.zeros(2)
    return colour_of_lines(scene.section, band, band.wavelength, photons, scene.mission)


def _sky_colour(scene: Scene) -> Float:
    """Return the electrons of the sky per pixel multiplied by its colours F1 and F2; zeros without sky background.

    The colours are the means of the functions f1 and f2 over the photons, minus the means over the band. The quantum
    efficiency of a pixel varies with wavelength as 1 + s f1 + c f2. All light of the sky except thermal emission is
    assumed to have the spectrum of zodiacal light 90 deg from the Sun.
    """
    if not scene.sky_rate > 0.0:
        return np.zeros(2)
    photons = diffuse_light.photons(scene.section, scene.sky_rate, band_of_scene(scene), scene.mission)
    return scene.sky_electrons * _colour_of_light(scene, photons)


def _band_means_of_scene(scene: Scene) -> Float:
    return band_means(scene.section, band_of_scene(scene), scene.mission)


def _change_rms(scene: Scene, light: Float) -> float:
    """Return the rms change of a pixel in electrons if its quantum efficiency is multiplied by 1 + s f1 + c f2.

    s and c are random numbers of the pixel with the standard deviations of the scene's detector. `light`, shape (2,),
    is the sum of f1 and the sum of f2 (functions of wavelength) over the electrons of the pixel.
    """
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
    """Return the rms over pixels of the change of the sky background by the chromatic response, in electrons per pixel.

    The change of the sky remains in a mean of dithered exposures. The changes of sources average out, because each
    exposure has the sources on other pixels.
    """
    return _change_rms(scene, _sky_colour(scene) + scene.sky_electrons * _band_means_of_scene(scene))


def _lamp_colour(scene: Scene) -> Float:
    """Return the electrons per pixel of the calibration lamp multiplied by its colours F1 and F2.

    They are for a pixel with the nominal illumination 1. The colours are the means of the functions f1 and f2 over the
    photons, minus the means over the band. The quantum efficiency of a pixel varies as 1 + s f1 + c f2.
    """
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


# Most of the CPU time of `EFFECT` is spent on drawing sources a second and a third time, with each photon weighted by
# one of the response functions f1 and f2 of wavelength.
EFFECT = Effect("chromatic_response", apply, _parameters, _contribution, fixed=True, systematic=_sky_change, cost=5e-2)
LAMP = Effect(
    "lamp_response", apply, _lamp_parameters, _lamp_change, fixed=True, random_stream=EFFECT.name, cost=1.5e-2
)
