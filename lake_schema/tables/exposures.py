"""Declaration of the table `exposures`: one row per exposure of Euclid or of a ground camera.

It also contains the codes of the channels and image types, and the passbands of each channel.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from lake_schema.columns import Column, Table

CHANNELS = (
    ("VIS", "Euclid visible camera"),
    ("NISP-P", "Euclid near-infrared photometer"),
    ("NISP-S", "Euclid near-infrared slitless spectrometer"),
    ("EXT", "ground camera"),
)
IMAGE_TYPES = (
    ("science", "sky exposure of a wide survey"),
    ("deep", "sky exposure of a deep field"),
    ("bias", "read-out without exposure"),
    ("dark", "exposure without light"),
    ("flat", "calibration lamp"),
    ("charge_injection", "rows filled electronically, which traps delay"),
    ("self_calibration", "dense field, many dithers"),
    ("standard_star", "standard star"),
    ("persistence", "dark after a bright exposure, which shows the persistence of its light"),
    ("planetary_nebula", "planetary nebula, whose emission lines calibrate the wavelength scale"),
    ("trap_pumping", "charge moved back and forth over the traps, which makes a dipole at each trap"),
    ("defocus", "defocused sky exposure, from which the wavefront is measured"),
    ("bleeding", "saturated stars at known positions of every detector"),
    ("stray_light", "sky exposure with a bright star just outside the field"),
    ("white_dwarf", "white dwarfs at known positions of every detector"),
)
# Passbands of each of Euclid's channels. They are also in the code that plans exposures, which is not imported here; a
# test compares them.
EUCLID_BANDS: Mapping[str, tuple[str, ...]] = {
    "VIS": ("euclid_vis",),
    "NISP-P": ("euclid_y", "euclid_j", "euclid_h"),
    "NISP-S": ("nisp_red", "nisp_blue"),
}
# Grisms of NISP that a request may name in place of their passband: the passband, and the direction of the spectra in
# the focal plane, deg. RGS270, the fourth grism of the wheel, is not used in flight and has no traces.
GRISM_NAMES: Mapping[str, tuple[str, float]] = {
    "RGS000": ("nisp_red", 0.0),
    "RGS180": ("nisp_red", 180.0),
    "BGS000": ("nisp_blue", 0.0),
}
# Passband by whose fluxes sources are selected for the images of a slitless channel, by channel.
SELECTION_BANDS: Mapping[str, str] = {"NISP-S": "euclid_h"}
# Image types of which images can be simulated, by channel. Exposures of the other types can be planned, but not
# rendered. truesky's registry of channels contains the same list, but takes long to import;
# tests/truesky/request/test_checks.py compares both.
RENDERED_TYPES: Mapping[str, tuple[str, ...]] = {
    "VIS": (
        "science",
        "deep",
        "self_calibration",
        "flat",
        "dark",
        "charge_injection",
        "bias",
        "trap_pumping",
        "defocus",
        "bleeding",
        "stray_light",
        "white_dwarf",
    ),
    "NISP-P": ("science", "deep", "self_calibration", "standard_star", "flat", "dark", "persistence"),
    "NISP-S": ("science", "deep", "standard_star", "planetary_nebula", "flat", "dark", "persistence"),
    "EXT": ("science", "deep", "flat", "dark", "bias"),
}

EXPOSURES = Table(
    "exposures",
    1,
    (
        Column("exposure_id", "int64", ucd="meta.id;obs.exposure", doc="identifier of the exposure", lo=0),
        Column("channel", "string", ucd="instr", doc="channel", codes=CHANNELS),
        Column("camera", "string", ucd="instr", doc="camera, a section of the mission database"),
        Column("band", "string", ucd="instr.bandpass", doc="passband name"),
        Column("image_type", "string", ucd="meta.code.class;obs", doc="image type", codes=IMAGE_TYPES),
        Column("ra", "float64", "deg", "pos.eq.ra", "boresight right ascension, ICRS", 0.0, 360.0),
        Column("dec", "float64", "deg", "pos.eq.dec", "boresight declination, ICRS", -90.0, 90.0),
        Column(
            "position_angle",
            "float64",
            "deg",
            "pos.posAng",
            "position angle of the focal plane's y axis, north through east",
            -180.0,
            360.0,
        ),
        Column("mjd", "float64", "d", "time.start;obs.exposure", "start of the exposure, MJD (UTC)", 0.0, 2e5),
        Column("exposure_time_s", "float64", "s", "time.duration;obs.exposure", "effective exposure time", 0.0, 1e6),
        Column(
            "sky",
            "float64",
            "electron pix-1 s-1",
            "instr.skyLevel",
            "rate of the diffuse sky per pixel at the field centre",
            0.0,
        ),
        Column(
            "seeing",
            "float64",
            "arcsec",
            "instr.obsty.seeing",
            "FWHM of the air at zenith and 500 nm, 0 in space",
            0.0,
            10.0,
        ),
        Column("zero_point", "float64", "mag", "phot.mag;arith.zp", "AB magnitude of 1 electron/s", 0.0, 50.0),
        Column("survey", "string", ucd="meta.id", doc="survey or request of the exposure"),
        Column("field", "int64", "", "meta.id;obs", "field of the survey, from 1", 1, nullable=True),
        Column("visit", "int32", "", "meta.number;obs", "visit of the field, from 1", 1, nullable=True),
        Column("dither", "int32", "", "meta.number;obs", "dither of the visit, from 1", 1, nullable=True),
        Column("grism", "string", "", "instr.dispersion", "grism", nullable=True),
        Column(
            "grism_angle",
            "float64",
            "deg",
            "pos.posAng;instr.dispersion",
            "position angle of the dispersion",
            -360.0,
            360.0,
            True,
        ),
        Column("lamp", "int32", "", "meta.number;instr", "calibration lamp, from 1", 1, nullable=True),
        Column("target", "string", "", "meta.id;src", "calibration source", nullable=True),
        Column("psf", "string", "", "meta.ref;instr.det.psf", "file of the PSF model, if given", nullable=True),
        Column(
            "settings",
            "string",
            "",
            "meta.note",
            "JSON of parameters of a variant or a calibration that replace parameters of the request",
            nullable=True,
        ),
        Column(
            "realisation",
            "int32",
            "",
            "meta.number",
            "realisation of the noise, from 1: counts exposures of equal camera, band, position, angle and start",
            1,
            nullable=True,
        ),
        Column("airmass", "float64", "", "obs.airMass", "airmass of the field, for ground cameras", 1.0, 10.0, True),
        Column(
            "zenith",
            "float64",
            "deg",
            "pos.posAng",
            "position angle of the zenith at the field, north through east",
            -180.0,
            180.0,
            True,
        ),
        Column(
            "clouds",
            "float64",
            "mag",
            "obs.atmos.extinction",
            "extinction by clouds, averaged over the exposure, for ground cameras",
            0.0,
            50.0,
            True,
        ),
        Column(
            "sky_slope_x",
            "float64",
            "deg-1",
            "arith.grad;instr.skyLevel",
            "relative change of the sky along the focal plane's x axis, by twilight",
            nullable=True,
        ),
        Column(
            "sky_slope_y",
            "float64",
            "deg-1",
            "arith.grad;instr.skyLevel",
            "relative change of the sky along the focal plane's y axis, by twilight",
            nullable=True,
        ),
    ),
    "Exposures, in the order they are taken.",
    key=("exposure_id",),
)


@dataclass(frozen=True, slots=True)
class ExposureRow:
    """One row of the table `exposures`: an exposure of Euclid or of a ground camera.

    There is one attribute per column of the table, with the same name and unit. None stands for a null.
    """

    exposure_id: int
    channel: str
    camera: str
    band: str
    image_type: str
    ra: float
    dec: float
    position_angle: float
    mjd: float
    exposure_time_s: float
    sky: float
    seeing: float
    zero_point: float
    survey: str
    field: int | None = None
    visit: int | None = None
    dither: int | None = None
    grism: str | None = None
    grism_angle: float | None = None
    lamp: int | None = None
    target: str | None = None
    psf: str | None = None
    settings: str | None = None
    realisation: int | None = None
    airmass: float | None = None
    zenith: float | None = None
    clouds: float | None = None
    sky_slope_x: float | None = None
    sky_slope_y: float | None = None

    @property
    def middle_mjd(self) -> float:
        """MJD of the middle of the exposure."""
        return self.mjd + 0.5 * self.exposure_time_s / 86400.0

    @classmethod
    def from_row(cls, row: Mapping[str, Any]) -> ExposureRow:
        """Make an instance from a row of an Arrow table, a mapping of column names to values.

        Raise KeyError if a column is missing; other columns are ignored.
        """
        return cls(**{name: row[name] for name in cls.__slots__})
