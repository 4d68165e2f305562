"""Measure the CPU time and the errors of drawing slitless spectra, for several settings (parameters of the code).

Errors are measured on the sources with which the settings were chosen, and on other sources. Galaxies and stars are
drawn one by one in the first order of the red grism, with a continuum and one emission line. They are compared with a
slow method: it uses large and finely sampled stamps, and a separate PSF at each step along the trace.
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
# Names of the measured errors: error of a pixel, error of the flux of a line, and error of the position of a line.
ERROR_NAMES = ("background", "flux", "position")
# Number of sources in the sample with which the settings of the drawing code are chosen.
NUM_CHOSEN = 18
# Number of sources in each sample with which the chosen settings are tested.
NUM_TEST = 36
# Seed of the sources with which settings are chosen, and seeds of the samples with which they are tested.
_CHOSEN_SEED, _TEST_SEEDS = 41, (42, 78)
# Number of sources with which the time of drawing is measured.
_NUM_TIMED = 400
# Seed of the sources with which the time of drawing is measured.
_TIMED_SEED = 43
# Tilts of the grism (deg), which are used in turn for the sources. All light of a source is in the first order.
_TILTS = (0.0, 4.0, -4.0)
# Brightest and faintest H_E magnitude of the sources.
_BRIGHT, _FAINT = 17.0, 23.0
# Electrons of a source of magnitude 0, for a zero point of 25.3 mag (1 electron per s) and 549.6 s.
_ZERO = 549.6 * 10 ** (0.4 * 25.3)
# Shape (ny, nx) of the image of one spectrum, pixels.
_SHAPE = (128, 720)
# Column and row at which the source of a spectrum would lie on the image without the grism. A random fraction of a
# pixel is added to both.
_PLACE = (270.0, 60.0)
# Half width and half height of the box in which the flux of a line is measured, pixels.
_BOX = (8, 4)
# Sigma of the Gaussian weight for the centroid of a line, pixels.
_SIGMA = 2.0
_TABLE_HEADER = """\
# Settings of drawing spectra. allowed: the accuracy.background for which a row is used. Errors grow with the light of
# a source, and those of H_E = 17 to 23 exceed it (columns `background` and `background_held`).
#
# edge, faint: of a sky pixel's noise; min_size: pixels; along, across: samples a pixel; block: A that share a PSF;
# nodes: wavelengths of the PSF; positions: of the PSF on a detector, one of euclid.DEGREES; separable: light of the
# brightest column, of a pixel's noise, below which an order is a product of two profiles.
# Then by python -m benchmarks.nisp_s --settings, the largest errors of {chosen} galaxies and stars of
# H_E = {bright:g} to {faint:g} that the settings were chosen on, and (_held) of {held} others, each in a first order
# at a tilt of 0, 4 or -4 deg: background: of a pixel, of its own noise; flux: of a line in {wide} x {high} pixels;
# position: of a line, pixels; against every sample of the trace with a PSF and rows of its own.
# CPU seconds of 7,400 first orders, on {machine}.
"""


@dataclass(frozen=True)
class SampleSource:
    """A source with a spectrum, for which the errors of drawing are measured.

    `source` is a list of one source, and `tilt` the tilt of the grism (deg). `continuum` and `line` are spectra,
    float32 [1, n]: multiplied by the response of the spectral order, they are the fraction of the source's electrons at
    each wavelength. `place` is the expected column and row of the line.
    """

    source: Sources
    tilt: float
    continuum: Float32
    line: Float32
    place: tuple[float, float]


def slow_settings() -> Settings:
    """Return the settings of the slow method to which the drawn spectra are compared."""
    return Settings(edge=1e-5, faint=0.0, min_size=80, along=4, across=4, block=0.0, nodes=10, positions=9, bin=0.0)


def first_orders(tilt: float) -> tuple[Order, ...]:
    """Return the first order of the red grism on detector DET22, as a tuple of one order, for a tilt in degrees."""
    mission, band = resolve(), passbands.load("nisp_red")
    first = next(t for t in traces.traces("RGS000", tilt, _detector(), mission) if t.order == 1)
    return (Order(first, int(band.wavelength[0]), band.response * band.wavelength),)


def _detector() -> detectors.Detector:
    return detectors.detector("nisp", "DET22", resolve())


def settings_psf(settings: Settings) -> Psf:
    """Return the PSF on detector DET22, at the numbers of wavelengths and positions that the settings contain."""
    trace = first_orders(0.0)[0].trace
    nodes = images.nodes(trace.first, trace.last, settings.nodes)
    return euclid.nisp_psf_at(_detector(), nodes, resolve(), settings.positions)


def sample_sources(seed: int, count: int) -> list[SampleSource]:
    """Return `count` random sources with spectra: two galaxies per star, uniform in H_E from 17 to 23."""
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
    """Draw the dispersed image of a source, and of its emission line alone.

    Parameters
    ----------
    sample_source : SampleSource
        The source with its spectrum.
    settings : Settings
        Settings of drawing spectra.
    psf : Psf
        PSF for these settings, from `settings_psf`.

    Returns
    -------
    total, line : float array, shape (128, 720)
        Expected electrons per pixel of the whole spectrum, and of its line alone.
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
    """Return the errors of the drawn spectrum of a source.

    Parameters
    ----------
    drawn, truth : tuple of float array
        Images to test and true images, each as returned by `draw_images` (whole spectrum, line).
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
    """Return the flux in a box around an emission line, and the centroid of the line with a Gaussian weight.

    `column` and `row` are the expected position of the line in pixels. The centroid (x, y) is relative to it.
    """
    first_column, first_row = round(column) - _BOX[0], round(row) - _BOX[1]
    box = image[first_row : first_row + 2 * _BOX[1] + 1, first_column : first_column + 2 * _BOX[0] + 1]
    y, x = np.indices(box.shape)
    x, y = x + first_column - column, y + first_row - row
    weighted = box * np.exp(-0.5 * (x**2 + y**2) / _SIGMA**2)
    total = weighted.sum()
    return float(box.sum()), float((weighted * x).sum() / total), float((weighted * y).sum() / total)


def seconds(settings: Settings, repeats: int) -> float:
    """Return the CPU time (s) to draw the first orders of 7,400 sources on a detector, 10 % of them stars.

    The time is extrapolated from 400 sources. It is the shortest of `repeats` measurements.
    """
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
    # Extrapolate with the time per source, which follows from the times of half and of all sources. Time that does not
    # depend on the number of sources counts once.
    each = (all_seconds - half_seconds) / (len(sources) - len(sources) // 2)
    return all_seconds + each * (7400 - len(sources))


def measure_settings(
    tiers: Iterable[Settings], repeats: int, num_chosen: int = NUM_CHOSEN, num_test: int = NUM_TEST
) -> list[dict[str, float]]:
    """Measure the errors and the CPU time of drawing spectra with several settings.

    Parameters
    ----------
    tiers : iterable of Settings
        Settings to measure.
    repeats : int
        Number of repeats of each measurement of time.
    num_chosen, num_test : int, optional
        Number of sources with which settings are chosen, and number of sources in each of two other samples with which
        they are tested.

    Returns
    -------
    list of dict
        One dictionary per setting: the largest errors for the first sample (`background`, `flux`, `position`) and for
        the test sample (the same names with `_held`), and `seconds` (CPU time of 7,400 sources).
    """
    samples = {
        "": sample_sources(_CHOSEN_SEED, num_chosen),
        "_held": [source for seed in _TEST_SEEDS for source in sample_sources(seed, num_test)],
    }
    slow = slow_settings()
    psf = settings_psf(slow)
    truths = {
        end: [draw_images(sample_source, slow, psf) for sample_source in sample_list]
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
    """Measure again the errors and times of the settings with which truesky draws slitless spectra.

    The settings are read from the present CSV table of the drawing code. Return the new table as text.
    """
    current_rows = draw.read_settings()
    setting_names = [name for name in current_rows[0] if name == "allowed" or name in Settings.__slots__]
    names = [*setting_names, *(f"{name}{end}" for end in ("", "_held") for name in ERROR_NAMES), "seconds"]
    measured_rows = measure_settings([draw.settings_from_row(row) for row in current_rows], repeats)
    lines = [
        ",".join(
            f"{row[name]:g}"
            if name in setting_names
            else f"{measured[name]:.2g}"
            if name == "seconds"
            else f"{report.round_up(measured[name]):g}"
            for name in names
        )
        for row, measured in zip(current_rows, measured_rows, strict=True)
    ]
    head = _TABLE_HEADER.format(
        chosen=NUM_CHOSEN, held=NUM_TEST * len(_TEST_SEEDS), bright=_BRIGHT, faint=_FAINT, wide=2 * _BOX[0] + 1,
        high=2 * _BOX[1] + 1, machine=report.machine(),
    )  # fmt: skip
    return "\n".join([*head.splitlines(), ",".join(names), *lines]) + "\n"
