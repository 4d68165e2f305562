"""Quantities with their limits, what happens beyond these, and the largest error that is allowed.

Limits that the program declares are read from the program.
"""

from dataclasses import dataclass

import numpy as np

from lake_schema import sky
from lake_schema.mission.bounds import bounds_of_parameter
from lake_schema.tables.exposures import EXPOSURES
from lake_schema.tables.galaxies import GALAXIES
from truesky.catalogue.external.mapping import GALAXY_BOUNDS
from truesky.cosmology import Z_MAX
from truesky.fluxes import high_redshift, passbands
from truesky.fluxes.libraries import from_files, templates
from truesky.fluxes.spectra import lines
from truesky.request.schema import MAX_SHEAR

# The program itself chooses values that are not possible beyond the limits.
REFUSED, FINITE, IMPOSSIBLE = "refused", "correct", "not possible"


@dataclass(frozen=True)
class Quantity:
    """A quantity of a subject, its limits, and what happens beyond these.

    `usual` limits the values of the quantity while another one is at its extremes, and `log` spaces its values evenly
    in the logarithm, above `tiny` if the lower limit is 0.
    """

    name: str
    lo: float
    hi: float
    unit: str = ""
    beyond: str = REFUSED
    usual: tuple[float, float] | None = None
    log: bool = False
    tiny: float = 1e-9

    @property
    def label(self):
        """Return the name in words."""
        return self.name.replace("_", " ")

    def is_outside(self, value):
        """Return True if a value is beyond the limits, or not a number."""
        return not self.lo <= value <= self.hi

    def value_beyond(self, decades, upper):
        """Return the value that is this number of decades (positive) beyond the lower or the upper limit."""
        if upper:
            return self.hi * 10.0**decades
        if self.lo > 0.0:
            return self.lo * 10.0**-decades
        return self.lo * 10.0**decades if self.lo else -(10.0 ** (decades - 3.0))


@dataclass(frozen=True)
class Subject:
    """Quantities whose values are combined, what their result is compared with, and its largest allowed error."""

    name: str
    quantities: tuple[Quantity, ...]
    compared_with: str
    error: float
    unit: str = ""


def _column(name, **settings):
    column = GALAXIES.column(name)
    return Quantity(name, column.lo, column.hi, column.unit, **settings)


def _given(name, unit="", **settings):
    return Quantity(name, *GALAXY_BOUNDS[name], unit, **settings)


def _parameter(key, name, **settings):
    lowest, highest, units = zip(*bounds_of_parameter(key), strict=True)
    return Quantity(name, max(lowest), min(highest), units[0], **settings)


def _template_redshifts():
    rest = templates.galaxy_library().wavelength
    return passbands.GRID_LAST / rest[-1] - 1.0, passbands.GRID_FIRST / rest[0] - 1.0


_SIZE = {"unit": "arcsec", "log": True, "usual": (1e-2, 10.0)}
_WAVELENGTH = Quantity("wavelength", passbands.GRID_FIRST, passbands.GRID_LAST, "A", usual=(3000.0, 20000.0))
_RA = Quantity("right_ascension", -360.0, 360.0, "deg", FINITE)
_DEC = Quantity("declination", -90.0, 90.0, "deg")
_CURVES = from_files.formats()["passband_ascii"]["bounds"]

SUBJECTS = (
    Subject(
        "galaxy on a stamp",
        (
            # The shape of the profile is drawn from a list: GalSim prepares each index in up to 6 s.
            _given("bulge_sersic_index"),
            _given("bulge_half_light_radius", **_SIZE),
            _given("disk_half_light_radius", **_SIZE),
            _given("bulge_axis_ratio", log=True),
            _given("disk_axis_ratio", log=True),
            _given("bulge_fraction"),
            _given("position_angle", "deg"),
            _given("kappa", usual=(-0.2, 0.4)),
            Quantity("reduced_shear", -MAX_SHEAR, MAX_SHEAR, usual=(-0.4, 0.4)),
            Quantity("electrons", 1e-6, 1e12, "", FINITE, (1e2, 1e9), log=True),
        ),
        "GalSim: Fourier transforms of the profile, PSF and pixel",
        5e-5,
        "of the flux",
    ),
    Subject(
        "galaxy in a passband of one sample",
        (
            Quantity("redshift", *_template_redshifts(), usual=(0.0, 3.0)),
            _column("a_v", usual=(0.0, 3.0)),
            _given("ebv", "mag", usual=(0.0, 0.5)),
            _column("mag_r01"),
            _given("kappa", beyond=FINITE, usual=(-0.2, 0.4)),
            _column("frac_1"),
            _WAVELENGTH,
        ),
        "the template, redshifted and dimmed by dust_extinction in double precision",
        1.0,
        "of the documented error",
    ),
    Subject(
        "galaxy of high redshift in a passband of one sample",
        (
            Quantity("redshift", 0.0, high_redshift.Z_MAX),
            _column("a_v", usual=(0.0, 3.0)),
            _column("mag_r01"),
            _WAVELENGTH,
        ),
        "the template, redshifted and dimmed by dust_extinction in double precision",
        1e-6,
        "of the flux",
    ),
    Subject(
        "distance",
        (Quantity("redshift", 0.0, Z_MAX, log=True),),
        "SciPy: quad",
        1e-11,
        "of the distance",
    ),
    Subject(
        "emission line",
        (
            Quantity("velocity_dispersion", lines.SIGMA_MIN, lines.SIGMA_MAX, "km s-1", FINITE, log=True),
            _column("z_obs", beyond=IMPOSSIBLE),
            _column("flux_halpha", log=True, tiny=1e-30, beyond=FINITE),
        ),
        "SciPy: ndtr at the edges of the bins",
        2e-8,
        "of the flux",
    ),
    Subject(
        "passband from a file",
        (
            Quantity("rows", 2, 100, "", FINITE),
            Quantity("width", 1e-3, 3000.0, "A", FINITE, log=True),
            Quantity("wavelength", _CURVES[0], passbands.GRID_LAST, "A", usual=(4000.0, 20000.0)),
        ),
        "SciPy: quad of the triangle in the file, for the pivot wavelength",
        1.0,
        "A",
    ),
    Subject(
        "position on the sky",
        (
            _RA,
            _DEC,
            Quantity("order_of_cell", 0, sky.MAX_ORDER, "", IMPOSSIBLE),
            Quantity("distance", 0.0, 180.0, "deg", FINITE, log=True, tiny=1e-9),
            Quantity("direction", 0.0, 360.0, "deg", FINITE),
        ),
        "ERFA: rotations; astropy: angular_separation; cdshealpix: lonlat_to_healpix",
        1e-12,
        "deg",
    ),
    Subject(
        "pixel of a detector",
        (
            _RA,
            _DEC,
            _parameter("vis.fpa.nx", "columns", log=True, usual=(16, 32000)),
            _parameter("vis.fpa.ny", "rows", log=True, usual=(16, 32000)),
            Quantity("position_angle", -180.0, 360.0, "deg", FINITE),
        ),
        "ERFA: rotations by the angle from the boresight",
        1e-8,
        "pixels",
    ),
    Subject(
        "field above a telescope",
        (
            _RA,
            _DEC,
            Quantity("mjd", EXPOSURES.column("mjd").lo, EXPOSURES.column("mjd").hi, "d", IMPOSSIBLE),
            _parameter("ext.lsstcam.site.latitude", "latitude"),
        ),
        "ERFA: atco13; airmass of Young 1994",
        1.0,
        "of the documented error",
    ),
    Subject(
        "seeing through turbulent air",
        (
            _parameter("ext.lsstcam.seeing", "seeing", log=True, usual=(0.5, 5.0)),
            _parameter("ext.lsstcam.psf.outer_scale", "outer_scale", log=True, usual=(10.0, 500.0)),
            Quantity("wavelength", 3000.0, 11000.0, "A", IMPOSSIBLE),
        ),
        "GalSim: VonKarman",
        1.0,
        "of the documented error",
    ),
    Subject(
        "detector that is read out",
        (
            _parameter("vis.exposure_time", "exposure_time", log=True),
            _parameter("vis.gain", "gain", log=True),
            _parameter("vis.read_noise", "read_noise", log=True, tiny=1e-3),
            _parameter("vis.bias", "bias"),
            _parameter("vis.dark_current", "dark_current", log=True, tiny=1e-6),
            _parameter("vis.adc_max", "adc_max"),
        ),
        "SciPy: mean of the rounded and clipped normal distribution (ndtr)",
        6.0,
        "standard errors",
    ),
)


def find(subject):
    """Return the subject with this name."""
    return next(one for one in SUBJECTS if one.name == subject)


def value_between(quantity, share, usual):
    """Return the value at a share (0 to 1) of the range of a quantity, or of its usual range."""
    lo, hi = quantity.usual if usual and quantity.usual else (quantity.lo, quantity.hi)
    if share in (0.0, 1.0) or not quantity.log:
        return float(lo + (hi - lo) * share) if share < 1.0 else float(hi)
    low = lo or quantity.tiny
    return float(low * np.exp(share * np.log(hi / low)))


def range_of(quantity):
    """Return the limits of a quantity in words."""
    return f"{quantity.lo:.4g} to {quantity.hi:.4g} {quantity.unit}".strip()


def quantity_rows():
    """Return the rows of the table of quantities in docs/promises.md."""
    return [
        f"| {subject.name} | {one.label} | {range_of(one)} | {one.beyond} |"
        for subject in SUBJECTS
        for one in subject.quantities
    ]


def reference_row(subject, seen):
    """Return the row of a subject in the table of references in docs/promises.md, with the largest error seen."""
    return f"| {subject.name} | {subject.compared_with} | {seen:.2g} {subject.unit} | {subject.error:.2g} |"
