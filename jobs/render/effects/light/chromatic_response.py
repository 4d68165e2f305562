"""Chromatic response: how a pixel's quantum efficiency departs, with the wavelength, from that of all pixels.

The efficiency of pixel p is that of the passband times

    1 + s_p f1(lambda) + c_p f2(lambda)

beside its grey part, which is `pixel_response`.  The mission database has f1, a slope, and f2, a curvature, by
wavelength; s and c are maps of the detector, each the sum of a smooth map and of one from pixel to pixel.  Light whose
photons have the shares w in wavelengths meets F = sum w f, told from that of flat f_nu, which is in the grey part.
Sources are drawn three times: as they are, and with each photon times f1, and times f2.

maps       s and c of a detector
table      f1 and f2 in the parts of a band
colours    F1 and F2 of lights;  of_lines : of light at given wavelengths
planes     the light of sources, drawn three times;  seen : what the pixels see of it
largest    the most that the colours of sources change
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from jobs import sums
from jobs.compiling import jit
from jobs.fluxes.passbands import Passband
from jobs.render.effects import pixel_random
from jobs.render.effects.scene import Frame
from jobs.render.psf.sub_bands import sub_bands
from lake_schema.arrays import Float
from lake_schema.errors import OutOfRange
from lake_schema.mission.configuration import MissionConfiguration

# Nodes of a smooth map along a side of the detector; between them it is bilinear.
_NODES = 9


def maps(shape: tuple[int, int], slope: float, curvature: float, rng: np.random.Generator) -> Frame:
    """float64[2, ny, nx]: s and c of every pixel, normally distributed; half of their variance is of the smooth map.

    shape : ny, nx;  slope, curvature : rms of s and c
    rng   : random numbers of the detector's pixels
    """
    for name, value in (("slope", slope), ("curvature", curvature)):
        if not 0.0 <= value <= 0.5:
            raise OutOfRange(f"chromatic response, {name}", value, 0.0, 0.5)
    out = np.empty((2, *shape))
    ends = [np.linspace(0.0, _NODES - 1.0, max(n, 2))[:n] for n in shape]
    for plane, rms in zip(out, (slope, curvature), strict=True):
        nodes = rng.standard_normal((_NODES, _NODES))
        # To the mean and the rms that are asked for, of so few numbers.
        nodes = (nodes - nodes.mean()) / nodes.std()
        _fill(plane, nodes, ends[0], ends[1], rms * np.sqrt(0.5), pixel_random.key(rng))
    return out


@jit
def _fill(plane: Any, nodes: Any, up: Any, across: Any, rms: float, key: Any) -> None:
    ny, nx = plane.shape
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
            plane[y, x] = rms * (smooth + pixel_random.normal(pixel_random.word(key, y * nx + x)))


def table(section: str, band: Passband, mission: MissionConfiguration) -> Float:
    """float64[PARTS, 2]: f1 and f2 in the parts of a band, told from their means over it.

    section, mission : of the camera in the mission database;  band : a passband
    """
    parts = sub_bands(band)
    found = [_mean(section, part.wavelength, part.response / part.wavelength, mission) for part in parts]
    return np.asarray(np.array(found) - np.mean(found, axis=0))


def of_lines(section: str, band: Passband, wavelength: Float, photons: Float, mission: MissionConfiguration) -> Float:
    """float64[2]: F1 and F2 of light of which a band detects `photons` [n] at wavelengths [n] A, as of `colours`.

    section, mission    : of the camera in the mission database;  band : a passband
    wavelength, photons : of the light
    """
    parts = sub_bands(band)
    even = [_mean(section, part.wavelength, part.response / part.wavelength, mission) for part in parts]
    return np.asarray(_mean(section, wavelength, photons, mission) - np.mean(even, axis=0))


def _mean(section: str, wavelength: Float, photons: Float, mission: MissionConfiguration) -> Float:
    nodes, *components = np.array(mission.numbers(f"{section}.response.components")).T
    return np.array([np.average(np.interp(1e-4 * wavelength, nodes, f), weights=photons) for f in components])


def colours(shares: Float, components: Float) -> Float:
    """float64[n, 2]: F1 and F2 of lights.

    shares : [n, PARTS] of their photons in the parts of a band;  components : of `table`
    """
    return np.asarray(sums.product(shares, components))


def planes(
    drawn: Frame, electrons: Float, shares: Float, components: Float, draw: Callable[[Float, Float], Frame]
) -> Frame:
    """float64[3, ny, nx]: the light of sources, and each photon of it times f1, and times f2.

    Blue light is concentrated in the middle of the PSF: what two colours change of a pixel is not the colour of the
    source alone.
    drawn     : [ny, nx] their light;  electrons : [n] of each
    shares, components : as of `colours`
    draw      : (electrons, 0 or more, and shares of sources) -> [ny, nx] their light
    """
    out = np.empty((3, *drawn.shape))
    out[0] = drawn
    for k in (0, 1):
        # No part has less than no light.
        least = float(components[:, k].min())
        weighted = shares * (components[:, k] - least)
        part = weighted.sum(axis=1)
        own = np.divide(weighted, part[:, None], out=shares.copy(), where=part[:, None] > 0.0)
        out[1 + k] = draw(electrons * part, own) + least * drawn
    return out


def seen(light: Frame, response: Frame) -> Frame:
    """Three planes of light e- -> [ny, nx] what pixels of these maps see of it; response : of `maps`."""
    return np.asarray(light[0] + response[0] * light[1] + response[1] * light[2])


def largest(peak: Float, own: Float, slope: float, curvature: float) -> float:
    """The most that the colours of sources change in a pixel, e- rms, without what the PSF's own colour adds to it.

    peak  : [n] e- in the brightest pixel of each;  own : [n, 2] of `colours`
    slope, curvature : rms of the maps
    """
    change = np.hypot(slope * own[:, 0], curvature * own[:, 1])
    return float((peak * change).max(initial=0.0))
