"""Drawing: seconds of a detector's sources, and their errors against GalSim.

    python -m benchmarks.render [--quick] [--json FILE]

Scenes: 4,701 galaxies (m 17 - 26, dN/dm ~ 10^0.3m) and 300 stars on a VIS detector, each with its own colour and place;
18,223 galaxies and 1,160 stars on an LSST detector. Errors are of galaxies that no setting was chosen on.
"""

from __future__ import annotations

import argparse
import json
import platform
import resource
import subprocess
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jobs import accuracy
from jobs.fluxes import passbands
from jobs.render import chromatic, focal_plane, psf, stamps, transfer
from jobs.render.profiles import Shapes
from jobs.render.stamps import Settings, Sources
from lake_schema.mission.configuration import resolve

MEMORY = 6 << 30
# Of the weight under which moments are taken, arcsec; of the aperture.
WEIGHT, APERTURE = 0.75, 1.0
# Galaxies whose errors are quoted, and side of the stamps that they are compared on.
HOLD_OUT, COMPARED = 240, 768


@dataclass(frozen=True)
class Scene:
    """nx, ny, pixel scale in arcsec, exposure in s, magnitude of 1 e-/s, noise in e-, numbers of galaxies and stars."""

    name: str
    nx: int
    ny: int
    scale: float
    exposure: float
    zero_point: float
    noise: float
    galaxies: int
    stars: int


VIS = Scene("vis", 4096, 4132, 0.1, 565.0, 25.7, 12.45, 4701, 300)
LSST = Scene("lsst", 4096, 4004, 0.2, 30.0, 28.17, 38.3, 18223, 1160)


def spread(scene: Scene, positions: int) -> psf.Psf:
    if scene.name == "lsst":
        return psf.ground_psf(0.7, 3.0, scene.scale)
    mission = resolve()
    return psf.vis_psf(focal_plane.detector("vis", "3-4", mission), passbands.load("euclid_vis"), mission, positions)


def sources(scene: Scene, seed: int, galaxies: int | None = None, stars: int | None = None) -> Sources:
    rng = np.random.default_rng(seed)
    n, m = galaxies if galaxies is not None else scene.galaxies, stars if stars is not None else scene.stars
    mag = np.concatenate([_magnitudes(rng, 17.0, 26.0, 0.3, n), _magnitudes(rng, 14.0, 25.5, 0.15, m)])
    total = n + m
    fraction = np.where(rng.random(n) < 0.3, 0.0, np.where(rng.random(n) < 0.14, 1.0, 0.6 * rng.random(n)))
    half_light = 0.32 * 10 ** (-0.14 * (mag[:n] - 24.5) + 0.18 * rng.normal(size=n))
    g = 0.03 * rng.normal(size=(2, n))
    shapes = Shapes(
        bulge_radius=half_light * np.where(fraction < 1, 0.5, 1.0),
        disk_radius=half_light * 1.1,
        bulge_fraction=fraction,
        sersic_index=np.clip(2.2 * np.exp(0.45 * rng.normal(size=n)), 0.5, 6.0),
        bulge_axis_ratio=rng.uniform(0.5, 1.0, n),
        inclination=np.degrees(np.arccos(rng.random(n))),
        beta=np.pi * rng.random(n),
        g1=g[0],
        g2=g[1],
        magnification=1 + 0.04 * rng.normal(size=n),
    )
    jacobian = scene.scale * np.array([[1.001, 0.002], [-0.003, 0.998]])
    # Power laws in wavelength, of photons.
    waves = np.linspace(-0.25, 0.25, chromatic.PARTS)
    photons = np.exp(np.outer(rng.normal(0.5, 1.5, total), waves))
    return Sources(
        np.arange(total),
        rng.uniform(0, scene.nx - 1, total),
        rng.uniform(0, scene.ny - 1, total),
        np.tile(jacobian, (total, 1, 1)),
        scene.exposure * 10 ** (0.4 * (scene.zero_point - mag)),
        np.where(np.arange(total) < n, np.arange(total), -1),
        shapes,
        photons / photons.sum(axis=1, keepdims=True),
    )


def _magnitudes(rng: np.random.Generator, bright: float, faint: float, slope: float, n: int) -> np.ndarray:
    low, high = 10 ** (slope * bright), 10 ** (slope * faint)
    return np.log10(low + (high - low) * rng.random(n)) / slope


def sizes_of(some: Sources, spread_: psf.Psf, scene: Scene, settings: Settings) -> tuple[np.ndarray, np.ndarray]:
    sizes = stamps.stamp_sizes(some.electrons, some.shape, some.shapes, spread_, scene.noise, settings)
    return sizes, stamps.floors(some.electrons, scene.noise, settings)


def seconds(scene: Scene, settings: Settings, repeats: int = 1) -> tuple[float, float]:
    """(CPU seconds of all sources, of which the PSF's planes), everything compiled and in the cache."""
    some, spread_ = sources(scene, 1), spread(scene, settings.positions)
    few = some.take(np.arange(len(some)) % 500 == 0)
    stamps.draw(few, np.full(len(few), 64), spread_, scene.nx, scene.ny)
    best = np.inf
    for _ in range(repeats):
        start = time.process_time()
        sizes, floors = sizes_of(some, spread_, scene, settings)
        stamps.draw(some, sizes, spread_, scene.nx, scene.ny, None, floors)
        best = min(best, time.process_time() - start)
    shared = [int(size) for size in np.unique(sizes) if size <= 256]
    start = time.process_time()
    for size in shared:
        transfer.transfer(spread_, size, 6.5)
    return best, time.process_time() - start


# ------------------------------------------------------------------------------------------------ errors


def moved(some: Sources, i: int, side: int) -> Sources:
    """One source, its middle pixel put on the middle of a frame; its PSF stays that of its place."""
    one = some.take(np.array([i]))
    shift = [side // 2 - np.rint(position) for position in (one.column, one.row)]
    return replace(one, column=one.column + shift[0], row=one.row + shift[1])


def alone(one: Sources, weights: np.ndarray, spread_: psf.Psf, size: int, floor: float, side: int) -> np.ndarray:
    """A source drawn by itself with given PSF weights."""
    frame = np.zeros((side, side), np.int64)
    passed = (
        psf.transfer(spread_, size) if spread_.planes is None else psf.collapsed(spread_, weights, size, np.float32)
    )
    bodies = (*stamps._bodies(one), np.array([floor]))
    table = stamps.sersic.table()
    stamps._draw_some(frame, one, np.array([0]), passed, np.ones((1, 1), np.float32), bodies, table, cut)
    return frame / stamps.kernel.FIXED_POINT


def measured(image: np.ndarray, scale: float, x: float, y: float) -> np.ndarray:
    """Aperture flux; centroid in arcsec; R2 in arcsec2; e1, e2, under a Gaussian weight about the true place."""
    rows, columns = np.mgrid[: image.shape[0], : image.shape[1]]
    dx, dy = (columns - x) * scale, (rows - y) * scale
    r2 = dx**2 + dy**2
    weighted = image * np.exp(-0.5 * r2 / WEIGHT**2)
    total = weighted.sum()
    xx, yy, xy = ((weighted * a).sum() / total for a in (dx * dx, dy * dy, dx * dy))
    return np.array(
        [
            image[r2 < APERTURE**2].sum(),
            (weighted * dx).sum() / total,
            (weighted * dy).sum() / total,
            xx + yy,
            (xx - yy) / (xx + yy),
            2 * xy / (xx + yy),
        ]
    )


def errors(image: np.ndarray, truth: np.ndarray, scene: Scene, one: Sources) -> np.ndarray:
    """aperture mag, centroid mas, dR2 / R2, ellipticity, largest pixel in sigma."""
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


NAMES = ("aperture_mag", "centroid_mas", "r2", "ellipticity", "pixel_sigma")


def sample(scene: Scene, seed: int, n: int) -> Sources:
    """Galaxies, as many in every magnitude bin."""
    some = sources(scene, seed, galaxies=40 * n, stars=0)
    bins = np.floor(-2.5 * np.log10(some.electrons / some.electrons.min()))
    rng, chosen = np.random.default_rng(seed), []
    for b in np.unique(bins):
        members = np.flatnonzero(bins == b)
        chosen.append(rng.permutation(members)[: -(-n // len(np.unique(bins)))])
    return some.take(np.sort(np.concatenate(chosen)))


def convergence(scene: Scene, trials: dict[str, Settings], seed: int, n: int) -> dict[str, np.ndarray]:
    """Errors [n, 5] of each trial against stamps of COMPARED pixels, nothing left out."""
    some, full = sample(scene, seed, n), spread(scene, 9)
    weights = transfer.basis_weights(full, some.photons, some.column, some.row)
    out: dict[str, list[np.ndarray]] = {name: [] for name in trials}
    for i in range(len(some)):
        one = moved(some, i, COMPARED)
        truth = alone(one, weights[i], full, COMPARED, 0.0, COMPARED)
        for name, settings in trials.items():
            sizes, floors = sizes_of(one, full, scene, settings)
            share = weights[i].copy()
            if settings.positions == 1 and full.planes is not None:
                share[len(full.planes.images) :] = 0.0
            image = alone(one, share, full, min(int(sizes[0]), COMPARED), floors[0], COMPARED)
            out[name].append(errors(image, truth, scene, one))
    return {name: np.array(rows) for name, rows in out.items()}


def against_galsim(scene: Scene, settings: Settings, seed: int, n: int) -> tuple[np.ndarray, float]:
    """Errors against galsim's tightest, and its CPU seconds a source."""
    some, full = sample(scene, seed, n), spread(scene, 9)
    weights = transfer.basis_weights(full, some.photons, some.column, some.row)
    out, spent = [], 0.0
    for i in range(len(some)):
        one = moved(some, i, COMPARED)
        sizes, floors = sizes_of(one, full, scene, settings)
        own = replace(full, profile=transfer.profile_of(full, weights[i]), planes=None)
        start = time.process_time()
        try:
            truth = stamps.reference(one, 0, own, COMPARED)
        except Exception as error:
            print(f"galsim: {type(error).__name__}")
            continue
        spent += time.process_time() - start
        image = alone(one, weights[i], full, min(int(sizes[0]), COMPARED), floors[0], COMPARED)
        out.append(errors(image, truth, scene, one))
    return np.array(out), spent / max(len(out), 1)


def shear_response(scene: Scene, settings: Settings, seed: int, n: int, g: float = 0.02) -> tuple[float, float]:
    """(worst |m|, worst |c|) of 90-degree pairs under +-g, against stamps of COMPARED pixels, noise-free."""
    some, full = sample(scene, seed, n), spread(scene, 9)
    weights = transfer.basis_weights(full, some.photons, some.column, some.row)
    bias, offset = [], []
    for i in range(len(some)):
        found = np.zeros((2, 2))
        for turn in (0.0, np.pi / 2):
            for k, shear in enumerate((-g, g)):
                one = moved(some, i, COMPARED)
                shapes = replace(one.shapes.take(one.shape), g1=np.array([shear]), g2=np.zeros(1))
                one = replace(one, shapes=replace(shapes, beta=shapes.beta + turn), shape=np.zeros(1, np.int64))
                sizes, floors = sizes_of(one, full, scene, settings)
                at = float(one.column[0]), float(one.row[0])
                for j, (size, floor) in enumerate(((min(int(sizes[0]), COMPARED), floors[0]), (COMPARED, 0.0))):
                    image = alone(one, weights[i], full, size, floor, COMPARED)
                    found[j, k] += 0.5 * measured(image, scene.scale, *at)[4]
        bias.append(abs((found[0, 1] - found[0, 0]) / (found[1, 1] - found[1, 0]) - 1))
        offset.append(abs((found[0] - found[1]).mean()))
    return max(bias), max(offset)


def show(title: str, found: np.ndarray) -> dict[str, float]:
    rms, worst = np.sqrt((found**2).mean(axis=0)), found.max(axis=0)
    print(f"{title:34}" + "".join(f" {name} {a:.1e}/{b:.1e}" for name, a, b in zip(NAMES, rms, worst, strict=True)))
    return {f"{name}_rms": a for name, a in zip(NAMES, rms, strict=True)} | {
        f"{name}_worst": a for name, a in zip(NAMES, worst, strict=True)
    }


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.render", description=__doc__)
    parser.add_argument("--quick", action="store_true", help="a tenth of the galaxies whose errors are measured")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args(argv)
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    n = 24 if options.quick else HOLD_OUT
    figures: dict[str, object] = {
        "name": "render",
        "commit": subprocess.run(["git", "rev-parse", "HEAD"], capture_output=True, text=True).stdout.strip(),
        "machine": platform.processor() or platform.machine(),
        "repeats": 3,
    }
    tiers = {name: stamps.settings_for(accuracy.preset(name)) for name in ("draft", "survey", "reference")}
    for scene in (VIS, LSST):
        for name, settings in tiers.items():
            spent, planes = seconds(scene, settings, 3 if name == "survey" else 1)
            print(f"{scene.name} {name}: {spent:.2f} s CPU, of which the PSF's planes {planes:.2f} s")
            figures[f"{scene.name}_{name}_s"] = spent
            figures[f"{scene.name}_{name}_planes_s"] = planes
        for name, found in convergence(scene, tiers, 12, n).items():
            figures |= {
                f"{scene.name}_{name}_{key}": value for key, value in show(f"{scene.name} {name}", found).items()
            }
        for name in ("draft", "survey"):
            m, c = shear_response(scene, tiers[name], 14, 12 if options.quick else 30)
            print(f"{scene.name} {name}: shear |m| <= {m:.1e}, |c| <= {c:.1e}")
            figures |= {f"{scene.name}_{name}_shear_m_worst": m, f"{scene.name}_{name}_shear_c_worst": c}
        found, each = against_galsim(scene, tiers["survey"], 13, 12 if options.quick else 24)
        figures |= {f"{scene.name}_galsim_{key}": value for key, value in show(f"{scene.name} galsim", found).items()}
        figures[f"{scene.name}_galsim_s_each"] = each
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1, default=float) + "\n")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
