"""Measure the quantities of simulated galaxies that observed.csv lists with values observed by surveys.

Rows of this file with the confidence P are published numbers that were looked up. Rows with the confidence M are quoted
from memory or read off a plot; they are shown, but do not count as failures. Magnitudes are without lensing
magnification and without extinction by the Milky Way, for which surveys correct theirs. Measured values are returned by
name, and Poisson errors of log10 of number densities under name + "_error".
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pyarrow as pa

from lake_schema import sky, units
from lake_schema.arrays import Array, Bool, Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from truesky.catalogue.galaxies import band_ratios
from truesky.catalogue.halos import matching
from truesky.cosmology import Cosmology, from_facts
from truesky.fluxes import passbands
from truesky.fluxes.high_redshift import QUASAR
from truesky.fluxes.libraries import templates

# Bands in which galaxies are counted.
BANDS = ("euclid_vis", "lsst_r", "lsst_i", "hsc_g", "hsc_r", "hsc_i", "hsc_z", "hsc_y")
# Limits in magnitude at which the counts in other bands of Hyper Suprime-Cam are divided by the counts in i.
HSC_LIMITS = (22, 23, 24)
# Number of arcmin^2 in a deg^2.
ARCMIN2 = 3600.0
# Redshift ranges of the stellar mass function; the keys are the redshifts in the names of measured values.
MASS_SHELLS = {0.35: (0.2, 0.5), 0.65: (0.5, 0.8), 0.95: (0.8, 1.1), 1.3: (1.1, 1.5), 1.75: (1.5, 2.0)}
# Central stellar masses of the mass function, log10 of Msun.
MASSES = (9.5, 10.0, 10.5, 11.0)
# Half width of a mass bin of the stellar mass function, dex.
MASS_HALF = 0.1
# Redshift ranges of the fraction of red galaxies; the keys are the redshifts in the names of measured values.
RED_SHELLS = {0.35: (0.2, 0.5), 0.95: (0.8, 1.1)}
# Central stellar masses of the fraction of red galaxies, log10 of Msun.
RED_MASSES = (10.1, 10.6, 11.1)
# Half width of a mass bin for the fraction of red galaxies, dex.
RED_HALF = 0.25
# Redshift ranges of the star formation rate density.
STAR_FORMATION_SHELLS = ((0.05, 0.3), (0.3, 0.7), (0.7, 1.2), (1.2, 1.8), (1.8, 2.5), (2.5, 3.5), (3.5, 4.5))
# Absolute AB magnitudes at 1500 A at which the ultraviolet luminosity function is measured, by central redshift.
ULTRAVIOLET = {3.0: (-22, -21, -20), 3.8: (-22, -21), 4.9: (-22, -21), 5.9: (-22,)}
# Rest-frame wavelength of ultraviolet magnitudes, angstrom.
_ULTRAVIOLET_AT = 1500.0
# Band whose cached table of flux ratios gives the flux at 1500 A, because the band observes it at high redshift.
_ULTRAVIOLET_BAND = "lsst_i"
# Central wavelength of the r band, angstrom.
_R_PIVOT = 6200.0
# Vacuum wavelength of H alpha, angstrom.
_HALPHA = 6564.6
# Band whose cached table of flux ratios gives the continuum at H alpha.
_NEAR_INFRARED = "euclid_h"


@dataclass(frozen=True, slots=True, eq=False)
class GalaxySample:
    """Central and satellite galaxies in an area of the sky, with magnitudes.

    Attributes
    ----------
    rows : mapping of str to array, shape (n,)
        Columns of the table `galaxies` by name.
    mags : mapping of str to float array, shape (n,)
        Apparent AB magnitudes by band.
    ultraviolet : float array, shape (n,)
        Absolute AB magnitude at 1500 A (rest frame), for h of `cosmology`.
    area : float
        Area of the sky, deg2.
    cosmology : Cosmology
        Parameters of the universe.
    quasars : float, optional
        Number of quasars per deg2 with r < 22.5; None if not known.
    """

    rows: Mapping[str, Array]
    mags: Mapping[str, Float]
    ultraviolet: Float
    area: float
    cosmology: Cosmology
    quasars: float | None = None

    def __getitem__(self, name: str) -> Float:
        return np.asarray(self.rows[name], float)

    def per_deg2(self, selected: Bool) -> float:
        """Return the number per deg2 of the galaxies for which the mask `selected`, shape (n,), is True."""
        return float(np.count_nonzero(selected) / self.area)

    def volume(self, z_min: float, z_max: float) -> float:
        """Return the comoving volume between two redshifts in the sample's area of the sky, Mpc^3 (not Mpc^3/h^3)."""
        steradian = self.area * np.radians(1.0) ** 2
        return float(self.cosmology.comoving_volume(z_min, z_max) * steradian / self.cosmology.h**3)


# Columns of the table `galaxies` that the measurements require.
COLUMNS = (
    "kind", "density_boost", "mag_r01", "z_true", "abs_mag_r01", "color_gr_01", "log_stellar_mass", "log_sfr",
    "log_halo_mass", "sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1", "flux_halpha", "flux_hbeta",
    "flux_oiii", "flux_nii",
)  # fmt: skip


def from_version(galaxies: read.Version) -> tuple[GalaxySample, Int]:
    """Read a sample of galaxies from the published table `galaxies` of a lake.

    Returns the central and satellite galaxies, and for each of them the number of the HEALPix cell (order 8) that
    contains its observed position. The area of the sample is the area of all cells in which galaxies were simulated,
    including cells without galaxies; if the table does not record them, only cells with galaxies count.
    """
    table = galaxies.rows([*COLUMNS, "_healpix_29"])
    cell = table["_healpix_29"].to_numpy() >> 2 * (sky.MAX_ORDER - GENERATION_ORDER)
    drawn = [cell for part in galaxies.manifest["parts"] for cell in part["facts"].get("generation_cells", ())]
    number = len(set(drawn)) or np.unique(cell).size
    area, cosmology = number * sky.cell_area(GENERATION_ORDER), from_facts(galaxies.manifest.get("facts", {}))
    return from_table(table, area, cosmology), cell[table["kind"].to_numpy() < 2]


def from_table(table: pa.Table, area: float, cosmology: Cosmology) -> GalaxySample:
    """Return a sample from the table `galaxies`.

    Parameters
    ----------
    table : Table
        Rows with the columns COLUMNS. Central and satellite galaxies are kept, quasars are counted, and other kinds of
        sources are ignored.
    area : float
        Area of the sky, deg2.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    GalaxySample
        The sample.
    """
    galaxies = table.filter(pa.array(table["kind"].to_numpy() < 2))
    sample = from_columns({name: galaxies[name].to_numpy() for name in COLUMNS}, area, cosmology)
    quasars = table.filter(pa.array(table["kind"].to_numpy() == QUASAR))
    mag, z, boost = (quasars[name].to_numpy().astype(float) for name in ("mag_r01", "z_true", "density_boost"))
    # Convert mag_r01, which for quasars is the magnitude at 1450 A in the rest frame, to the centre of r, for the
    # spectrum f_nu ~ nu^-0.5.
    red = mag - 1.25 * np.log10(_R_PIVOT / (1450.0 * (1.0 + z)))
    return replace(sample, quasars=float(np.sum((red < 22.5) / boost)) / area)


def from_columns(
    rows: Mapping[str, Array], area: float, cosmology: Cosmology, z_max: float = matching.Z_LAST
) -> GalaxySample:
    """Return a sample of central and satellite galaxies that are given as columns, and compute their magnitudes.

    Parameters
    ----------
    rows : mapping of str to array, shape (n,)
        COLUMNS of the table `galaxies`, for central and satellite galaxies only.
    area : float
        Area of the sky, deg2.
    cosmology : Cosmology
        Parameters of the universe.
    z_max : float
        Largest redshift of the cached tables of flux ratios between bands; at least that of all galaxies.

    Returns
    -------
    GalaxySample
        The sample; its number of quasars is None.
    """
    library = templates.galaxy_library()
    sed = _spectra(rows)
    z, m_r = rows["z_true"].astype(float), rows["abs_mag_r01"].astype(float)
    dustiest = _dustiest(sed)
    mags = {band: apparent_magnitudes(rows, band, cosmology, z_max) for band in BANDS}
    band_table = band_ratios.load(library, _ULTRAVIOLET_BAND, z_max, dustiest)
    curve = passbands.load(_ULTRAVIOLET_BAND)
    from_z = passbands.pivot_wavelength(curve) / _ULTRAVIOLET_AT - 1.0
    rest = m_r + band_ratios.offset(band_table, np.full(z.size, from_z), sed) + 2.5 * np.log10(1.0 + from_z)
    return GalaxySample(rows, mags, rest + 5.0 * np.log10(cosmology.h), area, cosmology)


def apparent_magnitudes(
    rows: Mapping[str, Array], band: str, cosmology: Cosmology, z_max: float = matching.Z_LAST
) -> Float:
    """Compute apparent AB magnitudes of galaxies in a band from their redshift, absolute magnitude and spectrum.

    Emission lines, lensing magnification and extinction by the Milky Way are not included.

    Parameters
    ----------
    rows : mapping of str to array, shape (n,)
        Columns of the table `galaxies`: z_true, abs_mag_r01 and the description of the spectrum (sed_1, frac_1, ...).
    band : str
        Name of the band, such as "euclid_vis".
    cosmology : Cosmology
        Parameters of the universe.
    z_max : float
        Largest redshift of the cached table of flux ratios; at least that of all galaxies.

    Returns
    -------
    float array, shape (n,)
        AB magnitudes.
    """
    sed, z = _spectra(rows), rows["z_true"].astype(float)
    table = band_ratios.load(templates.galaxy_library(), band, z_max, _dustiest(sed))
    return np.asarray(rows["abs_mag_r01"] + cosmology.distance_modulus(z) + band_ratios.offset(table, z, sed))


def figures(sample: GalaxySample) -> dict[str, float]:
    """Measure all quantities of observed.csv, and return their values by name.

    The sample should be complete to I_E = 26; otherwise values that need faint galaxies are too low. Without any
    galaxy, medians and fractions are NaN, logarithms of number densities -inf, and numbers per area 0. Quasars are left
    out if not known.
    """
    return {
        **counts(sample),
        **masses(sample),
        **star_formation(sample),
        **lines(sample),
        **environment(sample),
        **ultraviolet(sample),
        **({} if sample.quasars is None else {"quasars_r_22.5": sample.quasars}),
    }


def counts(sample: GalaxySample) -> dict[str, float]:
    """Measure the numbers of galaxies brighter than limits in i and I_E (per arcmin2) and in r (per deg2).

    The result also has log10 of the differential counts in i (per mag and deg2), median redshifts, and the counts in
    the bands g, r, z and y of Hyper Suprime-Cam divided by the count in its band i.
    """
    i_band, r_band, vis, z = sample.mags["lsst_i"], sample.mags["lsst_r"], sample.mags["euclid_vis"], sample["z_true"]
    values = {f"i_{limit}": sample.per_deg2(i_band < limit) / ARCMIN2 for limit in range(20, 27)}
    for at in 19.25 + 0.5 * np.arange(11):
        values |= _log_density(f"log_i_{at:g}", np.count_nonzero(np.abs(i_band - at) < 0.25), 0.5 * sample.area)
    values |= {f"r_{limit:g}": sample.per_deg2(r_band < limit) for limit in (17.77, 19.5, 19.8, 20.175)}
    for band, limit in itertools.product("grzy", HSC_LIMITS):
        number = np.count_nonzero(sample.mags["hsc_i"] < limit)
        ratio = np.count_nonzero(sample.mags[f"hsc_{band}"] < limit) / number if number else np.nan
        values[f"hsc_{band}_per_i_{limit}"] = ratio
    values["vis_24.5"] = sample.per_deg2(vis < 24.5) / ARCMIN2
    return values | {"z_vis_24.5": _median(z[vis < 24.5]), "z_i_22.5": _median(z[i_band < 22.5])}


def masses(sample: GalaxySample) -> dict[str, float]:
    """Measure the stellar mass function, log10 of galaxies per Mpc^3 and dex, in bins of mass and redshift.

    The result also has the fraction of red galaxies, NaN in bins without galaxies.
    """
    z, mass, red = sample["z_true"], sample["log_stellar_mass"], is_red(sample)
    values: dict[str, float] = {}
    for at, (z_min, z_max) in MASS_SHELLS.items():
        inside = (z > z_min) & (z < z_max)
        for m in MASSES:
            number = np.count_nonzero(inside & (np.abs(mass - m) < MASS_HALF))
            values |= _log_density(f"mass_function_{m:g}_z{at}", number, 2.0 * MASS_HALF * sample.volume(z_min, z_max))
    for at, (z_min, z_max) in RED_SHELLS.items():
        for m in RED_MASSES:
            selected = (z > z_min) & (z < z_max) & (np.abs(mass - m) < RED_HALF)
            values[f"red_{m:g}_z{at}"] = float(np.mean(red[selected])) if selected.any() else np.nan
    return values


def star_formation(sample: GalaxySample) -> dict[str, float]:
    """Measure the star formation rate density, log10 of Msun/yr/Mpc^3, in redshift ranges.

    The result also has the median and the scatter of log10 SFR (Msun/yr) of star-forming galaxies with 10^10 Msun.
    """
    z, mass, rate, forming = sample["z_true"], sample["log_stellar_mass"], sample["log_sfr"], is_blue(sample)
    values = {}
    for z_min, z_max in STAR_FORMATION_SHELLS:
        inside = (z > z_min) & (z < z_max)
        total = float(np.sum(10.0 ** rate[inside]))
        values[f"sfrd_{z_min}_{z_max}"] = float(np.log10(max(total, 1e-30) / sample.volume(z_min, z_max)))
    for at in (0.4, 1.0, 2.0):
        selected = forming & (np.abs(z - at) < 0.15) & (np.abs(mass - 10.0) < 0.1)
        values[f"main_sequence_z{at}"] = _median(rate[selected])
        values[f"main_sequence_scatter_z{at}"] = float(np.std(rate[selected])) if selected.any() else np.nan
    return values


def lines(sample: GalaxySample) -> dict[str, float]:
    """Measure emission lines: numbers of H alpha and [O III] emitters per deg2 above flux limits (erg/s/cm^2).

    The result also has the median log10 of [O III] / H beta by stellar mass and redshift, and the median rest-frame
    equivalent width (angstrom) of H alpha and [N II] in bright emitters.
    """
    z, mass = sample["z_true"], sample["log_stellar_mass"]
    oiii, halpha_nii = sample["flux_oiii"], sample["flux_halpha"] + (1.0 + 1.0 / 3.05) * sample["flux_nii"]
    halpha_range, oiii_range = (z > 0.9) & (z < 1.6), (z > 1.5) & (z < 2.3)
    values = {
        "halpha_nii_2e-16": sample.per_deg2(halpha_range & (halpha_nii > 2e-16)),
        "oiii_2e-16": sample.per_deg2(oiii_range & (oiii > 2e-16)),
        "oiii_1e-16": sample.per_deg2(oiii_range & (oiii > 1e-16)),
    }
    bright = (z > 1.3) & (z < 1.6) & (halpha_nii > 2e-16)
    values["ew_halpha_nii"] = _median(halpha_nii[bright] / (_continuum(sample, bright) * (1.0 + z[bright])))
    r3 = np.log10(np.maximum(oiii, 1e-30) / np.maximum(sample["flux_hbeta"], 1e-30))
    for at, low, high in ((1.6, 1.3, 1.8), (2.3, 2.0, 2.6)):
        for m in (9.5, 10.0, 10.5):
            selected = (z > low) & (z < high) & (np.abs(mass - m) < 0.15) & (oiii > 0.0)
            values[f"r3_{m:g}_z{at}"] = _median(r3[selected])
    return values


def environment(sample: GalaxySample) -> dict[str, float]:
    """Return the fraction of red galaxies among central galaxies of halos above 10^13.5 Msun/h at z = 1.

    It is NaN without such galaxies.
    """
    halo, z, red = sample["log_halo_mass"], sample["z_true"], is_red(sample)
    centrals = (sample.rows["kind"] == 0) & (halo > 13.5) & (z > 0.8) & (z < 1.2)
    return {"red_centrals_13.5_z1": float(np.mean(red[centrals])) if centrals.any() else np.nan}


def ultraviolet(sample: GalaxySample) -> dict[str, float]:
    """Measure the ultraviolet luminosity function: log10 of galaxies per Mpc^3 and mag at 1500 A, by redshift.

    The magnitudes are bright enough for samples that are complete to I_E = 26.
    """
    z = sample["z_true"]
    values: dict[str, float] = {}
    for at, magnitudes in ULTRAVIOLET.items():
        z_min, z_max = at - 0.3, min(at + 0.3, 6.0)
        inside = (z > z_min) & (z < z_max)
        for m in magnitudes:
            number = np.count_nonzero(inside & (np.abs(sample.ultraviolet - m) < 0.25))
            values |= _log_density(f"uv_{-m}_z{at}", number, 0.5 * sample.volume(z_min, z_max))
    return values


def is_red(sample: GalaxySample) -> Bool:
    """Return a mask, bool[n], of galaxies whose g - r is above the middle between the red and the blue sequence.

    The limit depends on the absolute magnitude, not on redshift.
    """
    return np.asarray(sample["color_gr_01"] > 0.78 - 0.02 * (sample["abs_mag_r01"] + 20.0))


def is_blue(sample: GalaxySample) -> Bool:
    """Return a mask, bool[n], of galaxies whose g - r is below the minimum between the red and the blue sequence.

    The limit depends on the absolute magnitude and on redshift.
    """
    redshift_step = np.clip(sample["z_true"] - 0.1, 0.0, 1.6)
    return np.asarray(sample["color_gr_01"] < 0.80 - 0.07 * (sample["abs_mag_r01"] + 20.0) - 0.16 * redshift_step)


def _continuum(sample: GalaxySample, selected: Bool) -> Float:
    """Return the observed continuum of the selected galaxies at redshifted H alpha, erg/s/cm^2/angstrom."""
    library, rows = templates.galaxy_library(), {name: values[selected] for name, values in sample.rows.items()}
    sed = _spectra(rows)
    z = rows["z_true"].astype(float)
    # Redshift at which H alpha is at the pivot wavelength of the band, where the table gives its continuum.
    at = passbands.pivot_wavelength(passbands.load(_NEAR_INFRARED)) / _HALPHA - 1.0
    table = band_ratios.load(library, _NEAR_INFRARED, matching.Z_LAST, _dustiest(sed))
    rest = rows["abs_mag_r01"] + band_ratios.offset(table, np.full(z.size, at), sed) + 2.5 * np.log10(1.0 + at)
    apparent_mag = rest + sample.cosmology.distance_modulus(z) - 2.5 * np.log10(1.0 + z)
    f_nu = 10.0 ** (-0.4 * (apparent_mag + units.AB_CGS))
    return np.asarray(f_nu * units.LIGHT_ANGSTROM_S / (_HALPHA * (1.0 + z)) ** 2)


def _spectra(rows: Mapping[str, Array]) -> band_ratios.Sed:
    return band_ratios.Sed(*(rows[name] for name in ("sed_1", "frac_1", "sed_2", "frac_2", "ext_law_1", "ebv_1")))


def _dustiest(sed: band_ratios.Sed) -> float:
    """Return the E(B-V) (mag) that the cached tables of flux ratios must reach for these spectra, at least 0.5."""
    return max(0.5, float(sed.ebv.max(initial=0.0)))


def _median(values: Sequence[float] | Float) -> float:
    return float(np.median(values)) if len(values) else np.nan


def _log_density(name: str, number: int | np.signedinteger[Any], per: float) -> dict[str, float]:
    """Return log10(number / per) by name, and its Poisson error by name + "_error"; -inf without error for number 0."""
    if not number:
        return {name: -np.inf}
    return {name: float(np.log10(number / per)), f"{name}_error": float(1.0 / (np.log(10.0) * np.sqrt(number)))}
