"""Measure time and errors of the settings for drawing spectra, for the sample used to choose them and for another one.

Galaxies and stars are drawn one by one in an order of the red grism, with continuum and one line. The truth is a slow
method: each sample of the trace has separate rows and a separate PSF, on large and finely sampled stamps, with a PSF of
more wavelengths.
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
from truesky.render.dispersing.draw import DispersedSources, Order, Settings
from truesky.render.psf import euclid
from truesky.render.psf.model import Psf
from truesky.render.sources.source_list import Sources

# Noise of the sky in an exposure with the red grism, electrons per pixel.
NOISE = 28.0
# Kinds of errors; the table contains the largest of each.
ERROR_NAMES = ("background", "flux", "position")
# Number of sources to choose the settings and to test them, with seeds; number of sources to time, with seed.
NUM_CHOSEN, NUM_TEST, _SEEDS, _NUM_TIMED, _TIMED_SEED = 18, 36, (41, 42), 400, 43
# Tilts of the grism (deg) of the sources in turn. All light of a source is in the first order.
_TILTS = (0.0, 4.0, -4.0)
# Brightest and faintest H_E, and electrons of magnitude 0 for a zero point of 25.3 and 549.6 s.
_BRIGHT, _FAINT, _ZERO = 17.0, 23.0, 549.6 * 10 ** (0.4 * 25.3)
_TRUTH = Settings(edge=1e-5, faint=0.0, min_size=80, along=4, across=4, block=0.0, nodes=5, positions=9)
# Shape of the frame and position of the undispersed image; half sides of the box around a line; sigma of the weight of
# its centroid. All in pixels.
_SHAPE, _PLACE, _BOX, _SIGMA = (128, 720), (270.0, 60.0), (8, 4), 2.0
_TABLE_HEADER = """\
# Settings of drawing spectra. allowed: the error of a pixel, of its noise, that they are for.
#
# edge, faint: of a sky pixel's noise; min_size: pixels; along, across: samples a pixel; block: A that share a PSF;
# nodes: wavelengths of the PSF; positions: of the PSF on a detector, one of euclid.DEGREES.
# Then by python -m benchmarks.nisp_s --settings, the largest errors of {chosen} galaxies and stars of
# H_E = {bright:g} to {faint:g} that the settings were chosen on, and (_held) of {held} others, each in a first order
# at a tilt of 0, 4 or -4 deg: background: of a pixel, of its own noise; flux: of a line in {wide} x {high} pixels;
# position: of a line, pixels; against every sample of the trace with a PSF and rows of its own.
# CPU seconds of 7,400 first orders, on {machine}.
"""


@dataclass(frozen=True)
class SampleSource:
    """A single source, the tilt of the grism (deg), its continuum and line, and the position of the line (pixels)."""

    source: Sources
    tilt: float
    continuum: Float32
    line: Float32
    place: tuple[float, float]


def first_orders(tilt: float) -> tuple[Order, ...]:
    """Return the first order of the red grism for a tilt in degrees."""
    mission, band = resolve(), passbands.load("nisp_red")
    first = next(t for t in traces.traces("RGS000", tilt, _detector(), mission) if t.order == 1)
    return (Order(first, int(band.wavelength[0]), band.response * band.wavelength),)


def _detector() -> detectors.Detector:
    return detectors.detector("nisp", "DET22", resolve())


def settings_psf(settings: Settings) -> Psf:
    """Return the PSF at the wavelengths and positions of the settings."""
    trace = first_orders(0.0)[0].trace
    nodes = images.nodes(trace.first, trace.last, settings.nodes)
    return euclid.nisp_psf_at(_detector(), nodes, resolve(), settings.positions)


def sample_sources(seed: int, count: int) -> list[SampleSource]:
    """Draw a sample of two galaxies per star, uniform in magnitude."""
    rng = np.random.default_rng(seed)
    stars = count // 3
    sources = scenes.sources(NISP, seed, galaxies=count - stars, stars=stars)
    mag = _BRIGHT + (_FAINT - _BRIGHT) * (rng.permutation(count) + rng.random(count)) / count
    sources = replace(sources, electrons=_ZERO * 10 ** (-0.4 * mag), photons=None)
    sources.column[:], sources.row[:] = (place + rng.random(count) for place in _PLACE)
    wave, weight = first_orders(0.0)[0].wavelength, first_orders(0.0)[0].response
    sample_list = []
    for i in range(count):
        tilt, centre = _TILTS[i % len(_TILTS)], rng.uniform(12600.0, 18400.0)
        parts = [wave ** rng.uniform(-3.0, 0.0), np.exp(-0.5 * ((wave - centre) / rng.uniform(5.0, 15.0)) ** 2)]
        share = rng.uniform(0.05, 0.3)
        continuum, line = (
            (s * part / (part * weight).sum()).astype(np.float32)[None]
            for s, part in zip((1 - share, share), parts, strict=True)
        )
        source = sources.take(np.array([i]))
        x, y = first_orders(tilt)[0].trace.offsets(float(source.column[0]), float(source.row[0]), np.array([centre]))
        place = float(source.column[0] + x[0]), float(source.row[0] + y[0])
        sample_list.append(SampleSource(source, tilt, continuum, line, place))
    return sample_list


def draw_images(sample_source: SampleSource, settings: Settings, psf: Psf) -> tuple[Float, Float]:
    """Draw a source.

    Parameters
    ----------
    sample_source : SampleSource
        The source.
    settings : Settings
        Settings of drawing spectra.
    psf : Psf
        PSF at the wavelengths and positions of the settings.

    Returns
    -------
    total, line : float array
        Expected electrons of the whole spectrum, and of its line alone.
    """
    spectra = sample_source.continuum + sample_source.line, sample_source.line
    dispersions = (
        DispersedSources(lambda _, spectrum=spectrum: spectrum, first_orders(sample_source.tilt), settings)
        for spectrum in spectra
    )  # type: ignore[misc]
    total, line = (draw.draw(sample_source.source, each, psf, _SHAPE, NOISE) for each in dispersions)
    return total, line


def errors(
    drawn: tuple[Float, Float], truth: tuple[Float, Float], sample_source: SampleSource
) -> tuple[float, float, float]:
    """Return the errors of a drawn source.

    Parameters
    ----------
    drawn, truth : tuple of float array
        Images of `draw_images`.
    sample_source : SampleSource
        The source.

    Returns
    -------
    background : float
        Largest error of a pixel, in units of its noise.
    flux : float
        Relative error of the flux of the line in a box.
    position : float
        Error of the position of the line, in pixels.
    """
    background = np.abs(drawn[0] - truth[0]) / np.sqrt(NOISE**2 + np.maximum(truth[0], 0.0))
    measured, expected = (_flux_and_centroid(image, *sample_source.place) for image in (drawn[1], truth[1]))
    return (
        float(background.max()),
        abs(measured[0] / expected[0] - 1.0),
        float(np.hypot(measured[1] - expected[1], measured[2] - expected[2])),
    )


def _flux_and_centroid(image: Float, column: float, row: float) -> tuple[float, float, float]:
    """Flux in a box around a line, and its centroid with a Gaussian weight."""
    first_column, first_row = round(column) - _BOX[0], round(row) - _BOX[1]
    box = image[first_row : first_row + 2 * _BOX[1] + 1, first_column : first_column + 2 * _BOX[0] + 1]
    y, x = np.indices(box.shape)
    x, y = x + first_column - column, y + first_row - row
    weighted = box * np.exp(-0.5 * (x**2 + y**2) / _SIGMA**2)
    total = weighted.sum()
    return float(box.sum()), float((weighted * x).sum() / total), float((weighted * y).sum() / total)


def seconds(settings: Settings, repeats: int) -> float:
    """Return the CPU time (s) to draw the first orders of 7,400 sources on a detector, 10 % of them stars."""
    rng, psf = np.random.default_rng(_TIMED_SEED), settings_psf(settings)
    sources = scenes.sources(NISP, _TIMED_SEED, galaxies=_NUM_TIMED - _NUM_TIMED // 10, stars=_NUM_TIMED // 10)
    low, high = 10 ** (0.3 * _BRIGHT), 10 ** (0.3 * _FAINT)
    mag = np.log10(low + (high - low) * rng.random(len(sources))) / 0.3
    sources = replace(sources, electrons=_ZERO * 10 ** (-0.4 * mag), photons=None)
    spectrum = sample_sources(_TIMED_SEED, 3)[0]
    flat = spectrum.continuum + spectrum.line
    dispersed = DispersedSources(lambda chosen: np.repeat(flat, len(chosen), axis=0), first_orders(0.0), settings)
    draw.draw(sources.take(np.arange(0, len(sources), 50)), dispersed, psf, (NISP.ny, NISP.nx), NOISE)
    half_seconds, all_seconds = np.inf, np.inf
    for _ in range(repeats):
        started = time.process_time()
        draw.draw(sources.take(np.arange(len(sources) // 2)), dispersed, psf, (NISP.ny, NISP.nx), NOISE)
        half = time.process_time()
        draw.draw(sources, dispersed, psf, (NISP.ny, NISP.nx), NOISE)
        half_seconds, all_seconds = min(half_seconds, half - started), min(all_seconds, time.process_time() - half)
    # Extrapolate by the time per source; the time that does not depend on the number of sources counts once.
    each = (all_seconds - half_seconds) / (len(sources) - len(sources) // 2)
    return all_seconds + each * (7400 - len(sources))


def measure_settings(
    tiers: Iterable[Settings], repeats: int, num_chosen: int = NUM_CHOSEN, num_test: int = NUM_TEST
) -> list[dict[str, float]]:
    """Measure errors and time of several settings.

    Parameters
    ----------
    tiers : iterable of Settings
        The settings.
    repeats : int
        Number of repeats of each time.
    num_chosen, num_test : int, optional
        Number of sources of the sample used to choose the settings, and of the test sample.

    Returns
    -------
    list of dict
        For each of the settings the largest errors for the first sample, for the test sample (keys that end in
        `_held`), and `seconds`.
    """
    samples = {
        end: sample_sources(seed, n) for end, seed, n in zip(("", "_held"), _SEEDS, (num_chosen, num_test), strict=True)
    }
    psf = settings_psf(_TRUTH)
    truths = {
        end: [draw_images(sample_source, _TRUTH, psf) for sample_source in sample_list]
        for end, sample_list in samples.items()
    }
    table_rows = []
    for settings in tiers:
        row, psf_for_settings = {}, settings_psf(settings)
        for end, sample_list in samples.items():
            each = [
                errors(draw_images(sample_source, settings, psf_for_settings), t, sample_source)
                for sample_source, t in zip(sample_list, truths[end], strict=True)
            ]
            row |= {f"{name}{end}": float(worst) for name, worst in zip(ERROR_NAMES, np.max(each, axis=0), strict=True)}
        table_rows.append({**row, "seconds": seconds(settings, repeats)})
    return table_rows


def settings_table(repeats: int = 2) -> str:
    """Return the table of the current settings with newly measured errors and times, as text."""
    current_rows = draw.read_settings()
    setting_names = [name for name in current_rows[0] if name == "allowed" or name in Settings.__slots__]
    names = [*setting_names, *(f"{name}{end}" for end in ("", "_held") for name in ERROR_NAMES), "seconds"]
    measured_rows = measure_settings([draw.settings_from_row(row) for row in current_rows], repeats)
    lines = [
        ",".join(
            f"{({**row, **measured})[name]:.2g}" if name not in setting_names else f"{row[name]:g}" for name in names
        )
        for row, measured in zip(current_rows, measured_rows, strict=True)
    ]
    head = _TABLE_HEADER.format(
        chosen=NUM_CHOSEN, held=NUM_TEST, bright=_BRIGHT, faint=_FAINT, wide=2 * _BOX[0] + 1, high=2 * _BOX[1] + 1,
        machine=report.machine(),
    )  # fmt: skip
    return "\n".join([*head.splitlines(), ",".join(names), *lines]) + "\n"
