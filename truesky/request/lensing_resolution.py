"""Choose the resolution of the lensing maps of a request that does not state it.

Coarse maps lack structure on small scales, so the two-point correlation xi+ of the shear is too small. The default is
the lowest resolution whose error of xi+ is small compared with the standard deviation of xi+ between fields as large as
the area of the request, at all separations from 1.5 to 48 arcmin. The allowed fraction depends on the accuracy of the
shape.
"""

from __future__ import annotations

import csv
from functools import cache
from pathlib import Path

from truesky.request.accuracy import SURVEY, Accuracy
from truesky.request.area import Area

# Table of errors and costs by resolution, written by benchmarks/trade.py. The last row is the highest resolution, with
# which all others are compared.
_TABLE = Path(__file__).with_name("lensing_resolution.csv")
# Largest error of xi+ in standard deviations between fields, for the accuracy of the shape "survey".
_LARGEST_ERROR = 2.0 / 3.0
# The largest error increases with this power of the accuracy of the shape; for "draft" it is 2.2 times larger.
_POWER = 1.0 / 3.0


def default_nside(area: Area, accuracy: Accuracy) -> int:
    """Return the HEALPix N_side of the lensing maps of a request without the key `universe.lensing_nside`.

    Parameters
    ----------
    area : Area
        Area of the request.
    accuracy : Accuracy
        Accuracy of the request; only its number for the shape matters.

    Returns
    -------
    int
        N_side, from 64 to 1024.
    """
    allowed = _LARGEST_ERROR * (accuracy.shape / SURVEY.shape) ** _POWER
    table = rows()
    square_degrees = area.square_degrees()
    for row in table[:-1]:
        if relative_error(row) * square_degrees**0.5 <= allowed:
            return int(row["nside"])
    return int(table[-1]["nside"])


def relative_error(row: dict[str, float]) -> float:
    """Return the largest error of xi+ of a row of `rows`, in standard deviations of xi+ between fields of 1 deg2."""
    scatter = rows()[-1]
    bins = [name for name in row if name.startswith("xi_plus_") and not name.endswith("_held")]
    return max(abs(row[name]) / scatter[name] for name in bins)


@cache
def rows() -> tuple[dict[str, float], ...]:
    """Return the rows of lensing_resolution.csv by column name, from the lowest to the highest resolution.

    `shear_rms` is the rms error of a component of the shear, `xi_plus_<arcmin>` the error of xi+ in the octave
    from this separation, relative to theory. Columns that end with ``_held`` were measured for another seed and other
    positions. `cpu_s` and `gb` are the cost of the maps of all source planes. The last row has the rms of the
    shear itself in `shear_rms`, and the standard deviation of xi+ between fields of 1 deg2 in `xi_plus_<arcmin>`.
    """
    with _TABLE.open(newline="", encoding="utf-8") as lines:
        read = csv.DictReader(line for line in lines if not line.startswith("#"))
        return tuple({name: float(value) for name, value in row.items()} for row in read)
