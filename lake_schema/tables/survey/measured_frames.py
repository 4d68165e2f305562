"""Declaration of the table `measured_frames`: sky and noise of rendered frames, and their bad pixels on the sky.

Depth maps take these values in place of the predicted ones.
"""

from __future__ import annotations

from lake_schema.columns import Column, Table
from lake_schema.tables.exposures import CHANNELS

MEASURED_FRAMES = Table(
    "measured_frames",
    1,
    (
        Column("exposure_id", "int64", ucd="meta.id;obs.exposure", doc="exposure", lo=0),
        Column("detector", "string", ucd="meta.id;instr.det", doc="detector name"),
        Column("channel", "string", ucd="instr", doc="channel", codes=CHANNELS),
        Column("band", "string", ucd="instr.bandpass", doc="passband name"),
        Column(
            "sky",
            "float64",
            "electron pix-1 s-1",
            "instr.skyLevel",
            "rate of the sky per detector pixel; missing if the frame has no blank sky",
            nullable=True,
        ),
        Column(
            "variance",
            "float64",
            "electron2 pix-1",
            "stat.variance;instr.background",
            "variance of a pixel of blank sky without interpixel capacitance; missing if there is no blank sky",
            0.0,
            nullable=True,
        ),
        Column("planned_sky", "float64", "electron pix-1 s-1", "instr.skyLevel", "the sky that the plan predicts", 0.0),
        Column(
            "planned_variance",
            "float64",
            "electron2 pix-1",
            "stat.variance;instr.background",
            "the variance that the plan predicts",
            0.0,
        ),
        Column(
            "good", "float64", "", "stat.filling;instr.det", "fraction of the detector's pixels that are good", 0.0, 1.0
        ),
        Column("blank", "int64", ucd="meta.number", doc="good pixels of blank sky, which were measured", lo=0),
        Column(
            "bad_pixels",
            "list<int64>",
            ucd="pos.healpix",
            doc="HEALPix pixels of order 14 (nested) of whose area at least 1 % is on bad pixels of the detector",
        ),
        Column(
            "saturated",
            "list<int64>",
            ucd="pos.healpix",
            doc="HEALPix pixels of order 14 (nested) with a saturated pixel of the detector",
        ),
    ),
    "Sky, noise and bad pixels of the rendered frames that count for depth maps, measured on the calibrated frames.",
    key=("exposure_id", "detector"),
)
