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

Found = TypeVar("Found")
# galsim asks for more than any machine has where a bulge is steep: bytes of address space.
MEMORY = 4 << 30
# Of the weight under which moments are taken, arcsec; radius of the aperture, arcsec.
WEIGHT, APERTURE = 0.75, 1.0
# Of 90-degree pairs: the shear whose response is measured.
SHEAR = 0.02
# Side of the frames that are compared, pixels.
COMPARED = 256
NAMES = ("aperture_mag", "centroid_mas", "r2", "ellipticity", "pixel_sigma")
# No approximation but the stamp, and that the largest.
FULL = Settings(edge=1e-7, aliased=1e-9, floor=0.0, least=51.2, positions=9)


def capped(work: Callable[..., Found], *args: Any) -> Found:
    """work(*args) in a process of its own whose memory is limited; what it is given is shared, not copied."""
    context = get_context("fork")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_report, args=(theirs, work, args))
    process.start()
    theirs.close()
    try:
        found: Found = ours.recv()
    except EOFError:
        raise RuntimeError(f"{work.__name__} failed in its process") from None
    process.join()
    return found


def _report(out: Connection, work: Callable[..., Any], args: tuple[Any, ...]) -> None:
    _cap()
    out.send(work(*args))


def _cap() -> None:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))


def measured(image: Float, scale: float, x: float, y: float) -> Float:
    """Aperture flux; centroid in arcsec; R2 in arcsec2; e1, e2, under a Gaussian weight about the true place."""
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    dx, dy = (columns - x) * scale, (rows - y) * scale
    r2 = dx**2 + dy**2
    weighted = image * np.exp(-0.5 * r2 / WEIGHT**2)
    total = weighted.sum()
    xx, yy, xy = ((weighted * a).sum() / total for a in (dx * dx, dy * dy, dx * dy))
    aperture = image[r2 < APERTURE**2].sum()
    centroid = (weighted * dx).sum() / total, (weighted * dy).sum() / total
    return np.array([aperture, *centroid, xx + yy, (xx - yy) / (xx + yy), 2 * xy / (xx + yy)])


def errors(image: Float, truth: Float, scene: Scene, one: Sources) -> Float:
    """NAMES: aperture mag, centroid mas, dR2 / R2, ellipticity, largest pixel in sigma."""
    at = float(one.column[0]), float(one.row[0])
    ours, theirs = measured(image, scene.scale, *at), measured(truth, scene.scale, *at)
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
    some, full = scenes.sample(scene, seed, n), scenes.psf_of(scene)
    out: dict[str, list[Float]] = {name: [] for name in tiers}
    bins, refused = [], 0
    for i, b in enumerate(scenes.bins_of(some, scene)):
        one, mine = scenes.moved(some, i, COMPARED), scenes.own(full, some, i)
        truth = references.image(one, mine, COMPARED)
        if truth is None:
            refused += 1
            continue
        bins.append(b)
        for name, settings in tiers.items():
            out[name].append(errors(scenes.draw(one, mine, scene, settings, COMPARED), truth, scene, one))
    return {name: np.array(rows) for name, rows in out.items()}, np.array(bins), refused


def shear_response(
    scene: Scene, tiers: Mapping[str, Settings], seed: int, n: int, g: float = SHEAR
) -> tuple[dict[str, Float], Sources]:
    """Errors (m, c) [n, 2] of each of the settings and the galaxies: 90-degree pairs under +-g, noise-free.

    The truth is the same galaxy through the same PSF on the largest stamp (FULL); |m| <= 1e-5 of galsim's.
    """
    some, full = scenes.sample(scene, seed, n), scenes.psf_of(scene)
    out: dict[str, list[tuple[float, float]]] = {name: [] for name in tiers}
    for i in range(len(some)):
        mine, one = scenes.own(full, some, i), scenes.moved(some, i, 2 * COMPARED)
        truth = response(drawing(mine, scene, FULL), one, scene.scale, g)
        for name, settings in tiers.items():
            out[name].append(bias(response(drawing(mine, scene, settings), one, scene.scale, g), truth))
    return {name: np.array(rows) for name, rows in out.items()}, some


def drawing(psf: model.Psf, scene: Scene, settings: Settings) -> Callable[[Sources], Float]:
    """A way to draw a galaxy: ours, on a frame of twice COMPARED."""
    return lambda one: scenes.draw(one, psf, scene, settings, 2 * COMPARED)


def response(draw: Callable[[Sources], Float], one: Sources, scale: float, g: float = SHEAR) -> Float:
    """(de1 / dg1, de2 / dg2, mean e1, mean e2) of a galaxy and the same turned by 90 degrees, under +-g.

    draw  : any way to draw a galaxy, free of noise
    one   : where it stands on the drawing, and its shapes, whose own shear gives way;  scale : arcsec a pixel
    """
    slopes, means = np.zeros(2), np.zeros(2)
    for turn in (0.0, np.pi / 2):
        for component in (0, 1):
            for sheared in (-g, g):
                shapes = one.shapes.take(one.shape)
                both = [np.array([sheared if k == component else 0.0]) for k in (0, 1)]
                shapes = replace(shapes, g1=both[0], g2=both[1], beta=shapes.beta + turn)
                image = draw(replace(one, shapes=shapes, shape=np.zeros(1, np.int64)))
                e = measured(image, scale, float(one.column[0]), float(one.row[0]))[4:6]
                slopes[component] += 0.25 * e[component] / sheared
                means += 0.125 * e
    return np.concatenate([slopes, means])


def bias(found: Float, truth: Float) -> tuple[float, float]:
    """(m, c) of a response against the true one: of the two components the worse, with its sign."""
    m, c = found[:2] / truth[:2] - 1, found[2:] - truth[2:]
    return float(m[np.argmax(np.abs(m))]), float(c[np.argmax(np.abs(c))])


def worst_by_kind(biases: Float, some: Sources, scene: Scene) -> dict[str, tuple[int, float, float]]:
    """Largest |m| and |c| of biases [n, 2], with the number of galaxies: by magnitude, size and index of the bulge."""
    shapes = some.shapes.take(some.shape)
    size, index = galaxy_shapes.half_light(shapes), np.where(shapes.bulge_fraction > 0, shapes.sersic_index, 1.0)
    kinds = (
        ("m", scenes.magnitudes(some, scene), BINS),
        ("r", size, (0.0, 0.2, 0.4, 0.8, np.inf)),
        ("n", index, (0.0, 1.5, 2.5, 4.0, np.inf)),
    )
    out = {}
    for name, values, edges in kinds:
        for low, high in pairwise(edges):
            here = (values >= low) & (values < high)
            if here.any():
                m, c = np.abs(biases[here]).max(axis=0)
                out[f"{name} {low:g}-{high:g}"] = int(here.sum()), float(m), float(c)
    return out


def figures(found: Float) -> dict[str, float]:
    """rms and worst of errors [n, 5]."""
    rms, worst = np.sqrt((found**2).mean(axis=0)), found.max(axis=0)
    named = zip(NAMES, rms, worst, strict=True)
    return {key: float(value) for name, a, b in named for key, value in ((f"{name}_rms", a), (f"{name}_worst", b))}


def by_bin(found: Float, bins: Int) -> dict[str, float]:
    """`figures` of each magnitude bin: their keys end in the bin's bright edge."""
    return {f"{key}_m{BINS[b]:.0f}": value for b in np.unique(bins) for key, value in figures(found[bins == b]).items()}


def table(title: str, found: Float, bins: Int) -> None:
    """Prints rms / worst of errors by magnitude bin."""
    print(f"{title:24}" + "".join(f"{name:>20}" for name in NAMES))
    rows = [(f"m {BINS[b]:.0f}-{BINS[b + 1]:.0f}", found[bins == b]) for b in range(len(BINS) - 1)]
    for label, some in [*rows, ("all", found)]:
        if len(some):
            rms, worst = np.sqrt((some**2).mean(axis=0)), some.max(axis=0)
            cells = "".join(f"{a:>10.1e}/{b:<9.1e}" for a, b in zip(rms, worst, strict=True))
            print(f"  {label:12}{len(some):>6}    {cells}")
