"""Table `extinction_laws`: the dust inside galaxies, one row a law code."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float, Float32
from lake_schema.columns import Column, Table
from lake_schema.tables.common import Origin

EXTINCTION_LAWS = Table(
    "extinction_laws",
    1,
    (
        Column("law", "int16", ucd="meta.code", doc="code, the ext_law_k of galaxies", lo=0),
        Column("first_wavelength", "float64", "Angstrom", "em.wl;stat.min", "of the first sample, vacuum", 1.0, 1e6),
        Column("wavelength_step", "float64", "Angstrom", "em.wl;spect.binSize", "between samples", 1e-3, 1e3),
        Column("k", "list<float32>", "", "phys.absorption", "A(lambda) / E(B-V), rest frame", 0.0, 1e3),
        Column("source", "string", ucd="meta.ref", doc="files that it was made from, and their reference"),
        Column("sha256", "string", ucd="meta.checksum", doc="of those files, one after another, hexadecimal"),
    ),
    "Extinction laws of the dust inside galaxies, on the wavelengths of the galaxy templates.",
    key=("law",),
)


def rows(wavelength: Float, k: Float32, origins: Sequence[Origin]) -> pa.Table:
    """Table `extinction_laws`.

    wavelength : [m] A, in equal steps;  k : [5, m];  origins : where each is from
    """
    n = len(k)
    return EXTINCTION_LAWS.build(
        {
            "law": np.arange(n),
            "first_wavelength": np.full(n, wavelength[0]),
            "wavelength_step": np.full(n, wavelength[1] - wavelength[0]),
            "k": [np.asarray(curve, np.float32) for curve in k],
            "source": [origin.source for origin in origins],
            "sha256": [origin.sha256 for origin in origins],
        }
    )
