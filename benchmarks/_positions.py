"""Measure the errors of interpolating the PSF across a VIS or NISP detector, and the CPU time to compute it.

The PSF is computed at some positions on the detector. Two methods give it at other positions: polynomials through a few
positions, which truesky uses, and the PSF of the nearest position of a grid, which other programs use.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks import _errors as errors
from benchmarks import _scenes as scenes
from benchmarks import report
from benchmarks._scenes import NISP, VIS, Scene
from lake_schema.arrays import Float
from lake_schema.mission.configuration import resolve
from truesky.numerics import cache
from truesky.render.camera import detectors
from truesky.render.psf import euclid, model, sub_bands

# Number of stars whose errors are measured.
NUM_STARS = 24
# Seed of the random positions and colours of the stars whose errors are measured.
_SEED = 5
# Number of stars with which benchmarks/trade.py tests the PSF.
NUM_TEST_STARS = 48
# R2 of the PSF / R2 of the smallest galaxies whose shear is measured; their size is 1.25 times that of the PSF. A
# relative error of the PSF's R2, multiplied by this ratio, is the multiplicative bias of shear (Paulin-Henriksson et
# al. 2008; Laureijs et al. 2011).
R2_RATIO = 1.25**-2
# Numbers of positions along each side of the square grids for the method of the nearest position, for VIS.
_NEAREST = (1, 2, 3, 4, 6, 10, 15, 20, 30, 40)
# Numbers of positions along each side of the square grids for the method of the nearest position, for NISP.
_NISP_NEAREST = (1, 2, 3, 4, 6, 10)
# CSV file to which the results of `measure_positions` for NISP are written.
_FILE = Path(model.__file__).parents[1] / "drawing" / "psf_positions_nisp.csv"
_COLUMNS = (
    "positions,nearest,flux_rms,flux_error,position_rms,position_error,"
    "r2_rms,r2_error,ellipticity_rms,ellipticity_error,seconds,megabytes"
)
_TABLE_HEADER = f"""\
# Error of the {{camera}} PSF by the number of its positions on a detector: of {NUM_STARS} stars of other places and \
colours the
# flux in 1" (relative), the position (pixels), R2 (relative) and the ellipticity under a Gaussian weight of 0.75" (rms
# and largest); CPU seconds to compute its planes, and what they hold. nearest: 0 = polynomials through the positions
# (euclid.DEGREES), 1 = the nearest of a grid, as in Serrano et al. 2024. Written by {{writer}}.
"""


@dataclass(frozen=True)
class Star:
    """A star with its true PSF.

    `place` is its position (x, y) on the detector: 0 is the centre, and -1 and 1 are the edges. `shares` contains the
    fraction of its photons in each sub-band, and `truth` its PSF in each sub-band [sub-bands, t, t].
    """

    place: tuple[float, float]
    shares: Float
    truth: Float


def make_optics(scene: Scene = VIS) -> Callable[[tuple[float, float]], Float]:
    """Return a function that computes the PSF at a position on a detector.

    The argument of the function is a position (x, y): 0 is the centre of the detector, and -1 and 1 are its edges. The
    function returns the sampled PSF [wavelengths, t, t], with its rows parallel to the rows of the detector.
    """
    mission, sampled = resolve(), _SAMPLINGS[scene.name]
    detector = detectors.detector(scene.name, scenes.SPACE[scene.name][0], mission)
    waves = scenes.scene_psf(scene, 1).planes.wavelength  # type: ignore[union-attr]
    blurs = [euclid._blur_variances(detector, float(waves[w]), mission) for w in range(len(waves))]
    mean_blur = tuple(np.mean(blurs, axis=0).tolist())
    window = euclid.centroid_window(scene.name, scenes.SPACE[scene.name][1], mission)
    sign = -1 if detector.upside_down else 1

    def compute_psf(place: tuple[float, float]) -> Float:
        nm = euclid.wavefront(
            *euclid._field_position(detector, sign * place[0], sign * place[1], mission), detector.section, mission
        )
        scale = detector.pixel_scale / sampled.samples
        nm = euclid.centre_wavefront(nm, waves, sampled, (scale, window), mean_blur, mission)
        core = replace(sampled, transform=sampled.core_transform, side=sampled.core_side)
        planes = [euclid._plane(nm, float(w), core, scale, blur, mission) for w, blur in zip(waves, blurs, strict=True)]
        return np.stack(planes).astype(float)[:, ::sign, ::sign]

    return compute_psf


def measure_positions(
    num_stars: int, nearest: tuple[int, ...] = _NEAREST, scene: Scene = VIS
) -> list[dict[str, float]]:
    """Measure errors and CPU time of the PSF for two methods of interpolation and several numbers of positions.

    The methods are polynomials through a few positions, and the nearest position of a square grid.

    Parameters
    ----------
    num_stars : int
        Number of random stars whose errors are measured.
    nearest : tuple of int, optional
        Numbers of positions along each side of the grids.
    scene : Scene, optional
        Detector to test, VIS or NISP.

    Returns
    -------
    list of dict
        One row per method and number of positions; the keys are in _COLUMNS.
    """
    psf_at, rng = make_optics(scene), np.random.default_rng(_SEED)
    psf_at((0.0, 0.0))
    start = time.process_time()
    centre = psf_at((0.0, 0.0))
    plane_s = (time.process_time() - start) / sub_bands.N_SUB_BANDS
    star_sample = [draw_star(psf_at, rng) for _ in range(num_stars)]
    out = []
    for positions in euclid.DEGREES:
        compute_s, psf = _compute_planes(positions, scene)
        error_values = np.array(
            [star_errors(centre + drift(psf, sample_star), sample_star, scene) for sample_star in star_sample]
        )
        out.append(_table_row(positions, False, error_values, compute_s, (psf.images.nbytes + psf.drift.nbytes) / 1e6))
    for side in nearest:
        grid_centres = (2 * np.arange(side) + 1) / side - 1
        error_values = np.array(
            [
                star_errors(psf_at(_nearest_position(grid_centres, sample_star.place)), sample_star, scene)
                for sample_star in star_sample
            ]
        )
        # The memory for a grid of positions is that of the core of the PSF at each position, and of one whole PSF. The
        # wings are needed only once, because they are the same at all positions.
        planes = side**2 * len(psf.wavelength)
        megabytes = (planes * centre[0].size * psf.images.itemsize + psf.images.nbytes) / 1e6
        out.append(_table_row(side**2, True, error_values, out[0]["seconds"] + planes * plane_s, megabytes))
    return out


def table_text(table_rows: list[dict[str, float]], scene: Scene = VIS) -> str:
    """Return the results of `measure_positions` as the text of a CSV file with a header."""
    header = _TABLE_HEADER.format(camera=scene.name.upper(), writer=_WRITERS[scene.name])
    lines = [
        ",".join(
            f"{row[name]:.0f}"
            if name in _INTEGER_COLUMNS
            else f"{report.round_up(row[name]) if name.endswith('_error') else row[name]:.2g}"
            for name in row
        )
        for row in table_rows
    ]
    return "\n".join([header + _COLUMNS, *lines]) + "\n"


# Sizes and sampling of the PSF images of each camera.
_SAMPLINGS = {"vis": euclid.VIS, "nisp": euclid.NISP}
# Command that writes the table of each camera, for the header of the table.
_WRITERS = {"vis": "python -m benchmarks.trade\n# --positions", "nisp": "python -m benchmarks._positions"}
_INTEGER_COLUMNS = ("positions", "nearest", "megabytes")


def draw_star(psf_at: Callable[[tuple[float, float]], Float], rng: np.random.Generator) -> Star:
    """Draw a star at a random position on the detector with a random spectrum; `psf_at` computes its true PSF."""
    place = rng.uniform(-1, 1, 2).tolist()
    photons = scenes.colours(1, rng)[0]
    return Star((place[0], place[1]), photons / photons.sum(), psf_at((place[0], place[1])))


def star_errors(planes: Float, star: Star, scene: Scene = VIS) -> tuple[float, float, float, float]:
    """Return the errors of the image of a star if an approximate PSF is used.

    Parameters
    ----------
    planes : float array, shape (wavelengths, t, t)
        PSF to test. The number of wavelengths must divide the number of sub-bands.
    star : Star
        The star with its true PSF.
    scene : Scene, optional
        Detector, of which the pixel scale is used.

    Returns
    -------
    tuple of float
        Relative error of the flux within 1 arcsec, error of the position in pixels, relative error of R2, and error of
        the ellipticity.
    """
    # The PSF may have fewer wavelengths than sub-bands. Then neighbouring sub-bands have the same PSF, and the light of
    # the star in them is added.
    shares = star.shares.reshape(len(planes), -1).sum(axis=1)
    measured = _moments(np.tensordot(shares, planes, 1), scene)
    truth = _moments(np.tensordot(star.shares, star.truth, 1), scene)
    shift = float(np.hypot(*(measured - truth)[1:3])) / scene.scale
    return (
        abs(measured[0] / truth[0] - 1),
        shift,
        abs(measured[3] / truth[3] - 1),
        float(np.hypot(*(measured - truth)[4:6])),
    )


def largest_errors(
    seed: int, n: int, psf_variants: Sequence[tuple[int, int]]
) -> dict[tuple[int, int], dict[str, float]]:
    """Return the largest errors of stars on a VIS detector for different numbers of PSF positions and wavelengths.

    Parameters
    ----------
    seed : int
        Seed of the stars.
    n : int
        Number of stars.
    psf_variants : sequence of (int, int)
        Numbers of positions and of wavelengths of each PSF.

    Returns
    -------
    dict of (int, int) to dict
        For each PSF the largest errors `flux` (relative), `shape` (bias of shear) and `position` (pixels).
    """
    psf_at, rng = make_optics(), np.random.default_rng(seed)
    centre, star_sample = psf_at((0.0, 0.0)), [draw_star(psf_at, rng) for _ in range(n)]
    out = {}
    for positions, colours in psf_variants:
        psf = scenes.scene_psf(VIS, positions, colours).planes
        assert psf is not None
        centre_planes = centre.reshape(colours, -1, *centre.shape[1:]).mean(axis=1)
        flux, moved, r2, e = np.array(
            [star_errors(centre_planes + drift(psf, sample_star), sample_star) for sample_star in star_sample]
        ).max(axis=0)
        out[positions, colours] = {"flux": flux, "shape": max(R2_RATIO * r2, e / 2), "position": moved}
    return out


def _moments(image: Float, scene: Scene) -> Float:
    middle = image.shape[0] // 2
    return errors.measure_image(image, scene.scale / _SAMPLINGS[scene.name].samples, middle, middle)


def drift(psf: model.Planes, star: Star) -> Float:
    """Return the difference between the PSF at a star's position and at the centre of the detector [wavelengths, t, t].

    It is the sum of the polynomials in position and wavelength with which truesky interpolates the PSF.
    """
    out = []
    for wavelength in psf.wavelength:
        redder = wavelength - psf.wavelength.mean()
        terms = [star.place[0] ** i * star.place[1] ** j * redder**colour for i, j, colour in psf.powers]
        out.append(np.tensordot(terms, psf.drift, 1) if terms else 0.0)
    return np.stack([np.broadcast_to(each, star.truth.shape[1:]) for each in out])


def _nearest_position(grid_centres: Float, place: tuple[float, float]) -> tuple[float, float]:
    x, y = (float(grid_centres[np.argmin(np.abs(grid_centres - at))]) for at in place)
    return x, y


def _compute_planes(positions: int, scene: Scene) -> tuple[float, model.Planes]:
    """Compute the PSF at `positions` positions of a detector without the cache; return the CPU time (s) and the PSF."""
    with cache.use_temporary_dir():
        start = time.process_time()
        planes = scenes.scene_psf(scene, positions).planes
        seconds = time.process_time() - start
    assert planes is not None
    return seconds, planes


def _table_row(
    positions: int, nearest: bool, error_values: Float, seconds: float, megabytes: float
) -> dict[str, float]:
    rms, worst = np.sqrt((error_values**2).mean(axis=0)), error_values.max(axis=0)
    rms_and_worst = np.column_stack([rms, worst]).ravel()
    values = positions, nearest, *rms_and_worst, seconds, megabytes
    return {name: float(value) for name, value in zip(_COLUMNS.split(","), values, strict=True)}


if __name__ == "__main__":
    _FILE.write_text(table_text(measure_positions(NUM_STARS, _NISP_NEAREST, NISP), NISP), encoding="utf-8")
