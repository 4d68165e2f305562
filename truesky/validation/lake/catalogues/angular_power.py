"""Check angular power spectra of galaxies in four redshift bins, and of galaxies with the convergence behind them.

Spectra are measured in the area that a band covers, with the mask of the table `depth`, and corrected for this mask.
Theory gives the expected spectra from the power of matter and the mean bias of the galaxies' halos. One factor per
spectrum compares all bands of multipoles that the field resolves and that are linear (wave numbers below 0.2 h/Mpc).

Notes
-----
The means of maps in the mask are subtracted, and the correction for the mask contains this. Errors are valid for
Gaussian fields with the expected power and noise in the mask; bands are not independent.
The tolerance of 20 % is for galaxies in the same halo, and for the magnification of galaxies.

References
----------
Hivon et al. 2002, ApJ 567, 2
Limber 1953, ApJ 117, 134
Tinker et al. 2010, ApJ 724, 878
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pyarrow.compute as pc

from lake_schema import sky
from lake_schema.arrays import Array, Bool, Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from truesky.catalogue.halos import matching
from truesky.cosmology import Cosmology, from_facts
from truesky.validation import field as fields
from truesky.validation import pseudo_power, theory
from truesky.validation.lake.catalogues.survey_mask import SurveyMask, band_of_points, read_mask, why_outdated
from truesky.validation.lake.measure.frame_context import Result
from truesky.validation.lake.measure.rows import Place, Row, not_applicable
from truesky.validation.pseudo_power import L_MAX, Bands
from truesky.validation.theory import Shells

# Name of this check in the table `validation` (measured values with expected values and verdicts).
NAME = "angular_power"
SOURCE = "Limber's approximation with the bias of the galaxies' halos (Tinker et al. 2010, ApJ 724, 878)"
_DRAWN = "points have the density that was asked for"
COLUMNS = ("_healpix_29", "kind", "z_true", "mag_r01", "log_halo_mass", "kappa")
# Edges of the redshift bins of the galaxies, and redshifts of the galaxies whose convergence is used.
Z_EDGES = (0.2, 0.4, 0.6, 0.8, 1.0)
_Z_SOURCES = (1.1, 1.6)
# Galaxies are used to this magnitude at 5600 A. The expected power is that of the sample, whether complete or not.
_MAX_MAG = 24.0
# With fewer galaxies than this number, a redshift bin is not measured.
_MIN_GALAXIES = 1000
# Largest wave number, h/Mpc, at which the bias of halos is the ratio of the densities.
_MAX_K = 0.2
# First multipole (below, redshifts distort, and Limber's approximation fails), narrowest band, last multipole.
_FIRST, _NARROWEST, _LAST = 20, 20, 400
# Relative tolerance of the power.
_TOLERANCE = 0.2
# Allowed relative difference of the density of random points.
_DENSITY_TOLERANCE = 0.01
# Approximate width of the shells of distance of the expected spectra, Mpc/h; number of bins of the sources' distances.
_SHELL, _SOURCE_BINS = 50.0, 20
# HEALPix nside of the lensing maps below which differences of the convergence count as known failures.
_NSIDE = 1024


@dataclass(frozen=True, slots=True, eq=False)
class _Map:
    """A masked map in cells of order 8, its mask, and the spectrum of its noise at l = 0 to L_MAX.

    The mean of the values in the mask is 0.
    """

    values: Float
    mask: Float
    noise: Float

    def product(self, other: _Map) -> float:
        """Return the mean product of both masks on the whole sky."""
        return float(np.mean(self.mask * other.mask))


def measure(galaxies: read.Version, depth: read.Version, randoms: read.Version) -> Result:
    """Check the angular power spectra of the table `galaxies` in the area of the tables `depth` and `randoms`.

    Parameters
    ----------
    galaxies, depth, randoms : Version
        Published tables of the lake.

    Returns
    -------
    Result
        Rows (measured values divided by expected ones, with verdicts) and arrays for plots. Spectra that
        cannot be measured have rows "not_applicable" with the reason.
    """
    missing = [name for name in COLUMNS if name not in galaxies.schema.names]
    if missing:
        return _no_result(f"table galaxies has no column {', '.join(missing)}")
    if why := why_outdated(depth, randoms):
        return _no_result(why)
    table, facts = galaxies.rows(list(COLUMNS)), galaxies.manifest.get("facts", {})
    columns = {name: table[name].to_numpy() for name in COLUMNS}
    field = fields.from_version(galaxies, columns["_healpix_29"])
    cells = np.unique(sky.parent(field.cells, field.order, GENERATION_ORDER)).tolist()
    drawn = randoms.manifest["facts"]
    mask = read_mask(depth, band_of_points(randoms), cells)
    result = compare(columns, mask, from_facts(facts), int(facts.get("lensing_nside", _NSIDE)))
    points = randoms.rows(["_healpix_29"], where=pc.field("band") == mask.band)
    number = int(np.count_nonzero(mask.contains(points["_healpix_29"].to_numpy())))
    row = _density_row(number, float(drawn["density"]), mask)
    return Result(Place(), [*result.rows, *row], result.series)


def compare(columns: Mapping[str, Array], mask: SurveyMask, cosmology: Cosmology, nside: int = _NSIDE) -> Result:
    """Check the power spectra of galaxies in a mask.

    Parameters
    ----------
    columns : mapping of str to array, shape (n,)
        COLUMNS of the table `galaxies`.
    mask : SurveyMask
        Part of the sky in which galaxies are used.
    cosmology : Cosmology
        Parameters of the universe.
    nside : int
        HEALPix resolution of the lensing maps. Below 1024, differences of the convergence count as known failures.

    Returns
    -------
    Result
        Two rows for each redshift bin: the power of galaxies and the cross power with the convergence, relative to the
        expected ones.
    """
    if not len(mask.pixels):
        return _no_result(f"no pixel of band {mask.band} is covered, unmasked and in the area of the galaxies")
    used = (columns["kind"] < 2) & (columns["mag_r01"] < _MAX_MAG) & mask.contains(columns["_healpix_29"])
    columns = {name: values[used] for name, values in columns.items()}
    edges = _band_edges(mask.area)
    convergence, why = _convergence_map(columns, mask)
    rows, series, galaxy_bands, cross_bands = [], {}, None, None
    for low, high in pairwise(Z_EDGES):
        sample = (columns["z_true"] > low) & (columns["z_true"] < high)
        first, last = int(edges[1]), _last_multipole(low, high, cosmology)
        inside = (edges[:-1] >= first) & (edges[1:] <= last + 1)
        reason = _why_not(columns, sample, inside, (first, last))
        if reason:
            names = (f"galaxies_{low:g}", f"convergence_{low:g}")
            rows += [not_applicable(NAME, Place(), f"{reason} at {low:g} < z < {high:g}", SOURCE, n) for n in names]
            continue
        density, tracers = _density_map(columns, sample, mask), _tracers(columns, sample, (low, high), cosmology)
        galaxy_bands = galaxy_bands or _bands(density, density, edges)
        power, band_values, covariance = _auto_power(density, tracers, galaxy_bands, cosmology)
        note = f"{np.count_nonzero(sample)} galaxies, {mask.area:.3g} deg2 of {mask.band}"
        rows.append(_row(f"galaxies_{low:g}", band_values[:, inside], covariance[np.ix_(inside, inside)], note))
        series[f"power_{low:g}"] = band_values[:, inside]
        if convergence is None:
            rows.append(not_applicable(NAME, Place(), why, SOURCE, f"convergence_{low:g}"))
            continue
        if cross_bands is None:
            are_equal = np.array_equal(density.mask, convergence.mask)
            cross_bands = galaxy_bands if are_equal else _bands(density, convergence, edges)
        samples = tracers, _sources(columns, cosmology)
        band_values, covariance = _cross_power(density, convergence, samples, (power, cross_bands), cosmology)
        covariance = covariance[np.ix_(inside, inside)]
        rows.append(_row(f"convergence_{low:g}", band_values[:, inside], covariance, note, nside))
        series[f"convergence_power_{low:g}"] = band_values[:, inside]
    return Result(Place(), rows, series)


def _band_edges(area: float) -> Int:
    """Return the edges of bands as wide as the resolution of a field (deg2) in multipoles, the first one below it."""
    side = np.sqrt(area)
    first, width = max(_FIRST, int(360.0 / side)), max(_NARROWEST, int(180.0 / side))
    inner = np.arange(first, L_MAX + 2 - width, width)
    return np.unique(np.concatenate([[2], inner[inner <= L_MAX], [L_MAX + 1]])).astype(np.int64)


def _bands(first: _Map, second: _Map, edges: Int) -> Bands:
    """Return the bands of the cross spectra of two maps whose means were subtracted."""
    return pseudo_power.bands(first.mask, second.mask, edges, is_centred=True)


def _last_multipole(low: float, high: float, cosmology: Cosmology) -> int:
    return min(int(_MAX_K * float(cosmology.comoving_distance(0.5 * (low + high)))), _LAST)


def _why_not(columns: Mapping[str, Array], sample: Bool, inside: Bool, limits: tuple[int, int]) -> str:
    number = int(np.count_nonzero(sample))
    if number < _MIN_GALAXIES:
        return f"{number} galaxies in the mask; {_MIN_GALAXIES} are required"
    if not inside.any():
        return f"no band from l = {limits[0]}, which the field resolves, to the linear l = {limits[1]}"
    if np.count_nonzero(np.isfinite(columns["log_halo_mass"][sample])) < 0.9 * number:
        return "the masses of the halos, and thus the bias of the galaxies, are not known"
    return ""


def _density_map(columns: Mapping[str, Array], sample: Bool, mask: SurveyMask) -> _Map:
    """Return the masked overdensity of galaxies, with the spectrum of their shot noise."""
    cells, weight = mask.cells()
    at = np.searchsorted(cells, sky.parent(columns["_healpix_29"][sample], sky.MAX_ORDER, GENERATION_ORDER))
    mean = len(at) / weight.sum()
    overdensity = np.bincount(at, minlength=len(cells)) / mean - weight
    solid_angle = np.radians(1.0) ** 2 * sky.cell_area(GENERATION_ORDER)
    noise = solid_angle**2 * len(at) / mean**2 / (4.0 * np.pi)
    full_mask = pseudo_power.map_of_cells(cells, weight)
    # The number of all galaxies is fixed, so that the map has no noise at l = 0, and less on the scale of the field.
    window = pseudo_power.power_of_maps(full_mask) * 4.0 * np.pi / (solid_angle * weight.sum()) ** 2
    return _Map(pseudo_power.map_of_cells(cells, overdensity), full_mask, noise * (1.0 - window))


def _is_source(columns: Mapping[str, Array]) -> Bool:
    z = columns["z_true"]
    return np.asarray((z > _Z_SOURCES[0]) & (z < _Z_SOURCES[1]) & np.isfinite(columns["kappa"]))


def _convergence_map(columns: Mapping[str, Array], mask: SurveyMask) -> tuple[_Map | None, str]:
    """Return the masked mean convergence of the galaxies behind all redshift bins, or None and the reason."""
    sample = _is_source(columns)
    kappa = columns["kappa"][sample].astype(float)
    if len(kappa) < _MIN_GALAXIES:
        return None, f"{len(kappa)} galaxies with convergence at z > {_Z_SOURCES[0]:g}; {_MIN_GALAXIES} are required"
    if not np.ptp(kappa):
        return None, "all galaxies have the same convergence"
    cells, weight = mask.cells()
    at = np.searchsorted(cells, sky.parent(columns["_healpix_29"][sample], sky.MAX_ORDER, GENERATION_ORDER))
    number = np.bincount(at, minlength=len(cells))
    weight = np.where(number > 0, weight, 0.0)
    mean = np.bincount(at, kappa, len(cells)) / np.maximum(number, 1)
    values = weight * (mean - np.sum(weight * mean) / weight.sum())
    # Scatter of the convergence in a cell, which the mean of its galaxies has, too.
    variance = np.maximum(np.bincount(at, kappa**2, len(cells)) / np.maximum(number, 1) - mean**2, 0.0)
    solid_angle = np.radians(1.0) ** 2 * sky.cell_area(GENERATION_ORDER)
    noise = solid_angle**2 / (4.0 * np.pi) * float(np.sum(weight**2 * variance / np.maximum(number, 1)))
    full_map, full_mask = (pseudo_power.map_of_cells(cells, part) for part in (values, weight))
    return _Map(full_map, full_mask, np.full(L_MAX + 1, noise)), ""


def _tracers(columns: Mapping[str, Array], sample: Bool, limits: tuple[float, float], cosmology: Cosmology) -> Shells:
    """Return the distribution of galaxies between two redshifts over distance, weighted with the halos' bias."""
    has_halo = sample & np.isfinite(columns["log_halo_mass"])
    z, mass = (columns[name][has_halo].astype(float) for name in ("z_true", "log_halo_mass"))
    chi, halos = np.asarray(cosmology.comoving_distance(z)), matching.masses(cosmology)
    # Equal shells that end at the limits of the sample: a shell that it fills in part would have a wrong density.
    low, high = (float(cosmology.comoving_distance(limit)) for limit in limits)
    edges = np.linspace(low, high, max(round((high - low) / _SHELL), 1) + 1)
    return theory.shells(chi, halos.interpolate_pairs(halos.bias, z, mass), edges)


def _sources(columns: Mapping[str, Array], cosmology: Cosmology) -> tuple[Float, Float]:
    """Return comoving distances, Mpc/h, and numbers of the galaxies whose convergence is used."""
    chi = np.asarray(cosmology.comoving_distance(columns["z_true"][_is_source(columns)].astype(float)))
    number, edges = np.histogram(chi, _SOURCE_BINS)
    return 0.5 * (edges[1:] + edges[:-1]), number.astype(float)


def _auto_power(density: _Map, tracers: Shells, bands: Bands, cosmology: Cosmology) -> tuple[Float, Float, Float]:
    """Return the expected C_l, rows with l, C_l, its error and its expected value by band, and the covariance."""
    c_l = _at_all_multipoles(lambda ell: theory.galaxy_power(cosmology, ell, tracers))
    value = bands.measure(pseudo_power.power_of_maps(density.values) - density.noise)
    total = _in_mask(density, bands, c_l)
    covariance = bands.covariance(total, total, total)
    return c_l, np.stack([bands.middle, value, np.sqrt(np.diag(covariance)), bands.expect(c_l)]), covariance


def _cross_power(
    density: _Map,
    convergence: _Map,
    samples: tuple[Shells, tuple[Float, Float]],
    theory_and_bands: tuple[Float, Bands],
    cosmology: Cosmology,
) -> tuple[Float, Float]:
    """Return rows with l, cross power, its error and its expected value by band, and the covariance."""
    tracers, (chi, number) = samples
    galaxies, bands = theory_and_bands
    c_l = _at_all_multipoles(lambda ell: theory.galaxy_convergence_power(cosmology, ell, tracers, chi, number))
    lensing = _at_all_multipoles(lambda ell: theory.convergence_power(cosmology, ell, chi, number))
    # Errors follow from the expected power of the convergence: with the measured one, fields with little structure
    # would have more weight, and the mean of the factors would be too small.
    spectra = _in_mask(density, bands, galaxies), _in_mask(convergence, bands, lensing)
    covariance = bands.covariance(*spectra, bands.mix(c_l) / density.product(convergence))
    value = bands.measure(pseudo_power.power_of_maps(density.values, convergence.values))
    return np.stack([bands.middle, value, np.sqrt(np.diag(covariance)), bands.expect(c_l)]), covariance


def _in_mask(masked: _Map, bands: Bands, c_l: Float) -> Float:
    """Return the mean spectrum of a map with its noise in each band, as it is in the mask."""
    noise = np.add.reduceat(masked.noise, bands.edges[:-1]) / np.diff(bands.edges)
    return np.asarray((bands.mix(c_l) + noise) / masked.product(masked))


def _at_all_multipoles(power: Callable[[Float], Float]) -> Float:
    """Return C_l at l = 0 to L_MAX, interpolated from 40 multipoles, as the means over cells have it."""
    ell, nodes = np.arange(L_MAX + 1), np.geomspace(1.0, L_MAX, 40)
    c_l = np.interp(np.log(np.maximum(ell, 1)), np.log(nodes), power(nodes))
    return np.asarray(c_l * pseudo_power.pixel_window() ** 2)


def _row(name: str, band_values: Float, covariance: Float, note: str, nside: int = _NSIDE) -> Row:
    """Return the row of the factor between measured and expected power, averaged over bands by their errors."""
    ell, value, error, expected = band_values
    share = expected / error**2 / np.sum((expected / error) ** 2)
    factor = float(np.sum(share * value))
    factor_error = float(np.sqrt(np.sum(share[:, None] * share * covariance)))
    rough = f"lensing maps contain structure only to l = {nside}" if nside < _NSIDE else ""
    full_note = f"{note}, {len(ell)} bands with l = {ell[0]:.0f} to {ell[-1]:.0f}"
    return Row(NAME, name, Place(), factor, factor_error, 1.0, _TOLERANCE, "", SOURCE, note=full_note,
               known_failure=rough)  # fmt: skip


def _density_row(number: int, density: float, mask: SurveyMask) -> list[Row]:
    """Return the row of the number of random points in the mask, relative to the number that was asked for."""
    expected = density * 3600.0 * mask.area
    if expected < 1.0:
        return []
    note = f"{number} random points in {mask.area:.3g} deg2"
    value, error = number / expected, expected**-0.5
    return [Row(NAME, "randoms", Place(), value, error, 1.0, _DENSITY_TOLERANCE, "", _DRAWN, note=note)]


def _no_result(why: str) -> Result:
    return Result(Place(), [not_applicable(NAME, Place(), why, SOURCE)], {})
