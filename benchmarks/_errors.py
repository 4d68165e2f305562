"""Errors of drawn galaxies: against galsim at its tightest, and of their response to shear."""

from __future__ import annotations

import resource
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from multiprocessing import get_context
from multiprocessing.connection import Connection
from typing import Any, TypeVar

import numpy as np

from benchmarks import _references as references
from benchmarks import _scenes as scenes
from benchmarks._scenes import BINS, Scene
from lake_schema.arrays import Float, Int
from truesky.render.drawing.settings import Settings
from truesky.render.psf import model
from truesky.render.sources import galaxy_shapes
from truesky.render.sources.source_list import Sources

Result = TypeVar("Found")
# galsim asks for more than any machine has where a bulge is steep: bytes of address space.
MEMORY = 4 << 30
# Of the weight under which moments are taken, arcsec; radius of the aperture, arcsec.
WEIGHT_SIGMA, APERTURE_RADIUS = 0.75, 1.0
# Of 90-degree pairs: the shear whose response is measured.
SHEAR = 0.02
# Side of the frames that are compared, pixels.
COMPARED_SIDE = 256
NAMES = ("aperture_mag", "centroid_mas", "r2", "ellipticity", "pixel_sigma")
# No approximation but the stamp, and that the largest.
FULL_SETTINGS = Settings(edge=1e-7, aliased=1e-9, floor=0.0, min_size_arcsec=51.2, positions=9)


def run_with_memory_limit(work: Callable[..., Result], *args: Any) -> Result:
    """work(*args) in a process of its own whose memory is limited; what it is given is shared, not copied."""
    context = get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_send_result, args=(theirs, work, args))
    process.start()
    theirs.close()
    try:
        result: Result = ours.recv()
    except EOFError:
        raise RuntimeError(f"{work.__name__} failed in its process") from None
    process.join()
    return result


def _send_result(out: Connection, work: Callable[..., Any], args: tuple[Any, ...]) -> None:
    _limit_memory()
    out.send(work(*args))


def _limit_memory() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


def measure_image(image: Float, scale: float, x: float, y: float) -> Float:
    """Aperture flux; centroid in arcsec; R2 in arcsec2; e1, e2, under a Gaussian weight about the true place."""
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    dx, dy = (columns - x) * scale, (rows - y) * scale
    r2 = dx**2 + dy**2
    weighted = image * np.exp(-0.5 * r2 / WEIGHT_SIGMA**2)
    total = weighted.sum()
    xx, yy, xy = ((weighted * a).sum() / total for a in (dx * dx, dy * dy, dx * dy))
    aperture = image[r2 < APERTURE_RADIUS**2].sum()
    centroid = (weighted * dx).sum() / total, (weighted * dy).sum() / total
    return np.array([aperture, *centroid, xx + yy, (xx - yy) / (xx + yy), 2 * xy / (xx + yy)])


def errors(image: Float, truth: Float, scene: Scene, source: Sources) -> Float:
    """NAMES: aperture mag, centroid mas, dR2 / R2, ellipticity, largest pixel in sigma."""
    position = float(source.column[0]), float(source.row[0])
    ours, theirs = measure_image(image, scene.scale, *position), measure_image(truth, scene.scale, *position)
    return np.array(
        [
            abs(2.5 * np.log10(ours[0] / theirs[0])),
            1e3 * np.hypot(*(ours - theirs)[1:3]),
            abs(ours[3] / theirs[3] - 1),
            np.hypot(*(ours - theirs)[4:6]),
            np.abs(image - truth).max() / scene.noise,
        ]
    )


def against_galsim(scene: Scene, tiers: Mapping[str, Settings], seed: int, n: int) -> tuple[dict[str, Float], Int, int]:
    """(errors [m, 5] of each of the settings, magnitude bins [m], galaxies that galsim refused)."""
    sources, full_psf = scenes.sample(scene, seed, n), scenes.scene_psf(scene)
    out: dict[str, list[Float]] = {name: [] for name in tiers}
    bins, refused = [], 0
    for i, b in enumerate(scenes.magnitude_bins(sources, scene)):
        source, source_psf = (
            scenes.centred_source(sources, i, COMPARED_SIDE),
            scenes.psf_of_source(full_psf, sources, i),
        )
        truth = references.reference_image(source, source_psf, COMPARED_SIDE)
        if truth is None:
            refused += 1
            continue
        bins.append(b)
        for name, settings in tiers.items():
            out[name].append(
                errors(scenes.draw_sources(source, source_psf, scene, settings, COMPARED_SIDE), truth, scene, source)
            )
    return {name: np.array(rows) for name, rows in out.items()}, np.array(bins), refused


def shear_response(
    scene: Scene, tiers: Mapping[str, Settings], seed: int, n: int, g: float = SHEAR
) -> tuple[dict[str, Float], Sources]:
    """Errors (m, c) [n, 2] of each of the settings and the galaxies: 90-degree pairs under +-g, noise-free.

    The truth is the same galaxy through the same PSF on the largest stamp (FULL); |m| <= 1e-5 of galsim's.
    """
    sources, full_psf = scenes.sample(scene, seed, n), scenes.scene_psf(scene)
    out: dict[str, list[tuple[float, float]]] = {name: [] for name in tiers}
    for i in range(len(sources)):
        source_psf, source = (
            scenes.psf_of_source(full_psf, sources, i),
            scenes.centred_source(sources, i, 2 * COMPARED_SIDE),
        )
        truth = response(make_drawer(source_psf, scene, FULL_SETTINGS), source, scene.scale, g)
        for name, settings in tiers.items():
            out[name].append(bias(response(make_drawer(source_psf, scene, settings), source, scene.scale, g), truth))
    return {name: np.array(rows) for name, rows in out.items()}, sources


def make_drawer(psf: model.Psf, scene: Scene, settings: Settings) -> Callable[[Sources], Float]:
    """A way to draw a galaxy: ours, on a frame of twice COMPARED."""
    return lambda source: scenes.draw_sources(source, psf, scene, settings, 2 * COMPARED_SIDE)


def response(draw: Callable[[Sources], Float], source: Sources, scale: float, g: float = SHEAR) -> Float:
    """(de1 / dg1, de2 / dg2, mean e1, mean e2) of a galaxy and the same turned by 90 degrees, under +-g.

    draw  : any way to draw a galaxy, free of noise
    one   : where it stands on the drawing, and its shapes, whose own shear gives way;  scale : arcsec a pixel
    """
    slopes, means = np.zeros(2), np.zeros(2)
    for turn in (0.0, np.pi / 2):
        for component in (0, 1):
            for sheared in (-g, g):
                shapes = source.shapes.take(source.shape)
                shears = [np.array([sheared if k == component else 0.0]) for k in (0, 1)]
                shapes = replace(shapes, g1=shears[0], g2=shears[1], beta=shapes.beta + turn)
                image = draw(replace(source, shapes=shapes, shape=np.zeros(1, np.int64)))
                e = measure_image(image, scale, float(source.column[0]), float(source.row[0]))[4:6]
                slopes[component] += 0.25 * e[component] / sheared
                means += 0.125 * e
    return np.concatenate([slopes, means])


def bias(measured: Float, truth: Float) -> tuple[float, float]:
    """(m, c) of a response against the true one: of the two components the worse, with its sign."""
    m, c = measured[:2] / truth[:2] - 1, measured[2:] - truth[2:]
    return float(m[np.argmax(np.abs(m))]), float(c[np.argmax(np.abs(c))])


def worst_by_group(biases: Float, sources: Sources, scene: Scene) -> dict[str, tuple[int, float, float]]:
    """Largest |m| and |c| of biases [n, 2], with the number of galaxies: by magnitude, size and index of the bulge."""
    shapes = sources.shapes.take(sources.shape)
    size, index = galaxy_shapes.half_light(shapes), np.where(shapes.bulge_fraction > 0, shapes.sersic_index, 1.0)
    groups = (
        ("m", scenes.magnitudes(sources, scene), BINS),
        ("r", size, (0.0, 0.2, 0.4, 0.8, np.inf)),
        ("n", index, (0.0, 1.5, 2.5, 4.0, np.inf)),
    )
    out = {}
    for name, values, edges in groups:
        for low, high in pairwise(edges):
            in_bin = (values >= low) & (values < high)
            if in_bin.any():
                m, c = np.abs(biases[in_bin]).max(axis=0)
                out[f"{name} {low:g}-{high:g}"] = int(in_bin.sum()), float(m), float(c)
    return out


def figures(error_values: Float) -> dict[str, float]:
    """rms and worst of errors [n, 5]."""
    rms, worst = np.sqrt((error_values**2).mean(axis=0)), error_values.max(axis=0)
    named = zip(NAMES, rms, worst, strict=True)
    return {key: float(value) for name, a, b in named for key, value in ((f"{name}_rms", a), (f"{name}_worst", b))}


def figures_by_bin(error_values: Float, bins: Int) -> dict[str, float]:
    """`figures` of each magnitude bin: their keys end in the bin's bright edge."""
    return {
        f"{key}_m{BINS[b]:.0f}": value
        for b in np.unique(bins)
        for key, value in figures(error_values[bins == b]).items()
    }


def print_table(title: str, error_values: Float, bins: Int) -> None:
    """Prints rms / worst of errors by magnitude bin."""
    print(f"{title:24}" + "".join(f"{name:>20}" for name in NAMES))
    rows = [(f"m {BINS[b]:.0f}-{BINS[b + 1]:.0f}", error_values[bins == b]) for b in range(len(BINS) - 1)]
    for label, bin_errors in [*rows, ("all", error_values)]:
        if len(bin_errors):
            rms, worst = np.sqrt((bin_errors**2).mean(axis=0)), bin_errors.max(axis=0)
            cells = "".join(f"{a:>10.1e}/{b:<9.1e}" for a, b in zip(rms, worst, strict=True))
            print(f"  {label:12}{len(bin_errors):>6}    {cells}")
