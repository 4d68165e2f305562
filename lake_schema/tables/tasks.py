"""Declaration of the table `tasks`: the images to simulate, one row per detector of an exposure.

A row contains the position of the detector on the sky, and the predicted CPU time, memory and file size.
"""

from __future__ import annotations

from lake_schema.columns import Column, Table
from lake_schema.tables.exposures import CHANNELS

TASKS = Table(
    "tasks",
    1,
    (
        Column("exposure_id", "int64", ucd="meta.id;obs.exposure", doc="exposure of the detector", lo=0),
        Column("detector", "string", ucd="meta.id;instr.det", doc="detector name"),
        Column("channel", "string", ucd="instr", doc="channel", codes=CHANNELS),
        Column("ra", "float64", "deg", "pos.eq.ra", "right ascension of the detector's centre", 0.0, 360.0),
        Column("dec", "float64", "deg", "pos.eq.dec", "declination of the detector's centre", -90.0, 90.0),
        Column(
            "radius",
            "float64",
            "deg",
            "phys.angSize",
            "circle about the centre: every source seen in it must be known",
            0.0,
            10.0,
        ),
        Column("cells", "list<int64>", ucd="pos.healpix", doc="order-8 cells (nested) that this circle touches"),
        Column("s_region", "string", ucd="pos.outline;obs.field", doc="footprint, STC-S polygon in ICRS"),
        Column("sources", "int64", ucd="meta.number", doc="predicted number of sources drawn", lo=0),
        Column(
            "seconds",
            "float64",
            "s",
            "time.duration",
            "predicted time of one core, of the machine that costs were measured on",
            0.0,
        ),
        Column("memory", "float64", "GB", "", "predicted peak memory", 0.0),
        Column("bytes", "int64", "byte", "", "predicted size of the products", lo=0),
    ),
    "Render tasks, longest first.",
    key=("exposure_id", "detector"),
)
