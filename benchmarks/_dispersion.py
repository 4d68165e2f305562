"""What the settings of dispersing cost and how wrong they are: of one sample they were chosen on, and of another.

Galaxies and stars in an order of the red grism, continuum and a line, one by one, against the slow way: every sample of
the trace in rows and with a PSF of its own, on large, fine stamps through a PSF of more wavelengths.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from benchmarks import _scenes as scenes
from benchmarks import report
from benchmarks._scenes import NISP
from lake_schema.arrays import Float, Float32
from lake_schema.mission.configuration import resolve
from truesky.fluxes import passbands
from truesky.render.camera import detectors, traces
from truesky.render.dispersing import draw, images
from truesky.render.dispersing.draw import Dispersed, Order, Settings
from truesky.render.psf import euclid
from truesky.render.psf.model import Psf
from truesky.render.sources.source_list import Sources

# Electrons a pixel, of the sky of an exposure through the red grism.
NOISE = 28.0
# The largest of each, and by which the table is ordered.
NUMBERS = ("background", "flux", "position")
# Sources of a sample, their seeds; those that are timed.
CHOSEN, HELD, _SEEDS, _TIMED, _TIMED_SEED = 18, 36, (41, 42), 400, 43
# All of their light is in one order and one row of tilts, deg.
_TILTS = (0.0, 4.0, -4.0)
# H_E of the brightest and of the faintest, electrons of magnitude 0: zero point 25.3 and 549 s.
_BRIGHT, _FAINT, _ZERO = 17.0, 23.0, 549.6 * 10 ** (0.4 * 25.3)
_TRUTH = Settings(edge=1e-5, faint=0.0, least=80, along=4, across=4, block=0.0, nodes=5, positions=9)
# Pixels of the frame, and where the undispersed image lies; half the box about a line; sigma of its weight.
_SHAPE, _PLACE, _BOX, _SIGMA = (128, 720), (270.0, 60.0), (8, 4), 2.0
_HEAD = """\
# Settings of drawing spectra. allowed: the error of a pixel, of its noise, that they are for.
#
# edge, faint: of a sky pixel's noise; least: pixels; along, across: samples a pixel; block: A that share a PSF;
# nodes: wavelengths of the PSF; positions: of the PSF on a detector, one of euclid.DEGREES.
# Then by python -m benchmarks.nisp_s --settings, the largest errors of {chosen} galaxies and stars of
# H_E = {bright:g} to {faint:g} that the settings were chosen on, and (_held) of {held} others, each in a first order
# at a tilt of 0, 4 or -4 deg: background: of a pixel, of its own noise; flux: of a line in {wide} x {high} pixels;
# position: of a line, pixels; against every sample of the trace with a PSF and rows of its own.
# CPU seconds of 7,400 first orders, on {machine}.
"""


@dataclass(frozen=True)
class One:
    """A source alone, its tilt, its continuum and line, and where the line lies, pixels."""

    source: Sources
    tilt: float
    continuum: Float32
    line: Float32
    place: tuple[float, float]


def orders(tilt: float) -> tuple[Order, ...]:
    """The first order of the red grism."""
    mission, band = resolve(), passbands.load("nisp_red")
    first = next(t for t in traces.traces("RGS000", tilt, _detector(), mission) if t.order == 1)
    return (Order(first, int(band.wavelength[0]), band.response * band.wavelength),)


def _detector() -> detectors.Detector:
    return detectors.detector("nisp", "DET22", resolve())


def psf_of(settings: Settings) -> Psf:
    """At the settings' wavelengths and places."""
    trace = orders(0.0)[0].trace
    nodes = images.nodes(trace.first, trace.last, settings.nodes)
    return euclid.nisp_psf_at(_detector(), nodes, resolve(), settings.positions)


def sample(seed: int, count: int) -> list[One]:
    """Two galaxies to a star, evenly in magnitude."""
    rng = np.random.default_rng(seed)
    stars = count // 3
    some = scenes.sources(NISP, seed, galaxies=count - stars, stars=stars)
    mag = _BRIGHT + (_FAINT - _BRIGHT) * (rng.permutation(count) + rng.random(count)) / count
    some = replace(some, electrons=_ZERO * 10 ** (-0.4 * mag), photons=None)
    some.column[:], some.row[:] = (place + rng.random(count) for place in _PLACE)
    wave, weight = orders(0.0)[0].wavelength, orders(0.0)[0].response
    found = []
    for i in range(count):
        tilt, centre = _TILTS[i % len(_TILTS)], rng.uniform(12600.0, 18400.0)
        parts = [wave ** rng.uniform(-3.0, 0.0), np.exp(-0.5 * ((wave - centre) / rng.uniform(5.0, 15.0)) ** 2)]
        share = rng.uniform(0.05, 0.3)
        continuum, line = (
            (s * part / (part * weight).sum()).astype(np.float32)[None]
            for s, part in zip((1 - share, share), parts, strict=True)
        )
        one = some.take(np.array([i]))
        x, y = orders(tilt)[0].trace.offsets(float(one.column[0]), float(one.row[0]), np.array([centre]))
        place = float(one.column[0] + x[0]), float(one.row[0] + y[0])
        found.append(One(one, tilt, continuum, line, place))
    return found


def images_of(one: One, settings: Settings, psf: Psf) -> tuple[Float, Float]:
    """(all of its light, its line alone) on a frame."""
    spectra = one.continuum + one.line, one.line
    both = (Dispersed(lambda _, own=own: own, orders(one.tilt), settings) for own in spectra)  # type: ignore[misc]
    whole, line = (draw.draw(one.source, each, psf, _SHAPE, NOISE) for each in both)
    return whole, line


def errors(found: tuple[Float, Float], truth: tuple[Float, Float], one: One) -> tuple[float, float, float]:
    """(largest of a pixel, of its own noise; of the line's flux in a box, relative; of its place, pixels)."""
    background = np.abs(found[0] - truth[0]) / np.sqrt(NOISE**2 + np.maximum(truth[0], 0.0))
    mine, true = (_measured(image, *one.place) for image in (found[1], truth[1]))
    return float(background.max()), abs(mine[0] / true[0] - 1.0), float(np.hypot(mine[1] - true[1], mine[2] - true[2]))


def _measured(image: Float, column: float, row: float) -> tuple[float, float, float]:
    """Flux in a box, and the centroid under a Gaussian weight about the line."""
    left, low = round(column) - _BOX[0], round(row) - _BOX[1]
    box = image[low : low + 2 * _BOX[1] + 1, left : left + 2 * _BOX[0] + 1]
    y, x = np.indices(box.shape)
    x, y = x + left - column, y + low - row
    weighted = box * np.exp(-0.5 * (x**2 + y**2) / _SIGMA**2)
    total = weighted.sum()
    return float(box.sum()), float((weighted * x).sum() / total), float((weighted * y).sum() / total)


def seconds(settings: Settings, repeats: int) -> float:
    """CPU s of the first orders of 7,400 sources on a detector, one in ten of them a star."""
    rng, psf = np.random.default_rng(_TIMED_SEED), psf_of(settings)
    some = scenes.sources(NISP, _TIMED_SEED, galaxies=_TIMED - _TIMED // 10, stars=_TIMED // 10)
    low, high = 10 ** (0.3 * _BRIGHT), 10 ** (0.3 * _FAINT)
    mag = np.log10(low + (high - low) * rng.random(len(some))) / 0.3
    some = replace(some, electrons=_ZERO * 10 ** (-0.4 * mag), photons=None)
    spectrum = sample(_TIMED_SEED, 3)[0]
    flat = spectrum.continuum + spectrum.line
    dispersed = Dispersed(lambda chosen: np.repeat(flat, len(chosen), axis=0), orders(0.0), settings)
    draw.draw(some.take(np.arange(0, len(some), 50)), dispersed, psf, (NISP.ny, NISP.nx), NOISE)
    few, all_of_them = np.inf, np.inf
    for _ in range(repeats):
        started = time.process_time()
        draw.draw(some.take(np.arange(len(some) // 2)), dispersed, psf, (NISP.ny, NISP.nx), NOISE)
        half = time.process_time()
        draw.draw(some, dispersed, psf, (NISP.ny, NISP.nx), NOISE)
        few, all_of_them = min(few, half - started), min(all_of_them, time.process_time() - half)
    # What is the same for any number of sources is the detector's once.
    each = (all_of_them - few) / (len(some) - len(some) // 2)
    return all_of_them + each * (7400 - len(some))


def rows(tiers: Iterable[Settings], repeats: int, chosen: int = CHOSEN, held: int = HELD) -> list[dict[str, float]]:
    """Of each: the largest errors of the sources it was chosen on and (_held) of the others; seconds."""
    samples = {end: sample(seed, n) for end, seed, n in zip(("", "_held"), _SEEDS, (chosen, held), strict=True)}
    psf = psf_of(_TRUTH)
    truths = {end: [images_of(one, _TRUTH, psf) for one in some] for end, some in samples.items()}
    found = []
    for settings in tiers:
        row, own = {}, psf_of(settings)
        for end, some in samples.items():
            each = [errors(images_of(one, settings, own), t, one) for one, t in zip(some, truths[end], strict=True)]
            row |= {f"{name}{end}": float(worst) for name, worst in zip(NUMBERS, np.max(each, axis=0), strict=True)}
        found.append({**row, "seconds": seconds(settings, repeats)})
    return found


def table(repeats: int = 2) -> str:
    """The table of settings that is in use, with what it is now measured to be."""
    known = draw.rows()
    own = [name for name in known[0] if name == "allowed" or name in Settings.__slots__]
    names = [*own, *(f"{name}{end}" for end in ("", "_held") for name in NUMBERS), "seconds"]
    found = rows([draw.of_row(row) for row in known], repeats)
    lines = [
        ",".join(f"{({**row, **measured})[name]:.2g}" if name not in own else f"{row[name]:g}" for name in names)
        for row, measured in zip(known, found, strict=True)
    ]
    head = _HEAD.format(
        chosen=CHOSEN, held=HELD, bright=_BRIGHT, faint=_FAINT, wide=2 * _BOX[0] + 1, high=2 * _BOX[1] + 1,
        machine=report.machine(),
    )  # fmt: skip
    return "\n".join([*head.splitlines(), ",".join(names), *lines]) + "\n"
