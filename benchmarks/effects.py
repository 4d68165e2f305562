"""Measure the instrumental effects of VIS (such as cosmic rays): CPU time, changes of pixels, and changes of sources.

The time and the changes of pixels are measured on a full detector with an artificial sky of points and squares. Each
effect acts on the result of the effects before it. Changes of magnitude, size and ellipticity are measured on a
standard set of stars and galaxies.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks import _scenes, report
from lake_schema.mission.configuration import resolve
from truesky.fluxes import passbands
from truesky.randomness.rng import stream
from truesky.render.camera import detectors
from truesky.render.camera.detectors import Detector
from truesky.render.channels import vis
from truesky.render.drawing import stamps
from truesky.render.effects.charge import cosmic_rays
from truesky.render.effects.effect import Effect
from truesky.render.effects.light import ghosts
from truesky.render.effects.readout import quadrants, readout_cosmic_rays
from truesky.render.effects.scene import Frame, Lights, Scene
from truesky.render.psf import euclid, model, sub_bands
from truesky.render.sources.galaxy_shapes import Shapes
from truesky.render.sources.source_list import Sources

# Number of squares of 7 x 7 pixels (galaxies) on a full detector.
_SOURCES = 30_000
# Number of points (stars) on a full detector.
_STARS = 200
# Electrons of the bright star whose ghost falls on the detector.
_LIGHT = 1e9
# Exposure time, s.
_EXPOSURE = 560.53
# Sky background, electrons per s and pixel.
_SKY = 0.25
# Magnitude of a source of 1 electron per s.
_ZERO_POINT = 25.93
# Standard set of sources: magnitude of the stars, magnitude of the galaxies, and half-light radius of the galaxies'
# exponential disc (arcsec).
_STAR, _GALAXY, _RADIUS = 19.0, 22.5, 0.3
# Distance between the sources of the standard set, and width and height of their stamps, pixels.
_SPACING, _STAMP = 64, 64
# Radius of the aperture in which fluxes are measured, arcsec.
APERTURE = 1.3


def draw_light(ny: int, nx: int) -> Frame:
    """Return an image [ny, nx] of expected electrons with random points and squares of 7 x 7 pixels.

    Their number is proportional to the area of the image.
    """
    rng = np.random.default_rng(1)
    frame = np.zeros((ny, nx))
    share = ny * nx / (_scenes.VIS.nx * _scenes.VIS.ny)
    for electrons in 10.0 ** rng.uniform(1.0, 4.0, int(_SOURCES * share)):
        x, y = rng.integers(4, nx - 4), rng.integers(4, ny - 4)
        frame[y - 3 : y + 4, x - 3 : x + 4] += electrons / 49.0
    for electrons in 10.0 ** rng.uniform(4.0, 6.5, int(_STARS * share)):
        frame[rng.integers(0, ny), rng.integers(0, nx)] += electrons
    return frame


def measure_effects(side: int | None, repeats: int) -> dict[str, float]:
    """Measure each effect of VIS: CPU time per detector, and rms and largest change of a pixel in units of its noise.

    The result also contains the margin of each effect: its estimated size divided by the size below which an image is
    rendered without it. `side` is the width and height of the detector in pixels; None means its real size. The
    shortest time of `repeats` measurements counts.
    """
    mission = resolve()
    detector = detectors.detector("vis", "3-4", mission)
    if side is not None:
        detector = type(detector)("3-4", "vis", side, side, detector.x, detector.y, 0.0, detector.pixel_scale)
    frame = draw_light(detector.ny, detector.nx)
    scene = Scene(mission, "vis", _EXPOSURE, _SKY, float(frame.max()), detector)
    # Place the bright star so that its ghost falls into the middle of the detector.
    middle = Lights(*(np.array([at]) for at in (0.5 * detector.nx, 0.5 * detector.ny, _LIGHT)))
    columns, rows = ghosts.offset(scene, "ghost", 1, middle)
    scene = replace(scene, lights=replace(middle, column=middle.column - columns, row=middle.row - rows))
    out: dict[str, float] = {}
    for effect in vis.SKY:
        frame = _measure_effect(effect, frame, scene, repeats, out)
    assembled = quadrants.assemble(frame, *quadrants.overscan_sizes(scene))
    out["all_s"] = sum(value for key, value in out.items() if key.endswith("_s"))
    out["mean_adu"] = float(assembled.mean())
    # Measure also the effects that science images do not have. Effects on flats act on the image without other
    # effects. Effects on trap-pumping images act on an empty image, one after another.
    light_alone = draw_light(detector.ny, detector.nx)
    for effect in vis.FLAT:
        if effect not in vis.SKY:
            _measure_effect(effect, light_alone, scene, repeats, out)
    filled = np.zeros_like(light_alone)
    for effect in vis.PUMPING:
        if effect not in vis.SKY:
            filled = _measure_effect(effect, filled, scene, repeats, out)
    return out


def _measure_effect(effect: Effect, frame: Frame, scene: Scene, repeats: int, out: dict[str, float]) -> Frame:
    """Apply an effect, add its CPU time, margin and changes of pixels to `out`, and return the new image.

    The margin is the estimated size of the effect divided by the size below which an image is rendered without it.
    """
    parameters = effect.parameters(scene)
    result = effect.apply(frame, *parameters, rng=stream(1, effect.name))
    apply_effect = partial(effect.apply, frame, *parameters, rng=stream(1, effect.name))
    out[f"{effect.name}_s"] = report.best_time(apply_effect, repeats, time.process_time)
    out[f"{effect.name}_margin"] = effect.margin(scene)
    if result.shape == frame.shape and effect.name != "adc":
        _add_change(effect.name, result - frame, scene, out)
    return result


def _add_change(name: str, change: Frame, scene: Scene, out: dict[str, float]) -> None:
    """Add the rms and the largest change of a pixel, in units of its noise, to `out`; `name` is the effect's name."""
    out[f"{name}_rms_sigma"] = float(np.sqrt(np.mean(change**2))) / scene.pixel_noise
    out[f"{name}_largest_sigma"] = float(np.abs(change).max()) / scene.pixel_noise


def standard_sources(detector: Detector, spacing: int) -> Sources:
    """Return the standard set of sources: stars and round exponential galaxies in turn, on a square lattice.

    The distance between neighbours is `spacing` pixels, plus random fractions of a pixel.
    """
    rng = np.random.default_rng(2)
    middle = [np.arange(spacing / 2, n - spacing / 2 + 1, spacing) for n in (detector.nx, detector.ny)]
    column, row = (axis.ravel() for axis in np.meshgrid(*middle))
    n = len(column)
    is_star, ones, zeros = np.arange(n) % 2 == 0, np.ones(1), np.zeros(1)
    light = _EXPOSURE * 10.0 ** (0.4 * (_ZERO_POINT - np.where(is_star, _STAR, _GALAXY)))
    disc = Shapes(ones, ones * _RADIUS, zeros, ones, ones, zeros, zeros, zeros, zeros, ones)
    jacobian = np.tile(detector.pixel_scale * np.eye(2), (n, 1, 1))
    shift = rng.uniform(-0.5, 0.5, (2, n))
    return Sources(
        np.arange(n), column + shift[0], row + shift[1], jacobian, light, np.where(is_star, -1, 0), disc,
        np.full((n, sub_bands.N_SUB_BANDS), 1.0 / sub_bands.N_SUB_BANDS),
    )  # fmt: skip


def measure_shapes(frame: Frame, sources: Sources, radius: float = APERTURE, scale: float = 0.1) -> Frame:
    """Measure the flux, size and ellipticity of each source on an image.

    Parameters
    ----------
    frame : float array, shape (ny, nx)
        Image in any unit.
    sources : Sources
        The sources.
    radius : float, optional
        Radius of the aperture, in arcsec.
    scale : float, optional
        Pixel scale in arcsec.

    Returns
    -------
    float array, shape (n, 4)
        Flux in the aperture (the mean of the surroundings is subtracted), R^2 (arcsec2), e1 and e2. R^2 and the
        ellipticity have a Gaussian weight with a sigma of 0.75 arcsec.
    """
    half, out = round(2.0 * radius / scale), []
    for x, y in zip(sources.column, sources.row, strict=True):
        x0, y0 = max(round(x) - half, 0), max(round(y) - half, 0)
        cutout = frame[y0 : y0 + 2 * half + 1, x0 : x0 + 2 * half + 1]
        rows, columns = np.mgrid[: cutout.shape[0], : cutout.shape[1]]
        dx, dy = (columns - (x - x0)) * scale, (rows - (y - y0)) * scale
        distance = np.hypot(dx, dy)
        # Subtract the mean of the surroundings and not the median, because a median of counts is a whole number.
        cutout = cutout - cutout[distance > 1.5 * radius].mean()
        weighted = cutout * np.exp(-0.5 * (distance / 0.75) ** 2)
        xx, yy, xy = ((weighted * a).sum() / weighted.sum() for a in (dx * dx, dy * dy, dx * dy))
        out.append([cutout[distance < radius].sum(), xx + yy, (xx - yy) / (xx + yy), 2 * xy / (xx + yy)])
    return np.array(out)


def effect_changes(scene: Scene, sources: Sources, frame: Frame, radius: float = APERTURE) -> dict[str, Frame]:
    """Measure how each effect of VIS changes the magnitude, size and ellipticity of each source.

    The conversion to digital units is left out, and so are cosmic rays, because they hit only some sources.

    Parameters
    ----------
    scene : Scene
        Description of the exposure from which the effects take their parameters.
    sources : Sources
        The sources.
    frame : float array, shape (ny, nx)
        Expected electrons of the sources per pixel.
    radius : float, optional
        Radius of the aperture, in arcsec.

    Returns
    -------
    dict of str to float array, shape (n, 4)
        Change of magnitude, dR^2 / R^2, de1 and de2 of each source, by name of the effect.
    """
    out: dict[str, Frame] = {}
    sizes = quadrants.overscan_sizes(scene)
    previous_shapes = measure_shapes(frame, sources, radius)
    for effect in vis.SKY[:-1]:
        if effect in (cosmic_rays.EFFECT, readout_cosmic_rays.READOUT):
            continue
        frame = effect.apply(frame, *effect.parameters(scene), rng=stream(1, effect.name))
        new_shapes = measure_shapes(frame if frame.ndim == 2 else quadrants.assemble(frame, *sizes), sources, radius)
        out[effect.name] = _shape_differences(previous_shapes, new_shapes)
        previous_shapes = new_shapes
    return out


def median_changes(side: int | None, repeats: int) -> dict[str, float]:
    """Return the median changes of stars and of galaxies of the standard set by each effect of VIS.

    For each effect the result contains the changes of magnitude, of size (dR^2 / R^2), and of shear (half of the change
    of ellipticity). `side` is the width and height of the detector in pixels; None means its real size.
    """
    mission = resolve()
    detector = detectors.detector("vis", "3-4", mission)
    detector = detector if side is None else replace(detector, nx=side, ny=side)
    sources = standard_sources(detector, _SPACING)
    psf = euclid.vis_psf(detector, passbands.load("euclid_vis"), mission)
    light = stamps.draw(sources, np.full(len(sources), _STAMP), psf, detector.nx, detector.ny)
    lights = Lights(np.array([100.0]), np.array([100.0]), np.array([_LIGHT]))
    scene = Scene(mission, "vis", _EXPOSURE, _SKY, float(light.max()), detector, lights)
    out: dict[str, float] = {}
    drawing_change = _measure_drawing(sources, psf, light, scene, repeats, out)
    for name, change in {vis.TRANSFER_EFFECT.name: drawing_change, **effect_changes(scene, sources, light)}.items():
        for kind, in_class in (("star", sources.shape < 0), ("galaxy", sources.shape >= 0)):
            mag, size, e1, e2 = np.nanmedian(change[in_class], axis=0)
            out[f"{name}_{kind}_mag"], out[f"{name}_{kind}_size"] = float(mag), float(size)
            out[f"{name}_{kind}_shear"] = float(np.hypot(e1, e2)) / 2
    return out


def _measure_drawing(
    sources: Sources, psf: model.Psf, light: Frame, scene: Scene, repeats: int, out: dict[str, float]
) -> Frame:  # fmt: skip
    """Measure the one effect of VIS (varying sensitivity within a pixel) that is applied while sources are drawn.

    Its additional CPU time, margin and changes of pixels are added to `out`. The margin is the estimated size of the
    effect divided by the size below which an image is rendered without it. Return the changes of magnitude, size and
    ellipticity of each source [n, 4]. `light` is the image without this effect.
    """
    (strength,) = vis.TRANSFER_EFFECT.parameters(scene)
    sizes, (ny, nx) = np.full(len(sources), _STAMP), light.shape
    draw_with, draw_without = (
        partial(stamps.draw, sources, sizes, psf_variant, nx, ny)
        for psf_variant in (replace(psf, intra_pixel=strength), psf)
    )
    extra_s = report.best_time(draw_with, repeats, time.process_time) - report.best_time(
        draw_without, repeats, time.process_time
    )
    # The difference of the two times can be negative if it is smaller than their scatter.
    out[f"{vis.TRANSFER_EFFECT.name}_s"] = max(extra_s, 0.0)
    out[f"{vis.TRANSFER_EFFECT.name}_margin"] = vis.TRANSFER_EFFECT.margin(scene)
    drawn = draw_with()
    _add_change(vis.TRANSFER_EFFECT.name, drawn - light, scene, out)
    return _shape_differences(measure_shapes(light, sources), measure_shapes(drawn, sources))


def _shape_differences(previous_shapes: Frame, new_shapes: Frame) -> Frame:
    """Return the differences between two results of `measure_shapes`: magnitude, dR^2 / R^2, de1, de2 [n, 4]."""
    ratio = new_shapes[:, :2] / previous_shapes[:, :2]
    return np.column_stack([-2.5 * np.log10(ratio[:, 0]), ratio[:, 1] - 1, new_shapes[:, 2:] - previous_shapes[:, 2:]])


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark with the options `argv` (default: the command line), print the results, return 0."""
    options = report.options("effects", __doc__ or "", argv)
    side = 512 if options.quick else None
    repeats = 1 if options.quick else 3
    figures = measure_effects(side, repeats) | median_changes(side, repeats)
    report.print_and_write("effects", repeats, figures, {"all_s": "CPU, every effect of a science image"}, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
