"""Measure what the resolution of the lensing maps costs: errors of the shear against CPU seconds and bytes.

Maps of each resolution (HEALPix nside) are compared with maps of nside = 1024 of the same matter, for sources at z = 1
at random positions in circular fields. The reference resolves the cells of the matter box: 4 Mpc/h is 13 arcmin at the
distance of the lenses. Smaller structure is missing from the matter, not from the maps.

The default resolution of a request follows from the errors for one seed of the matter. The errors for another seed and
other positions are in columns that end with ``_held``.
"""

from __future__ import annotations

import csv
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from benchmarks import report
from lake_schema import sky
from lake_schema.arrays import Float
from truesky.catalogue.galaxies import lensing
from truesky.catalogue.galaxies.lensing import Planes
from truesky.catalogue.matter import density_box
from truesky.catalogue.matter.density_box import Box
from truesky.cosmology import FIDUCIAL
from truesky.numerics import cache
from truesky.request.schema import LENSING_NSIDES
from truesky.validation import theory
from truesky.validation.model.shear import convergence_maps, gaussian_box

Row = dict[str, float]
_HEADER = """\
# Lensing maps by resolution, by python -m benchmarks.trade --lensing: errors of the shear, and cost.
#
# shear_rms: rms error of a component of the shear of sources at z = 1. xi_plus_1.5 etc.: error of xi+ in the
# octave from this separation (arcmin), relative to non-linear theory. Both are relative to the last row; _held: for
# another seed and other positions. Last row: rms of the shear itself, and standard deviation of xi+ between fields of
# 1 deg2 relative to theory. cpu_s and gb: CPU seconds to make the maps of all source planes, and their size on disc.
# {fields} fields of {area:.1f} deg2 with {positions} positions each. On {machine}.
"""
# Edges of the bins of separation in which the two-point correlation is compared, arcmin.
EDGES = (1.5, 3.0, 6.0, 12.0, 24.0, 48.0)
# Resolution with which all others are compared.
_REFERENCE = 1024
# Cells per side of the matter box (the default of a request), and redshift of the sources.
_BOX_CELLS, _Z = 256, 1.0
# Seeds of the matter and of the positions. The default follows from the errors for the first; the others are quoted.
_SEEDS = {"": 31, "_held": 77}
# Number of fields on the sky, their radius (deg), and the number of positions in each.
_NUM_FIELDS, _RADIUS, _NUM_POSITIONS = 24, 1.7, 8000
_ARCMIN = float(np.radians(1.0 / 60.0))


def measure(quick: bool) -> list[Row]:
    """Return one row per resolution: errors of the shear for two seeds, CPU seconds and GB.

    Names are `nside`, `shear_rms` (rms error of a component of the shear), `xi_plus_<arcmin>` (error of xi+ in the
    octave from this separation, relative to xi+ of non-linear theory), all for both seeds, `cpu_s` and `gb` (of all
    source planes). The last row, of the reference, has the rms of the shear itself in `shear_rms`, and in
    `xi_plus_<arcmin>` the standard deviation of xi+ between fields of 1 deg2, relative to theory. `quick` uses a small
    box, few positions and low resolutions, for tests.
    """
    nsides = (16, 32) if quick else LENSING_NSIDES[: LENSING_NSIDES.index(_REFERENCE)]
    reference, cells = (64, 64) if quick else (_REFERENCE, _BOX_CELLS)
    rows: dict[int, Row] = {nside: {"nside": float(nside)} for nside in (*nsides, reference)}
    for suffix, seed in _SEEDS.items():
        box = gaussian_box(FIDUCIAL, seed, cells)
        fields = list(_draw_fields(seed, 4 if quick else _NUM_FIELDS, 500 if quick else _NUM_POSITIONS))
        true_shear = _shear_of_fields(box, reference, fields)
        true_xi = _correlations(fields, true_shear)
        prediction = _predict_correlation()
        for nside in nsides:
            shear = _shear_of_fields(box, nside, fields)
            change = (_correlations(fields, shear) - true_xi).mean(0) / prediction
            rows[nside][f"shear_rms{suffix}"] = float(np.sqrt(np.mean(np.abs(shear - true_shear) ** 2) / 2.0))
            rows[nside] |= {f"xi_plus_{low:g}{suffix}": float(v) for low, v in zip(EDGES[:-1], change, strict=True)}
        # The variance of the mean of independent pieces of a field falls with its area.
        scatter = true_xi.std(0, ddof=1) * np.sqrt(_field_area()) / prediction
        rows[reference][f"shear_rms{suffix}"] = float(np.sqrt(np.mean(np.abs(true_shear) ** 2) / 2.0))
        rows[reference] |= {f"xi_plus_{low:g}{suffix}": float(v) for low, v in zip(EDGES[:-1], scatter, strict=True)}
    for nside in rows:
        rows[nside] |= _measure_cost(cells, nside)
    return list(rows.values())


def write_table(rows: Sequence[Row], file: Path) -> None:
    """Write the rows of `measure` to the CSV table that truesky.request.lensing_resolution reads."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    numbers = {"fields": _NUM_FIELDS, "area": _field_area(), "positions": _NUM_POSITIONS}
    with file.open("w", newline="", encoding="utf-8") as out:
        out.write(_HEADER.format(**numbers, machine=report.machine()))
        writer = csv.DictWriter(out, names, lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: f"{value:.4g}" for name, value in row.items()} for row in rows)


def _field_area() -> float:
    return float(2.0 * np.pi * (1.0 - np.cos(np.radians(_RADIUS))) * np.degrees(1.0) ** 2)


def _draw_fields(seed: int, number: int, positions: int) -> Iterator[tuple[Float, Float]]:
    """Yield right ascension and declination (deg) of random positions in circles at |dec| < 45 deg."""
    rng = np.random.default_rng(seed)
    for _ in range(number):
        ra, dec = rng.uniform(0.0, 360.0), np.degrees(np.arcsin(rng.uniform(-0.7, 0.7)))
        distance, angle = np.radians(_RADIUS) * np.sqrt(rng.random(positions)), 2.0 * np.pi * rng.random(positions)
        east, north = distance * np.sin(angle), distance * np.cos(angle)
        yield sky.offset_positions(np.full(positions, ra), np.full(positions, dec), east, north)


def _shear_of_fields(box: Box, nside: int, fields: Sequence[tuple[Float, Float]]) -> Float:
    """Return gamma1 + i gamma2 of sources at z = 1, complex array of shape (fields, positions)."""
    kappa, gain = convergence_maps(box, nside, [_Z], int(lensing.settings().l_max * nside))
    chi = np.atleast_1d(FIDUCIAL.comoving_distance(_Z))
    planes = Planes(nside, chi, (lensing.maps_of_convergence(kappa[0], nside, gain[0]),))
    values = [lensing.interpolate(planes, ra, dec, np.full(ra.size, chi[0])) for ra, dec in fields]
    return np.array([row[lensing.GAMMA_1] + 1j * row[lensing.GAMMA_2] for row in values])


def _correlations(fields: Sequence[tuple[Float, Float]], shear: Float) -> Float:
    """Return xi+ in the bins of `EDGES`, shape (fields, bins).

    Meridians are parallel within a field to 2 deg, which changes xi+ by less than 0.1 %.
    """
    rows = []
    for (ra, dec), gamma in zip(fields, shear, strict=True):
        vectors = sky.unit_vectors(ra, dec)
        tree = cKDTree(vectors)
        pairs = tree.query_pairs(EDGES[-1] * _ARCMIN, output_type="ndarray")
        separation = np.linalg.norm(vectors[pairs[:, 0]] - vectors[pairs[:, 1]], axis=1) / _ARCMIN
        place = np.digitize(separation, EDGES)
        product = (gamma[pairs[:, 0]] * gamma[pairs[:, 1]].conj()).real
        total, count = (np.bincount(place, weight, len(EDGES) + 1)[1:-1] for weight in (product, np.ones(place.size)))
        rows.append(total / count)
    return np.array(rows)


def _predict_correlation() -> Float:
    """Return xi+ of sources at z = 1 by non-linear theory in the bins of `EDGES`."""
    edges = np.array(EDGES) * _ARCMIN
    theta = 2.0 / 3.0 * (edges[1:] ** 3 - edges[:-1] ** 3) / (edges[1:] ** 2 - edges[:-1] ** 2)
    power = theory.convergence_power(FIDUCIAL, theory.ELL, np.atleast_1d(FIDUCIAL.comoving_distance(_Z)), np.ones(1))
    return theory.shear_correlations(theta, theory.ELL, power)[0]


def _measure_cost(cells: int, nside: int) -> Row:
    """Return the CPU seconds to make the maps of all source planes, and their size on disc in GB."""
    with cache.use_temporary_dir():
        box = density_box.load(_SEEDS[""], cells, FIDUCIAL)
        box_bytes = sum(path.stat().st_size for path in cache.cache_dir().rglob("*") if path.is_file())
        start = time.process_time()
        lensing.load(box, nside, with_far_planes=True)
        seconds = time.process_time() - start
        total = sum(path.stat().st_size for path in cache.cache_dir().rglob("*") if path.is_file())
    return {"cpu_s": seconds, "gb": (total - box_bytes) / 1e9}
