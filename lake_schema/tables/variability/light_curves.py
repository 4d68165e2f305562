"""Declaration of the table `light_curves`: the fluxes of sources that change in the planned exposures of a request."""

from __future__ import annotations

from lake_schema.columns import Column, Table

SUPERNOVA, VARIABLE_STAR, QUASAR, NUCLEUS, LENSED_SUPERNOVA, LENSED_QUASAR = range(1, 7)
SOURCE_TYPES = (
    (SUPERNOVA, "supernova, in table transients"),
    (VARIABLE_STAR, "variable star, in stars"),
    (QUASAR, "quasar, in galaxies and active_nuclei"),
    (NUCLEUS, "nucleus in a galaxy: point_id of active_nuclei"),
    (LENSED_SUPERNOVA, "image of a lensed supernova, in lensed_images"),
    (LENSED_QUASAR, "image of a lensed quasar, in lensed_images"),
)

LIGHT_CURVES = Table(
    "light_curves",
    1,
    (
        Column("exposure_id", "int64", ucd="meta.id;obs.exposure", doc="exposure", lo=0),
        Column("detector", "string", ucd="meta.id;instr.det", doc="detector name"),
        Column("id", "int64", ucd="meta.id;meta.main", doc="source, as in rendered_truth", lo=0),
        Column("source_type", "int8", ucd="src.class", doc="type of source", codes=SOURCE_TYPES, lo=1, hi=6),
        Column("band", "string", ucd="instr.bandpass", doc="passband of the exposure"),
        Column("mjd", "float64", "d", "time.epoch;obs.exposure", "middle of the exposure, MJD (UTC)", 0.0, 2e5),
        Column(
            "f_nu", "float32", "uJy", "phot.flux.density", "band-averaged f_nu at this date, as the image has it", 0.0,
        ),
        Column(
            "f_nu_mean", "float32", "uJy", "phot.flux.density;stat.mean",
            "mean of f_nu over time, for stars and quasars as in the tables of fluxes; null for supernovae", 0.0,
            nullable=True,
        ),
        Column("x", "float64", "pix", "pos.cartesian.x;instr.det", "column, 0 = centre of the first pixel"),
        Column("y", "float64", "pix", "pos.cartesian.y;instr.det", "row, 0 = centre of the first pixel"),
    ),
    "Fluxes of the sources that change, in each planned exposure and on the detector that they fall on.",
    key=("exposure_id", "detector", "id"),
)  # fmt: skip
