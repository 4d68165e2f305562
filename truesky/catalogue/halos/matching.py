"""Assign galaxy luminosities to halos and sub-halos by abundance matching.

The proxy mass m' of a central galaxy is the mass of its halo, and the proxy mass of a satellite is the mass of its
sub-halo, both with a log-normal scatter. The absolute magnitude M_r follows from n_tot(> m', z) = n(< M_r, z), so the
luminosity function n is reproduced exactly. n_tot counts centrals and satellites after the scatter; therefore no
deconvolution is necessary. The parameters are in halos.toml. M_r is in 0.1r (SDSS r blueshifted to z = 0.1) for h = 1.

References
----------
Carretero et al. 2015, MNRAS 447, 646
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from lake_schema.arrays import Float, Int
from truesky.catalogue import parameters
from truesky.catalogue.halos import luminosity_function
from truesky.catalogue.halos.luminosity_function import Inverse
from truesky.catalogue.matter import linear_theory
from truesky.cosmology import Cosmology
from truesky.numerics import matrices

# Last redshift of all tables by redshift; galaxies in halos end at z = 6.
Z_LAST = 6.1
# Number of redshifts of the tables from 0 to Z_LAST, uniform in ln(1 + z).
_Z_NODES = 69
# log10 of the masses (Msun/h) of the tables, in steps of 0.02 dex.
_LOG_MASS = np.linspace(8.0, 16.4, 421)


@dataclass(frozen=True, slots=True)
class Occupation:
    """Parameters of the number and the masses of satellites in halos; explained in halos.toml, [occupation]."""

    min_mass_ratio: float
    ratio: float
    ratio_z: float
    z_pivot: float
    z_last: float
    scatter: float
    depth: float
    concentration: float

    def ratio_at(self, z: Float) -> Float:
        """Return the mean increase of the mass ratio halo / sub-halo from one satellite to the next, at each redshift.

        The satellites of a halo are in the order of decreasing sub-halo mass.
        """
        stretch = (1.0 + self.z_pivot) / (1.0 + np.minimum(z, self.z_last))
        return np.asarray(self.ratio * stretch**self.ratio_z)


@dataclass(frozen=True, slots=True)
class HaloShape:
    """Parameters of the radius and the velocity dispersion of halos; explained in halos.toml, [halo]."""

    overdensity: float
    critical_density: float
    sigma_15: float
    slope: float
    critical: float


@dataclass(frozen=True, slots=True, eq=False)
class Masses:
    """Tables of halo properties by redshift (uniform in ln(1 + z)) and mass (uniform in the logarithm).

    Attributes
    ----------
    log_mass : float array, shape (m,)
        log10 M_200m / (Msun/h) of the columns.
    z : float array, shape (z,)
        Redshifts of the rows of `ln_density` and `bias`.
    ln_density : float array, shape (z, m)
        ln of the abundance dn/dlog10 M in comoving (Mpc/h)^-3.
    bias : float array, shape (z, m)
        Linear halo bias.
    concentration : float array, shape (coarse z, m)
        Concentration c_200m at fewer redshifts, also uniform in ln(1 + z) over the same range.
    shape : HaloShape
        Parameters of radius and velocity dispersion.
    cosmology : Cosmology
        Parameters of the universe.
    """

    log_mass: Float
    z: Float
    ln_density: Float
    bias: Float
    concentration: Float
    shape: HaloShape
    cosmology: Cosmology

    def interpolate(self, table: Float, z: Float, log_mass: Float) -> Float:
        """Interpolate one of the tables at all combinations of redshifts and masses, linearly in ln(1 + z) and log10 M.

        Parameters
        ----------
        table : float array, shape (z, m)
            Table such as `bias`; its redshifts are uniform in ln(1 + z).
        z : float array, shape (a,)
            Redshift. Values beyond the table are extrapolated.
        log_mass : float array, shape (b,)
            log10 mass, Msun/h. Values beyond the table are extrapolated.

        Returns
        -------
        float array, shape (a, b)
            Values of the table.
        """
        row, part = _redshift_node(z, table.shape[0])
        column, share = _mass_node(log_mass, self.log_mass)
        along = table[:, column] * (1.0 - share) + table[:, column + 1] * share
        return np.asarray(along[row] * (1.0 - part)[:, None] + along[row + 1] * part[:, None])

    def interpolate_pairs(self, table: Float, z: Float, log_mass: Float) -> Float:
        """Interpolate one of the tables at n pairs of redshift and mass, linearly in ln(1 + z) and log10 M.

        Parameters
        ----------
        table : float array, shape (z, m)
            Table such as `bias`; its redshifts are uniform in ln(1 + z).
        z : float array, shape (n,)
            Redshift. Values beyond the table are extrapolated.
        log_mass : float array, shape (n,)
            log10 mass, Msun/h. Values beyond the table are extrapolated.

        Returns
        -------
        float array, shape (n,)
            Values of the table.
        """
        return _interpolate_pairs(table, self.log_mass, z, log_mass)

    def radius(self, log_mass: Float) -> Float:
        """Return the halo radius R_200m in comoving Mpc/h, from log10 of M_200m in Msun/h."""
        density = self.shape.overdensity * self.cosmology.omega_cold * self.shape.critical_density
        return np.asarray(np.cbrt(3.0 * 10.0**log_mass / (4.0 * np.pi * density)))

    def dispersion(self, log_mass: Float, z: Float) -> Float:
        """Return the one-dimensional velocity dispersion of satellites in km/s, from log10 mass (Msun/h) and redshift.

        References
        ----------
        Evrard et al. 2008
        """
        mass = self.shape.critical * self.cosmology.expansion_rate(z) * 10.0 ** (log_mass - 15.0)
        return np.asarray(self.shape.sigma_15 * mass**self.shape.slope)


@dataclass(frozen=True, slots=True, eq=False)
class Matching:
    """Table of the absolute magnitude of galaxies by redshift and proxy mass.

    The proxy mass is the mass of the halo (central galaxies) or of the sub-halo (satellites) with a scatter.

    Attributes
    ----------
    log_mass : float array, shape (m,)
        log10 of the proxy masses of the columns, Msun/h.
    m_r : float array, shape (z, m)
        Absolute magnitude in 0.1r for h = 1, mag. The redshifts of the rows are uniform in ln(1 + z), from 0 to 6.1.
    occupation : Occupation
        Parameters of the satellites and of the scatter.
    """

    log_mass: Float
    m_r: Float
    occupation: Occupation

    def magnitude(self, z: Float, proxy: Float) -> Float:
        """Return the absolute magnitude M_r (mag) of galaxies at redshifts z.

        `proxy` is log10 of the proxy mass (Msun/h): the mass of the halo or sub-halo with a scatter. Values beyond the
        table are extrapolated.
        """
        return _interpolate_pairs(self.m_r, self.log_mass, z, proxy)

    def proxy_mass(self, z: Float, m_r: Float) -> Float:
        """Return log10 of the proxy mass (Msun/h) of galaxies with redshifts z and absolute magnitudes M_r (mag).

        The proxy mass is the mass of the halo or sub-halo with a scatter. Magnitudes beyond the table get the first or
        last mass of the table.
        """
        row, part = _redshift_node(z, self.m_r.shape[0])
        curves = self.m_r[row] * (1.0 - part)[:, None] + self.m_r[row + 1] * part[:, None]
        return np.array([np.interp(-m, -curve, self.log_mass) for m, curve in zip(m_r, curves, strict=True)])


def masses(cosmology: Cosmology) -> Masses:
    """Return the tables of halo abundance, bias and concentration in a cosmology, for z = 0 to 6.1."""
    z = np.expm1(np.linspace(0.0, np.log1p(Z_LAST), _Z_NODES))
    tables = linear_theory.halo_tables(cosmology, _LOG_MASS, z)
    shape = HaloShape(**parameters.section("halos.toml", "halo"))
    density = np.log(np.maximum(tables["density"], 1e-300))
    return Masses(_LOG_MASS, z, density, tables["bias"], tables["concentration"], shape, cosmology)


def match_luminosities(halos: Masses, luminosities: Inverse) -> Matching:
    """Return the table of absolute magnitudes by redshift and proxy mass that reproduces the luminosity function.

    The proxy mass is the mass of a halo or sub-halo with a scatter. `luminosities` is the inverse of the luminosity
    function.
    """
    occupation = Occupation(**parameters.section("halos.toml", "occupation"))
    rows = [
        luminosity_function.magnitude(luminosities, number, np.full(number.size, z))
        for z, number in zip(halos.z, proxy_density(halos, occupation), strict=True)
    ]
    # At the highest masses the density underflows; the brightest magnitude of lower masses is repeated there.
    return Matching(halos.log_mass, np.minimum.accumulate(np.array(rows), axis=1), occupation)


def proxy_density(halos: Masses, occupation: Occupation) -> Float:
    """Return the number density of central galaxies and satellites above each proxy mass, shape (z, m).

    The proxy mass is the mass of the halo or sub-halo with a scatter. The density is in comoving (Mpc/h)^-3, at the
    redshifts and masses of `halos`.
    """
    step = halos.log_mass[1] - halos.log_mass[0]
    number = np.exp(halos.ln_density) * step
    satellites = matrices.matmul(number, satellites_above(halos.log_mass, occupation).T)
    satellites *= satellite_evolution(halos.z, occupation)[:, None]
    # Add the satellites in each mass interval: the difference of two cumulative numbers. The last interval contains all
    # satellites above its lower edge.
    inside = number + np.concatenate([satellites[:, :-1] - satellites[:, 1:], satellites[:, -1:]], axis=1)
    smooth = scatter_masses(inside, step, occupation)
    above = np.cumsum(smooth[:, ::-1], axis=1)[:, ::-1]
    return np.maximum(above - 0.5 * smooth, 1e-30)


def scatter_masses(number: Float, step: float, occupation: Occupation) -> Float:
    """Convolve numbers of galaxies per mass bin with the log-normal scatter between mass and luminosity.

    Parameters
    ----------
    number : float array, shape (z, m)
        Number per bin of the mass without scatter.
    step : float
        Width of a bin, dex.
    occupation : Occupation
        Standard deviation and largest value of the scatter, dex.

    Returns
    -------
    float array, shape (z, m)
        Number per bin of the proxy mass, that is the mass with the scatter.
    """
    half = round(occupation.depth / step)
    kernel = np.exp(-0.5 * (np.arange(-half, half + 1) * step / occupation.scatter) ** 2)
    kernel /= kernel.sum()
    padded = np.pad(number, ((0, 0), (half, half)), mode="reflect", reflect_type="odd")
    smooth: Float = matrices.matmul(sliding_window_view(np.maximum(padded, 0.0), kernel.size, axis=1), kernel)
    return smooth


def satellites_above(log_mass: Float, occupation: Occupation) -> Float:
    """Return the mean number of satellites with a sub-halo mass above m[i] in a halo of mass M[j], shape (m, m).

    Both masses have the values 10^log_mass (Msun/h). The number is for the redshift `z_pivot` of `occupation`.
    """
    over = 10.0 ** (log_mass[None, :] - log_mass[:, None])
    return np.asarray(np.maximum(over - occupation.min_mass_ratio, 0.0) / occupation.ratio)


def satellite_evolution(z: Float, occupation: Occupation) -> Float:
    """Return the number of satellites of a halo at each redshift, relative to the redshift `z_pivot`."""
    return np.asarray(occupation.ratio / occupation.ratio_at(z))


def _redshift_node(z: Float, nodes: int) -> tuple[Int, Float]:
    step = np.log1p(np.asarray(z, float)) * ((nodes - 1) / np.log1p(Z_LAST))
    row = np.clip(step.astype(np.int64), 0, nodes - 2)
    return row, step - row


def _mass_node(log_mass: Float, nodes: Float) -> tuple[Int, Float]:
    step = (np.asarray(log_mass, float) - nodes[0]) / (nodes[1] - nodes[0])
    column = np.clip(step.astype(np.int64), 0, nodes.size - 2)
    return column, step - column


def _interpolate_pairs(table: Float, nodes: Float, z: Float, log_mass: Float) -> Float:
    row, part = _redshift_node(z, table.shape[0])
    column, share = _mass_node(log_mass, nodes)
    low = table[row, column] * (1.0 - share) + table[row, column + 1] * share
    high = table[row + 1, column] * (1.0 - share) + table[row + 1, column + 1] * share
    return np.asarray(low * (1.0 - part) + high * part)
