"""Table `exposures`: what the telescope or camera does, one row an exposure."""

from __future__ import annotations

from lake_schema.columns import Column, Table

CHANNELS = (("VIS", "Euclid visible camera"), ("EXT", "ground camera"))
IMAGE_TYPES = (("science", "sky exposure"),)

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
            "of the focal plane's y axis, north through east",
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
            "diffuse sky: rate in a pixel at the field centre",
            0.0,
        ),
        Column("seeing", "float64", "arcsec", "instr.obsty.seeing", "FWHM of the atmosphere, 0 in space", 0.0, 10.0),
    ),
    "Exposures, in the order they are taken.",
    key=("exposure_id",),
)
