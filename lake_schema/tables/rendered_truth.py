"""Table `rendered_truth`: what was drawn where, one row a source of a detector.

Of sources beside it that send in no more than the faint wings beyond their stamps there is none, but of stars whose
spikes may be noticed.
"""

from __future__ import annotations

from lake_schema.columns import Column, Table

METHODS = (
    (0, "a point, through the PSF at its place"),
    (1, "a profile, convolved with the PSF at its place"),
    (2, "a strong lens' picture, convolved with the PSF at its place"),
    (3, "a trail of a moving point, in pieces, each through the PSF at its place"),
)


def _trail(axis: str, doc: str) -> Column:
    return Column(f"trail_{axis}", "float64", "pix", f"pos.cartesian.{axis};instr.det", doc, nullable=True, since=2)


RENDERED_TRUTH = Table(
    "rendered_truth",
    2,
    (
        Column("exposure_id", "int64", ucd="meta.id;obs.exposure", doc="exposure", lo=0),
        Column("detector", "string", ucd="meta.id;instr.det", doc="detector name"),
        Column(
            "id",
            "int64",
            ucd="meta.id;meta.main",
            doc="source, as in the catalogues; kind 6: a moving body; kind 5, member 1: a standard star",
            lo=0,
        ),
        Column("x", "float64", "pix", "pos.cartesian.x;instr.det", "column, 0 = centre of the first pixel"),
        Column("y", "float64", "pix", "pos.cartesian.y;instr.det", "row, 0 = centre of the first pixel"),
        Column("expected", "float64", "electron", "phot.count", "in the exposure, on and off the detector", 0.0),
        Column("drawn", "float64", "electron", "phot.count;instr.det", "of its stamp, on pixels that are read"),
        Column(
            "stamp", "int32", "pix", "phys.angSize;instr.det", "side of the stamp; fainter wings are drawn beyond it", 1
        ),
        Column("method", "int8", "", "meta.code", "how it was drawn", codes=METHODS),
        _trail("x", "it moves by, with (x, y) in the middle; of very long trails each row is of the part near"),
        _trail("y", "the same along the rows' axis"),
    ),
    "Sources of the rendered images: true places and electrons.",
    key=("exposure_id", "detector", "id"),
)
