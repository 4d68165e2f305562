"""Declaration of the table `observed`: catalogued sources as a survey would detect and measure them.

`EXAMPLES` declares the rows of a model file, from which the measurements are drawn. It is not a table of a lake.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from lake_schema.columns import Column, Table
from lake_schema.tables.common import DEC, HEALPIX_29, ID, RA

_PLACE = "as measured in the first band that detects it, else without errors (lensed)"


def observed_sources(bands: Sequence[str]) -> Table:
    """Return the declaration of the table of observed sources, with the measurements in these passbands."""
    return Table(
        "observed",
        1,
        (
            replace(ID, doc="source, as in the tables galaxies and stars"),
            replace(RA, doc=f"right ascension, ICRS, {_PLACE}"),
            replace(DEC, doc=f"declination, ICRS, {_PLACE}"),
            HEALPIX_29,
            Column("detected", "bool", ucd="meta.code", doc="true if a band detects the source"),
            *(column for band in bands for column in _measurements(band)),
        ),
        "Sources in the fields of view of the plan, as images would show them: drawn from measurements on images.",
        order=5,
    )


def _measurements(band: str) -> tuple[Column, ...]:
    return (
        Column(f"detected_{band}", "bool", "", "meta.code", f"true if {band} detects it; missing without exposure"
               , nullable=True),
        _magnitude(f"mag_auto_{band}", "phot.mag", f"total AB magnitude in {band} (MAG_AUTO), missing if not detected"),
        _magnitude(f"magerr_auto_{band}", "stat.error;phot.mag", f"error of mag_auto_{band}", 0.0),
        _magnitude(f"mag_aper_{band}", "phot.mag", f"AB magnitude in {band} in the circular aperture of the model"),
        _magnitude(f"magerr_aper_{band}", "stat.error;phot.mag", f"error of mag_aper_{band}", 0.0),
        Column(f"flux_radius_{band}", "float32", "arcsec", "phys.angSize", f"half-light radius in {band} (FLUX_RADIUS)",
               0.0, 1e3, nullable=True, mantissa_bits=14),
        Column(f"flags_{band}", "int16", "", "meta.code.qual", f"FLAGS of SourceExtractor in {band}", 0, 255,
               nullable=True),
        Column(f"blended_{band}", "bool", "", "meta.code.qual",
               f"true if a detection in {band} covers it that belongs to a brighter source", nullable=True),
        Column(f"extrapolated_{band}", "bool", "", "meta.code.qual",
               f"true if the depth in {band} is outside the range of the model", nullable=True),
    )  # fmt: skip


def _magnitude(name: str, ucd: str, doc: str, low: float = -20.0) -> Column:
    return Column(name, "float32", "mag", ucd, doc, low, 100.0, nullable=True, mantissa_bits=16)


def _outcome(name: str, unit: str, doc: str) -> Column:
    return Column(name, "float32", unit, "", f"{doc}; NaN if not detected")


EXAMPLES = Table(
    "emulator_examples",
    1,
    (
        Column("brightness", "float32", "mag", "phot.mag", "true magnitude minus depth"),
        Column("width", "float32", "", "phys.angSize", "log10 of the half-light radius over that of the PSF"),
        Column("blending", "float32", "", "", "log10 of the neighbours' light over the own light"),
        Column("is_point", "bool", "", "src.class.starGalaxy", "star or QSO"),
        Column("detected", "bool", "", "meta.code", "detected"),
        Column("blended", "bool", "", "meta.code", "in a detection of a brighter source"),
        _outcome("mag_auto", "mag", "MAG_AUTO minus true magnitude"),
        _outcome("magerr_auto", "mag", "its error"),
        _outcome("mag_aper", "mag", "MAG_APER minus true magnitude"),
        _outcome("magerr_aper", "mag", "its error"),
        _outcome("radius", "", "FLUX_RADIUS over the true half-light radius after convolution"),
        _outcome("dx", "", "measured minus true column in half-light radii of the PSF"),
        _outcome("dy", "", "the same along the rows' axis"),
        Column("flags", "int16", "", "meta.code.qual", "FLAGS, 0 if not detected"),
    ),
    "Sources on images, and how they were detected and measured.",
    key=(),
)
