"""Galaxies and quasars beyond redshift 6: rows of table `galaxies` of kinds 3 and 2.

model       the luminosity functions, tabulated
draw        rows of one generation cell
per_deg2    how many there are

They are drawn at random places: no structure beyond the galaxies' light-cone. `density_boost` says how many times
more were drawn than there are.
Ref: Bouwens et al. 2021, AJ 162, 47; Matsuoka et al. 2018, ApJ 869, 150; the numbers are in high_redshift.toml.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from jobs.catalogue import dust_map, parameters
from jobs.catalogue.galaxies import halo_lensing, morphology
from jobs.catalogue.galaxies.halo_lensing import Neighbourhood
from jobs.catalogue.galaxies.lensing import Lens
from jobs.fluxes import cosmology
from jobs.fluxes.high_redshift import (
    HIGH_REDSHIFT,
    HIGH_REDSHIFT_SLOPES,
    LYMAN_ALPHA_WIDTHS,
    QUASAR,
    QUASAR_OFFSETS,
    QUASAR_STRENGTHS,
    ultraviolet_magnitude,
)
from jobs.rng import stream
from lake_schema import ids, sky
from lake_schema.arrays import Float, Float32, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.tables.galaxies import GALAXIES

_FILE = "high_redshift.toml"
_STREAM = {HIGH_REDSHIFT: "high_redshift", QUASAR: "quasars"}
_Z_STEP, _M_STEP, _M_BRIGHTEST = 0.02, 0.02, -32.0


@dataclass(frozen=True, slots=True, eq=False)
class Kind:
    """One of the two kinds: numbers of the file, and counts per deg2 of cells of (z, M).

    z : [r] lower edges;  m : [c] lower edges;  counts : [r, c]
    """

    code: int
    numbers: dict[str, Any]
    boost: float
    z: Float
    m: Float
    counts: Float

    @property
    def per_deg2(self) -> float:
        """In nature."""
        return float(self.counts.sum())


def model(galaxy_boost: float = 1.0, quasar_boost: float = 1.0) -> tuple[Kind, ...]:
    """The kinds that are drawn; a boost of 0 leaves one out."""
    wanted = ((HIGH_REDSHIFT, "galaxies", galaxy_boost), (QUASAR, "quasars", quasar_boost))
    return tuple(_kind(code, parameters.section(_FILE, name), boost) for code, name, boost in wanted if boost > 0.0)


def draw(cell: int, seed: int, kind: Kind, lens: Lens | Neighbourhood, dust: Float32) -> pa.Table:
    """Rows of one kind in a generation cell, sorted by _healpix_29.

    dust : float32[pixel] map of A(V), mag (jobs.catalogue.dust_map)
    cell   : nested index at order 8;  seed : of the request;  kind : the objects' luminosity function and boost
    lens   : halos and maps, maps alone, or one shear for all
    """
    rng = stream(seed, _STREAM[kind.code], cell)
    n = int(rng.poisson(kind.boost * kind.per_deg2 * sky.cell_area(GENERATION_ORDER)))
    at = np.searchsorted(np.cumsum(kind.counts), rng.random(n) * kind.per_deg2, side="right")
    row, column = np.divmod(np.minimum(at, kind.counts.size - 1), kind.m.size)
    z = kind.z[row] + _Z_STEP * rng.random(n)
    m = kind.m[column] + _M_STEP * rng.random(n)
    index, ra, dec = sky.random_in_cell(GENERATION_ORDER, cell, n, rng)
    source = ids.source_id(np.full(n, kind.code), cell, ids.FIRST_NUMBER + np.arange(n))
    zeros = np.zeros(n)
    columns = {
        "id": source,
        "halo_id": ids.halo_of(source),
        "ra": ra,
        "dec": dec,
        "_healpix_29": index,
        **halo_lensing.columns(lens, ra, dec, cosmology.comoving_distance(z)),
        "kind": np.full(n, kind.code),
        "density_boost": np.full(n, kind.boost),
        "z_true": z,
        "z_obs": z,
        "abs_mag_r01": m - 5.0 * np.log10(cosmology.HUBBLE),
        "mag_r01": ultraviolet_magnitude(m, z),
        "color_gr_01": zeros,
        "sed_1": _templates(kind, m, rng),
        "frac_1": zeros + 1.0,
        "sed_2": zeros.astype(int),
        "frac_2": zeros,
        **{name: zeros.astype(int) for name in ("ext_law_1", "ext_law_2")},
        **{name: zeros for name in ("ebv_1", "ebv_2")},
        **_shapes(kind, z, m, rng),
        "a_v": dust_map.a_v(dust, ra, dec),
    }
    return GALAXIES.build(columns)


def density(code: int, numbers: dict[str, Any], m: Float, z: Float) -> Float:
    """dn/dM, Mpc^-3 mag^-1.

    m : float[...] absolute ultraviolet AB mag;  z : float[...]
    code    : kind of object;  numbers : constants of its luminosity function
    """
    since = z - 6.0
    if code == QUASAR:
        x = 0.4 * (m - numbers["m_star"])
        slopes = 10.0 ** ((numbers["faint"] + 1.0) * x) + 10.0 ** ((numbers["bright"] + 1.0) * x)
        return np.asarray(numbers["phi"] * 10.0 ** (numbers["rate"] * since) / slopes)
    star = numbers["m_star"] + numbers["m_star_rate"] * since
    phi = numbers["phi_star"] * 10.0 ** (numbers["phi_rate"] * since + numbers["phi_curve"] * since**2)
    alpha = numbers["alpha"] + numbers["alpha_rate"] * since
    ln_x = -0.4 * np.log(10.0) * (m - star)
    return np.asarray(0.4 * np.log(10.0) * phi * np.exp((alpha + 1.0) * ln_x - np.exp(ln_x)))


def _kind(code: int, numbers: dict[str, Any], boost: float) -> Kind:
    z = np.arange(numbers["z_min"], numbers["z_max"] - 1e-9, _Z_STEP)
    m = np.arange(_M_BRIGHTEST, -12.0, _M_STEP)
    middle_z, middle_m = z[:, None] + 0.5 * _Z_STEP, m[None, :] + 0.5 * _M_STEP
    volume = cosmology.comoving_volume(z, z + _Z_STEP)[:, None] * np.radians(1.0) ** 2 / cosmology.HUBBLE**3
    counts = density(code, numbers, middle_m, middle_z) * volume * _M_STEP
    bright = ultraviolet_magnitude(middle_m, middle_z) < numbers["limit"]
    return Kind(code, numbers, boost, z, m, np.where(bright, counts, 0.0))


def _templates(kind: Kind, m: Float, rng: np.random.Generator) -> Int:
    """Index of the template: slope, then strength of the lines."""
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


def _shapes(kind: Kind, z: Float, m: Float, rng: np.random.Generator) -> dict[str, npt.NDArray[np.generic]]:
    """One Sersic component: everything is in the bulge."""
    law, n = kind.numbers, z.size
    if kind.code == QUASAR:
        radius, ratio, sersic = np.full(n, law["radius"]), np.ones(n), 1.0
    else:
        mean = law["radius"] * ((1.0 + z) / 7.0) ** law["radius_z"] * 10.0 ** (-0.4 * law["radius_m"] * (m + 21.0))
        kpc = mean * 10.0 ** (law["radius_scatter"] * rng.standard_normal(n))
        radius, sersic = kpc / cosmology.kpc_per_arcsec(z), law["sersic"]
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
