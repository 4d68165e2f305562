"""Check the multipoles xi_0 and xi_2 of galaxies in redshift space against linear theory, at 20 to 40 Mpc/h.

Galaxies are placed at the distances of their observed redshifts, and compared with the random points of the table
`randoms`, to which smoothed distances of the galaxies are given. One factor per multipole averages the bins of
separation. The ratio of both factors does not depend on the amplitude of the matter power.

References
----------
Kaiser 1987, MNRAS 227, 1
Tinker et al. 2010, ApJ 724, 878
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.arrays import Array, Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from truesky.catalogue.halos import matching
from truesky.cosmology import Cosmology, from_facts
from truesky.randomness.rng import stream
from truesky.validation import field as fields
from truesky.validation import pairs, redshift_space
from truesky.validation.field import Field
from truesky.validation.lake.catalogues.survey_mask import SurveyMask, band_of_points, read_mask, why_outdated
from truesky.validation.lake.measure.frame_context import Result
from truesky.validation.lake.measure.rows import Place, Row, not_applicable

# Name of this check in the table `validation` (measured values with expected values and verdicts).
NAME = "redshift_space"
SOURCE = "linear theory (Kaiser 1987, MNRAS 227, 1) with the bias of the galaxies' halos (Tinker et al. 2010)"
COLUMNS = ("id", "ra", "dec", "_healpix_29", "kind", "z_obs", "mag_r01", "log_halo_mass")
RANDOM_COLUMNS = ("id", "ra", "dec", "_healpix_29")
# Observed redshifts of the galaxies, and their faintest magnitude at 5600 A.
Z_MIN, Z_MAX = 0.4, 0.8
_MAX_MAG = 23.0
# Edges of the bins of separation, Mpc/h.
EDGES = np.array([20.0, 25.0, 30.0, 35.0, 40.0])
# With fewer galaxies or random points than this number, nothing is measured.
_MIN_GALAXIES = 2000
# Width with which distances of galaxies are smoothed for the random points, Mpc/h.
_SMOOTHING = 100.0
# Number of random points per galaxy.
_RANDOMS = 3
# Number of random points whose pairs represent the distribution of separations in the volume.
_PLACES = 1500
# Relative tolerances of xi_0, of xi_2, and of their ratio. Linear theory misses some per cent of xi_2 at 20 Mpc/h.
_TOLERANCES = (0.2, 0.3, 0.3)


@dataclass(frozen=True, slots=True, eq=False)
class _Points:
    """Galaxies or random points in redshift space: identifiers, positions in Mpc/h, and jackknife patches."""

    id: Int
    place: Float
    patch: Int


def measure(galaxies: read.Version, depth: read.Version, randoms: read.Version) -> Result:
    """Check the multipoles of the table `galaxies` in the area of the tables `depth` and `randoms`.

    Parameters
    ----------
    galaxies, depth, randoms : Version
        Published tables of the lake.

    Returns
    -------
    Result
        Rows (measured values divided by expected ones, with verdicts) and arrays for plots. The only row is
        "not_applicable" if they cannot be measured.
    """
    missing = [name for name in COLUMNS if name not in galaxies.schema.names]
    if missing:
        return _no_result(f"table galaxies has no column {', '.join(missing)}")
    if why := why_outdated(depth, randoms):
        return _no_result(why)
    table, band = galaxies.rows(list(COLUMNS)), band_of_points(randoms)
    points = randoms.rows(list(RANDOM_COLUMNS), where=pc.field("band") == band)
    columns = {name: table[name].to_numpy() for name in COLUMNS}
    field = fields.from_version(galaxies, columns["_healpix_29"])
    cells = np.unique(sky.parent(field.cells, field.order, GENERATION_ORDER)).tolist()
    mask = read_mask(depth, band, cells)
    scattered = {name: points[name].to_numpy() for name in RANDOM_COLUMNS}
    return compare(columns, scattered, mask, from_facts(galaxies.manifest.get("facts", {})))


def compare(
    columns: Mapping[str, Array], scattered: Mapping[str, Array], mask: SurveyMask, cosmology: Cosmology
) -> Result:
    """Check the multipoles of galaxies in a mask.

    Parameters
    ----------
    columns : mapping of str to array, shape (n,)
        COLUMNS of the table `galaxies`.
    scattered : mapping of str to array, shape (m,)
        RANDOM_COLUMNS of the table `randoms`.
    mask : SurveyMask
        Part of the sky in which galaxies and random points are used.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    Result
        Three rows: xi_0 and xi_2 relative to linear theory, and the ratio of both.
    """
    used = (columns["kind"] < 2) & (columns["mag_r01"] < _MAX_MAG) & (columns["z_obs"] > 0.0) & (columns["z_obs"] < 2.0)
    used &= mask.contains(columns["_healpix_29"])
    columns = {name: values[used] for name, values in columns.items()}
    scattered = {name: values[mask.contains(scattered["_healpix_29"])] for name, values in scattered.items()}
    sample = (columns["z_obs"] > Z_MIN) & (columns["z_obs"] < Z_MAX)
    field = fields.from_cells(GENERATION_ORDER, mask.cells()[0])
    number = int(np.count_nonzero(sample))
    if why := _why_not(number, len(scattered["id"]), mask, field, cosmology):
        return _no_result(why)
    has_halo = sample & np.isfinite(columns["log_halo_mass"])
    if np.count_nonzero(has_halo) < 0.9 * number:
        return _no_result("the masses of the halos, and thus the bias of the galaxies, are not known")
    halos = matching.masses(cosmology)
    z, mass = (columns[name][has_halo].astype(float) for name in ("z_obs", "log_halo_mass"))
    bias = float(np.mean(halos.interpolate_pairs(halos.bias, z, mass)))
    chi = np.asarray(cosmology.comoving_distance(columns["z_obs"].astype(float)))
    points = (_points(columns, chi, sample, field), _random_points(scattered, chi, (number, field), cosmology))
    value, jackknife = _measure(*points)
    expected = redshift_space.expected_multipoles(cosmology, float(np.median(z)), bias, EDGES)
    expected[0] -= _mean_over_volume(points[1], cosmology, float(np.median(z)), bias)
    note = f"{number} galaxies at {Z_MIN:g} < z < {Z_MAX:g}, mean bias {bias:.2f}, {mask.area:.3g} deg2 of {mask.band}"
    return _rows(value, jackknife, expected, note)


def _why_not(number: int, n_random: int, mask: SurveyMask, field: Field, cosmology: Cosmology) -> str:
    if min(number, n_random) < _MIN_GALAXIES:
        return (
            f"{number} galaxies at {Z_MIN:g} < z < {Z_MAX:g} and {n_random} random points in the mask; "
            f"{_MIN_GALAXIES} of both are required"
        )
    width = float(np.degrees(EDGES[-1] / cosmology.comoving_distance(Z_MIN)))
    if mask.area < 2.0 * width**2 or field.n_patches < fields.MIN_PATCHES:
        return f"the area of {mask.area:.3g} deg2 is too small for pairs {EDGES[-1]:g} Mpc/h, or {width:.1f} deg, apart"
    return ""


def _points(columns: Mapping[str, Array], chi: Float, chosen: Array, field: Field) -> _Points:
    place = sky.unit_vectors(columns["ra"][chosen], columns["dec"][chosen]) * chi[chosen][:, None]
    return _Points(columns["id"][chosen], place, field.patch_of(columns["_healpix_29"][chosen]))


def _random_points(
    scattered: Mapping[str, Array], chi: Float, sample: tuple[int, Field], cosmology: Cosmology
) -> _Points:
    """Give random points the smoothed distances of galaxies, so that their number follows that of galaxies."""
    number, field = sample
    low, high = (float(cosmology.comoving_distance(z)) for z in (Z_MIN, Z_MAX))
    nearby_chi = chi[(chi > low - 4.0 * _SMOOTHING) & (chi < high + 4.0 * _SMOOTHING)]
    number_drawn = min(_RANDOMS * number, len(scattered["id"]))
    rng = stream("validation", "redshift_space", "distances")
    drawn = np.zeros(0)
    while len(drawn) < number_drawn:
        more = nearby_chi[rng.integers(0, len(nearby_chi), 2 * number_drawn)] + _SMOOTHING * rng.standard_normal(
            2 * number_drawn
        )
        drawn = np.append(drawn, more[(more > low) & (more < high)])
    # Rows are in the order of positions: take a random subset.
    chosen = np.sort(rng.permutation(len(scattered["id"]))[:number_drawn])
    distances = np.zeros(len(scattered["id"]))
    distances[chosen] = drawn[:number_drawn]
    return _points(scattered, distances, chosen, field)


def _measure(*samples: _Points) -> tuple[Float, Float]:
    """Return the measured multipoles, and without each patch; random subsets are used if there are too many pairs."""
    thinned = []
    for points in samples:
        scale, widest = pairs.scale_to_unit_ball(points.place, EDGES[-1])
        thin = pairs.thin_sample(points.id, points.place * scale, widest)
        thinned.append((points.place[thin], points.patch[thin]))
    kind = np.repeat([0, 1], [len(place) for place, _ in thinned])
    place, patch = (np.concatenate([part[i] for part in thinned]) for i in (0, 1))
    return redshift_space.measure_multipoles(place, kind, patch, EDGES)


def _mean_over_volume(points: _Points, cosmology: Cosmology, z: float, bias: float) -> float:
    """Return the mean of the expected xi_0 over all pairs in the volume, which the mean density of galaxies hides."""
    place = points.place[:: max(len(points.place) // _PLACES, 1)]
    r, xi = redshift_space.matter_correlation(cosmology, z)
    factor, _ = redshift_space.kaiser_factors(bias, float(cosmology.growth_rate(z)))
    distances = [np.sqrt(np.sum((place[i + 1 :] - position) ** 2, 1)) for i, position in enumerate(place)]
    return factor * float(np.mean(np.interp(np.concatenate(distances), r, xi, right=0.0)))


def _rows(value: Float, jackknife: Float, expected: Float, note: str) -> Result:
    error = fields.jackknife_error(jackknife)
    if not (np.isfinite(value).all() and np.isfinite(error).all() and (error > 0.0).all()):
        return _no_result("some separations have no pairs of random points at some angle to the line of sight")
    weight = (expected / error) ** 2
    factor = np.sum(weight * value / expected, -1) / weight.sum(-1)
    factors = np.sum(weight * jackknife / expected, -1) / weight.sum(-1)
    measured = np.append(factor, factor[1] / factor[0])
    errors = fields.jackknife_error(np.column_stack([factors, factors[:, 1] / factors[:, 0]]))
    rows = [
        Row(NAME, name, Place(), float(factor_value), float(factor_error), 1.0, tolerance, "", SOURCE, note=note)
        for name, factor_value, factor_error, tolerance in zip(
            ("xi_0", "xi_2", "ratio"), measured, errors, _TOLERANCES, strict=True
        )
    ]
    middle = 0.5 * (EDGES[1:] + EDGES[:-1])
    return Result(Place(), rows, {"multipoles": np.stack([middle, *value, *error, *expected])})


def _no_result(why: str) -> Result:
    return Result(Place(), [not_applicable(NAME, Place(), why, SOURCE)], {})
