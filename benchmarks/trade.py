"""Speed for accuracy in drawing: the settings walked one process a point, and what others leave out.

Errors of settings are of galaxies that none was chosen on, against the same galaxies on the largest stamps, whose own
errors against galsim benchmarks/render tells (settings "reference"). The scene is VIS's.
"""

from __future__ import annotations

import argparse
import csv
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import numpy.typing as npt

from benchmarks import _approximations as approximations
from benchmarks import _errors as errors
from benchmarks import _peers as peers
from benchmarks import _positions as positions
from benchmarks import _references as references
from benchmarks import _scenes as scenes
from benchmarks import report
from benchmarks._approximations import NONE, Approximation
from benchmarks._scenes import VIS
from jobs.render import psf
from jobs.render.stamps import Settings, Sources

Float = npt.NDArray[np.float64]
Row = dict[str, str | float]
# From draft to reference; then the survey's with one setting changed at a time.
_CHAIN = (
    Settings(0.3, 3e-3, 5e-2, 4.0, 4),
    Settings(0.1, 1e-3, 1e-2, 4.8, 4),
    Settings(0.03, 1e-3, 3e-3, 4.8, 9),
    Settings(0.01, 1e-4, 3e-4, 6.4, 9),
    Settings(0.004, 3e-5, 1e-5, 8.0, 9),
    Settings(0.0005, 1e-5, 1e-7, 12.8, 25),
)
_SURVEY = 3
_CHANGED = (("edge", 0.1), ("ghost", 1e-2), ("floor", 1e-2), ("least", 5.6), ("least", 3.2))
# Galaxies: that the settings are chosen on, against galsim, and sheared in pairs; that the errors are quoted of.
_CHOSEN_ON, _QUOTED, _PAIRS = 24, 24, 18
_CHOSEN_SEED, _QUOTED_SEED, _SCENE_SEED = 12, 21, 1
# Threshold of galsim's largest frequency where settings are chosen: at 1e-4 its middles of bright discs are 3e-3 of
# the noise wrong.
_HIGHEST = 1e-5
# What others are held against: no approximation but the stamp, and that large.
_TRUTH = Settings(edge=1e-6, ghost=1e-8, floor=0.0, least=25.6, positions=9)
# Magnitudes of a relative error.
_MAG = 1.0857362
_SETTINGS = f"""\
# Settings of stamps by python -m benchmarks.trade --settings: the largest errors over {_CHOSEN_ON} VIS galaxies
# that they are chosen on, against galsim at its tightest. flux: in a 1" aperture; shape: the larger of half the
# ellipticity's error and of |m|, |c| of {_PAIRS} 90-degree pairs; position: pixels; background: of a pixel's
# noise; CPU seconds of a VIS detector's sources. Errors of other galaxies: benchmarks/results/trade.csv.
edge,ghost,floor,least,flux_error,shape_error,position_error,background_error,seconds
"""


@dataclass(frozen=True)
class Galaxy:
    """One of a sample: itself, on frames that it is in the middle of, and its PSF; its image and response to shear."""

    sources: Sources
    spread: psf.Psf
    image: Float
    response: Float | None


def sample(some: Sources, pairs: int, highest: float = 0.0) -> list[Galaxy]:
    """Galaxies with the truth about them, the first ones' response too; highest : galsim's, where it is the truth."""
    full, out = scenes.spread(VIS), []
    order = np.random.default_rng(_CHOSEN_SEED).permutation(len(some))
    for k, i in enumerate(order):
        own, one = scenes.own(full, some, i), scenes.moved(some, i, errors.COMPARED)
        image = references.image(one, own, errors.COMPARED, highest) if highest else None
        if image is None:
            image = scenes.draw(one, own, VIS, _TRUTH, errors.COMPARED)
        out.append(Galaxy(one, own, image, _response(one, own, NONE, _TRUTH) if k < pairs else None))
    return out


def _response(one: Sources, spread: psf.Psf, approximation: Approximation, settings: Settings) -> Float:
    return errors.response(
        lambda each: approximation.draw(each, spread, VIS, settings, errors.COMPARED), one, VIS.scale
    )


def compared(
    settings: Settings, galaxies: list[Galaxy], others: list[Galaxy], approximation: Approximation = NONE
) -> tuple[Float, Float]:
    """(errors [n, 5], m and c [pairs, 2]) of galaxies; others : the same as they are approximated, or themselves."""
    found, bias = [], []
    for galaxy, other in zip(galaxies, others, strict=True):
        image = approximation.draw(other.sources, other.spread, VIS, settings, errors.COMPARED)
        found.append(errors.errors(image, galaxy.image, VIS, galaxy.sources))
        if galaxy.response is not None:
            response = _response(other.sources, other.spread, approximation, settings)
            bias.append(errors.bias(response, galaxy.response))
    return np.array(found), np.array(bias)


def _summary(found: Float, bias: Float) -> Row:
    m, c = np.abs(bias).max(axis=0)
    return {**errors.figures(found), "shear_m_worst": float(m), "shear_c_worst": float(c), "galaxies": len(found)}


def point(settings: Settings, chosen: list[Galaxy], quoted: list[Galaxy], repeats: int) -> Row:
    """Seconds and errors of settings: of the galaxies that settings are chosen on, and of others."""
    found, bias = compared(settings, chosen, chosen)
    worst = found.max(axis=0)
    row: Row = {
        "flux_error": float(np.expm1(worst[0] / _MAG)),
        "shape_error": float(max(worst[3] / 2, np.abs(bias).max())),
        "position_error": float(worst[1] / 1e3 / VIS.scale),
        "background_error": float(worst[4]),
    }
    some, spread = scenes.sources(VIS, _SCENE_SEED), scenes.spread(VIS, settings.positions)
    row["seconds"] = _seconds(some, spread, settings, repeats)
    return {**row, **_summary(*compared(settings, quoted, quoted))}


def approximated(approximation: Approximation, settings: Settings, repeats: int, quoted: list[Galaxy]) -> Row:
    """What an approximation buys and costs: seconds of its galaxies with and without, and errors."""
    n, pairs, timed = approximation.numbers
    some, full = scenes.sources(VIS, _SCENE_SEED, stars=0), scenes.spread(VIS)
    if timed:
        some = approximation.concerned(VIS, _SCENE_SEED, timed)
    row: Row = {"galaxies_timed": len(some), "seconds_before": _seconds(some, full, settings, repeats)}
    simple, less = approximation.simplified(some), approximation.spread(full)
    row["seconds"] = _seconds(simple, less, settings, repeats, approximation.timed or approximation)
    some = approximation.concerned(VIS, _QUOTED_SEED, n)
    galaxies = quoted if approximation.concerned is NONE.concerned else sample(some, pairs)
    others = [_changed(galaxy, some, less, approximation) for galaxy in galaxies]
    # Nothing but the approximation is wrong: the stamps are large, unless they are what is approximated.
    wide = _TRUTH if approximation.sizes is NONE.sizes else settings
    return {**row, **_summary(*compared(wide, galaxies, others, approximation))}


def _changed(galaxy: Galaxy, some: Sources, less: psf.Psf, approximation: Approximation) -> Galaxy:
    """A galaxy of `some` as it is approximated; `less`: the detector's PSF as it is."""
    one = replace(approximation.simplified(galaxy.sources), photons=None)
    if approximation.spread is NONE.spread:
        return replace(galaxy, sources=one)
    place = np.flatnonzero(some.ids == galaxy.sources.ids[0])
    return replace(galaxy, sources=one, spread=scenes.own(less, approximation.simplified(some), int(place[0])))


def _seconds(
    some: Sources, spread: psf.Psf, settings: Settings, repeats: int, approximation: Approximation = NONE
) -> float:
    """CPU s of sources on the scene's frame."""
    # The brightest are drawn in double precision, which is compiled on its own.
    bright = some.electrons >= np.sort(some.electrons)[-3:].min()
    approximation.draw(some.take(bright | (np.arange(len(some)) % 500 == 0)), spread, VIS, settings)
    return report.best(lambda: approximation.draw(some, spread, VIS, settings), repeats, time.process_time)


def by_galsim(quoted: list[Galaxy], each: int) -> Row:
    """galsim's default: seconds of the scene's galaxies, errors."""
    default, _ = peers.galsim_seconds(VIS, each)
    found = [
        errors.errors(peers.galsim_image(g.sources, g.spread, errors.COMPARED), g.image, VIS, g.sources) for g in quoted
    ]
    return {"seconds": default, **errors.figures(np.array(found)), "galaxies": len(found)}


def walk(quick: bool, repeats: int) -> Iterator[Row]:
    """A row a point, each in a process of its own."""
    chain = [_CHAIN[0], _CHAIN[_SURVEY]] if quick else _CHAIN
    changed = [] if quick else [Settings(**{**asdict(_CHAIN[_SURVEY]), name: value}) for name, value in _CHANGED]
    n, pairs = (6, 2) if quick else (_QUOTED, _PAIRS)
    chosen = sample(scenes.sample(VIS, _CHOSEN_SEED, 6 if quick else _CHOSEN_ON), pairs, 0.0 if quick else _HIGHEST)
    quoted = sample(scenes.sample(VIS, _QUOTED_SEED, n), pairs)
    for kind, some in (("settings", chain), ("changed", changed)):
        for i, settings in enumerate(some):
            name = f"{i + 1}" if kind == "settings" else "{} {:g}".format(*_CHANGED[i])
            found = errors.capped(point, settings, chosen, quoted, repeats)
            yield {"kind": kind, "name": name, **asdict(settings), **found}
    for approximation in approximations.ALL[:1] if quick else approximations.ALL:
        found = errors.capped(approximated, approximation, _CHAIN[_SURVEY], repeats, quoted)
        yield {"kind": "approximation", "name": approximation.name, **found}
    if not quick:
        yield {"kind": "peer", "name": "galsim", **errors.capped(by_galsim, quoted, 4)}


def _line(row: Row) -> str:
    shown = ("seconds", "aperture_mag_rms", "r2_rms", "r2_worst", "ellipticity_worst", "shear_m_worst", "shear_c_worst")
    return f"{row['kind']:14}{row['name']:32}" + "".join(f"{row[key]:>12.2g}" for key in shown if key in row)


def write(rows: list[Row], file: Path) -> None:
    """trade.csv: a column for every key, empty where a row has none."""
    names = list(dict.fromkeys(key for row in rows for key in row))
    with file.open("w", newline="", encoding="utf-8") as out:
        writer = csv.DictWriter(out, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: f"{v:.4g}" if isinstance(v, float) else v for key, v in row.items()} for row in rows)


def settings_table(rows: list[Row]) -> str:
    """The table that stamps.settings_for reads, of the rows of trade.csv."""
    names = _SETTINGS.splitlines()[-1].split(",")
    some = [row for row in rows if row["kind"] == "settings"]
    return _SETTINGS + "".join(",".join(f"{float(row[name]):.4g}" for name in names) + "\n" for row in some)


def pareto(rows: list[Row], file: Path) -> None:
    """Seconds against the errors of flux, shape and position."""
    from matplotlib.figure import Figure

    shown = {"aperture_mag_rms": 'flux in 1", mag', "r2_rms": "R², relative", "ellipticity_rms": "ellipticity"}
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    axes = figure.subplots(1, 4, sharey=True)
    for axis, (key, label) in zip(axes, (shown | {"centroid_mas_rms": "position, mas"}).items(), strict=True):
        for kind, style in (("settings", "o-"), ("changed", "x"), ("peer", "s")):
            some = [row for row in rows if row["kind"] == kind]
            axis.loglog([row[key] for row in some], [row["seconds"] for row in some], style, label=kind)
        axis.set_xlabel(f"rms error: {label}")
    axes[0].set_ylabel("CPU s of a VIS detector")
    axes[0].legend()
    figure.savefig(file, dpi=100)


def main(argv: Sequence[str] | None = None) -> int:
    """Walks, prints and writes what is asked for."""
    own = argparse.ArgumentParser(add_help=False)
    own.add_argument("--csv", type=Path, metavar="FILE", help="write the points to this file")
    own.add_argument("--figure", type=Path, metavar="FILE", help="draw seconds against errors")
    own.add_argument("--settings", type=Path, metavar="FILE", help="write the table that settings are chosen from")
    own.add_argument("--positions", type=Path, metavar="FILE", help="write the table of positions of the PSF alone")
    own.add_argument("--repeats", type=int, default=2, help="of every time, the best of which counts")
    known, others = own.parse_known_args(argv)
    options = report.options("trade", __doc__ or "", others)
    if known.positions:
        known.positions.write_text(positions.text(positions.rows(positions.STARS)), encoding="utf-8")
        return 0
    repeats = 1 if options.quick else known.repeats
    rows: list[Row] = []
    for row in walk(options.quick, repeats):
        rows.append(row)
        print(_line(row), flush=True)
        # After every point: the walk is long.
        if known.csv:
            write(rows, known.csv)
    if known.figure:
        pareto(rows, known.figure)
    if known.settings:
        known.settings.write_text(settings_table(rows), encoding="utf-8")
    figures = {f"{row['name']}_s".replace(" ", "_"): float(row["seconds"]) for row in rows if row["kind"] != "settings"}
    report.finish("trade", repeats, figures, {}, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
