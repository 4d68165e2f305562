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
from dataclasses import asdict
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
# From draft to reference; then the third with one setting changed at a time.
_CHAIN = (
    Settings(0.15, 3e-4, 2e-2, 4.0, 4),
    Settings(0.15, 1e-4, 3e-2, 4.8, 4),
    Settings(0.08, 1e-4, 1e-2, 4.8, 4),
    Settings(0.03, 5e-5, 1e-3, 4.8, 9),
    Settings(0.004, 2e-5, 1e-5, 5.6, 9),
    Settings(0.002, 5e-6, 3e-6, 8.0, 9),
    Settings(0.0005, 1e-6, 1e-7, 12.8, 25),
)
_SURVEY = 4
_CHANGED = (("edge", 0.05), ("ghost", 1e-3), ("floor", 1e-2), ("least", 3.2))
# Galaxies: that the settings are chosen on, against galsim, and sheared in pairs; that the errors are quoted of.
_CHOSEN_ON, _CHOSEN_PAIRS, _QUOTED, _PAIRS = 24, 12, 48, 12
_CHOSEN_SEED, _QUOTED_SEED, _SCENE_SEED = 12, 21, 1
# Threshold of galsim's largest frequency where settings are chosen: at 1e-4 its middles of bright discs are 3e-3 of
# the noise wrong.
_HIGHEST = 1e-5
# Magnitudes of a relative error.
_MAG = 1.0857362
_SETTINGS = f"""\
# Settings of stamps by python -m benchmarks.trade --settings: the largest errors over {_CHOSEN_ON} VIS galaxies
# that they are chosen on, against galsim at its tightest. flux: in a 1" aperture; shape: the larger of half the
# ellipticity's error and of |m|, |c| of {_CHOSEN_PAIRS} 90-degree pairs; position: pixels; background: of a pixel's
# noise; CPU seconds of a VIS detector's sources. Errors of other galaxies: benchmarks/results/trade.csv.
edge,ghost,floor,least,flux_error,shape_error,position_error,background_error,seconds
"""


def truths(seed: int, n: int, approximation: Approximation = NONE) -> Float:
    """Responses to shear [n, 4] on the largest stamps."""
    some, full = approximation.concerned(VIS, seed, n), scenes.spread(VIS)
    return np.array([_response(some, full, i, NONE, errors.FULL) for i in range(len(some))])


def _response(some: Sources, full: psf.Psf, i: int, approximation: Approximation, settings: Settings) -> Float:
    own = scenes.own(full, some, i)
    return errors.response(
        lambda one: approximation.draw(one, own, VIS, settings, 2 * errors.COMPARED),
        scenes.moved(some, i, 2 * errors.COMPARED),
        VIS.scale,
    )


def compared(
    settings: Settings, seed: int, n: int, responses: Float, approximation: Approximation = NONE, highest: float = 0.0
) -> tuple[Float, Float]:
    """(errors [n, 5], m and c [pairs, 2]) of galaxies that an approximation concerns.

    responses : `truths` of pairs;  highest : galsim's, where the truth is galsim's
    """
    full = scenes.spread(VIS)
    less, found, bias = approximation.spread(full), [], []
    some = approximation.concerned(VIS, seed, n)
    simple = approximation.simplified(some)
    for i in range(len(some)):
        own, one = scenes.own(full, some, i), scenes.moved(some, i, errors.COMPARED)
        truth = references.image(one, own, errors.COMPARED, highest) if highest else None
        if truth is None:
            truth = scenes.draw(one, own, VIS, errors.FULL, errors.COMPARED)
        its = own if less is full and simple is some else scenes.own(less, simple, i)
        image = approximation.draw(scenes.moved(simple, i, errors.COMPARED), its, VIS, settings, errors.COMPARED)
        found.append(errors.errors(image, truth, VIS, one))
    some = approximation.simplified(approximation.concerned(VIS, seed, len(responses)))
    for i, truth in enumerate(responses):
        bias.append(errors.bias(_response(some, less, i, approximation, settings), truth))
    return np.array(found), np.array(bias)


def _summary(found: Float, bias: Float) -> Row:
    m, c = np.abs(bias).max(axis=0)
    return {**errors.figures(found), "shear_m_worst": float(m), "shear_c_worst": float(c), "galaxies": len(found)}


def point(settings: Settings, chosen: Float, quoted: Float, repeats: int, n: tuple[int, int]) -> Row:
    """Seconds and errors of settings; chosen, quoted : `truths` of the two samples; n : galaxies in them."""
    found, bias = compared(settings, _CHOSEN_SEED, n[0], chosen, highest=_HIGHEST)
    worst = found.max(axis=0)
    row: Row = {
        "flux_error": float(np.expm1(worst[0] / _MAG)),
        "shape_error": float(max(worst[3] / 2, np.abs(bias).max())),
        "position_error": float(worst[1] / 1e3 / VIS.scale),
        "background_error": float(worst[4]),
    }
    some, spread = scenes.sources(VIS, _SCENE_SEED), scenes.spread(VIS, settings.positions)
    row["seconds"] = _seconds(some, spread, settings, repeats)
    return {**row, **_summary(*compared(settings, _QUOTED_SEED, n[1], quoted))}


def approximated(name: str, settings: Settings, repeats: int, few: int) -> Row:
    """What an approximation buys and costs: seconds of its galaxies with and without, and errors."""
    approximation = next(each for each in approximations.ALL if each.name == name)
    n, pairs, timed = approximation.numbers
    n, pairs = -(-n // few), -(-pairs // few)
    some, spread = scenes.sources(VIS, _SCENE_SEED, stars=0), scenes.spread(VIS, settings.positions)
    if timed:
        some = approximation.concerned(VIS, _SCENE_SEED, timed)
    row: Row = {"galaxies_timed": len(some), "seconds_before": _seconds(some, spread, settings, repeats)}
    simple, less = approximation.simplified(some), approximation.spread(spread)
    row["seconds"] = _seconds(simple, less, settings, repeats, approximation.timed or approximation)
    # Nothing but the approximation is wrong: the stamps are the largest, unless they are what is approximated.
    wide = errors.FULL if approximation.sizes is NONE.sizes else settings
    responses = truths(_QUOTED_SEED, pairs, approximation)
    return {**row, **_summary(*compared(wide, _QUOTED_SEED, n, responses, approximation))}


def _seconds(
    some: Sources, spread: psf.Psf, settings: Settings, repeats: int, approximation: Approximation = NONE
) -> float:
    """CPU s of sources on the scene's frame."""
    approximation.draw(some.take(np.arange(len(some)) % 500 == 0), spread, VIS, settings)
    return report.best(lambda: approximation.draw(some, spread, VIS, settings), repeats, time.process_time)


def by_galsim(each: int, n: int) -> Row:
    """galsim's default: seconds of the scene's galaxies, errors."""
    default, _ = peers.galsim_seconds(VIS, each)
    some, full, found = scenes.sample(VIS, _QUOTED_SEED, n), scenes.spread(VIS), []
    for i in range(len(some)):
        own, one = scenes.own(full, some, i), scenes.moved(some, i, errors.COMPARED)
        truth = scenes.draw(one, own, VIS, errors.FULL, errors.COMPARED)
        found.append(errors.errors(peers.galsim_image(one, own, errors.COMPARED), truth, VIS, one))
    return {"seconds": default, **errors.figures(np.array(found)), "galaxies": len(found)}


def walk(quick: bool, repeats: int) -> Iterator[Row]:
    """A row a point, each in a process of its own."""
    chain = [_CHAIN[0], _CHAIN[_SURVEY]] if quick else _CHAIN
    changed = [] if quick else [Settings(**{**asdict(_CHAIN[_SURVEY]), name: value}) for name, value in _CHANGED]
    n = (6, 6) if quick else (_CHOSEN_ON, _QUOTED)
    chosen = errors.capped(truths, _CHOSEN_SEED, 2 if quick else _CHOSEN_PAIRS)
    quoted = errors.capped(truths, _QUOTED_SEED, 2 if quick else _PAIRS)
    for kind, some in (("settings", chain), ("changed", changed)):
        for i, settings in enumerate(some):
            name = f"{i + 1}" if kind == "settings" else "{} {:g}".format(*_CHANGED[i])
            found = errors.capped(point, settings, chosen, quoted, repeats, n)
            yield {"kind": kind, "name": name, **asdict(settings), **found}
    if not quick:
        yield {"kind": "peer", "name": "galsim", **errors.capped(by_galsim, 4, _QUOTED)}
    for approximation in approximations.ALL[:1] if quick else approximations.ALL:
        found = errors.capped(approximated, approximation.name, _CHAIN[_SURVEY], repeats, 6 if quick else 1)
        yield {"kind": "approximation", "name": approximation.name, **found}


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
    """The table that stamps.settings_for reads."""
    names = _SETTINGS.splitlines()[-1].split(",")
    return _SETTINGS + "".join(
        ",".join(f"{row[name]:.2g}" for name in names) + "\n" for row in rows if row["kind"] == "settings"
    )


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
