"""Flux of a template spectrum with dust in a passband at redshift z, relative to its rest-frame flux in 0.1r.

0.1r is the SDSS r band blueshifted to z = 0.1. The apparent magnitude in band b follows from the ratio of the two
fluxes::

    m_b = M_r + DM(z) - 2.5 log10(ratio)        (M_r = M(0.1r) - 5 log10 h, DM for H0 = 100)

A small table of ln(ratio) by redshift, extinction law, template and E(B-V) is used only for the magnitude limit of the
catalogue, for colours and for the column mag_r01. The fluxes of the catalogue are computed without it.

References
----------
Hogg et al. 2002, arXiv:astro-ph/0210394
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lake_schema.arrays import Float, Float32, Int
from truesky.fluxes import passbands
from truesky.fluxes.libraries.templates import Library
from truesky.fluxes.spectra import extinction
from truesky.numerics import matrices
from truesky.numerics.cache import cached_arrays, content_key
from truesky.numerics.cache_labels import label_band_ratios
from truesky.numerics.code_fingerprints import code_key

# Passband 0.1r: SDSS r blueshifted to z = 0.1.
REFERENCE_BAND = "sdss_r01"
# Step of ln(1 + z) between two redshifts of the table.
_STEP = 0.005
# Possible numbers of Chebyshev-Lobatto nodes of E(B-V). `_nodes` takes the smallest number that is accurate enough.
_EBV_NODES = (5, 9, 17, 33)
# Largest interpolation error halfway between two nodes of E(B-V), mag.
_EBV_ERROR = 2e-4
# Number of redshifts at which the interpolation error in E(B-V) is measured.
_REDSHIFTS = 8


@dataclass(frozen=True, slots=True)
class Sed:
    """Spectra of n galaxies; each is a mixture of two template spectra behind the same dust.

    Attributes
    ----------
    template_1, template_2 : int array, shape (n,)
        Indices of the two templates in the library.
    frac_1, frac_2 : float array, shape (n,)
        Fractions of the two templates in the rest-frame flux after the dust in 0.1r (SDSS r blueshifted to z = 0.1).
    law : int array, shape (n,)
        Extinction law, 0 (no dust) to 4.
    ebv : float array, shape (n,)
        E(B-V), mag.
    """

    template_1: Int
    frac_1: Float
    template_2: Int
    frac_2: Float
    law: Int
    ebv: Float

    def select(self, keep: npt.NDArray[np.generic]) -> Sed:
        """Return the spectra of some galaxies, given as a bool mask of shape (n,) or as row numbers."""
        return Sed(
            self.template_1[keep],
            self.frac_1[keep],
            self.template_2[keep],
            self.frac_2[keep],
            self.law[keep],
            self.ebv[keep],
        )


@dataclass(frozen=True, slots=True, eq=False)
class BandRatios:
    """Table of ln(observed f_nu in a passband / rest-frame f_nu in 0.1r) of template spectra with dust.

    0.1r is the SDSS r band blueshifted to z = 0.1. This logarithm is called ln(ratio) below.

    Attributes
    ----------
    band : str
        Name of the passband.
    ebv : float array, shape (e,)
        E(B-V) of the last axis of `values`, mag.
    values : float32 array, shape (z, 4, templates, e)
        ln(ratio) by redshift, extinction law (1 to 4), template and E(B-V). The redshifts start at 0 and have a
        constant step of ln(1 + z).
    """

    band: str
    ebv: Float
    values: Float32


def build(library: Library, band: str, z_max: float, ebv_max: float) -> BandRatios:
    """Compute the brightness of template spectra with dust in one passband by redshift (0.5 s for z_max = 2.3).

    Parameters
    ----------
    library : Library
        Template spectra.
    band : str
        Name of the passband.
    z_max : float
        Largest redshift; the table starts at 0.
    ebv_max : float
        Largest E(B-V), mag; the table starts at 0.

    Returns
    -------
    BandRatios
        The table.

    Notes
    -----
    The error of `ln_ratio` is below 0.0005 mag for templates with flux in the band
    (tests/truesky/catalogue/galaxies/test_band_ratios.py).
    """
    ebv = _nodes(library, band, z_max, ebv_max)
    steps = int(np.ceil(np.log1p(z_max) / _STEP)) + 1
    values = _ln_ratios(library, band, np.expm1(_STEP * np.arange(steps + 1)), ebv)
    return BandRatios(band, ebv, np.ascontiguousarray(values, np.float32))


def _nodes(library: Library, band: str, z_max: float, ebv_max: float) -> Float:
    """Return the values of E(B-V) (mag) from 0 to `ebv_max` between which brightnesses are interpolated (nodes).

    Their number is the smallest of `_EBV_NODES` with an interpolation error below `_EBV_ERROR`, or else the largest.
    """
    z = np.expm1(np.linspace(0.0, np.log1p(z_max), _REDSHIFTS))
    for count in _EBV_NODES:
        finer = 0.5 * ebv_max * (1.0 - np.cos(np.pi * np.arange(2 * count - 1) / (2 * count - 2)))
        if count == _EBV_NODES[-1]:
            break
        ln_ratios = _ln_ratios(library, band, z, finer)
        error = matrices.matmul(ln_ratios[..., ::2], ebv_weights(finer[::2], finer[1::2]).T) - ln_ratios[..., 1::2]
        if 2.5 / np.log(10.0) * np.abs(error).max() < _EBV_ERROR:
            break
    return np.ascontiguousarray(finer[::2])


def _ln_ratios(library: Library, band: str, redshifts: Float, ebv: Float) -> Float:
    """Return ln(observed f_nu in the band / rest-frame f_nu in 0.1r), shape (z, 4 extinction laws, templates, e).

    A template without flux in the band gets the logarithm of the smallest float32 number.
    """
    dust = dust_transmission(library, ebv)
    spectra = library.flux.astype(np.float64).T
    reference = _band_flux(dust, spectra, band_weights(library, REFERENCE_BAND, 0.0))
    tiny = np.finfo(np.float32).tiny
    rows = []
    for z in redshifts:
        flux = _band_flux(dust, spectra, band_weights(library, band, float(z)))
        rows.append(np.log(np.maximum(flux / reference, tiny)))
    return np.stack(rows).transpose(0, 1, 3, 2)


def load(library: Library, band: str, z_max: float, ebv_max: float) -> BandRatios:
    """Return the same table as `build`, from the disc cache if it has been computed before.

    Parameters
    ----------
    library : Library
        Template spectra.
    band : str
        Name of the passband.
    z_max : float
        Largest redshift; the table starts at 0.
    ebv_max : float
        Largest E(B-V), mag; the table starts at 0.

    Returns
    -------
    BandRatios
        The table. It is computed again if the code, the library, a passband curve or an extinction law has changed.
    """
    curves = [passbands.load(name) for name in (band, REFERENCE_BAND)]
    responses = [array for curve in curves for array in (curve.wavelength, curve.response)]
    laws = extinction.laws(library.wavelength)
    key = content_key(code_key(__name__), z_max, ebv_max, library.wavelength, library.flux, laws, *responses)

    def make_arrays() -> dict[str, npt.NDArray[np.generic]]:
        table = build(library, band, z_max, ebv_max)
        return {"ebv": table.ebv, "values": table.values}

    cached = cached_arrays(f"band_ratios_{band}", key, make_arrays, label_band_ratios(band))
    return BandRatios(band, cached["ebv"], cached["values"])


def dust_transmission(library: Library, ebv: Float) -> Float:
    """Return the fraction of light that passes the dust, shape (4, e, wavelengths of the library).

    The first axis are the extinction laws 1 to 4, the second the values of `ebv` (E(B-V), mag).
    """
    k = extinction.laws(library.wavelength)[1:]
    return np.asarray(extinction.transmission(k[:, None, :], ebv[None, :, None]), float)


def band_weights(library: Library, band: str, z: float) -> Float:
    """Return weights whose scalar product with a rest-frame spectrum f_lambda is the observed mean f_nu in a band.

    Parameters
    ----------
    library : Library
        Template spectra, whose wavelengths have steps of 1 A.
    band : str
        Name of the passband.
    z : float
        Redshift.

    Returns
    -------
    float array, shape (wavelengths,)
        Weight of each wavelength of the library. Parts of the band outside the library get no weight.

    Notes
    -----
    The observed spectrum is f_lambda(lambda / (1 + z)) / (1 + z).
    """
    curve = passbands.load(band)
    weights = passbands.weights(curve) / (1.0 + z)
    at = curve.wavelength / (1.0 + z) - library.wavelength[0]
    index = np.clip(at.astype(np.int64), 0, library.wavelength.size - 2)
    part = np.clip(at - index, 0.0, 1.0)
    inside = (at >= 0.0) & (at <= library.wavelength.size - 1)
    size = library.wavelength.size
    low = np.bincount(index, np.where(inside, weights * (1.0 - part), 0.0), size)
    return np.asarray(low + np.bincount(index + 1, np.where(inside, weights * part, 0.0), size))


def _band_flux(dust: Float, spectra: Float, weights: Float) -> Float:
    """Return the flux of each template behind dust in a band, shape (4 extinction laws, e, templates)."""
    used = np.flatnonzero(weights)
    cut = slice(used[0], used[-1] + 1)
    return np.asarray(matrices.matmul(dust[:, :, cut] * weights[cut], spectra[cut]))


def ln_ratio(table: BandRatios, z: Float, template: Int, law: Int, ebv: Float) -> Float:
    """Interpolate ln(ratio) of single template spectra, linearly in ln(1 + z) and by a polynomial in E(B-V).

    Parameters
    ----------
    table : BandRatios
        Table of ln(observed f_nu in a passband / rest-frame f_nu in 0.1r).
    z : float array, shape (n,)
        Redshift.
    template : int array, shape (n,)
        Index of the template.
    law : int array, shape (n,)
        Extinction law, 0 to 4; 0 means no dust, and E(B-V) is then ignored.
    ebv : float array, shape (n,)
        E(B-V), mag.

    Returns
    -------
    float array, shape (n,)
        ln(ratio). Values beyond the table are extrapolated; nothing is checked.
    """
    # Import here, because compiled code is slow to import.
    from truesky.catalogue.galaxies import ratio_sums

    redshift, dust = np.ascontiguousarray(z, np.float64), np.ascontiguousarray(ebv, np.float64)
    indices = np.ascontiguousarray(template, np.int64), np.ascontiguousarray(law, np.int64)
    out = np.empty(redshift.size)
    ratio_sums.ln_ratios(table.values, _STEP, table.ebv, redshift, *indices, dust, out)
    return out


def ebv_weights(nodes: Float, ebv: Float) -> Float:
    """Return the weights of Lagrange interpolation from e nodes (mag) to n values of E(B-V) (mag), shape (n, e)."""
    weights = np.ones((ebv.size, nodes.size))
    for i, node in enumerate(nodes):
        for j, other in enumerate(nodes):
            if i != j:
                weights[:, i] *= (ebv - other) / (node - other)
    return weights


def offset(table: BandRatios, z: Float, sed: Sed) -> Float:
    """Return apparent minus absolute magnitude minus distance modulus, m_b - M_r - DM(z), of galaxy spectra.

    Parameters
    ----------
    table : BandRatios
        Table of the passband b of the apparent magnitude. M_r is in 0.1r at rest, for h = 1, and so is DM.
    z : float array, shape (n,)
        Redshift.
    sed : Sed
        Spectra of the n galaxies.

    Returns
    -------
    float array, shape (n,)
        Offset, mag.
    """
    ratio_1 = np.exp(ln_ratio(table, z, sed.template_1, sed.law, sed.ebv))
    ratio_2 = np.exp(ln_ratio(table, z, sed.template_2, sed.law, sed.ebv))
    return np.asarray(-2.5 * np.log10(sed.frac_1 * ratio_1 + sed.frac_2 * ratio_2))


def brightest_offset(table: BandRatios) -> tuple[Float, Float]:
    """Return the redshifts of a table, and at each the smallest m_b - M_r - DM(z) (mag) of any spectrum.

    The minimum is over all templates, extinction laws and values of E(B-V); see `offset` for the magnitudes.
    """
    z = np.expm1(_STEP * np.arange(table.values.shape[0]))
    highest = table.values.astype(np.float64).max(axis=(1, 2, 3))
    return z, -2.5 / np.log(10.0) * highest


def sed_of_colour(table: BandRatios, colour: Float, law: Int, ebv: Float) -> Sed:
    """Return mixtures of two neighbouring templates that have the given colours behind the given dust.

    Parameters
    ----------
    table : BandRatios
        Table of the passband 0.1g, of which only z = 0 is used.
    colour : float array, shape (n,)
        Rest-frame colour 0.1(g - r), mag.
    law : int array, shape (n,)
        Extinction law, 0 (no dust) to 4.
    ebv : float array, shape (n,)
        E(B-V), mag.

    Returns
    -------
    Sed
        Spectra. If all spectra behind this dust are bluer or redder than the colour, the first or last template.

    Notes
    -----
    A mixture of templates i and i - 1 with fractions 1 - f and f of the 0.1r flux mixes their 0.1g / 0.1r ratios with
    the same fractions, so the inversion is exact.
    """
    weights = ebv_weights(table.ebv, np.where(law > 0, ebv, 0.0))
    by_law = table.values[0].astype(np.float64)[np.maximum(law, 1) - 1]
    ratio = np.exp(np.einsum("nte,ne->nt", by_law, weights))
    target = 10.0 ** (-0.4 * colour)
    last = ratio.shape[1] - 1
    template = np.clip(np.sum(ratio < target[:, None], axis=1), 1, last)
    row = np.arange(colour.size)
    late, early = ratio[row, template], ratio[row, template - 1]
    share = np.clip((late - target) / (late - early), 0.0, 1.0)
    return Sed(template, 1.0 - share, template - 1, share, law, ebv)


def sed_of_index(index: Float, law: Int, ebv: Float) -> Sed:
    """Return mixtures of two neighbouring templates from a template index that is a real number.

    Parameters
    ----------
    index : float array, shape (n,)
        Index t >= 0, which is not checked.
    law : int array, shape (n,)
        Extinction law, 0 (no dust) to 4.
    ebv : float array, shape (n,)
        E(B-V), mag.

    Returns
    -------
    Sed
        Mixture of templates i = max(ceil(t), 1) and i - 1 with fractions 1 - f and f = i - t.

    References
    ----------
    Serrano et al. 2024, appendix B
    """
    upper = np.maximum(np.ceil(index), 1.0).astype(np.int64)
    share = np.asarray(upper - index, np.float64)
    return Sed(upper, 1.0 - share, upper - 1, share, law, ebv)


def columns(sed: Sed) -> dict[str, npt.NDArray[np.generic]]:
    """Return spectra as columns of table `galaxies`, by name; both templates of a galaxy have the same dust."""
    return {
        "sed_1": sed.template_1,
        "frac_1": sed.frac_1,
        "ext_law_1": sed.law,
        "ebv_1": sed.ebv,
        "sed_2": sed.template_2,
        "frac_2": sed.frac_2,
        "ext_law_2": sed.law,
        "ebv_2": sed.ebv,
    }


def colours(table: BandRatios, sed: Sed) -> Float:
    """Return the rest-frame colour 0.1(g - r) of galaxy spectra in mag; `table` is the table of the passband 0.1g."""
    return offset(table, np.zeros(sed.ebv.size), sed)
