"""Draw quasars (`kind` 2) and galaxies beyond redshift 6 (`kind` 3) as rows of table `galaxies`.

Their positions are random, without clustering; with `draw_in_halos`, quasars below redshift 6 are in halos. The column
`density_boost` is the ratio of the drawn to the natural number density. Each interval of one magnitude is drawn
separately, so a catalogue with a brighter limit contains the bright objects of a deeper catalogue. The file
high_redshift.toml contains the parameters.

References
----------
Palanque-Delabrouille et al. 2016; Bouwens et al. 2021, AJ 162, 47; Matsuoka et al. 2018, ApJ 869, 150
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from lake_schema import ids, sky
from lake_schema.arrays import Bool, Float, Float32, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.galaxies import GALAXIES
from truesky.catalogue import dust_map, parameters
from truesky.catalogue.galaxies import halo_lensing, morphology
from truesky.catalogue.galaxies.halo_lensing import Neighbourhood
from truesky.catalogue.galaxies.lensing import Lens
from truesky.catalogue.halos.halos import HaloModel
from truesky.catalogue.halos.population import observed_redshift
from truesky.catalogue.nuclei import quasar_hosts
from truesky.catalogue.nuclei.quasar_hosts import QuasarHosts
from truesky.cosmology import Cosmology
from truesky.fluxes.high_redshift import (
    HIGH_REDSHIFT,
    HIGH_REDSHIFT_SLOPES,
    HUBBLE,
    LYMAN_ALPHA_WIDTHS,
    QUASAR,
    QUASAR_OFFSETS,
    QUASAR_STRENGTHS,
    ultraviolet_magnitude,
)
from truesky.randomness.per_source import AnyGenerator, PerSourceGenerator
from truesky.randomness.rng import stream

_FILE = "high_redshift.toml"
_STREAM = {HIGH_REDSHIFT: "high_redshift", QUASAR: "quasars"}
# Function that returns True for the positions (ra and dec arrays, deg) of the objects to draw.
PositionFilter = Callable[[Float, Float], Bool]
# Width of the cells in redshift and in absolute magnitude (mag) in which objects are counted.
_Z_STEP, _M_STEP = 0.02, 0.02
# Brightest absolute ultraviolet AB magnitude that is drawn.
_M_BRIGHTEST = -32.0
# Redshift at which the galaxies in halos end and the galaxies of this module begin.
_LIGHTCONE_END = 6.0
# Brightest apparent magnitude that is drawn, an integer.
_FIRST_MAGNITUDE = 10


@dataclass(frozen=True, slots=True, eq=False)
class Kind:
    """Luminosity function of quasars, or of galaxies beyond redshift 6, as counts in cells of redshift and magnitude.

    Attributes
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    code : int
        Kind of the objects: HIGH_REDSHIFT or QUASAR.
    numbers : dict
        Parameters from high_redshift.toml, by name.
    boost : float
        Ratio of the drawn to the natural number density.
    z : float array, shape (r,)
        Lower edges of the redshift cells.
    m : float array, shape (c,)
        Lower edges of the cells of absolute ultraviolet AB magnitude.
    limit : float
        Faintest apparent ultraviolet AB magnitude.
    z_end : float
        Redshift beyond which objects are left out; objects beyond z = 6 are always kept.
    first : int
        Apparent magnitude of the first arrays of `cells` and `counts`.
    cells : tuple of int array
        One array per integer apparent magnitude: the cells with this magnitude, as flat indices into an array (r, c).
    counts : tuple of float array
        For each array of `cells`, the cumulative sum of the natural number of objects per deg2.
    """

    cosmology: Cosmology
    code: int
    numbers: dict[str, Any]
    boost: float
    z: Float
    m: Float
    limit: float
    z_end: float
    first: int
    cells: tuple[Int, ...]
    counts: tuple[Float, ...]

    def per_deg2(self, z_min: float = 0.0, z_max: float = np.inf) -> float:
        """Return the natural number of observable objects per deg2 between two redshifts, without the boost.

        The redshifts should be edges of the redshift cells (multiples of 0.02 from the first edge), because cells are
        counted as a whole.
        """
        number = 0.0
        for cells, counts in zip(self.cells, self.counts, strict=True):
            z, m = (nodes[i] for nodes, i in zip((self.z, self.m), np.divmod(cells, self.m.size), strict=True))
            apparent = ultraviolet_magnitude(self.cosmology, m + 0.5 * _M_STEP, z + 0.5 * _Z_STEP)
            is_observable = apparent < self.limit
            selected = (
                (z > z_min - 1e-6)
                & (z < z_max - 1e-6)
                & ((z < self.z_end) | (z > _LIGHTCONE_END - 1e-6))
                & is_observable
            )
            number += float(np.diff(counts, prepend=0.0)[selected].sum())
        return number


def model(
    cosmology: Cosmology,
    galaxy_boost: float = 1.0,
    quasar_boost: float = 1.0,
    limit: float = 26.0,
    z_end: float = 6.0,
) -> tuple[Kind, ...]:
    """Return the luminosity functions of the objects to draw: galaxies beyond redshift 6, and quasars.

    Parameters
    ----------
    cosmology : Cosmology
        Parameters of the universe.
    galaxy_boost, quasar_boost : float
        Ratio of the drawn to the natural number density; with 0, these objects are left out.
    limit : float
        Faintest apparent AB magnitude at 1500 A (galaxies) or 1450 A (quasars) in the rest frame.
    z_end : float
        Redshift beyond which quasars are left out; quasars and galaxies beyond z = 6 are always kept.

    Returns
    -------
    tuple of Kind
        Zero to two luminosity functions, galaxies first.
    """
    kinds = ((HIGH_REDSHIFT, "galaxies", galaxy_boost), (QUASAR, "quasars", quasar_boost))
    included = ((code, parameters.section(_FILE, name), boost) for code, name, boost in kinds if boost > 0.0)
    return tuple(_tabulate_kind(cosmology, *arguments, limit, z_end) for arguments in included)


def draw(
    cell: int,
    seed: int,
    kind: Kind,
    lens: Lens | Neighbourhood,
    dust: Float32,
    position_filter: PositionFilter | None = None,
) -> pa.Table:
    """Draw the quasars, or the galaxies beyond redshift 6, whose true positions are in a HEALPix cell of order 8.

    Parameters
    ----------
    cell : int
        Nested index of the order-8 cell.
    seed : int
        Seed of the request.
    kind : Kind
        Luminosity function and boost.
    lens : Lens or Neighbourhood
        Lensing maps, a uniform shear, or maps with the halos that lens sources in the cell.
    dust : float32 array, shape (pixels,)
        Map of the Milky Way's A(V), mag (truesky.catalogue.dust_map).
    position_filter : callable, optional
        Function that returns True for the true positions (ra, dec) to keep; None keeps all.

    Returns
    -------
    Table
        Rows of table `galaxies`, not sorted; empty if there are no objects.
    """
    samples = [_draw_magnitude(cell, seed, kind, step) for step in range(len(kind.cells))]
    z, m, ra, dec = (np.concatenate(column) for column in zip(*samples, strict=True))
    selected = (ultraviolet_magnitude(kind.cosmology, m, z) < kind.limit) & ((z < kind.z_end) | (z >= _LIGHTCONE_END))
    if position_filter is not None:
        selected &= position_filter(ra, dec)
    # The numbers in the identifiers count all drawn objects, so an identifier does not depend on the selection.
    numbers = ids.FIRST_NUMBER + np.flatnonzero(selected)
    z, m, ra, dec = z[selected], m[selected], ra[selected], dec[selected]
    source = ids.source_id(np.full(numbers.size, kind.code), cell, numbers)
    places = halo_lensing.columns(lens, ra, dec, kind.cosmology.comoving_distance(z))
    identity = {"id": source, "halo_id": ids.halo_from_id(source), "z_obs": z}
    return _rows(kind, seed, dust, m, {**identity, **places, "z_true": z})


def hosts(kind: Kind, halo_model: HaloModel) -> QuasarHosts:
    """Return the tables from which the quasars of `kind` below redshift 6 are drawn in halos.

    Raises BadInput if a halo would have more than one quasar because of the boost.
    """
    z = halo_model.steps.z
    included = (z > parameters.section(_FILE, "near_quasars")["z_min"]) & (z < _LIGHTCONE_END)
    m = np.arange(_M_BRIGHTEST, quasar_hosts.faintest() + 0.5 * _M_STEP, _M_STEP)
    counts = density(kind.code, kind.numbers, m[:-1] + 0.5 * _M_STEP, z[:, None]) * _M_STEP / HUBBLE**3
    max_distance = float(kind.cosmology.comoving_distance(kind.z_end))
    return quasar_hosts.model(halo_model, m, np.where(included[:, None], counts, 0.0), kind.boost, max_distance)


def draw_in_halos(
    cell: int,
    seed: int,
    kind: Kind,
    tables: QuasarHosts,
    lens: Lens | Neighbourhood,
    dust: Float32,
    position_filter: PositionFilter | None = None,
) -> pa.Table:
    """Draw the quasars below redshift 6 whose true positions are in a HEALPix cell of order 8, in halos.

    Parameters
    ----------
    cell : int
        Nested index of the order-8 cell.
    seed : int
        Seed of the request.
    kind : Kind
        Limits of the quasars.
    tables : QuasarHosts
        Expected number of quasars in halos, from `hosts`.
    lens : Lens or Neighbourhood
        Lensing maps, a uniform shear, or maps with the halos that lens sources in the cell.
    dust : float32 array, shape (pixels,)
        Map of the Milky Way's A(V), mag (truesky.catalogue.dust_map).
    position_filter : callable, optional
        Function that returns True for the true positions (ra, dec) to keep; None keeps all.

    Returns
    -------
    Table
        Rows of table `galaxies`, not sorted. A quasar has the position and the redshifts of the central galaxy of its
        halo. Its identifier is that of the halo, with the kind of quasars.
    """
    quasars = quasar_hosts.draw(tables, seed, cell)
    z = tables.halos.distances.redshift(quasars.halos.chi)
    ra, dec = sky.positions_of_indices(quasars.halos.index)
    selected = (ultraviolet_magnitude(kind.cosmology, quasars.m_1450, z) < kind.limit) & (z < kind.z_end)
    if position_filter is not None:
        selected &= position_filter(ra, dec)
    host, z = quasars.halos.select(selected), z[selected]
    identity = {
        "id": np.int64(kind.code) << 60 | host.id,
        "halo_id": host.id,
        "z_obs": observed_redshift(z, host.velocity),
        "log_halo_mass": host.log_mass,
    }
    places = halo_lensing.columns(lens, ra[selected], dec[selected], host.chi)
    return _rows(kind, seed, dust, quasars.m_1450[selected], {**identity, **places, "z_true": z})


def _rows(kind: Kind, seed: int, dust: Float32, m: Float, drawn: dict[str, Any]) -> pa.Table:
    """Return rows of table `galaxies` for objects with absolute magnitudes `m`.

    `drawn` are their identifiers, positions, lensing, redshifts and, for quasars in halos, halo masses, as columns.
    """
    z, zeros = np.asarray(drawn["z_true"], float), np.zeros(m.size)
    rng = PerSourceGenerator(np.asarray(drawn["id"], np.int64), seed, _STREAM[kind.code])
    columns = {
        **drawn,
        "kind": np.full(m.size, kind.code),
        "density_boost": np.full(m.size, kind.boost),
        "abs_mag_r01": m - 5.0 * np.log10(HUBBLE),
        "mag_r01": ultraviolet_magnitude(kind.cosmology, m, z),
        "sed_1": _templates(kind, m, rng),
        "frac_1": zeros + 1.0,
        "sed_2": zeros.astype(int),
        "frac_2": zeros,
        **{name: zeros.astype(int) for name in ("ext_law_1", "ext_law_2")},
        **{name: zeros for name in ("ebv_1", "ebv_2")},
        **_shapes(kind, z, m, rng),
        "a_v": dust_map.a_v(dust, drawn["ra"], drawn["dec"]),
    }
    return GALAXIES.build(columns)


def _draw_magnitude(cell: int, seed: int, kind: Kind, step: int) -> tuple[Float, Float, Float, Float]:
    """Draw redshift, absolute magnitude, ra and dec (deg) of the objects with apparent magnitude kind.first + step.

    The apparent magnitude is rounded down to an integer, so all objects of an interval of one magnitude are drawn.
    """
    rng, counts = stream(seed, _STREAM[kind.code], cell, kind.first + step), kind.counts[step]
    total = float(counts[-1]) if counts.size else 0.0
    n = int(rng.poisson(kind.boost * total * sky.cell_area(GENERATION_ORDER)))
    at = np.searchsorted(counts, rng.random(n) * total, side="right")
    row, column = np.divmod(kind.cells[step][np.minimum(at, counts.size - 1)], kind.m.size)
    z, m = kind.z[row] + _Z_STEP * rng.random(n), kind.m[column] + _M_STEP * rng.random(n)
    _, ra, dec = sky.random_in_cell(GENERATION_ORDER, cell, n, rng)
    return z, m, ra, dec


def density(code: int, numbers: dict[str, Any], m: Float, z: Float) -> Float:
    """Return the luminosity function dn/dM of quasars, or of galaxies beyond redshift 6.

    Parameters
    ----------
    code : int
        Kind of the objects: HIGH_REDSHIFT or QUASAR.
    numbers : dict
        Parameters of the luminosity function, by name, from high_redshift.toml.
    m : float array
        Absolute ultraviolet AB magnitude.
    z : float array
        Redshift, of the same shape as `m` or broadcastable.

    Returns
    -------
    float array
        dn/dM, Mpc^-3 mag^-1, for h = 0.67.
    """
    z_offset = z - _LIGHTCONE_END
    if code == QUASAR:
        amplitude = numbers["phi"] * 10.0 ** (numbers["rate"] * z_offset)
        high_z_density = _double_power(amplitude, numbers, m - numbers["m_star"])
        return np.where(
            z_offset < 0.0, _low_redshift_quasars(parameters.section(_FILE, "near_quasars"), m, z), high_z_density
        )
    star = numbers["m_star"] + numbers["m_star_rate"] * z_offset
    phi = numbers["phi_star"] * 10.0 ** (numbers["phi_rate"] * z_offset + numbers["phi_curve"] * z_offset**2)
    alpha = numbers["alpha"] + numbers["alpha_rate"] * z_offset
    ln_x = -0.4 * np.log(10.0) * (m - star)
    return np.asarray(0.4 * np.log(10.0) * phi * np.exp((alpha + 1.0) * ln_x - np.exp(ln_x)))


def _low_redshift_quasars(numbers: dict[str, Any], m: Float, z: Float) -> Float:
    d = z - numbers["z_pivot"]
    d_below, d_above = np.minimum(d, 0.0), np.maximum(d, 0.0)
    star = numbers["m_star"] + numbers["near_rate"] * d_below + numbers["near_curve"] * d_below**2
    star = star + numbers["far_rate"] * d_above
    log_phi = numbers["log_phi"] + numbers["phi_rate"] * d_above + numbers["phi_curve"] * d_above**2
    return _double_power(10.0**log_phi, numbers, m - star)


def _double_power(phi: Float, numbers: dict[str, Any], brighter: Float) -> Float:
    x = 0.4 * brighter
    return np.asarray(phi / (10.0 ** ((numbers["faint"] + 1.0) * x) + 10.0 ** ((numbers["bright"] + 1.0) * x)))


def _tabulate_kind(
    cosmology: Cosmology, code: int, numbers: dict[str, Any], boost: float, limit: float, z_end: float
) -> Kind:
    z_first = parameters.section(_FILE, "near_quasars")["z_min"] if code == QUASAR else _LIGHTCONE_END
    z = np.arange(z_first, numbers["z_max"] - 1e-9, _Z_STEP)
    m = np.arange(_M_BRIGHTEST, -12.0, _M_STEP)
    middle_z, middle_m = z[:, None] + 0.5 * _Z_STEP, m[None, :] + 0.5 * _M_STEP
    volume = cosmology.comoving_volume(z, z + _Z_STEP)[:, None] * np.radians(1.0) ** 2 / HUBBLE**3
    counts = density(code, numbers, middle_m, middle_z) * volume * _M_STEP
    # Group the cells by apparent magnitude rounded down. The last group may contain cells beyond the limit, because
    # `draw` draws whole groups and selects by the exact limit.
    mag = np.floor(ultraviolet_magnitude(cosmology, middle_m, middle_z))
    last = int(np.ceil(limit + 2.0 * _M_STEP))
    cells = tuple(np.flatnonzero(mag == step) for step in range(_FIRST_MAGNITUDE, last))
    cumulative = tuple(np.cumsum(counts.ravel()[place]) for place in cells)
    return Kind(cosmology, code, numbers, boost, z, m, limit, z_end, _FIRST_MAGNITUDE, cells, cumulative)


def _templates(kind: Kind, m: Float, rng: AnyGenerator) -> Int:
    """Draw the index of the template spectrum of each object with absolute magnitude `m`.

    The templates have several ultraviolet slopes with k line strengths each. The template with slope i and strength j
    has the index i k + j. The slope of a galaxy follows from its absolute magnitude, with a scatter. The slope of a
    quasar and all line strengths are random.
    """
    if kind.code == QUASAR:
        slope = rng.integers(0, len(QUASAR_OFFSETS), m.size)
        return np.asarray(slope * len(QUASAR_STRENGTHS) + rng.integers(0, len(QUASAR_STRENGTHS), m.size), np.int64)
    law = kind.numbers
    beta = law["slope"] + law["slope_rate"] * (m + law["slope_pivot"])
    beta = beta + law["slope_scatter"] * rng.standard_normal(m.size)
    nearest = np.abs(beta[:, None] - np.array(HIGH_REDSHIFT_SLOPES)).argmin(1) if m.size else np.zeros(0, int)
    odds = np.cumsum(law["lyman_odds"])
    width = np.searchsorted(odds[:-1], rng.random(m.size) * odds[-1], side="right")
    return np.asarray(nearest * len(LYMAN_ALPHA_WIDTHS) + width, np.int64)


def _shapes(kind: Kind, z: Float, m: Float, rng: AnyGenerator) -> dict[str, npt.NDArray[np.generic]]:
    """Draw the shape of each object, as columns of table `galaxies`.

    An object is one Sersic profile, which is stored as a bulge with all of the light.
    """
    law, n = kind.numbers, z.size
    if kind.code == QUASAR:
        radius, ratio, sersic = np.full(n, law["radius"]), np.ones(n), 1.0
    else:
        mean = law["radius"] * ((1.0 + z) / 7.0) ** law["radius_z"] * 10.0 ** (-0.4 * law["radius_m"] * (m + 21.0))
        kpc = mean * 10.0 ** (law["radius_scatter"] * rng.standard_normal(n))
        radius, sersic = kpc / kind.cosmology.kpc_per_arcsec(z), law["sersic"]
        ratio = law["axis_ratio"][0] + (law["axis_ratio"][1] - law["axis_ratio"][0]) * rng.random(n)
    return {
        "bulge_half_light_radius": radius,
        "disk_half_light_radius": radius,
        "bulge_fraction": np.ones(n),
        "bulge_sersic_index": np.full(n, sersic),
        "bulge_axis_ratio": ratio,
        "disk_axis_ratio": ratio,
        "inclination": morphology.inclination(ratio, 0.1),
        "position_angle": morphology.position_angle(n, rng),
    }
