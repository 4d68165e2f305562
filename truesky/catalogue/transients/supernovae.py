"""Draw the supernovae of a cell: in which galaxies they explode, when, and how bright they are.

Time is divided into blocks. Every galaxy has a number of supernovae in each block, which depends only on the galaxy and
the block. A deeper catalogue or a longer window of time therefore contains the same supernovae and more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import numpy.typing as npt
import pyarrow as pa
import scipy

from lake_schema import ids, sky
from lake_schema.arrays import Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.variability.transients import TRANSIENTS
from truesky.catalogue import cells, parameters
from truesky.catalogue.transients import places, rates
from truesky.cosmology import Cosmology
from truesky.fluxes.sources import magnification
from truesky.randomness import per_source
from truesky.randomness.per_source import PerSourceGenerator
from truesky.variability import supernova_light
from truesky.variability.supernova_light import Supernovae
from truesky.variability.supernova_templates import KINDS, TYPE_IA, Template

COLUMNS = ("id", "kind", "ra", "dec", "z_true", "z_obs", "log_stellar_mass", "log_sfr", "a_v", *places.COLUMNS)
# Length of a block of time, days. Blocks are counted from MJD 0.
BLOCK_DAYS = 4096.0
DAYS_A_YEAR = 365.25
# Names of the families of supernovae in requests.
FAMILIES = ("ia", "core_collapse")
# Difference of Vega and AB magnitudes in B, AB - Vega: Blanton & Roweis 2007, AJ 133, 734, table 1.
_AB_MINUS_VEGA_B = -0.09
# A(B) / E(B-V) of dust with R_V = 3.1: Cardelli, Clayton & Mathis 1989.
_R_B = 4.1
_ARCSEC = np.radians(1.0 / 3600.0)
# Mean above which a Poisson distribution is replaced by a Gaussian.
_GAUSSIAN_MEAN = 500.0


@dataclass(frozen=True, slots=True)
class TypeIa:
    """Parameters of type Ia supernovae; explained in transients.toml, [type_ia]."""

    magnitude: float
    alpha: float
    beta: float
    scatter: float
    x1: tuple[float, float, float]
    x1_limits: tuple[float, float]
    c: tuple[float, float, float]
    c_limits: tuple[float, float]
    stretch: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class CoreCollapse:
    """Parameters of core-collapse supernovae; explained in transients.toml, [core_collapse]."""

    kinds: tuple[str, ...]
    shares: tuple[float, ...]
    magnitude: tuple[float, ...]
    scatter: tuple[float, ...]
    brightest: float
    hubble: float
    ebv: float
    ebv_limit: float


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Which transients are drawn.

    Attributes
    ----------
    start, end : float
        First and last date, MJD. Transients that shine at any time in between are drawn.
    kinds : tuple of str
        Families of supernovae, from FAMILIES.
    boost : float
        Ratio of the drawn rate to the natural rate.
    templates : mapping of int to Template
        Spectra by kind, which determine how long a supernova shines.
    """

    start: float
    end: float
    kinds: tuple[str, ...]
    boost: float
    templates: Mapping[int, Template]


@lru_cache(maxsize=1)
def type_ia() -> TypeIa:
    """Return the built-in parameters of type Ia supernovae."""
    return TypeIa(**parameters.section(rates.FILE, "type_ia"))


@lru_cache(maxsize=1)
def core_collapse() -> CoreCollapse:
    """Return the built-in parameters of core-collapse supernovae."""
    return CoreCollapse(**parameters.section(rates.FILE, "core_collapse"))


def draw(cell: int, galaxies: pa.Table, seed: int, window: Window, cosmology: Cosmology) -> pa.Table:
    """Draw the rows of table `transients` in one order-8 cell.

    Parameters
    ----------
    cell : int
        Nested index of the order-8 cell.
    galaxies : Table
        Rows of table `galaxies` whose observed position is in the cell, with the columns COLUMNS.
    seed : int
        Seed of the request.
    window : Window
        Window of time, kinds and boost.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    Table
        Rows of table `transients`, sorted by the order-29 cell of the position, then by identifier.

    Notes
    -----
    Only galaxies with a stellar mass have supernovae; galaxies from a user's catalogue may lack it. A supernova that
    would be outside of the cell of its host (one in a thousand) is placed in the middle of its host.
    """
    log_mass, log_sfr = (_numbers(galaxies, name) for name in ("log_stellar_mass", "log_sfr"))
    galaxies = galaxies.filter(pa.array(np.isfinite(log_mass) & np.isfinite(log_sfr)))
    log_mass, log_sfr, z = (_numbers(galaxies, name) for name in ("log_stellar_mass", "log_sfr", "z_true"))
    tables = [TRANSIENTS.empty()]
    for family, rate in zip(FAMILIES, rates.expected_rates(log_mass, log_sfr, z), strict=True):
        if family in window.kinds:
            mean = rate * window.boost * BLOCK_DAYS / (DAYS_A_YEAR * (1.0 + z))
            tables.append(_draw_family(cell, galaxies, mean, family, seed, window, cosmology))
    rows = cells.sort_rows(pa.concat_tables(tables))
    # Identifiers have 39 random bits. Of two equal ones, of which there is one in a million cells, the first is kept.
    _, first = np.unique(rows["id"].to_numpy(), return_index=True)
    return rows.take(np.sort(first))


def _numbers(rows: pa.Table, name: str) -> Float:
    return np.asarray(rows[name].to_numpy(zero_copy_only=False), float)


def _draw_family(
    cell: int, galaxies: pa.Table, mean: Float, family: str, seed: int, window: Window, cosmology: Cosmology
) -> pa.Table:
    """Draw the supernovae of a family; `mean` is their mean number in each galaxy and block of time."""
    host, keys, peak = _draw_peaks(galaxies["id"].to_numpy(), mean, family, seed, _blocks(galaxies, family, window))
    hosts = galaxies.take(pa.array(host))
    draw_properties = _draw_type_ia if family == "ia" else _draw_core_collapse
    rng = PerSourceGenerator(keys.view(np.int64), seed, "transients.properties")
    kind, absolute, stretch, ebv = draw_properties(len(host), cosmology.h, rng)
    z, z_obs = _numbers(hosts, "z_true"), _numbers(hosts, "z_obs")
    kappa, gamma1, gamma2 = (_numbers(hosts, name) for name in ("kappa", "gamma1", "gamma2"))
    magnified = magnification(kappa, gamma1, gamma2, hosts["id"].to_numpy())
    apparent = absolute + cosmology.distance_modulus(z) - 5.0 * np.log10(cosmology.h)
    drawn = Supernovae(kind, z_obs, peak, apparent, stretch, ebv, magnified, _numbers(hosts, "a_v"))
    first, last = supernova_light.first_and_last_day(drawn, window.templates)
    east, north, ra, dec = _places(cell, hosts, kind, PerSourceGenerator(keys.view(np.int64), seed, "transients.place"))
    rows = TRANSIENTS.build(
        {
            "id": ids.transient_id(cell, keys), "ra": ra, "dec": dec,
            "_healpix_29": sky.cell_at(ra, dec, sky.MAX_ORDER), "type": kind, "host_id": hosts["id"].to_numpy(),
            "offset_east": east, "offset_north": north, "z_true": z, "z_obs": z_obs, "peak_mjd": peak,
            "abs_mag_b": absolute, "mag_b": apparent, "stretch": stretch, "ebv": ebv, "magnification": magnified,
            "a_v": drawn.a_v, "density_boost": np.full(len(host), window.boost),
        }
    )  # fmt: skip
    return rows.filter(pa.array((last >= window.start) & (first <= window.end)))


def _blocks(galaxies: pa.Table, family: str, window: Window) -> range:
    """Return the blocks of time in which a supernova of a family may peak that shines in the window."""
    slowest = 1.0 + float(np.max(_numbers(galaxies, "z_obs"), initial=0.0))
    if family == "ia":
        slowest *= float(_stretch(np.array(type_ia().x1_limits[1])))
    kinds = [TYPE_IA] if family == "ia" else [KINDS[name] for name in core_collapse().kinds]
    rise = -min(float(window.templates[kind].phase[0]) for kind in kinds) * slowest
    fall = max(float(window.templates[kind].phase[-1]) for kind in kinds) * slowest
    return range(int((window.start - fall) // BLOCK_DAYS), int((window.end + rise) // BLOCK_DAYS) + 1)


def _draw_peaks(
    hosts: Int, mean: Float, family: str, seed: int, blocks: range
) -> tuple[Int, npt.NDArray[np.uint64], Float]:
    """Draw which galaxies have supernovae in which blocks, and when.

    Returns the row of the host, the random key and the date of the peak of each supernova.
    """
    nothing = np.zeros(0, np.int64), np.zeros(0, np.uint64), np.zeros(0)
    parts: list[tuple[Int, npt.NDArray[np.uint64], Float]] = [nothing]
    for block in blocks:
        name = f"transients.{family}"
        counts = poisson_counts(PerSourceGenerator(hosts, seed, name, block).random(), mean)
        for member in range(int(np.max(counts, initial=0))):
            host = np.flatnonzero(counts > member)
            keys = per_source.keys(hosts[host], seed, name, block, member)
            share = PerSourceGenerator(keys.view(np.int64), seed, "transients.date").random()
            parts.append((host, keys, (block + share) * BLOCK_DAYS))
    host, keys, peak = (np.concatenate(part) for part in zip(*parts, strict=True))
    return host, keys, peak


def poisson_counts(uniform: Float, mean: Float) -> Int:
    """Return the quantiles of Poisson distributions.

    Parameters
    ----------
    uniform : float array, shape (n,)
        Probabilities, 0 to 1.
    mean : float array, shape (n,)
        Means, at least 0. Above 500, the Gaussian with the same mean and variance is used.

    Returns
    -------
    int array, shape (n,)
        Smallest numbers with a cumulative probability of at least `uniform`.
    """
    gaussian = mean + np.sqrt(mean) * scipy.special.ndtri(np.clip(uniform, 1e-300, 1.0 - 1e-16))
    out = np.where(mean > _GAUSSIAN_MEAN, np.rint(gaussian), 0.0).astype(np.int64)
    remaining = np.flatnonzero((uniform > np.exp(-mean)) & (mean <= _GAUSSIAN_MEAN))
    term = np.exp(-mean[remaining])
    total, number = term.copy(), 0
    while len(remaining):
        number += 1
        term = term * mean[remaining] / number
        total = total + term
        out[remaining] = number
        # Rounding of the sum must not keep the last source for ever.
        going = (uniform[remaining] > total) & ((number < mean[remaining]) | (term > 1e-18))
        remaining, term, total = remaining[going], term[going], total[going]
    return out


def _draw_type_ia(n: int, hubble: float, rng: PerSourceGenerator) -> tuple[Int, Float, Float, Float]:
    """Draw kind, absolute magnitude (AB, rest-frame B), stretch and E(B-V) of type Ia supernovae."""
    law = type_ia()
    x1 = np.clip(_two_sided(law.x1, n, rng), *law.x1_limits)
    c = np.clip(_two_sided(law.c, n, rng), *law.c_limits)
    faint = law.beta * c - law.alpha * x1 + law.scatter * rng.standard_normal(n)
    zero_point = law.magnitude + _AB_MINUS_VEGA_B + 5.0 * np.log10(hubble / 0.7)
    return np.full(n, TYPE_IA), zero_point + faint, _stretch(x1), c


def _stretch(x1: Float) -> Float:
    """Return the stretch of the light curves of type Ia supernovae from the parameter x1."""
    return np.asarray(sum(coefficient * x1**power for power, coefficient in enumerate(type_ia().stretch)))


def _draw_core_collapse(n: int, hubble: float, rng: PerSourceGenerator) -> tuple[Int, Float, Float, Float]:
    """Draw kind, absolute magnitude (AB, rest-frame B), stretch and E(B-V) of core-collapse supernovae."""
    law = core_collapse()
    row = np.minimum(np.searchsorted(np.cumsum(law.shares), rng.random(n)), len(law.kinds) - 1)
    magnitude, scatter = np.array(law.magnitude)[row], np.array(law.scatter)[row]
    bare = np.maximum(magnitude + scatter * rng.standard_normal(n), law.brightest)
    ebv = np.minimum(-law.ebv * np.log(rng.random(n)), law.ebv_limit)
    zero_point = _AB_MINUS_VEGA_B + 5.0 * np.log10(hubble / law.hubble)
    kind = np.array([KINDS[name] for name in law.kinds])[row]
    return kind, bare + zero_point + _R_B * ebv, np.ones(n), ebv


def _two_sided(law: tuple[float, float, float], n: int, rng: PerSourceGenerator) -> Float:
    """Draw from a Gaussian with different widths on both sides; `law` has the mode and the widths below and above."""
    mode, below, above = law
    size = np.abs(rng.standard_normal(n))
    return np.asarray(mode + size * np.where(rng.random(n) < below / (below + above), -below, above))


def _places(cell: int, hosts: pa.Table, kind: Int, rng: PerSourceGenerator) -> tuple[Float, Float, Float, Float]:
    """Draw offsets from the hosts to east and north (arcsec), and positions (deg) inside the order-8 cell."""
    ra, dec = hosts["ra"].to_numpy(), hosts["dec"].to_numpy()
    # float32 as in the table, so that the offsets of a row agree with its position.
    offsets = [part.astype(np.float32).astype(float) for part in places.draw_offsets(hosts, kind != TYPE_IA, rng)]
    place = sky.offset_positions(ra, dec, *(part * _ARCSEC for part in offsets))
    inside = sky.cell_at(*place, GENERATION_ORDER) == cell
    east, north = (np.where(inside, part, 0.0) for part in offsets)
    return east, north, np.where(inside, place[0], ra), np.where(inside, place[1], dec)
