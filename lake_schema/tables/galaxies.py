"""Declaration of the tables `galaxies` and `emission_lines` (wavelengths and widths of the galaxies' lines).

The columns of `galaxies` are in the ten groups of Serrano et al. 2024, section 4.1. The spectrum (SED) of a galaxy is
the sum of two template spectra, each with its extinction law and E(B-V), as in the Flagship 2 catalogue. Flagship 1 has
one law and one E(B-V) per galaxy, which are then equal for both templates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
import pyarrow as pa

from lake_schema.columns import Column, Table
from lake_schema.tables.common import (
    HEALPIX_29,
    OBSERVED_DEC,
    OBSERVED_RA,
    SOURCE_KINDS,
    TRUE_DEC,
    TRUE_RA,
    Origin,
    density_boost_column,
    id_of_kinds,
)

LAWS = ((0, "none"), (1, "Prevot"), (2, "Calzetti"), (3, "Calzetti + 2175 A bump"), (4, "Calzetti + double bump"))

# Scale height of the disc of every galaxy, in units of its radial scale length. It relates the column `inclination` to
# the axis ratio, and discs are drawn with it (Serrano et al. 2024, "Bulge and disc model").
DISK_SCALE_HEIGHT = 0.1

_LINE_DOC = (
    "observed flux of the primary component, dimmed by the galaxy's own dust, before magnification and the Milky Way; "
    "missing if it was not modelled"
)


def _line_column(name: str, label: str) -> Column:
    ucd_and_doc = "phot.flux;spect.line", f"{label}: {_LINE_DOC}"
    return Column(f"flux_{name}", "float32", "erg s-1 cm-2", *ucd_and_doc, 0.0, 1e-5, True)


def _component(k: int) -> tuple[Column, ...]:
    part = f"SED component {k}"
    return (
        Column(f"sed_{k}", "int16", ucd="meta.code", doc=f"{part}: template index in the library, early to late", lo=0),
        Column(
            f"frac_{k}",
            "float32",
            ucd="phot.flux;arith.ratio",
            doc=f"{part}: fraction of the rest-frame 0.1r flux, after its own dust",
            lo=0.0,
            hi=1.0,
        ),
        Column(f"ext_law_{k}", "int8", ucd="meta.code", doc=f"{part}: extinction law", codes=LAWS, lo=0, hi=4),
        Column(f"ebv_{k}", "float32", "mag", "phot.color.excess", f"{part}: internal E(B-V)", 0.0, 3.0),
    )


# Columns of group 1 (groups of Serrano et al. 2024, section 4.1): identity.
_IDENTITY = (
    id_of_kinds(0, 4),
    Column(
        "halo_id",
        "int64",
        ucd="meta.id.parent",
        doc="parent halo: its row in table halos, and the id of its central galaxy",
        lo=0,
    ),
)
# Columns of groups 3 to 10 (groups of Serrano et al. 2024, section 4.1). In the table, the columns of group 2, the
# position, are between the columns of _IDENTITY and _OTHER_COLUMNS.
_OTHER_COLUMNS = (
    # Columns of group 3: type of source.
    Column("kind", "int8", ucd="src.class", doc="kind of source", codes=SOURCE_KINDS[:5], lo=0, hi=4),
    density_boost_column("this kind was"),
    # Columns of group 4: redshift.
    Column("z_true", "float32", "", "src.redshift", "cosmological redshift", 0.0, 15.0),
    Column("z_obs", "float32", "", "src.redshift", "observed redshift, with the peculiar velocity", -0.02, 15.0),
    # Columns of group 5: reference magnitude, colour and masses.
    Column(
        "abs_mag_r01",
        "float32",
        "mag",
        "phot.mag;phys.magAbs;em.opt.R",
        "absolute AB magnitude - 5 log10 h of the continuum in SDSS r blue-shifted to z = 0.1, after internal dust",
        -30.0,
        5.0,
    ),
    Column(
        "mag_r01",
        "float32",
        "mag",
        "phot.mag;em.opt.R",
        "apparent AB magnitude of the continuum, without emission lines, in the same reference passband (K-corrected), "
        "before magnification and Milky Way; "
        "for kinds 2 (QSO) and 3 (high redshift) at 1450 and 1500 Angstrom in the rest frame instead",
        -5.0,
        60.0,
    ),
    Column(
        "color_gr_01",
        "float32",
        "mag",
        "phot.color;em.opt.B;em.opt.R",
        "rest-frame colour 0.1(g - r); missing for kinds 2 (QSO) and 3 (high redshift)",
        -2.0,
        4.0,
        True,
    ),
    Column("log_halo_mass", "float32", "", "phys.mass", "log10 of M_200m / (Msun/h) of the host halo", 5.0, 17.0, True),
    Column(
        "log_stellar_mass",
        "float32",
        "",
        "phys.mass",
        "log10 of the stellar mass / Msun (with h of the universe), Chabrier",
        0.0,
        14.0,
        True,
    ),
    Column(
        "log_sfr",
        "float32",
        "",
        "phys.SFR",
        "log10 of the star formation rate / (Msun/yr), Chabrier or Kroupa",
        -10.0,
        5.0,
        True,
    ),
    # Columns of group 6: spectrum of the galaxy, the sum of two templates with their dust.
    *_component(1),
    *_component(2),
    # Columns of group 7: fluxes of emission lines.
    _line_column("halpha", "H alpha 6564.6"),
    _line_column("hbeta", "H beta 4862.7"),
    _line_column("oii", "[O II] 3727.1 (the doublet's other line has the same flux)"),
    _line_column("oiii", "[O III] 5008.2 (4960.3 has 1 / 2.98 of it)"),
    _line_column("nii", "[N II] 6585.3 (6549.9 has 1 / 3.05 of it)"),
    _line_column("sii", "[S II] 6718.3 (the doublet's other line has the same flux)"),
    _line_column("hgamma", "H gamma 4341.7"),
    _line_column("hdelta", "H delta 4102.9"),
    _line_column("paalpha", "Paschen alpha 18756"),
    _line_column("pabeta", "Paschen beta 12822"),
    _line_column("pagamma", "Paschen gamma 10941"),
    _line_column("padelta", "Paschen delta 10052"),
    _line_column("siii", "[S III] 9533.2 (9071.1 has 1 / 2.47 of it)"),
    _line_column("hei", "He I 10833"),
    _line_column("hei_5877", "He I 5877.2"),
    # Columns of group 8: morphology.
    Column(
        "bulge_half_light_radius",
        "float32",
        "arcsec",
        "phys.angSize.smajAxis",
        "bulge: half-light semi-major axis",
        0.0,
        120.0,
    ),
    Column(
        "disk_half_light_radius",
        "float32",
        "arcsec",
        "phys.angSize.smajAxis",
        "disc: half-light semi-major axis",
        0.0,
        120.0,
    ),
    Column(
        "bulge_fraction",
        "float32",
        ucd="phot.flux;arith.ratio",
        doc="flux of the bulge / total, in the rest-frame 0.1r; in other bands by bulge_color",
        lo=0.0,
        hi=1.0,
    ),
    Column(
        "bulge_color",
        "float32",
        "mag",
        "phot.color;em.opt.B;em.opt.R",
        "rest-frame 0.1(g - r) of the bulge less that of the disc, as far as there are templates that are redder "
        "than the galaxy's own; missing if both have the same spectrum",
        -2.0,
        2.0,
        True,
    ),
    Column("bulge_sersic_index", "float32", ucd="src.morph.scLength", doc="Sersic index of the bulge", lo=0.3, hi=6.2),
    Column("bulge_axis_ratio", "float32", ucd="phys.size.axisRatio", doc="bulge: minor / major axis", lo=0.02, hi=1.0),
    Column(
        "disk_axis_ratio",
        "float32",
        ucd="phys.size.axisRatio",
        doc="disc: apparent minor / major axis",
        lo=0.02,
        hi=1.0,
    ),
    Column(
        "inclination",
        "float32",
        "deg",
        "src.orbital.inclination",
        "disc inclination, 0 face-on, 90 edge-on",
        0.0,
        90.0,
    ),
    Column(
        "position_angle",
        "float32",
        "deg",
        "pos.posAng",
        "position angle of the major axis, north through east",
        0.0,
        180.0,
    ),
    # Columns of group 9: weak lensing.
    Column("kappa", "float32", ucd="arith.factor", doc="convergence", lo=-1.0, hi=2.0),
    Column(
        "gamma1",
        "float32",
        ucd="arith.factor",
        doc="shear along east-west (negative east and west of a mass)",
        lo=-1.0,
        hi=1.0,
    ),
    Column(
        "gamma2",
        "float32",
        ucd="arith.factor",
        doc="shear along north-east (negative north-east of a mass)",
        lo=-1.0,
        hi=1.0,
    ),
    # Columns of group 10: dust of the Milky Way.
    Column(
        "a_v",
        "float32",
        "mag",
        "phys.absorption.gal",
        "extinction A(V) of the Milky Way, by the curve of O'Donnell 1994 with R_V = 3.1",
        0.0,
        40.0,
    ),
    # Columns of galaxies from a user's catalogue, or with an image from a user's library.
    Column(
        "origin_id",
        "int64",
        ucd="meta.id",
        doc="identifier in the catalogue from which the galaxy was taken; missing if truesky drew it",
        nullable=True,
    ),
    Column(
        "stamp",
        "int32",
        ucd="meta.number",
        doc="number of the image in a user's library that is drawn instead of the profile, from 0; missing if none",
        lo=0,
        hi=1e6,
        nullable=True,
    ),
)
_DESCRIPTION = "Galaxies of the True Universe: central, satellite, QSO, high-redshift and strongly lensed."

GALAXIES = Table(
    "galaxies",
    1,
    (*_IDENTITY, OBSERVED_RA, OBSERVED_DEC, HEALPIX_29, TRUE_RA, TRUE_DEC, *_OTHER_COLUMNS),
    _DESCRIPTION,
    order=5,
)

_WIDTH = (
    "coefficient of log10 sigma/(km/s) = (width_slope + width_slope_z z_obs) (abs_mag_r01 - width_magnitude) "
    "+ width_z z_obs"
)

EMISSION_LINES = Table(
    "emission_lines",
    1,
    (
        Column("name", "string", ucd="meta.id;spect.line", doc="name of the line"),
        Column("flux_column", "string", ucd="meta.code", doc="column of table galaxies with the flux of its primary"),
        Column("ratio", "float64", "", "phot.flux;arith.ratio", "flux relative to the flux of the column", 0.0, 1e3),
        Column("vacuum_wavelength", "float64", "Angstrom", "em.wl", "rest wavelength in vacuum", 100.0, 1e6),
        Column("air_wavelength", "float64", "Angstrom", "em.wl", "rest wavelength in air", 100.0, 1e6),
        Column("width_slope", "float64", "", "stat.fit.param", _WIDTH, -10.0, 10.0),
        Column("width_slope_z", "float64", "", "stat.fit.param", _WIDTH, -10.0, 10.0),
        Column("width_magnitude", "float64", "mag", "stat.fit.param", _WIDTH, -50.0, 50.0),
        Column("width_z", "float64", "", "stat.fit.param", _WIDTH, -10.0, 10.0),
        Column("width_least", "float64", "km / s", "spect.line.width;stat.min", "smallest sigma", 0.0, 1e5),
        Column("width_most", "float64", "km / s", "spect.line.width;stat.max", "largest sigma", 0.0, 1e5),
        Column("source", "string", ucd="meta.ref", doc="source of wavelength and ratio, and its file"),
        Column("sha256", "string", ucd="meta.checksum", doc="sha256 of that file, hexadecimal"),
    ),
    "Emission lines of galaxies: Gaussian in wavelength, with the flux in table galaxies.",
    key=("name",),
)


class Line(Protocol):
    """Attributes of an emission line that `line_rows` needs.

    Attributes
    ----------
    name : str
        Name of the line.
    column : str
        Name of the column of the table `galaxies` that determines the flux of the line.
    ratio : float
        Flux of the line divided by the value of that column; 1 if the column contains the flux of this line.
    vacuum, air : float
        Rest wavelengths in vacuum and in air, in angstrom.
    """

    @property
    def name(self) -> str: ...
    @property
    def column(self) -> str: ...
    @property
    def ratio(self) -> float: ...
    @property
    def vacuum(self) -> float: ...
    @property
    def air(self) -> float: ...


def line_rows(lines: Sequence[Line], width: Mapping[str, float], origins: Sequence[Origin]) -> pa.Table:
    """Build the rows of the table `emission_lines`.

    Parameters
    ----------
    lines : sequence of Line, length n
        Lines, one per row.
    width : mapping of str to float
        Coefficients of the formula for the widths of lines, the same for all lines, by name of the column: width_slope,
        width_slope_z, width_magnitude, width_z, width_least and width_most.
    origins : sequence of Origin, length n
        File and reference of each line.

    Returns
    -------
    pyarrow.Table
        Table with n rows.
    """
    return EMISSION_LINES.build(
        {
            "name": [line.name for line in lines],
            "flux_column": [line.column for line in lines],
            "ratio": np.array([line.ratio for line in lines]),
            "vacuum_wavelength": np.array([line.vacuum for line in lines]),
            "air_wavelength": np.array([line.air for line in lines]),
            **{name: np.full(len(lines), value) for name, value in width.items()},
            "source": [origin.source for origin in origins],
            "sha256": [origin.sha256 for origin in origins],
        }
    )
