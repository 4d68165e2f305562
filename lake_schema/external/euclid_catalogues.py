"""Declaration of the catalogues of Euclid's True Universe: sim.tuGalaxyCatalog 0.1 and sim.tuStarCatalog.

Euclid's package SHE_PPT (table_formats/sim_tu_gal_catalog.py, 2022) lists the 69 columns of galaxies, which are here in
its order and with its types. No list of the columns of stars is published. Public programs read these columns
(SHE_Validation, skyCatalogs), and stars are assumed to have fluxes in the same bands as galaxies.
"""

from __future__ import annotations

from lake_schema.columns import Column, Table

# Part of the name of a flux column, such as VIS of TU_FNU_VIS_MAG, and the passband of truesky; "" if it has none.
BANDS = {
    "VIS": "euclid_vis",
    "Y_NISP": "euclid_y",
    "J_NISP": "euclid_j",
    "H_NISP": "euclid_h",
    "G_DECAM": "des_g",
    "R_DECAM": "des_r",
    "I_DECAM": "des_i",
    "Z_DECAM": "des_z",
    "U_MEGACAM": "cfis_u",
    "R_MEGACAM": "cfis_r",
    "G_JPCAM": "jedis_g",
    "I_PANSTARRS": "ps1_i",
    "Z_PANSTARRS": "",
    "G_HSC": "hsc_g",
    "Z_HSC": "hsc_z",
    "G_GAIA": "gaia_g",
    "BP_GAIA": "gaia_bp",
    "RP_GAIA": "gaia_rp",
    **{f"{band.upper()}_LSST": f"lsst_{band}" for band in "ugrizy"},
    **{f"{band.upper()}_2MASS": f"twomass_{band}" for band in ("j", "h", "ks")},
}
# Emission lines: the beginning of the name of the column, and the line.
_LINES = {
    "HALPHA": "H alpha",
    "HBETA": "H beta",
    "HGAMMA": "H gamma",
    "HDELTA": "H delta",
    "HEPSILON": "H epsilon",
    "PBETA": "Paschen beta",
    "PGAMMA": "Paschen gamma",
    "PDELTA": "Paschen delta",
    "PEPSILON": "Paschen epsilon",
    "O2": "[O II] 3727 + 3730",
    "O3": "[O III] 5008",
    "N2": "[N II] 6585",
    "S2": "[S II] 6718",
    "S3": "[S III] 9533",
}


def flux_column(band: str, kind: str) -> str:
    """Return the name of the flux column of a band, a key of `BANDS`; `kind` is "galaxy" or "star"."""
    return f"TU_FNU_{band}_MAG" if kind == "galaxy" else f"TU_FNU_{band}"


def _fluxes(kind: str) -> tuple[Column, ...]:
    content = "magnified, Milky Way's dust" if kind == "galaxy" else "with the dust on the way"
    return tuple(
        Column(flux_column(band, kind), "float32", "Jy", "phot.flux.density", f"flux density in {band}, {content}")
        for band in BANDS
    )


def _component(k: int) -> tuple[Column, ...]:
    fraction = (Column("SED_FRACTION_1", "float32", doc="fraction of rest-frame 0.1r flux of the first template"),)
    return (
        Column(f"SED_TEMPLATE_{k}", "float32", ucd="meta.code", doc=f"index of template {k}"),
        Column(f"EXT_LAW_{k}", "int16", ucd="meta.code", doc=f"extinction law of template {k}, 0 to 4"),
        Column(f"EBV_{k}", "float32", "mag", "phot.color.excess", f"internal E(B-V) of template {k}"),
        *(fraction if k == 1 else ()),
    )


GALAXIES = Table(
    "tuGalaxyCatalog",
    1,
    (
        Column("SOURCE_ID", "int64", ucd="meta.id;meta.main", doc="identifier of the galaxy"),
        Column("HALO_ID", "int64", ucd="meta.id.parent", doc="identifier of its halo"),
        Column("KIND", "int16", ucd="src.class", doc="0 central, 1 satellite"),
        Column("RA", "float64", "deg", "pos.eq.ra", "true right ascension, without lensing"),
        Column("DEC", "float64", "deg", "pos.eq.dec", "true declination, without lensing"),
        Column("RA_MAG", "float64", "deg", "pos.eq.ra;meta.main", "right ascension as seen, with lensing"),
        Column("DEC_MAG", "float64", "deg", "pos.eq.dec;meta.main", "declination as seen, with lensing"),
        Column("Z_OBS", "float32", "", "src.redshift", "redshift, with the peculiar velocity"),
        Column("REF_MAG_ABS", "float32", "mag", "phot.mag;phys.magAbs", "absolute magnitude in 0.1r, minus 5 log10 h"),
        Column("REF_MAG", "float32", "mag", "phot.mag", "magnitude in 0.1r, before lensing and Milky Way"),
        Column("BULGE_FRACTION", "float32", doc="flux of the bulge / total, in 0.1r"),
        Column("BULGE_R50", "float32", "arcsec", "phys.angSize.smajAxis", "half-light semi-major axis of the bulge"),
        Column("DISK_R50", "float32", "arcsec", "phys.angSize.smajAxis", "half-light semi-major axis of the disc"),
        Column("BULGE_NSERSIC", "float32", doc="Sersic index of the bulge"),
        Column("BULGE_AXIS_RATIO", "float32", ucd="phys.size.axisRatio", doc="minor / major axis of the bulge"),
        Column("INCLINATION_ANGLE", "float32", "deg", doc="inclination of the disc, 0 face-on, 90 edge-on"),
        Column("DISK_ANGLE", "float32", "deg", "pos.posAng", "position angle, north through east, without lensing"),
        Column("KAPPA", "float32", doc="convergence"),
        Column("GAMMA1", "float32", doc="shear along east-west"),
        Column("GAMMA2", "float32", doc="shear along north-east"),
        *_component(1),
        *_component(2),
        *(
            Column(f"{name}_LOGFLAM_EXT_MAG", "float32", "", "phot.flux;spect.line", f"log10 flux (cgs) of {line}")
            for name, line in _LINES.items()
        ),
        Column("AV", "float32", "mag", "phys.absorption.gal", "extinction A(V) of the Milky Way"),
        *_fluxes("galaxy"),
    ),
    "Galaxies of Euclid's True Universe.",
    key=("SOURCE_ID",),
)

STARS = Table(
    "tuStarCatalog",
    1,
    (
        Column("SOURCE_ID", "int64", ucd="meta.id;meta.main", doc="identifier of the star"),
        Column("RA", "float64", "deg", "pos.eq.ra;meta.main", "right ascension at J2015.5"),
        Column("DEC", "float64", "deg", "pos.eq.dec;meta.main", "declination at J2015.5"),
        Column("DIST", "float32", "pc", "pos.distance", "distance from the Sun"),
        Column("TU_MAG_H_2MASS", "float32", "mag", "phot.mag;em.IR.H", "2MASS H (Vega), before extinction"),
        Column("SED_TEMPLATE", "int32", ucd="meta.code", doc="index of the template with the largest share"),
        Column("AV", "float32", "mag", "phys.absorption.gal", "extinction A(V) on the way"),
        *_fluxes("star"),
    ),
    "Stars of Euclid's True Universe.",
    key=("SOURCE_ID",),
)
