"""Measure the CPU time and the errors of drawing sources on a VIS detector, for several settings and approximations.

A setting is a set of parameters of the drawing code. The settings are chosen with one sample of sources, which are
compared with a drawing on very large stamps in double precision. Their errors are then measured on a test sample, with
equal numbers of galaxies and stars in each range of magnitude, against galsim with its tightest parameters.

The benchmark also measures galsim with default parameters, and galsim with a relaxed value of one tight parameter. It
measures approximations with which other programs save time, relative to the most accurate drawing of truesky. The
errors of each setting, and each approximation, are measured in a separate process. The CPU times of all settings are
measured in one process.

With --lensing it measures the lensing maps of the catalogue instead: errors of the shear and cost by resolution.
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
from benchmarks import _lensing as lensing
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
# Settings of the drawing code from the least accurate ("quicklook") to the most accurate ("reference").
_CHAIN = (
    Settings(0.5, 1e-2, 1e-1, 2.4, 1, 2),
    Settings(0.25, 4e-3, 3e-2, 4.0, 4, 4),
    Settings(0.085, 1e-3, 1e-2, 5.2, 9),
    Settings(0.04, 5e-4, 3e-3, 5.6, 9),
    Settings(0.018, 2e-4, 1e-3, 6.5, 9),
    Settings(0.005, 5e-5, 1e-4, 8.0, 25),
)
# Index in _CHAIN of the settings for the accuracy "survey".
_SURVEY = 4
# Variants of the settings for survey accuracy: name of one parameter, and its changed value.
_CHANGED = (
    ("edge", 0.1),
    ("aliased", 1e-2),
    ("floor", 1e-2),
    ("min_size_arcsec", 5.6),
    ("min_size_arcsec", 3.2),
    ("colours", 4),
)
# Number of galaxies, and of stars, per range of magnitude in the sample with which settings are chosen.
_NUM_CHOSEN = 3
# Number of galaxies, and of stars, per range of magnitude in the sample with which the chosen settings are tested.
_NUM_TEST = 4
# Number of galaxies in each sample for which the bias of shear is measured.
_NUM_SHEARED = 12
# Number of galaxies with which approximations of other programs are measured.
_NUM_QUOTED = 24
# Number of galaxies with which the bias of shear by approximations of other programs is measured.
_NUM_PAIRS = 18
_CHOSEN_SEED, _TEST_SEED, _QUOTED_SEED, _SCENE_SEED = 12, 34, 21, 1
# Seeds of the stars with which the error of the PSF is measured: for the sample with which settings are chosen, and for
# the test sample.
_PSF_SEEDS = (5, 6)
# Parameter maxk_threshold of galsim for the true images. With 1e-4 the centres of bright discs would be wrong by 3e-3
# of the noise.
_MAXK_THRESHOLD = 1e-5
# Galaxies fainter than this magnitude are small compared with the width of the image on which they are drawn.
_SMALL = 20.0
# Variants of galsim with one relaxed parameter: name, folding_threshold, maxk_threshold.
_LOOSER_THRESHOLDS = (("folding 1e-3", 1e-3, _MAXK_THRESHOLD), ("largest frequency 1e-4", references.ACCURACY, 1e-4))
# Settings of the most accurate drawing. Its only approximation is a finite stamp, at least 25.6 arcsec wide.
_TRUTH = Settings(edge=1e-6, aliased=1e-8, floor=0.0, min_size_arcsec=25.6, positions=9)
# Factor from a small relative error of a flux to the error in magnitudes: 2.5 / ln(10).
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
    """A source in the middle of an image, its PSF, its true image, and its true response to shear.

    `sources` is a list of one source. `response` contains de1/dg1, de2/dg2 and the mean e1 and e2 of a pair rotated by
    90 degrees; it is None if it is not measured.
    """

    sources: Sources
    psf: model.Psf
    image: Float
    response: Float | None

    @property
    def is_star(self) -> bool:
        """True if the source is a star."""
        return bool(self.sources.shape[0] < 0)


def make_references(sources: Sources, num_pairs: int, maxk_threshold: float = 0.0) -> list[Reference]:
    """Draw the true images of sources on a VIS detector.

    Parameters
    ----------
    sources : Sources
        The sources.
    num_pairs : int
        Number of galaxies whose response to shear is measured; the first ones in random order are used.
    maxk_threshold : float, optional
        Parameter of galsim, with which galaxies are drawn. With 0 (default), and if galsim fails, the true images are
        drawn by truesky on very large stamps. Otherwise those of stars follow from the Fourier series of their PSF.

    Returns
    -------
    list of Reference
        The sources with their true images, in random order.
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
    """Return the true image of a galaxy (drawn by galsim) or of a star (from the Fourier series of its PSF).

    None is returned if galsim fails or has not enough memory.
    """
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
    """Measure the errors of sources that are drawn with some settings and, optionally, with an approximation.

    Parameters
    ----------
    settings : Settings
        Parameters of the drawing code, such as limits for the sizes of stamps.
    galaxies : list of Reference
        The sources with their true images.
    simplified : list of Reference
        The sources to draw, in the same order: `galaxies` again, or a simplified copy for an approximation.
    approximation : Approximation, optional
        Approximation of stamp sizes or of the image. By default nothing is approximated.

    Returns
    -------
    errors : float array, shape (n, 5)
        Aperture magnitude, centroid (mas), relative R2, ellipticity, and largest error of a pixel in units of the
        noise.
    bias : float array, shape (pairs, 2)
        Bias (m, c) of the response to shear, for the sources whose true response is known.
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
    """Measure the errors of settings of the drawing code for two samples.

    Parameters
    ----------
    settings : Settings
        Parameters of the drawing code, such as limits for the sizes of stamps.
    chosen_sample, test_sample : list of Reference
        Sources with which settings are chosen, and other sources with which they are tested.
    psf_errors : mapping of str to dict
        Largest errors that follow from the finite numbers of positions and wavelengths of the PSF, by name, for the
        first sample (key "") and for the test sample (key "_held"). They are added in quadrature.

    Returns
    -------
    dict
        Largest errors by name: `flux` (relative), `shape`, `position` (pixels) and `background` (in units of the
        noise). Names for the test sample end in `_held`.
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
    """Return the largest errors by the names that a request uses for an accuracy: flux, shape, position, background.

    `error_values` [n, 5] and `bias` [pairs, 2] are results of `compare`. `is_star` [n] is True for stars.
    """
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
    """Measure the CPU time with and without an approximation, and its errors.

    Parameters
    ----------
    approximation : Approximation
        Approximation to measure.
    settings : Settings
        Parameters of the drawing code, such as limits for the sizes of stamps.
    repeats : int
        Number of repeats of each measurement of time.
    quoted : list of Reference
        Galaxies with true images, for approximations that apply to all galaxies. Other approximations draw a sample of
        the galaxies for which they are meant.

    Returns
    -------
    dict
        `seconds_before` and `seconds` (CPU time without and with the approximation), `galaxies_timed` (number of
        galaxies that were timed), and errors by name.
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
    # Draw on large stamps, so that the approximation is the only source of error. An approximation of the sizes of
    # stamps is measured with `settings`.
    settings_used = _TRUTH if approximation.sizes is NO_APPROXIMATION.sizes else settings
    return {**row, **_summary(*compare(settings_used, galaxies, simplified, approximation))}


def _simplify_galaxy(
    galaxy: Reference, sources: Sources, simple_psf: model.Psf, approximation: Approximation
) -> Reference:
    """Return a galaxy to which an approximation of profiles and PSF has been applied.

    `sources` is the list of sources from which the galaxy was taken, and `simple_psf` the simplified PSF of the
    detector.
    """
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
    """Return the CPU time (s) to draw sources on a VIS detector, the shortest of `repeats` measurements."""
    # Draw a few sources before the clock starts, because functions are compiled at their first call. The brightest
    # ones are among them, because they use separate functions in double precision.
    is_bright = sources.electrons >= np.sort(sources.electrons)[-3:].min()
    approximation.draw(sources.take(is_bright | (np.arange(len(sources)) % 500 == 0)), psf, VIS, settings)
    return report.best_time(lambda: approximation.draw(sources, psf, VIS, settings), repeats, time.process_time)


def time_settings(settings_list: Sequence[Settings], repeats: int) -> dict[Settings, float]:
    """Return the CPU time (s) to draw all sources of a VIS detector with each of several settings.

    In each repeat all settings are timed one after another, so that other load on the machine affects them equally. The
    shortest time of each counts.
    """
    scene, out = scenes.sources(VIS, _SCENE_SEED), dict.fromkeys(settings_list, np.inf)
    for _ in range(repeats):
        for each in settings_list:
            psf = scenes.scene_psf(VIS, each.positions, each.colours)
            out[each] = min(out[each], _seconds(scene, psf, each, 1))
    return out


def measure_galsim(test_sample: list[Reference], num_per_bin: int) -> Row:
    """Return the CPU time and the errors of galsim with default parameters.

    The errors are measured for the galaxies in `test_sample`, relative to their true images. `num_per_bin` is the
    number of galaxies per bin of magnitude for which the time is measured; it is scaled to all galaxies of a VIS
    detector.
    """
    default, _ = peers.galsim_seconds(VIS, num_per_bin)
    galaxies = [reference for reference in test_sample if not reference.is_star]
    error_values = [
        errors.errors(peers.galsim_image(g.sources, g.psf, errors.COMPARED_SIDE), g.image, VIS, g.sources)
        for g in galaxies
    ]
    return {"seconds": default, **errors.figures(np.array(error_values)), "galaxies": len(error_values)}


def compare_oracles(test_sample: list[Reference]) -> Iterator[Row]:
    """Yield the differences between galsim with its tightest parameters and other accurate methods.

    The methods are truesky on very large stamps, galsim with one relaxed parameter, and the Fourier series of the PSF.
    The last row compares truesky with the Fourier series, for small galaxies.
    """
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
    # For galaxies that are small compared with the image, the Fourier series is more accurate than galsim.
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
    """Measure everything, and yield one row (values by name) per setting, approximation or other program.

    `quick` measures only a few of them with few sources. Each row is measured in a separate process, but all
    settings are timed in the same process.
    """
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
    """Write rows (dictionaries with values by name) to a CSV file, with one column for every name.

    A field is empty if its row does not have the name.
    """
    names = list(dict.fromkeys(key for row in rows for key in row))
    with file.open("w", newline="", encoding="utf-8") as out:
        writer = csv.DictWriter(out, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows({key: f"{v:.4g}" if isinstance(v, float) else v for key, v in row.items()} for row in rows)


def settings_table(rows: list[Row]) -> str:
    """Return the CSV table of settings, errors and times that truesky.request.accuracy reads, as text.

    `rows` are the rows of `measure_all`; at least one must have the kind "settings".
    """
    names = _SETTINGS.splitlines()[-1].split(",")
    setting_rows = [row for row in rows if row["kind"] == "settings"]
    lines = [",".join(f"{float(row[name]):.4g}" for name in names) for row in setting_rows]
    return _SETTINGS.format(machine=setting_rows[0]["machine"]) + "\n".join(lines) + "\n"


def draw_figure(rows: list[Row], file: Path) -> None:
    """Plot CPU time against the rms errors of flux, size, ellipticity and position into an image file.

    `rows` are the rows of `measure_all`.
    """
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
    """Run the benchmark with the options `argv` (default: the command line), and return 0.

    The results are printed, and written to the files that options name.
    """
    extra_parser = argparse.ArgumentParser(add_help=False)
    extra_parser.add_argument("--csv", type=Path, metavar="FILE", help="write the points to this file")
    extra_parser.add_argument("--figure", type=Path, metavar="FILE", help="plot time against errors")
    extra_parser.add_argument(
        "--settings", type=Path, metavar="FILE", help="write the table from which settings are chosen"
    )
    extra_parser.add_argument(
        "--positions", type=Path, metavar="FILE", help="write only the table of positions of the PSF"
    )
    extra_parser.add_argument(
        "--lensing", type=Path, metavar="FILE", help="write only the table of resolutions of the lensing maps"
    )
    extra_parser.add_argument("--repeats", type=int, default=3, help="repeats; the shortest time counts")
    extra_options, other_arguments = extra_parser.parse_known_args(argv)
    options = report.options("trade", __doc__ or "", other_arguments)
    if extra_options.positions:
        extra_options.positions.write_text(
            positions.table_text(positions.measure_positions(positions.NUM_STARS)), encoding="utf-8"
        )
        return 0
    if extra_options.lensing:
        lensing.write_table(lensing.measure(options.quick), extra_options.lensing)
        return 0
    repeats = 1 if options.quick else extra_options.repeats
    rows: list[Row] = []
    for row in measure_all(options.quick, repeats):
        rows.append(row)
        print(_format_row(row), flush=True)
        # Write the file after every row, because the benchmark takes long and might be interrupted.
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
