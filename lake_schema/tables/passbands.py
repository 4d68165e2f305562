"""Declaration of the table `passbands`: the response curves with which fluxes were computed, one row per passband."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
import numpy.typing as npt
import pyarrow as pa

from lake_schema.arrays import Float
from lake_schema.columns import Column, Table
from lake_schema.tables.common import Origin

MEDIA = (("air", "from the ground"), ("vacuum", "from space"))

PASSBANDS = Table(
    "passbands",
    1,
    (
        Column("name", "string", ucd="meta.id;instr.bandpass", doc="name, the <band> of f_nu_<band>"),
        Column("medium", "string", ucd="meta.code", doc="medium in which the wavelengths are measured", codes=MEDIA),
        Column("pivot_wavelength", "float64", "Angstrom", "em.wl.central", "pivot wavelength", 100.0, 1e6),
        Column("log_width", "float64", "", "instr.bandwidth", "integral of the response over ln(wavelength)", 0.0, 1e3),
        Column(
            "first_wavelength", "float64", "Angstrom", "em.wl;stat.min", "wavelength of the first sample", 100.0, 1e6
        ),
        Column("wavelength_step", "float64", "Angstrom", "em.wl;spect.binSize", "distance between samples", 1e-3, 1e3),
        Column(
            "response", "list<float64>", "", "phys.transmission", "detected electrons per arriving photon", 0.0, 1e9
        ),
        Column("source", "string", ucd="meta.ref", doc="file from which it was made, and its reference"),
        Column("sha256", "string", ucd="meta.checksum", doc="sha256 of that file, hexadecimal"),
        Column(
            "ab_minus_vega",
            "float64",
            "mag",
            "phot.mag;arith.diff",
            "AB magnitude of Vega in this band, m_AB - m_Vega of any source; the zero point of Vega magnitudes is "
            "3631 Jy x 10^(-0.4 ab_minus_vega). Vega's spectrum is star Vega of table templates "
            "at the level of its source, f_lambda = 3.531e-9 erg s-1 cm-2 A-1 at 5500 A; photons are counted, as for "
            "all fluxes; missing if the spectrum does not cover the band",
            -10.0,
            20.0,
            True,
        ),
    ),
    "Passbands.",
    key=("name",),
)


class Passband(Protocol):
    """Attributes of a passband that `rows` needs: the response to photons on a wavelength grid with equal steps.

    Attributes
    ----------
    name : str
        Name of the band.
    medium : str
        Medium in which wavelengths are measured, "air" or "vacuum".
    wavelength : float array, shape (m,)
        Wavelengths in angstrom.
    response : float array, shape (m,)
        Detected electrons per arriving photon.
    """

    @property
    def name(self) -> str: ...
    @property
    def medium(self) -> str: ...
    @property
    def wavelength(self) -> Float: ...
    @property
    def response(self) -> Float: ...


def rows(
    bands: Sequence[Passband],
    pivot_wavelengths: npt.ArrayLike,
    log_widths: npt.ArrayLike,
    origins: Sequence[Origin],
    ab_minus_vega: Sequence[float | None],
) -> pa.Table:
    """Build the rows of the table `passbands`.

    Parameters
    ----------
    bands : sequence of Passband, length n
        Passbands, one per row.
    pivot_wavelengths : float array, shape (n,)
        Pivot wavelengths in angstrom.
    log_widths : float array, shape (n,)
        Integrals of the responses over ln(wavelength).
    origins : sequence of Origin, length n
        File and reference from which each passband was made.
    ab_minus_vega : sequence of float or None, length n
        AB magnitude of Vega in each band, None if Vega's spectrum does not cover the band.

    Returns
    -------
    pyarrow.Table
        Table with n rows.
    """
    return PASSBANDS.build(
        {
            "name": [band.name for band in bands],
            "medium": [band.medium for band in bands],
            "pivot_wavelength": np.asarray(pivot_wavelengths, float),
            "log_width": np.asarray(log_widths, float),
            "first_wavelength": np.array([band.wavelength[0] for band in bands], float),
            "wavelength_step": np.array([band.wavelength[1] - band.wavelength[0] for band in bands], float),
            "response": [np.asarray(band.response) for band in bands],
            "source": [origin.source for origin in origins],
            "sha256": [origin.sha256 for origin in origins],
            "ab_minus_vega": pa.array(ab_minus_vega, pa.float64()),
        }
    )
