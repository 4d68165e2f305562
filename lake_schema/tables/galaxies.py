"""Table `galaxies`: the True Universe's galaxies, the ten groups of columns of Serrano et al. 2024, section 4.1.

The SED is held in the two-component form (Flagship 2); one mixed template with one law and one E(B-V) (Flagship 1) is
the case of equal laws and E(B-V).
"""

from __future__ import annotations

from lake_schema.columns import Column, Table
from lake_schema.tables.common import DEC, HEALPIX_29, KINDS, RA, id_of_kinds

LAWS = ((0, "none"), (1, "Prevot"), (2, "Calzetti"), (3, "Calzetti + 2175 A bump"), (4, "Calzetti + double bump"))

# Scale height of every disc in scale lengths: what `inclination` makes of an axis ratio, and how a disc is drawn
# (Serrano et al. 2024, "Bulge and disc model").
DISK_SCALE_HEIGHT = 0.1

_LINE = (
    "observed flux of the primary component, dimmed by the galaxy's own dust, before magnification and the Milky Way; "
    "missing where it was not modelled"
)


def _line(name: str, which: str, ucd: str = "phot.flux;spect.line") -> Column:
    return Column(f"flux_{name}", "float32", "erg s-1 cm-2", ucd, f"{which}: {_LINE}", 0.0, 1e-5, True)


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


GALAXIES = Table(
    "galaxies",
    2,
    (
        # 1 identity
        id_of_kinds(0, 4),
        Column(
            "halo_id",
            "int64",
            ucd="meta.id.parent",
            doc="parent halo: its row in table halos, and the id of its central galaxy",
            lo=0,
        ),
        # 2 positions
        RA,
        DEC,
        HEALPIX_29,
        Column(
            "ra_lensed",
            "float64",
            "deg",
            "pos.eq.ra",
            "observed (lensed) right ascension, what is rendered",
            0.0,
            360.0,
        ),
        Column(
            "dec_lensed", "float64", "deg", "pos.eq.dec", "observed (lensed) declination, what is rendered", -90.0, 90.0
        ),
        # 3 kind
        Column("kind", "int8", ucd="src.class", doc="kind of source", codes=KINDS[:5], lo=0, hi=4),
        Column(
            "density_boost",
            "float32",
            ucd="stat.weight",
            doc="how many times denser than in nature this kind was drawn; weight by its inverse",
            lo=1e-3,
            hi=1e6,
        ),
        # 4 redshift
        Column("z_true", "float32", "", "src.redshift", "cosmological redshift", 0.0, 15.0),
        Column("z_obs", "float32", "", "src.redshift", "observed redshift, with the peculiar velocity", -0.02, 15.0),
        # 5 reference magnitude
        Column(
            "abs_mag_r01",
            "float32",
            "mag",
            "phot.mag;phys.magAbs;em.opt.R",
            "absolute AB magnitude - 5 log10 h in SDSS r blue-shifted to z = 0.1, observed (after internal dust)",
            -30.0,
            5.0,
        ),
        Column(
            "mag_r01",
            "float32",
            "mag",
            "phot.mag;em.opt.R",
            "apparent AB magnitude in the same reference passband (K-corrected), before magnification and Milky Way; "
            "for kinds 2 (QSO) and 3 (high redshift) at 1450 and 1500 Angstrom in the rest frame instead",
            -5.0,
            60.0,
        ),
        Column(
            "color_gr_01", "float32", "mag", "phot.color;em.opt.B;em.opt.R", "rest-frame colour 0.1(g - r)", -2.0, 4.0
        ),
        Column(
            "log_halo_mass", "float32", "", "phys.mass", "log10 of M_200m / (Msun/h) of the host halo", 5.0, 17.0, True
        ),
        Column(
            "log_stellar_mass",
            "float32",
            "",
            "phys.mass",
            "log10 of the stellar mass / Msun (h = 0.67)",
            0.0,
            14.0,
            True,
        ),
        Column(
            "log_sfr",
            "float32",
            "",
            "phys.SFR",
            "log10 of the star formation rate / (Msun/yr), Salpeter",
            -10.0,
            5.0,
            True,
        ),
        # 6 SED
        *_component(1),
        *_component(2),
        # 7 emission lines
        _line("halpha", "H alpha 6564.6"),
        _line("hbeta", "H beta 4862.7"),
        _line("oii", "[O II] 3727.1 (the doublet's other line has the same flux)"),
        _line("oiii", "[O III] 5008.2 (4960.3 has a third of it)"),
        _line("nii", "[N II] 6585.3 (6549.9 has a third of it)"),
        _line("sii", "[S II] 6718.3 (the doublet's other line has the same flux)"),
        # 8 morphology
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
            "bulge_fraction", "float32", ucd="phot.flux;arith.ratio", doc="flux of the bulge / total", lo=0.0, hi=1.0
        ),
        Column(
            "bulge_sersic_index", "float32", ucd="src.morph.scLength", doc="Sersic index of the bulge", lo=0.3, hi=6.2
        ),
        Column(
            "bulge_axis_ratio", "float32", ucd="phys.size.axisRatio", doc="bulge: minor / major axis", lo=0.02, hi=1.0
        ),
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
        Column("position_angle", "float32", "deg", "pos.posAng", "of the major axis, north through east", 0.0, 180.0),
        # 9 lensing
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
        # 10 Milky Way
        Column(
            "a_v", "float32", "mag", "phys.absorption.gal", "extinction A(V) of the Milky Way, R_V = 3.1", 0.0, 40.0
        ),
        # Of another catalogue
        Column(
            "origin_id",
            "int64",
            ucd="meta.id",
            doc="identifier in the catalogue that the galaxy was taken from; missing where it was drawn here",
            nullable=True,
            since=2,
        ),
    ),
    "Galaxies of the True Universe: central, satellite, QSO, high-redshift and strongly lensed.",
    order=5,
)
