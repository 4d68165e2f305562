"""Compare dispersed images by the program slitlessutils with images by truesky: light along spectra, and CPU time."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import _scenes as scenes
from lake_schema.arrays import Float
from lake_schema.mission.configuration import resolve
from truesky.fluxes import passbands
from truesky.render.camera import traces
from truesky.render.camera.detectors import detector
from truesky.render.dispersing import draw, grism_files, images
from truesky.render.dispersing.draw import DispersedSources, Order
from truesky.render.psf import euclid
from truesky.render.psf.model import Psf
from truesky.render.sources.source_list import Sources
from truesky.request.accuracy import SURVEY

# Environment variable with the path of a Python interpreter that has slitlessutils. A separate one is necessary,
# because slitlessutils requires an older NumPy.
PYTHON_VARIABLE = "TRUESKY_SLITLESSUTILS"
_INSTALL_HINT = "python3.11 -m venv PEERS; PEERS/bin/pip install slitlessutils==1.0.0 'numpy<2.4'"
_PEER_SCRIPT = Path(__file__).with_name("_slitlessutils.py")
# Number of wavelengths per pixel that slitlessutils uses (its default).
_SUBSAMPLES = 5
# Length along the spectrum of the intervals in which the light is compared, pixels.
_INTERVAL = 64
# Noise of a sky pixel, electrons.
_NOISE = 28.0
# Shape of the detector, pixels.
_SHAPE = (2040, 2040)
# Width and height of the stamps of single sources, pixels.
_SIDE = 40
# The time of truesky is measured for this number of copies of the sources, so that the fixed time per detector is
# divided among many sources.
_NUM_COPIES = 25


def slitlessutils_figures(count: int = 2, seed: int = 7) -> dict[str, float]:
    """Compare spectra drawn by slitlessutils and by truesky: CPU time, and light along the spectra.

    The spectra are first orders of the red grism on detector DET23.

    Parameters
    ----------
    count : int, optional
        Number of sources, half of them stars and half galaxies.
    seed : int, optional
        Seed of the sources.

    Returns
    -------
    dict of str to float
        `spectrum_s` and `slitlessutils_spectrum_s` (CPU time per spectrum, s), `against_slitlessutils` (time of
        slitlessutils / time of truesky), and `slitlessutils_flux` (largest relative difference of light in intervals of
        64 pixels).

    Notes
    -----
    SystemExit is raised if slitlessutils is not available.
    """
    python = _python()
    order, psf = _grism()
    sources = _sources(count, seed)
    spectrum = _spectrum(order)
    ours, seconds = _time_drawing(sources, order, psf, spectrum)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        configuration = grism_files.write(folder, "RGS000", [order], _SHAPE)
        theirs, their_seconds = _run_peer(python, folder, configuration, *_peer_inputs(sources, order, psf, spectrum))
    differences = _differences(sources, order, ours, theirs)
    return {
        "spectrum_s": seconds / count,
        "slitlessutils_spectrum_s": their_seconds / count,
        "against_slitlessutils": their_seconds / seconds,
        "slitlessutils_flux": float(np.abs(differences).max()),
    }


def _python() -> str:
    python = os.environ.get(PYTHON_VARIABLE, "")
    if not python or subprocess.run([python, "-c", "import pypolyclip"], check=False, capture_output=True).returncode:
        raise SystemExit(f"{PYTHON_VARIABLE} must be the path of a Python with slitlessutils ({_INSTALL_HINT})")
    return python


def _grism() -> tuple[Order, Psf]:
    """Return the first order of the red grism on detector DET23, and the PSF at its wavelengths."""
    mission, band = resolve(), passbands.load("nisp_red")
    nisp_detector = detector("nisp", "DET23", mission)
    trace = next(
        candidate for candidate in traces.traces("RGS000", 0.0, nisp_detector, mission) if candidate.order == 1
    )
    part = (band.wavelength >= trace.first) & (band.wavelength <= trace.last)
    # Sensitivity in electrons per erg s-1 cm-2 A-1. It is scaled to values far above 1e10, the lower limit of
    # sensitivities in slitlessutils.
    response = (band.response * band.wavelength)[part] * 1e12
    nodes = images.nodes(trace.first, trace.last, 3)
    return Order(trace, int(band.wavelength[part][0]), response), euclid.nisp_psf_at(nisp_detector, nodes, mission, 4)


def _sources(count: int, seed: int) -> Sources:
    """Return faint galaxies and stars whose first orders do not overlap and lie completely on the detector."""
    sources = scenes.sources(scenes.NISP, seed, galaxies=40, stars=count - count // 2)
    small = np.flatnonzero(scenes.magnitudes(sources, scenes.NISP)[:40] > 21.0)[: count // 2]
    sources = sources.take(np.concatenate([small, 40 + np.arange(count - count // 2)]))
    rng = np.random.default_rng(seed)
    column, row = 900.0 + rng.uniform(0.0, 1.0, count), 200.0 + 100.0 * np.arange(count) + rng.uniform(0.0, 1.0, count)
    return replace(sources, column=column, row=row, electrons=np.ones(count))


def _spectrum(order: Order) -> Float:
    """Return f_lambda at the wavelengths of an order: a power law with two lines, scaled to 20,000 electrons."""
    waves = order.wavelength
    flux = (waves / 15000.0) ** -1.5
    for centre in (13500.0, 16600.0):
        flux += 5.0 * np.exp(-0.5 * ((waves - centre) / 8.0) ** 2)
    return np.asarray(flux * 2e4 / float((flux * order.response).sum()))


def _time_drawing(sources: Sources, order: Order, psf: Psf, spectrum: Float) -> tuple[Float, float]:
    """Draw the dispersed image of the sources with truesky, and return it with its CPU time (s).

    The time is measured for 25 copies of the sources and divided by 25. The fixed times of a detector, such as the
    transform of the PSF, are then divided among many sources, as on a full detector. The shorter of two times counts.
    """
    source_spectrum, best = spectrum.astype(np.float32), np.inf
    # Use stamps of 40 pixels, because the images for slitlessutils have this size, too.
    settings = replace(draw.settings_for(SURVEY), min_size=_SIDE)
    dispersed = DispersedSources(lambda which: np.tile(source_spectrum, (len(which), 1)), (order,), settings)
    frame = draw.draw(sources, dispersed, psf, _SHAPE, _NOISE)
    copies = sources.take(np.tile(np.arange(len(sources)), _NUM_COPIES))
    for _ in range(2):
        start = time.process_time()
        draw.draw(copies, dispersed, psf, _SHAPE, _NOISE)
        best = min(best, (time.process_time() - start) / _NUM_COPIES)
    return frame, best


def _peer_inputs(sources: Sources, order: Order, psf: Psf, spectrum: Float) -> tuple[Float, Float, Float, Float]:
    """Return the inputs with which slitlessutils draws the sources that truesky draws.

    They are images of the sources with PSF but without dispersion [n, side, side], the (column, row) of their first
    pixels on the detector [n, 2], wavelengths (A) [v], and f_lambda at these wavelengths [n, v].
    """
    constant_trace = replace(order.trace, x=np.zeros((2, 3)), y=np.zeros((2, 3)))
    undispersed_order = Order(constant_trace, order.first, order.response / float((spectrum * order.response).sum()))
    source_spectrum, stamps, corners = spectrum.astype(np.float32), [], []
    for i in range(len(sources)):
        source = sources.take(np.array([i]))
        # Draw the source on a small frame. Its PSF is then that of another position on the detector, but the difference
        # is only 0.1 %.
        corner = np.floor([source.column[0], source.row[0]]).astype(int) - _SIDE // 2
        shifted = replace(source, column=source.column - corner[0], row=source.row - corner[1])
        settings = replace(draw.settings_for(SURVEY), min_size=_SIDE, edge=1e-9, faint=0.0)
        dispersed = DispersedSources(
            lambda which: np.tile(source_spectrum, (len(which), 1)), (undispersed_order,), settings
        )
        stamps.append(draw.draw(shifted, dispersed, psf, (_SIDE, _SIDE), 1.0))
        corners.append(corner)
    step = (order.trace.last - order.trace.first) / 512.0 / _SUBSAMPLES
    waves = np.arange(order.trace.first + 0.5 * step, order.trace.last, step)
    # Average f_lambda over the interval around each wavelength, so that the flux of narrow lines does not change.
    edges = np.concatenate([[0.0], np.cumsum(spectrum)])
    at = [np.interp(waves + side * step - order.first + 0.5, np.arange(len(edges)), edges) for side in (-0.5, 0.5)]
    flux = (at[1] - at[0]) / step
    return np.array(stamps), np.array(corners), waves, np.tile(flux, (len(sources), 1))


def _run_peer(
    python: str, folder: Path, configuration: Path, stamps: Float, corners: Float, waves: Float, spectra: Float
) -> tuple[Float, float]:
    input_file, output_file = folder / "given.npz", folder / "out.npz"
    np.savez(input_file, images=stamps, corners=corners, waves=waves, spectra=spectra, shape=np.array(_SHAPE))
    environment = {**os.environ, "HOME": str(folder), "OMP_NUM_THREADS": "1"}
    subprocess.run(
        [python, str(_PEER_SCRIPT), str(configuration), str(input_file), str(output_file)],
        check=True,
        env=environment,
        # slitlessutils writes a log into the current folder.
        cwd=folder,
        capture_output=True,
    )
    with np.load(output_file) as read:
        return np.asarray(read["frame"]), float(read["seconds"])


def _differences(sources: Sources, order: Order, ours: Float, theirs: Float) -> Float:
    """Return the relative differences of the light of two images along the spectrum of each source [n, intervals].

    Light is summed in intervals of 64 columns, within 20 rows on each side of the spectrum.
    """
    differences = []
    for column, row in zip(sources.column.tolist(), sources.row.tolist(), strict=True):
        x, y = order.trace.offsets(column, row, np.array([order.trace.first, order.trace.last]))
        first_row = round(row + float(y.mean())) - _SIDE // 2
        first_column = int(column + x[0])
        edges = np.arange(first_column, int(column + x[1]), _INTERVAL)
        sums = [
            np.add.reduceat(frame[first_row : first_row + _SIDE].sum(axis=0), edges)[:-1] for frame in (ours, theirs)
        ]  # fmt: skip
        differences.append(sums[1] / sums[0] - 1.0)
    return np.array(differences)


if __name__ == "__main__":
    print(slitlessutils_figures())
