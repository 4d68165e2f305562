"""How bright a template is in a passband at redshift z, dust included, against its own rest-frame 0.1r flux.

    m_b = M_r + DM(z) - 2.5 log10(ratio)        (M_r = M(0.1r) - 5 log10 h, DM for H0 = 100)

build       the table of ln(ratio) on redshift, law, template and E(B-V)
load        the same, from the cache where it is there
ln_ratio    read it for one component of an SED
offset      m_b - M_r - DM(z) of two-component SEDs
brightest   the smallest offset that any SED has, against redshift
invert      the SED that has a colour: two neighbouring templates and their shares;  colours : 0.1(g - r) of SEDs
between     the SED of a real template index;  columns : an SED as columns of table `galaxies`

A small table for the catalogue's own needs: selection in one band, and the reference magnitude. Fluxes are
not computed from it.
Ref: Hogg et al. 2002, arXiv:astro-ph/0210394
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
from truesky.numerics.code_fingerprints import code_key

REFERENCE_BAND = "sdss_r01"
# Uniform steps of ln(1 + z), and numbers of Chebyshev-Lobatto nodes of E(B-V): the fewest whose error is below that,
# mag, halfway between them at so many redshifts. The errors stated below hold with these.
_STEP = 0.005
_EBV_NODES, _EBV_ERROR, _REDSHIFTS = (5, 9, 17, 33), 2e-4, 8


@dataclass(frozen=True, slots=True)
class Sed:
    """Two-component spectra of n galaxies: columns sed_k, frac_k, ext_law_k, ebv_k of table `galaxies`."""

    template_1: Int
    frac_1: Float
    template_2: Int
    frac_2: Float
    law: Int
    ebv: Float

    def select(self, keep: npt.NDArray[np.generic]) -> Sed:
        """The galaxies that are kept.

        keep : bool or int[m] rows
        """
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
    """ln(f_nu in the band at z / f_nu in 0.1r at rest) of dusty templates.

    ebv : [e] mag nodes; values : float32[z, 4, template, e], laws 1 .. 4, uniform in ln(1 + z) from 0
    """

    band: str
    ebv: Float
    values: Float32


def build(library: Library, band: str, z_max: float, ebv_max: float) -> BandRatios:
    """The table of one passband, 0 <= z <= z_max, 0 <= E(B-V) <= ebv_max (0.5 s for z_max = 2.3).

    library : templates;  band : name of the passband;  z_max, ebv_max : where the table ends
    Error: `ln_ratio` within 0.0005 mag where the template has light
           (tests/truesky/catalogue/galaxies/test_band_ratios.py)
    """
    ebv = _nodes(library, band, z_max, ebv_max)
    steps = int(np.ceil(np.log1p(z_max) / _STEP)) + 1
    values = _ln_ratios(library, band, np.expm1(_STEP * np.arange(steps + 1)), ebv)
    return BandRatios(band, ebv, np.ascontiguousarray(values, np.float32))


def _nodes(library: Library, band: str, z_max: float, ebv_max: float) -> Float:
    """E(B-V)[e]: more where dust takes much away, in blue bands and behind much of it."""
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
    """[z, 4, template, e]"""
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
    """`build`, kept in the cache under everything that it depends on.

    library, band, z_max, ebv_max : as of `build`
    """
    curves = [passbands.load(name) for name in (band, REFERENCE_BAND)]
    responses = [array for curve in curves for array in (curve.wavelength, curve.response)]
    laws = extinction.laws(library.wavelength)
    key = content_key(code_key(__name__), z_max, ebv_max, library.wavelength, library.flux, laws, *responses)

    def make_arrays() -> dict[str, npt.NDArray[np.generic]]:
        table = build(library, band, z_max, ebv_max)
        return {"ebv": table.ebv, "values": table.values}

    cached = cached_arrays(f"band_ratios_{band}", key, make_arrays)
    return BandRatios(band, cached["ebv"], cached["values"])


def dust_transmission(library: Library, ebv: Float) -> Float:
    """Transmission of laws 1 .. 4 at each E(B-V), [4, e, lambda] on the library's wavelengths.

    ebv : float[e] mag
    """
    k = extinction.laws(library.wavelength)[1:]
    return np.asarray(extinction.transmission(k[:, None, :], ebv[None, :, None]), float)


def band_weights(library: Library, band: str, z: float) -> Float:
    """Weights[lambda] with which rest-frame f_lambda sums to the observed, band-averaged f_nu.

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
    """[4, e, template]"""
    used = np.flatnonzero(weights)
    cut = slice(used[0], used[-1] + 1)
    return np.asarray(matrices.matmul(dust[:, :, cut] * weights[cut], spectra[cut]))


def ln_ratio(table: BandRatios, z: Float, template: Int, law: Int, ebv: Float) -> Float:
    """ln(ratio)[n], linear in ln(1 + z), polynomial in E(B-V); law 0 has no dust.

    z, ebv : float[n] redshift, E(B-V) mag;  template, law : int[n]
    table  : of `build`
    """
    # Compiled code is imported where it is wanted.
    from truesky.catalogue.galaxies import ratio_sums

    redshift, dust = np.ascontiguousarray(z, np.float64), np.ascontiguousarray(ebv, np.float64)
    indices = np.ascontiguousarray(template, np.int64), np.ascontiguousarray(law, np.int64)
    out = np.empty(redshift.size)
    ratio_sums.ln_ratios(table.values, _STEP, table.ebv, redshift, *indices, dust, out)
    return out


def ebv_weights(nodes: Float, ebv: Float) -> Float:
    """Lagrange weights [n, e] of the nodes at E(B-V)[n].

    nodes : float[e] mag;  ebv : float[n] mag
    """
    weights = np.ones((ebv.size, nodes.size))
    for i, node in enumerate(nodes):
        for j, other in enumerate(nodes):
            if i != j:
                weights[:, i] *= (ebv - other) / (node - other)
    return weights


def offset(table: BandRatios, z: Float, sed: Sed) -> Float:
    """m_b - M_r - DM(z) [n] mag of two-component spectra.

    z : float[n];  sed : n spectra
    """
    ratio_1 = np.exp(ln_ratio(table, z, sed.template_1, sed.law, sed.ebv))
    ratio_2 = np.exp(ln_ratio(table, z, sed.template_2, sed.law, sed.ebv))
    return np.asarray(-2.5 * np.log10(sed.frac_1 * ratio_1 + sed.frac_2 * ratio_2))


def brightest_offset(table: BandRatios) -> tuple[Float, Float]:
    """Redshifts[m], and the smallest m_b - M_r - DM[m] of any template, law and E(B-V) there."""
    z = np.expm1(_STEP * np.arange(table.values.shape[0]))
    highest = table.values.astype(np.float64).max(axis=(1, 2, 3))
    return z, -2.5 / np.log(10.0) * highest


def sed_of_colour(table: BandRatios, colour: Float, law: Int, ebv: Float) -> Sed:
    """The spectra that have the wanted colours; the end of the library where dust leaves none that has.

    colour : float[n] 0.1(g - r) mag;  law : int[n];  ebv : float[n] mag
    table : of 0.1g at z = 0. Mixing templates i and i - 1 with shares 1 - f and f of the 0.1r flux mixes
            their 0.1g / 0.1r ratios with the same shares, so the inversion is exact.
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
    """Of real template indices t[n] >= 0: i = max(ceil(t), 1) and i - 1, with shares 1 - f and f = i - t.

    index : float[n];  law : int[n];  ebv : float[n] mag
    Ref: Serrano et al. 2024, appendix B
    """
    upper = np.maximum(np.ceil(index), 1.0).astype(np.int64)
    share = np.asarray(upper - index, np.float64)
    return Sed(upper, 1.0 - share, upper - 1, share, law, ebv)


def columns(sed: Sed) -> dict[str, npt.NDArray[np.generic]]:
    """Spectra as columns of table `galaxies`: both components behind the same dust.

    returns : [n] each
    """
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
    """0.1(g - r)[n] of two-component spectra; table : of 0.1g at z = 0."""
    return offset(table, np.zeros(sed.ebv.size), sed)
