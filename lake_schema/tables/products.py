"""Declaration of the tables of image files: `products` (one detector per file) and `exposure_files` (one exposure)."""

from __future__ import annotations

from lake_schema.columns import Column, Table
from lake_schema.tables.exposures import CHANNELS

CONTENTS = (
    ("science", "what the detector delivers"),
    ("noise_free", "expected electrons of the sources alone"),
    ("stars", "expected electrons of the stars alone"),
    ("sky", "expected electrons of the diffuse sky and of starlight that strays"),
    ("cosmic_rays", "electrons of cosmic rays, where they hit"),
    ("ghosts", "expected electrons of ghosts"),
    ("persistence", "expected electrons that earlier exposures left"),
    ("satellites", "expected electrons of satellites' trails"),
    ("ramp", "groups of a ramp, as read"),
    ("saturation", "1 where a pixel or the converter is full"),
    ("traps", "traps of the first species, plus 256 times those of the second, 65536 times those of the third"),
    ("dipoles", "electrons that trap pumping brought"),
    ("order_1", "expected electrons of the sources' first order"),
    ("order_0", "the same of order 0"),
    ("order_2", "the same of order 2"),
    ("order_m1", "the same of order -1"),
)

PRODUCTS = Table(
    "products",
    1,
    (
        Column("path", "string", ucd="meta.ref.uri", doc="file, relative to this version of the table"),
        Column("content", "string", ucd="meta.code.class", doc="content of the file", codes=CONTENTS),
        Column("exposure_id", "int64", ucd="meta.id;obs.exposure", doc="exposure", lo=0),
        Column("detector", "string", ucd="meta.id;instr.det", doc="detector name"),
        Column("channel", "string", ucd="instr", doc="channel", codes=CHANNELS),
        Column("band", "string", ucd="instr.bandpass", doc="passband name"),
        Column("ra", "float64", "deg", "pos.eq.ra", "right ascension of the detector's centre", 0.0, 360.0),
        Column("dec", "float64", "deg", "pos.eq.dec", "declination of the detector's centre", -90.0, 90.0),
        Column("s_region", "string", ucd="pos.outline;obs.field", doc="footprint, STC-S polygon in ICRS"),
        Column("mission", "string", ucd="meta.code", doc="fingerprint of the mission configuration"),
        Column("sources", "int64", ucd="meta.number", doc="number of sources drawn", lo=0),
    ),
    "Published images and truth maps.",
    key=("path",),
)

EXPOSURE_FILES = Table(
    "exposure_files",
    1,
    (
        Column("path", "string", ucd="meta.ref.uri", doc="file, relative to this version of the table"),
        Column("exposure_id", "int64", ucd="meta.id;obs.exposure", doc="exposure", lo=0),
        Column("channel", "string", ucd="instr", doc="channel", codes=CHANNELS),
        Column("band", "string", ucd="instr.bandpass", doc="passband name"),
        Column("ra", "float64", "deg", "pos.eq.ra", "right ascension of the boresight", 0.0, 360.0),
        Column("dec", "float64", "deg", "pos.eq.dec", "declination of the boresight", -90.0, 90.0),
        Column("detectors", "int32", ucd="meta.number", doc="detectors in the file", lo=1),
        Column("planned", "int32", ucd="meta.number", doc="detectors of the exposure that are planned", lo=1),
        Column("mission", "string", ucd="meta.code", doc="fingerprint of the mission configuration"),
        Column("sources", "int64", ucd="meta.number", doc="number of sources drawn, summed over the detectors", lo=0),
    ),
    "Published images of whole exposures: the science images of their detectors, one after the other.",
    key=("path",),
)
