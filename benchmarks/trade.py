"""Measure time against accuracy of drawing, for a sequence of settings and for approximations of other programs.

The settings are chosen on one sample of sources; the truth is a drawing on the largest stamps in double precision.
Their errors are then measured on other sources, with equal numbers of galaxies and stars in each layer of magnitude;
the truth is galsim with its tightest parameters. The benchmark also measures galsim with default parameters on these
galaxies, and the change of galsim's images if one of the tight parameters is looser. Errors of approximations are
relative to our most accurate drawing. The scene is a VIS detector. Each point is measured in a separate process.
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
from benchmarks._approximations import NO_APPROXIMATION, Approximation
from benchmarks._scenes import VIS
from lake_schema.arrays import Bool, Float
from truesky.render.drawing.settings import Settings
from truesky.render.psf import model
from truesky.render.sources.source_list import Sources

Row = dict[str, str | float]
# Settings from quicklook to reference accuracy; then single changes of the settings for survey accuracy.
_CHAIN = (
    Settings(0.5, 1e-2, 1e-1, 2.4, 1, 2),
    Settings(0.25, 4e-3, 3e-2, 4.0, 4, 4),
    Settings(0.085, 1e-3, 1e-2, 5.2, 9),
    Settings(0.04, 5e-4, 3e-3, 5.6, 9),
    Settings(0.018, 2e-4, 1e-3, 6.5, 9),
    Settings(0.005, 5e-5, 1e-4, 8.0, 25),
)
_SURVEY = 4
_CHANGED = (
    ("edge", 0.1),
    ("aliased", 1e-2),
    ("floor", 1e-2),
    ("min_size_arcsec", 5.6),
    ("min_size_arcsec", 3.2),
    ("colours", 4),
)
# Numbers of galaxies and of stars per layer of magnitude, to choose the settings and to test them; number of galaxies
# in each sample that are sheared in pairs. Number of galaxies to measure approximations, and of their pairs.
_NUM_CHOSEN, _NUM_TEST, _NUM_SHEARED, _NUM_QUOTED, _NUM_PAIRS = 3, 4, 12, 24, 18
_CHOSEN_SEED, _TEST_SEED, _QUOTED_SEED, _SCENE_SEED = 12, 34, 21, 1
# Seeds of the stars that measure the error of the PSF.
_PSF_SEEDS = (5, 6)
# Threshold of the largest frequency in galsim. With 1e-4 the centres of bright discs are wrong by 3e-3 of the noise.
_MAXK_THRESHOLD = 1e-5
# Galaxies fainter than this are small compared with the frame.
_SMALL = 20.0
# Names of cases with one looser parameter of galsim: threshold of folding, threshold of the largest frequency.
_LOOSER_THRESHOLDS = (("folding 1e-3", 1e-3, _MAXK_THRESHOLD), ("largest frequency 1e-4", references.ACCURACY, 1e-4))
# The only approximation of the truth is a finite, large stamp. It is drawn in double precision.
_TRUTH = Settings(edge=1e-6, aliased=1e-8, floor=0.0, min_size_arcsec=25.6, positions=9)
# Magnitudes per relative error of flux.
_MAG = 1.0857362
_NUMBERS = ("flux", "shape", "position", "background")
_SETTING_NAMES = ("edge", "aliased", "floor", "min_size_arcsec", "positions", "colours")
_COLUMNS = ",".join((*_SETTING_NAMES, *_NUMBERS, *(f"{name}_held" for name in _NUMBERS), "seconds"))
_SETTINGS = f"""\
# Settings of drawing by python -m benchmarks.trade --settings, and the largest errors they make.
#
# flux: of a source, in a 1" aperture, relative; position: pixels; background: of a sky pixel's noise; shape: the
# largest of |m| and |c| of {_NUM_SHEARED} 90-degree pairs, of half the ellipticity's error, and of
# {positions.R2_RATIO:.2f} times what a star's R2 is wrong by (what that does to m, benchmarks/_positions.py).
# First of {12 * _NUM_CHOSEN} VIS galaxies and stars of 14.5 to 26 mag that the settings were chosen on, against the
# largest stamps; then (_held) of {12 * _NUM_TEST} others: galaxies against galsim at its tightest, stars against the
# Fourier series of their PSF, pairs against the largest stamps. To each, as the root of the sum of squares, the PSF's
# own error of {positions.NUM_STARS} and of {positions.NUM_TEST_STARS} stars of other places, their colours of eight
# sub-bands. CPU seconds of a VIS detector's sources, on {{machine}}.
{_COLUMNS}
"""


@dataclass(frozen=True)
class Reference:
    """A source of a sample in the middle of a frame, its PSF, its true image, and its response to shear if measured."""

    sources: Sources
    psf: model.Psf
    image: Float
    response: Float | None

    @property
    def is_star(self) -> bool:
        """True if the source is a star."""
        return bool(self.sources.shape[0] < 0)


def make_references(sources: Sources, num_pairs: int, maxk_threshold: float = 0.0) -> list[Reference]:
    """Draw the true images of sources.

    Parameters
    ----------
    sources : Sources
        The sources.
    num_pairs : int
        Number of galaxies whose response to shear is measured.
    maxk_threshold : float, optional
        Threshold of galsim for the largest frequency. 0 uses our drawing on the largest stamps as truth.

    Returns
    -------
    list of Reference
        The sources in random order.
    """
    full_psf, out = scenes.scene_psf(VIS), []
    order = np.random.default_rng(_CHOSEN_SEED).permutation(len(sources))
    for i in order:
        source_psf, source = (
            scenes.psf_of_source(full_psf, sources, i),
            scenes.centred_source(sources, i, errors.COMPARED_SIDE),
        )
        image = None
        if maxk_threshold:
            point = source.shape[0] < 0
            image = (
                references.image_by_series(source, source_psf, errors.COMPARED_SIDE)
                if point
                else references.reference_image(source, source_psf, errors.COMPARED_SIDE, maxk_threshold)
            )
        if image is None:
            image = scenes.draw_sources(source, source_psf, VIS, _TRUTH, errors.COMPARED_SIDE)
        sheared = source.shape[0] >= 0 and num_pairs > 0
        num_pairs -= sheared
        out.append(
            Reference(
                source, source_psf, image, _response(source, source_psf, NO_APPROXIMATION, _TRUTH) if sheared else None
            )
        )
    return out


def _truth(source: Sources, psf: model.Psf, maxk_threshold: float) -> Float | None:
    """True image of a galaxy (by galsim) or of a star (by the Fourier series of its PSF)."""
    if source.shape[0] < 0:
        return references.image_by_series(source, psf, errors.COMPARED_SIDE)
    return references.reference_image(source, psf, errors.COMPARED_SIDE, maxk_threshold)


def _response(source: Sources, psf: model.Psf, approximation: Approximation, settings: Settings) -> Float:
    return errors.response(
        lambda each: approximation.draw(each, psf, VIS, settings, errors.COMPARED_SIDE), source, VIS.scale
    )


def compare(
    settings: Settings,
    galaxies: list[Reference],
    simplified: list[Reference],
    approximation: Approximation = NO_APPROXIMATION,
) -> tuple[Float, Float]:
    """Measure the errors of galaxies that are drawn with an approximation.

    Parameters
    ----------
    settings : Settings
        Settings of drawing.
    galaxies : list of Reference
        The galaxies with their true images.
    simplified : list of Reference
        The galaxies to draw: the simplified ones, or the same.
    approximation : Approximation, optional
        The approximation. By default there is no approximation.

    Returns
    -------
    errors : float array, shape (n, 5)
        Errors by the names in `_errors.NAMES`.
    bias : float array, shape (pairs, 2)
        Bias (m, c) of the response to shear.
    """
    error_values, bias = [], []
    for galaxy, simplified_galaxy in zip(galaxies, simplified, strict=True):
        image = approximation.draw(
            simplified_galaxy.sources, simplified_galaxy.psf, VIS, settings, errors.COMPARED_SIDE
        )
        error_values.append(errors.errors(image, galaxy.image, VIS, galaxy.sources))
        if galaxy.response is not None:
            response = _response(simplified_galaxy.sources, simplified_galaxy.psf, approximation, settings)
            bias.append(errors.bias(response, galaxy.response))
    return np.array(error_values), np.array(bias)


def _summary(error_values: Float, bias: Float) -> Row:
    m, c = np.abs(bias).max(axis=0)
    return {
        **errors.figures(error_values),
        "shear_m_worst": float(m),
        "shear_c_worst": float(c),
        "galaxies": len(error_values),
    }


def measure_settings(
    settings: Settings,
    chosen_sample: list[Reference],
    test_sample: list[Reference],
    psf_errors: Mapping[str, dict[str, float]],
) -> Row:
    """Measure the errors of settings for the sample used to choose them, and for the test sample.

    Parameters
    ----------
    settings : Settings
        The settings.
    chosen_sample, test_sample : list of Reference
        The two samples.
    psf_errors : mapping of str to dict
        Largest errors from the finite numbers of positions and colours of the PSF, for "" (first sample) and "_held"
        (test sample).

    Returns
    -------
    dict
        Errors by name; keys of the test sample end in `_held`.
    """
    row: Row = {}
    for kind, sample_part in (("", chosen_sample), ("_held", test_sample)):
        error_values, bias = compare(settings, sample_part, sample_part)
        drawn = _largest_errors(error_values, bias, np.array([each.is_star for each in sample_part]))
        row |= {f"{name}{kind}": math.hypot(drawn[name], psf_errors[kind].get(name, 0.0)) for name in _NUMBERS}
        row |= {f"{name}{kind}_drawn": value for name, value in drawn.items()}
    mag = np.array([float(scenes.magnitudes(each.sources, VIS)[0]) for each in test_sample])
    for low, high in pairwise(scenes.LAYERS):
        row[f"background_held_m{low:g}"] = float(error_values[(mag >= low) & (mag < high), 4].max(initial=0.0))
    galaxy = np.array([not each.is_star for each in test_sample])
    return {**row, **_summary(error_values[galaxy], bias)}


def _largest_errors(error_values: Float, bias: Float, is_star: Bool) -> dict[str, float]:
    """Largest errors by the names of an accuracy, from the errors [n, 5] and bias [pairs, 2] of `compare`."""
    worst = error_values.max(axis=0)
    return {
        "flux": float(np.expm1(worst[0] / _MAG)),
        "shape": float(
            max(worst[3] / 2, np.abs(bias).max(), positions.R2_RATIO * error_values[is_star, 2].max(initial=0.0))
        ),
        "position": float(worst[1] / 1e3 / VIS.scale),
        "background": float(worst[4]),
    }


def measure_approximation(
    approximation: Approximation, settings: Settings, repeats: int, quoted: list[Reference]
) -> Row:
    """Measure the times with and without an approximation, and its errors.

    Parameters
    ----------
    approximation : Approximation
        The approximation.
    settings : Settings
        Settings of drawing.
    repeats : int
        Number of repeats of each time.
    quoted : list of Reference
        Sample for approximations that apply to all galaxies.

    Returns
    -------
    dict
        `seconds_before` and `seconds` (CPU time without and with the approximation), and errors.
    """
    n, pairs, num_timed = approximation.sample_sizes
    sources, full_psf = scenes.sources(VIS, _SCENE_SEED, stars=0), scenes.scene_psf(VIS)
    if num_timed:
        sources = approximation.select_galaxies(VIS, _SCENE_SEED, num_timed)
    row: Row = {"galaxies_timed": len(sources), "seconds_before": _seconds(sources, full_psf, settings, repeats)}
    simple_sources, simple_psf = approximation.simplify(sources), approximation.simplify_psf(full_psf)
    row["seconds"] = _seconds(simple_sources, simple_psf, settings, repeats, approximation.timed_as or approximation)
    sources = approximation.select_galaxies(VIS, _QUOTED_SEED, n)
    galaxies = (
        quoted if approximation.select_galaxies is NO_APPROXIMATION.select_galaxies else make_references(sources, pairs)
    )
    simplified = [_simplify_galaxy(galaxy, sources, simple_psf, approximation) for galaxy in galaxies]
    # Use large stamps, so that the approximation is the only error, unless it approximates the sizes of stamps.
    settings_used = _TRUTH if approximation.sizes is NO_APPROXIMATION.sizes else settings
    return {**row, **_summary(*compare(settings_used, galaxies, simplified, approximation))}


def _simplify_galaxy(
    galaxy: Reference, sources: Sources, simple_psf: model.Psf, approximation: Approximation
) -> Reference:
    """Simplify a galaxy of `sources`; `simple_psf` is the simplified PSF of the detector."""
    source = replace(approximation.simplify(galaxy.sources), photons=None)
    if approximation.simplify_psf is NO_APPROXIMATION.simplify_psf:
        return replace(galaxy, sources=source)
    place = np.flatnonzero(sources.ids == galaxy.sources.ids[0])
    return replace(
        galaxy, sources=source, psf=scenes.psf_of_source(simple_psf, approximation.simplify(sources), int(place[0]))
    )


def _seconds(
    sources: Sources, psf: model.Psf, settings: Settings, repeats: int, approximation: Approximation = NO_APPROXIMATION
) -> float:
    """CPU time (s) to draw sources on the frame of the scene."""
    # Draw some of the brightest sources first: they use double precision, which is compiled separately.
    is_bright = sources.electrons >= np.sort(sources.electrons)[-3:].min()
    approximation.draw(sources.take(is_bright | (np.arange(len(sources)) % 500 == 0)), psf, VIS, settings)
    return report.best_time(lambda: approximation.draw(sources, psf, VIS, settings), repeats, time.process_time)


def time_settings(settings_list: Sequence[Settings], repeats: int) -> dict[Settings, float]:
    """Return the CPU time (s) of the scene by settings.

    All settings are drawn in turn, so that other load on the machine affects them equally.
    """
    scene, out = scenes.sources(VIS, _SCENE_SEED), dict.fromkeys(settings_list, np.inf)
    for _ in range(repeats):
        for each in settings_list:
            psf = scenes.scene_psf(VIS, each.positions, each.colours)
            out[each] = min(out[each], _seconds(scene, psf, each, 1))
    return out


def measure_galsim(test_sample: list[Reference], num_per_bin: int) -> Row:
    """Return time and errors of galsim with default parameters, for the galaxies and the truth that our errors use."""
    default, _ = peers.galsim_seconds(VIS, num_per_bin)
    galaxies = [reference for reference in test_sample if not reference.is_star]
    error_values = [
        errors.errors(peers.galsim_image(g.sources, g.psf, errors.COMPARED_SIDE), g.image, VIS, g.sources)
        for g in galaxies
    ]
    return {"seconds": default, **errors.figures(np.array(error_values)), "galaxies": len(error_values)}


def compare_oracles(test_sample: list[Reference]) -> Iterator[Row]:
    """Yield the differences between galsim with its tightest parameters and methods that should be as accurate."""
    galaxies = [reference for reference in test_sample if not reference.is_star]
    draw_functions: dict[str, Callable[[Reference], Float | None]] = {
        "ours, the largest stamps": lambda g: scenes.draw_sources(g.sources, g.psf, VIS, _TRUTH, errors.COMPARED_SIDE)
    }
    for name, folding_threshold, maxk_threshold in _LOOSER_THRESHOLDS:
        draw_functions[name] = partial(
            _draw_with_thresholds, folding_threshold=folding_threshold, maxk_threshold=maxk_threshold
        )
    draw_functions["the PSF by its Fourier series"] = _draw_by_series
    for name, draw_galaxy in draw_functions.items():
        images = [(draw_galaxy(reference), reference) for reference in galaxies]
        error_values = [errors.errors(image, g.image, VIS, g.sources) for image, g in images if image is not None]
        yield {"kind": "oracle", "name": name, **errors.figures(np.array(error_values)), "galaxies": len(error_values)}
    # For galaxies that are small compared with the frame the Fourier series is the better truth.
    faint = [reference for reference in galaxies if float(scenes.magnitudes(reference.sources, VIS)[0]) > _SMALL]
    error_values = [
        errors.errors(draw_functions["ours, the largest stamps"](g), _draw_by_series(g), VIS, g.sources) for g in faint
    ]  # type: ignore[arg-type]
    yield {"kind": "series", "name": "ours", **errors.figures(np.array(error_values)), "galaxies": len(error_values)}


def _draw_by_series(reference: Reference) -> Float:
    return references.image_by_series(reference.sources, reference.psf, errors.COMPARED_SIDE)


def _draw_with_thresholds(reference: Reference, folding_threshold: float, maxk_threshold: float) -> Float | None:
    return references.reference_image(
        reference.sources, reference.psf, errors.COMPARED_SIDE, maxk_threshold, folding_threshold
    )


def measure_all(quick: bool, repeats: int) -> Iterator[Row]:
    """Yield one row per point, each measured in a separate process."""
    chain = [_CHAIN[0], _CHAIN[_SURVEY]] if quick else _CHAIN
    changed = [] if quick else [Settings(**{**asdict(_CHAIN[_SURVEY]), name: value}) for name, value in _CHANGED]
    num_chosen, num_test, pairs = (1, 1, 2) if quick else (_NUM_CHOSEN, _NUM_TEST, _NUM_SHEARED)
    chosen_sample = make_references(scenes.stratified_sample(VIS, _CHOSEN_SEED, num_chosen), pairs)
    test_sample = errors.run_with_memory_limit(
        make_references, scenes.stratified_sample(VIS, _TEST_SEED, num_test), pairs, 0.0 if quick else _MAXK_THRESHOLD
    )
    psf_variants = list(dict.fromkeys((candidate.positions, candidate.colours) for candidate in (*chain, *changed)))
    stars = (positions.NUM_STARS, positions.NUM_TEST_STARS)
    psf_errors = [
        positions.largest_errors(seed, 4 if quick else n, psf_variants)
        for seed, n in zip(_PSF_SEEDS, stars, strict=True)
    ]
    seconds = errors.run_with_memory_limit(time_settings, [*chain, *changed], repeats)
    for kind, settings_group in (("settings", chain), ("changed", changed)):
        for i, settings in enumerate(settings_group):
            name = f"{i + 1}" if kind == "settings" else "{} {:g}".format(*_CHANGED[i])
            psf_error_pair = {
                end: errors_by_variant[settings.positions, settings.colours]
                for end, errors_by_variant in zip(("", "_held"), psf_errors, strict=True)
            }
            figures = errors.run_with_memory_limit(
                measure_settings, settings, chosen_sample, test_sample, psf_error_pair
            )
            header = {"kind": kind, "name": name, **asdict(settings), "seconds": seconds[settings]}
            yield {**header, **figures, "machine": report.machine()}
    if not quick:
        yield {"kind": "peer", "name": "galsim", **errors.run_with_memory_limit(measure_galsim, test_sample, 4)}
        yield from errors.run_with_memory_limit(lambda: list(compare_oracles(test_sample)))
    quoted = make_references(scenes.sample(VIS, _QUOTED_SEED, 6 if quick else _NUM_QUOTED), 2 if quick else _NUM_PAIRS)
    for approximation in approximations.ALL[:1] if quick else approximations.ALL:
        figures = errors.run_with_memory_limit(measure_approximation, approximation, _CHAIN[_SURVEY], repeats, quoted)
        yield {"kind": "approximation", "name": approximation.name, **figures}


def _format_row(row: Row) -> str:
    columns = (
        "seconds",
        "aperture_mag_rms",
        "r2_rms",
        "r2_worst",
        "ellipticity_worst",
        "shear_m_worst",
        "shear_c_worst",
    )
    return f"{row['kind']:14}{row['name']:32}" + "".join(f"{row[key]:>12.2g}" for key in columns if key in row)


def write(rows: list[Row], file: Path) -> None:
    """Write the rows as CSV, with a column for every key; a field is empty if a row does not have the key."""
    names = list(dict.fromkeys(key for row in rows for key in row))
    with file.open("w", newline="", encoding="utf-8") as out:
        writer = csv.DictWriter(out, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: f"{v:.4g}" if isinstance(v, float) else v for key, v in row.items()} for row in rows)


def settings_table(rows: list[Row]) -> str:
    """Return the table of settings that truesky.request.accuracy reads, from the rows of trade.csv."""
    names = _SETTINGS.splitlines()[-1].split(",")
    setting_rows = [row for row in rows if row["kind"] == "settings"]
    lines = [",".join(f"{float(row[name]):.4g}" for name in names) for row in setting_rows]
    return _SETTINGS.format(machine=setting_rows[0]["machine"]) + "\n".join(lines) + "\n"


def draw_figure(rows: list[Row], file: Path) -> None:
    """Plot time against the errors of flux, size, ellipticity and position."""
    from matplotlib.figure import Figure

    labels = {"aperture_mag_rms": 'flux in 1", mag', "r2_rms": "R², relative", "ellipticity_rms": "ellipticity"}
    figure = Figure(figsize=(13, 4.2), layout="constrained")
    axes = figure.subplots(1, 4, sharey=True)
    for axis, (key, label) in zip(axes, (labels | {"centroid_mas_rms": "position, mas"}).items(), strict=True):
        for kind, style in (("settings", "o-"), ("changed", "x"), ("peer", "s")):
            points = [row for row in rows if row["kind"] == kind]
            axis.loglog([row[key] for row in points], [row["seconds"] for row in points], style, label=kind)
        axis.set_xlabel(f"rms error: {label}")
    axes[0].set_ylabel("CPU s of a VIS detector")
    axes[0].legend()
    figure.savefig(file, dpi=100)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark, print the figures and write the requested files."""
    extra_parser = argparse.ArgumentParser(add_help=False)
    extra_parser.add_argument("--csv", type=Path, metavar="FILE", help="write the points to this file")
    extra_parser.add_argument("--figure", type=Path, metavar="FILE", help="plot time against errors")
    extra_parser.add_argument(
        "--settings", type=Path, metavar="FILE", help="write the table from which settings are chosen"
    )
    extra_parser.add_argument(
        "--positions", type=Path, metavar="FILE", help="write only the table of positions of the PSF"
    )
    extra_parser.add_argument("--repeats", type=int, default=3, help="repeats; the shortest time counts")
    extra_options, other_arguments = extra_parser.parse_known_args(argv)
    options = report.options("trade", __doc__ or "", other_arguments)
    if extra_options.positions:
        extra_options.positions.write_text(
            positions.table_text(positions.measure_positions(positions.NUM_STARS)), encoding="utf-8"
        )
        return 0
    repeats = 1 if options.quick else extra_options.repeats
    rows: list[Row] = []
    for row in measure_all(options.quick, repeats):
        rows.append(row)
        print(_format_row(row), flush=True)
        # Write after every point, because the benchmark takes long.
        if extra_options.csv:
            write(rows, extra_options.csv)
    if extra_options.figure:
        draw_figure(rows, extra_options.figure)
    if extra_options.settings:
        extra_options.settings.write_text(settings_table(rows), encoding="utf-8")
    figures = {
        f"{row['name']}_s".replace(" ", "_"): float(row["seconds"])
        for row in rows
        if "seconds" in row and row["kind"] != "settings"
    }
    report.print_and_write("trade", repeats, figures, {}, options.json)
    return 0


if __name__ == "__main__":
    sys.exit(main())
