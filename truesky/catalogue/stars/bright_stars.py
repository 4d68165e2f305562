"""Read the bright stars of the Tycho-2 catalogue, which replace drawn stars brighter than V = 11 (hand-over magnitude).

The files are tyc2.dat and suppl_1.dat (the first supplement) of Tycho-2, or FITS versions of these files.

References
----------
Hog et al. 2000 (Tycho-2, CDS I/259)
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from lake_schema import sky, user_files
from lake_schema.arrays import Array, Float, Int
from lake_schema.errors import BadInput
from lake_schema.fits import external
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store.provenance import file_sha256
from truesky.catalogue import parameters
from truesky.fluxes.libraries.stellar import StellarTypes
from truesky.numerics.cache import cached_arrays, content_key
from truesky.numerics.code_fingerprints import code_key

# Number of fields between the bars of a record of each file, and indices of the fields: mean position (ra, dec),
# observed position (ra, dec), B_T magnitude, V_T magnitude.
_FIELDS = {"tyc2.dat": (32, (2, 3), (24, 25), 17, 19), "suppl_1.dat": (18, (2, 3), (2, 3), 11, 13)}
# Possible column names in FITS versions of the files: mean position (ra, dec), observed position (ra, dec), B_T, V_T.
_TITLES = (
    (("RAmdeg", "mRAdeg"), ("DEmdeg", "mDEdeg")),
    (("RAdeg", "RA(ICRS)", "RA_ICRS_", "RA"), ("DEdeg", "DE(ICRS)", "DE_ICRS_", "DE")),
    ("BTmag", "BT"),
    ("VTmag", "VT"),
)
# Smallest and largest magnitude that a file may have; Sirius has -1.1, and the faintest star of the catalogue 16.
MAGNITUDES = (-3.0, 20.0)
_NUMBER = r"^[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$"
_KIND, _LONGEST_LINE = "catalogue of stars", 1000


@dataclass(frozen=True, slots=True, eq=False)
class BrightStars:
    """Tycho-2 stars brighter than the hand-over magnitude, sorted by position.

    Attributes
    ----------
    hand_over : float
        Observed V magnitude (Vega) above which drawn stars are used instead.
    index : int array, shape (n,)
        Position: nested index of the HEALPix cell of order 29.
    ra, dec : float array, shape (n,)
        J2000 position, deg.
    mag_v, color_bv : float array, shape (n,)
        Observed Johnson V and B - V (Vega), mag.
    record_count : int
        Number of records of the files.
    without_color, without_magnitude : int
        Number of records with only one of the magnitudes B_T and V_T, and number of records with neither.
    """

    hand_over: float
    index: Int
    ra: Float
    dec: Float
    mag_v: Float
    color_bv: Float
    record_count: int
    without_color: int
    without_magnitude: int


def sha256(files: tuple[Path, ...]) -> list[str]:
    """Return the SHA-256 of each file. Raises BadInput if a file does not exist."""
    return [file_sha256(user_files.check_file(file, _KIND, "stars.tycho2")) for file in files]


def load(files: tuple[Path, ...], checksums: list[str]) -> BrightStars:
    """Read the Tycho-2 stars brighter than the hand-over magnitude, from the disc cache if they have been read before.

    `checksums` is the SHA-256 of each file, by which the cache recognises the files. Raises BadInput if a file has
    another format, or a value that is not a number or not on the sky; the message names the file and the record.
    """
    key = content_key(code_key(__name__), *checksums)
    arrays = cached_arrays("tycho2", key, lambda: _read(files))
    index, ra, dec, mag_v, color_bv = (arrays[name] for name in ("index", "ra", "dec", "mag_v", "color_bv"))
    counts = arrays["counts"].tolist()
    return BrightStars(_numbers()["hand_over"], index, ra, dec, mag_v, color_bv, *counts)


def rows_of_cell(stars: BrightStars, cell: int) -> slice:
    """Return the range of rows whose stars are in an order-8 cell (nested index)."""
    first, last = np.searchsorted(stars.index, sky.cell_range(GENERATION_ORDER, cell))
    return slice(int(first), int(last))


def columns(stars: BrightStars, rows: slice, types: StellarTypes) -> dict[str, Any]:
    """Return columns of table `stars` for Tycho-2 stars.

    Each star gets the template spectrum, the V - H colour and the temperature of the stellar type with the nearest
    B - V. Columns with unknown values are masked.

    Parameters
    ----------
    stars : BrightStars
        All stars.
    rows : slice
        Range of the rows to return, n rows.
    types : StellarTypes
        Stellar types of the template library.

    Returns
    -------
    dict of str to array, shape (n,)
        Columns by name.
    """
    nearest = np.abs(types.color_bv - stars.color_bv[rows, None]).argmin(1)
    blank = masked_column(nearest.size)
    return {
        "sed": nearest,
        "mag_h": stars.mag_v[rows] - types.v_minus_h[nearest],
        "teff": types.teff[nearest],
        "abs_mag_h": blank,
        "distance": blank,
        "log_g": blank,
        "metallicity": blank,
    }


def masked_column(n: int) -> np.ma.MaskedArray[Any, Any]:
    """Return a column of n masked (unknown) values."""
    return np.ma.MaskedArray(np.zeros(n, np.int64), mask=True)


def _numbers() -> dict[str, Any]:
    return parameters.section("milky_way.toml", "bright_stars")


def _read(files: tuple[Path, ...]) -> dict[str, Array]:
    numbers = _numbers()
    place, bt, vt = (np.concatenate(values, -1) for values in zip(*map(_records, files), strict=True))
    has_magnitude = np.isfinite(bt) | np.isfinite(vt)
    color = bt - vt
    without_color = has_magnitude & ~np.isfinite(color)
    color = np.where(without_color, numbers["usual_bt_vt"], color)
    mag_v = np.where(np.isfinite(vt), vt, bt - color) + numbers["v_per_color"] * color
    is_bright = has_magnitude & (mag_v < numbers["hand_over"])
    ra, dec = sky.check_positions(*place[:, is_bright])
    index = sky.healpix_29(ra, dec)
    order = np.argsort(index, kind="stable")
    return {
        "index": index[order],
        "ra": ra[order],
        "dec": dec[order],
        "mag_v": mag_v[is_bright][order],
        "color_bv": numbers["bv_per_color"] * color[is_bright][order],
        "counts": np.array([bt.size, without_color.sum(), np.sum(~has_magnitude)]),
    }


def _records(file: Path) -> tuple[Float, Float, Float]:
    """Read a file, and return positions (ra, dec, deg), shape (2, n), and B_T and V_T magnitudes (NaN if blank).

    The observed position is used if there is no mean position. Raises BadInput if a position is not on the sky, or a
    magnitude is out of range.
    """
    values = _read_fits(file) if file.suffix.lower() in (".fits", ".fit", ".fz") else _read_text(file)
    mean, observed = np.stack(values[:2]), np.stack(values[2:4])
    for name, magnitudes in (("B_T", values[4]), ("V_T", values[5])):
        is_wrong = ~np.isnan(magnitudes) & ~((magnitudes >= MAGNITUDES[0]) & (magnitudes <= MAGNITUDES[1]))
        if is_wrong.any():
            record = int(is_wrong.argmax())
            allowed = f"must be from {MAGNITUDES[0]:g} to {MAGNITUDES[1]:g} mag"
            raise BadInput(f"{file}: {name} of record {record + 1} is {magnitudes[record]:g}, but {allowed}")
    place = np.where(np.isfinite(mean), mean, observed)
    bad = ~((place[0] >= 0.0) & (place[0] <= 360.0) & (np.abs(place[1]) <= 90.0))
    if bad.any():
        record = int(bad.argmax())
        where = f"{place[0, record]:g}, {place[1, record]:g}"
        raise BadInput(
            f"{file}: record {record + 1} lies at {where}, which is not on the sky ({bad.sum()} bad records)"
        )
    return place, values[4], values[5]


def _read_text(file: Path) -> list[Float]:
    with user_files.open_file(file, _KIND) as stream:
        line = stream.readline(_LONGEST_LINE)
    if len(line) == _LONGEST_LINE:
        # Refuse a long first line, because the CSV reader would allocate memory for each of its fields.
        raise BadInput(f"{file}: the first record has {_LONGEST_LINE} characters or more, must have fewer")
    count = line.count(b"|") + 1
    layouts = [layout for layout in _FIELDS.values() if layout[0] == count]
    if not layouts:
        raise BadInput(f"{file}: records have {count} fields between bars, must have 32 (tyc2.dat) or 18 (suppl_1.dat)")
    _, mean, observed, bt, vt = layouts[0]
    names = [f"f{k}" for k in (*mean, *observed, bt, vt)]
    unique_names = list(dict.fromkeys(names))
    try:
        rows = csv.read_csv(
            file,
            csv.ReadOptions(autogenerate_column_names=True),
            csv.ParseOptions(delimiter="|", quote_char=False),
            csv.ConvertOptions(include_columns=unique_names, column_types=dict.fromkeys(unique_names, pa.string())),
        )
    except pa.ArrowException as error:
        raise BadInput(f"{file}: {' '.join(str(error).split())[:200]}") from None
    return [_parse_floats(file, rows[name]) for name in names]


def _parse_floats(file: Path, texts: pa.ChunkedArray) -> Float:
    trimmed = pc.utf8_trim_whitespace(texts)
    blank = pc.equal(trimmed, "")
    invalid = pc.invert(pc.or_(blank, pc.match_substring_regex(trimmed, _NUMBER)))
    if pc.any(invalid).as_py():
        record = pc.index(invalid, True).as_py()
        text = repr(trimmed[record].as_py())[:40]
        raise BadInput(f"{file}: record {record + 1}: {text} is not a number ({pc.sum(invalid).as_py()} bad records)")
    return np.asarray(pc.cast(pc.if_else(blank, None, trimmed), pa.float64()).to_numpy(), float)


def _read_fits(file: Path) -> list[Float]:
    mean, observed, bt, vt = _TITLES
    table = external.read_numbers(file, _KIND)
    file_columns = [_first_present(table, titles) for titles in (*mean, *observed, bt, vt)]
    for titles, values in zip((bt, vt), file_columns[4:], strict=True):
        if values is None:
            raise BadInput(f"{file}: has no column {' or '.join(titles)}; it has {', '.join(table)}")
    blank = np.full(len(file_columns[4]), np.nan)
    return [blank if values is None else values for values in file_columns]


def _first_present(table: dict[str, Float], titles: tuple[str, ...]) -> Any:
    return next((table[title] for title in titles if title in table), None)
