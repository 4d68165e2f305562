"""Speed for accuracy in drawing: the settings walked one process a point, and what others leave out.

Settings are chosen on a sample of sources, against the same on the largest stamps in double precision; their errors are
quoted of other sources, against galsim at its tightest: galaxies and stars, as many in every layer of magnitude. What
galsim's default makes of these galaxies, and how far galsim's own parameters move it at its tightest, stands beside.
Errors of approximations are against our own drawing at its best. The scene is VIS's.
"""

from __future__ import annotations

import argparse
import csv
import math
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np

from benchmarks import _approximations as approximations
from benchmarks import _errors as errors
from benchmarks import _peers as peers
from benchmarks import _positions as positions
from benchmarks import _references as references
from benchmarks import _scenes as scenes
from benchmarks import report
from benchmarks._approximations import NONE, Approximation
from benchmarks._scenes import VIS
from lake_schema.arrays import Bool, Float
from truesky.render.drawing.settings import Settings
from truesky.render.psf import model
from truesky.render.sources.source_list import Sources

Row = dict[str, str | float]
# From quicklook to reference; then the survey's with one setting changed at a time.
_CHAIN = (
    Settings(0.5, 1e-2, 1e-1, 2.4, 1, 2),
    Settings(0.25, 4e-3, 3e-2, 4.0, 4, 4),
    Settings(0.085, 1e-3, 1e-2, 5.2, 9),
    Settings(0.04, 5e-4, 3e-3, 5.6, 9),
    Settings(0.018, 2e-4, 1e-3, 6.5, 9),
    Settings(0.005, 5e-5, 1e-4, 8.0, 25),
)
_SURVEY = 4
_CHANGED = (("edge", 0.1), ("aliased", 1e-2), ("floor", 1e-2), ("least", 5.6), ("least", 3.2), ("colours", 4))
# Of each layer of magnitude as many galaxies and stars: that the settings are chosen on, that the errors are quoted of;
# of each, galaxies that are sheared in pairs. Galaxies that approximations are measured on, and their pairs.
_EACH, _HELD, _SHEARED, _QUOTED, _PAIRS = 3, 4, 12, 24, 18
_CHOSEN_SEED, _HELD_SEED, _QUOTED_SEED, _SCENE_SEED = 12, 34, 21, 1
# Seeds of the stars that the error of the PSF is of.
_PSF_SEEDS = (5, 6)
# Threshold of galsim's largest frequency: at 1e-4 its middles of bright discs are 3e-3 of the noise wrong.
_HIGHEST = 1e-5
# Galaxies fainter than this are small beside the frame.
_SMALL = 20.0
# galsim at its tightest but for one parameter each.
_LOOSER = (("folding 1e-3", 1e-3, _HIGHEST), ("largest frequency 1e-4", references.ACCURACY, 1e-4))
# No approximation but the stamp, and that large; in double precision, as nothing may be left out.
_TRUTH = Settings(edge=1e-6, aliased=1e-8, floor=0.0, least=25.6, positions=9)
# Magnitudes of a relative error.
_MAG = 1.0857362
_NUMBERS = ("flux", "shape", "position", "background")
_SETTINGS = f"""\
# Settings of drawing by python -m benchmarks.trade --settings, and the largest errors they make.
#
# flux: of a source, in a 1" aperture, relative; position: pixels; background: of a sky pixel's noise; shape: the
# largest of |m| and |c| of {_SHEARED} 90-degree pairs, of half the ellipticity's error, and of {positions.LENSED:.2f}
# times what a star's R2 is wrong by (what that does to m, benchmarks/_positions.py).
# First of {12 * _EACH} VIS galaxies and stars of 14.5 to 26 mag that the settings were chosen on, against the largest
# stamps; then (_held) of {12 * _HELD} others: galaxies against galsim at its tightest, stars against the Fourier series
# of their PSF, pairs against the largest stamps. To each, as the root of the sum of squares, the PSF's own error of
# {positions.STARS} and of {positions.HELD} stars of other places, their colours of eight sub-bands. CPU seconds of a
# VIS detector's sources, on {{machine}}.
edge,aliased,floor,least,positions,colours,{",".join(_NUMBERS)},{",".join(f"{name}_held" for name in _NUMBERS)},seconds
"""


@dataclass(frozen=True)
class Known:
    """One of a sample: itself, on frames that it is in the middle of, and its PSF; its image and response to shear."""

    sources: Sources
    psf: model.Psf
    image: Float
    response: Float | None

    @property
    def star(self) -> bool:
        return bool(self.sources.shape[0] < 0)


def sample(some: Sources, pairs: int, highest: float = 0.0) -> list[Known]:
    """Sources with the truth about them, the first galaxies' response too; highest : galsim's, if that is the truth."""
    full, out = scenes.psf_of(VIS), []
    order = np.random.default_rng(_CHOSEN_SEED).permutation(len(some))
    for i in order:
        own, one = scenes.own(full, some, i), scenes.moved(some, i, errors.COMPARED)
        image = None
        if highest:
            point = one.shape[0] < 0
            image = (
                references.by_series(one, own, errors.COMPARED)
                if point
                else references.image(one, own, errors.COMPARED, highest)
            )
        if image is None:
            image = scenes.draw(one, own, VIS, _TRUTH, errors.COMPARED)
        sheared = one.shape[0] >= 0 and pairs > 0
        pairs -= sheared
        out.append(Known(one, own, image, _response(one, own, NONE, _TRUTH) if sheared else None))
    return out


def _truth(one: Sources, own: model.Psf, highest: float) -> Float | None:
    """Of a galaxy galsim's; a point has no profile that it would be needed for."""
    if one.shape[0] < 0:
        return references.by_series(one, own, errors.COMPARED)
    return references.image(one, own, errors.COMPARED, highest)


def _response(one: Sources, psf: model.Psf, approximation: Approximation, settings: Settings) -> Float:
    return errors.response(lambda each: approximation.draw(each, psf, VIS, settings, errors.COMPARED), one, VIS.scale)


def compared(
    settings: Settings, galaxies: list[Known], others: list[Known], approximation: Approximation = NONE
) -> tuple[Float, Float]:
    """(errors [n, 5], m and c [pairs, 2]) of galaxies; others : the same as they are approximated, or themselves."""
    found, bias = [], []
    for galaxy, other in zip(galaxies, others, strict=True):
        image = approximation.draw(other.sources, other.psf, VIS, settings, errors.COMPARED)
        found.append(errors.errors(image, galaxy.image, VIS, galaxy.sources))
        if galaxy.response is not None:
            response = _response(other.sources, other.psf, approximation, settings)
            bias.append(errors.bias(response, galaxy.response))
    return np.array(found), np.array(bias)


def _summary(found: Float, bias: Float) -> Row:
    m, c = np.abs(bias).max(axis=0)
    return {**errors.figures(found), "shear_m_worst": float(m), "shear_c_worst": float(c), "galaxies": len(found)}


def point(
    settings: Settings, chosen: list[Known], held: list[Known], psf_errors: Mapping[str, dict[str, float]]
) -> Row:
    """Errors of settings: of the sources that they are chosen on, and of others.

    psf_errors : "" and "_held": the largest errors of the PSF's own positions and colours
    """
    row: Row = {}
    for kind, some in (("", chosen), ("_held", held)):
        found, bias = compared(settings, some, some)
        drawn = _largest(found, bias, np.array([each.star for each in some]))
        row |= {f"{name}{kind}": math.hypot(drawn[name], psf_errors[kind].get(name, 0.0)) for name in _NUMBERS}
        row |= {f"{name}{kind}_drawn": value for name, value in drawn.items()}
    mag = np.array([float(scenes.magnitudes(each.sources, VIS)[0]) for each in held])
    for low, high in pairwise(scenes.LAYERS):
        row[f"background_held_m{low:g}"] = float(found[(mag >= low) & (mag < high), 4].max(initial=0.0))
    galaxy = np.array([not each.star for each in held])
    return {**row, **_summary(found[galaxy], bias)}


def _largest(found: Float, bias: Float, star: Bool) -> dict[str, float]:
    """Errors in the terms of an accuracy; found [n, 5] and bias [pairs, 2] of `compared`."""
    worst = found.max(axis=0)
    return {
        "flux": float(np.expm1(worst[0] / _MAG)),
        "shape": float(max(worst[3] / 2, np.abs(bias).max(), positions.LENSED * found[star, 2].max(initial=0.0))),
        "position": float(worst[1] / 1e3 / VIS.scale),
        "background": float(worst[4]),
    }


def approximated(approximation: Approximation, settings: Settings, repeats: int, quoted: list[Known]) -> Row:
    """What an approximation buys and costs: seconds of its galaxies with and without, and errors."""
    n, pairs, timed = approximation.numbers
    some, full = scenes.sources(VIS, _SCENE_SEED, stars=0), scenes.psf_of(VIS)
    if timed:
        some = approximation.concerned(VIS, _SCENE_SEED, timed)
    row: Row = {"galaxies_timed": len(some), "seconds_before": _seconds(some, full, settings, repeats)}
    simple, less = approximation.simplified(some), approximation.psf(full)
    row["seconds"] = _seconds(simple, less, settings, repeats, approximation.timed or approximation)
    some = approximation.concerned(VIS, _QUOTED_SEED, n)
    galaxies = quoted if approximation.concerned is NONE.concerned else sample(some, pairs)
    others = [_changed(galaxy, some, less, approximation) for galaxy in galaxies]
    # Nothing but the approximation is wrong: the stamps are large, unless they are what is approximated.
    wide = _TRUTH if approximation.sizes is NONE.sizes else settings
    return {**row, **_summary(*compared(wide, galaxies, others, approximation))}


def _changed(galaxy: Known, some: Sources, less: model.Psf, approximation: Approximation) -> Known:
    """A galaxy of `some` as it is approximated; `less`: the detector's PSF as it is."""
    one = replace(approximation.simplified(galaxy.sources), photons=None)
    if approximation.psf is NONE.psf:
        return replace(galaxy, sources=one)
    place = np.flatnonzero(some.ids == galaxy.sources.ids[0])
    return replace(galaxy, sources=one, psf=scenes.own(less, approximation.simplified(some), int(place[0])))


def _seconds(
    some: Sources, psf: model.Psf, settings: Settings, repeats: int, approximation: Approximation = NONE
) -> float:
    """CPU s of sources on the scene's frame."""
    # The brightest are drawn in double precision, which is compiled on its own.
    bright = some.electrons >= np.sort(some.electrons)[-3:].min()
    approximation.draw(some.take(bright | (np.arange(len(some)) % 500 == 0)), psf, VIS, settings)
    return report.best(lambda: approximation.draw(some, psf, VIS, settings), repeats, time.process_time)


def together(some: Sequence[Settings], repeats: int) -> dict[Settings, float]:
    """CPU s of the scene's sources by settings, each drawn in turn: what else the machine does is shared by all."""
    scene, out = scenes.sources(VIS, _SCENE_SEED), dict.fromkeys(some, np.inf)
    for _ in range(repeats):
        for each in some:
            psf = scenes.psf_of(VIS, each.positions, each.colours)
            out[each] = min(out[each], _seconds(scene, psf, each, 1))
    return out


def by_galsim(held: list[Known], each: int) -> Row:
    """galsim's default: seconds of the scene's galaxies, errors of the same galaxies as ours against the same truth."""
    default, _ = peers.galsim_seconds(VIS, each)
    some = [known for known in held if not known.star]
    found = [
        errors.errors(peers.galsim_image(g.sources, g.psf, errors.COMPARED), g.image, VIS, g.sources) for g in some
    ]
    return {"seconds": default, **errors.figures(np.array(found)), "galaxies": len(found)}


def oracles(held: list[Known]) -> Iterator[Row]:
    """How far galsim's tightest is to be trusted: others that should be as good, against it, of the same galaxies."""
    some = [known for known in held if not known.star]
    ways: dict[str, Callable[[Known], Float | None]] = {
        "ours, the largest stamps": lambda g: scenes.draw(g.sources, g.psf, VIS, _TRUTH, errors.COMPARED)
    }
    for name, folding, highest in _LOOSER:
        ways[name] = partial(_looser, folding=folding, highest=highest)
    ways["the PSF by its Fourier series"] = _by_series
    for name, way in ways.items():
        images = [(way(known), known) for known in some]
        found = [errors.errors(image, g.image, VIS, g.sources) for image, g in images if image is not None]
        yield {"kind": "oracle", "name": name, **errors.figures(np.array(found)), "galaxies": len(found)}
    # Of those that are small beside the frame, ours against the better of both.
    faint = [known for known in some if float(scenes.magnitudes(known.sources, VIS)[0]) > _SMALL]
    found = [errors.errors(ways["ours, the largest stamps"](g), _by_series(g), VIS, g.sources) for g in faint]  # type: ignore[arg-type]
    yield {"kind": "series", "name": "ours", **errors.figures(np.array(found)), "galaxies": len(found)}


def _by_series(known: Known) -> Float:
    return references.by_series(known.sources, known.psf, errors.COMPARED)


def _looser(known: Known, folding: float, highest: float) -> Float | None:
    return references.image(known.sources, known.psf, errors.COMPARED, highest, folding)


def walk(quick: bool, repeats: int) -> Iterator[Row]:
    """A row a point, each in a process of its own."""
    chain = [_CHAIN[0], _CHAIN[_SURVEY]] if quick else _CHAIN
    changed = [] if quick else [Settings(**{**asdict(_CHAIN[_SURVEY]), name: value}) for name, value in _CHANGED]
    each, others, pairs = (1, 1, 2) if quick else (_EACH, _HELD, _SHEARED)
    chosen = sample(scenes.stratified(VIS, _CHOSEN_SEED, each), pairs)
    held = errors.capped(sample, scenes.stratified(VIS, _HELD_SEED, others), pairs, 0.0 if quick else _HIGHEST)
    kinds = list(dict.fromkeys((some.positions, some.colours) for some in (*chain, *changed)))
    stars = (positions.STARS, positions.HELD)
    psf_errors = [positions.largest(seed, 4 if quick else n, kinds) for seed, n in zip(_PSF_SEEDS, stars, strict=True)]
    seconds = errors.capped(together, [*chain, *changed], repeats)
    for kind, some in (("settings", chain), ("changed", changed)):
        for i, settings in enumerate(some):
            name = f"{i + 1}" if kind == "settings" else "{} {:g}".format(*_CHANGED[i])
            own = {
                end: of[settings.positions, settings.colours] for end, of in zip(("", "_held"), psf_errors, strict=True)
            }
            found = errors.capped(point, settings, chosen, held, own)
            about = {"kind": kind, "name": name, **asdict(settings), "seconds": seconds[settings]}
            yield {**about, **found, "machine": report.machine()}
    if not quick:
        yield {"kind": "peer", "name": "galsim", **errors.capped(by_galsim, held, 4)}
        yield from errors.capped(lambda: list(oracles(held)))
    quoted = sample(scenes.sample(VIS, _QUOTED_SEED, 6 if quick else _QUOTED), 2 if quick else _PAIRS)
    for approximation in approximations.ALL[:1] if quick else approximations.ALL:
        found = errors.capped(approximated, approximation, _CHAIN[_SURVEY], repeats, quoted)
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
    """The table that truesky.request.accuracy reads, of the rows of trade.csv."""
    names = _SETTINGS.splitlines()[-1].split(",")
    some = [row for row in rows if row["kind"] == "settings"]
    lines = [",".join(f"{float(row[name]):.4g}" for name in names) for row in some]
    return _SETTINGS.format(machine=some[0]["machine"]) + "\n".join(lines) + "\n"


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
    own.add_argument("--repeats", type=int, default=3, help="of every time, the best of which counts")
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
    figures = {
        f"{row['name']}_s".replace(" ", "_"): float(row["seconds"])
        for row in rows
        if "seconds" in row and row["kind"] != "settings"
    }
    report.finish("trade", repeats, figures, {}, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
