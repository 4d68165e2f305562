"""Read a star catalogue of the user, such as an output of the Besancon model, which replaces the drawn stars.

A catalogue is a text or FITS table, whose column names are given by the request. A text table has fields separated by
blanks or commas below a line with the column names. Lines before this line are ignored. The table ends at the first
line with another number of fields.
"""

from __future__ import annotations

import re
from array import array
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import TextIOWrapper
from itertools import islice
from pathlib import Path

import numpy as np
import numpy.typing as npt

from lake_schema import sky, user_files
from lake_schema.arrays import Array, Float, Int
from lake_schema.errors import BadInput, refuse_mistakes
from lake_schema.external.files import check_column_names
from lake_schema.external.mistakes import TableMistakes, find_out_of_bounds
from lake_schema.fits import external
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store.provenance import canonical
from lake_schema.texts import spelling, synonyms
from truesky.catalogue import parameters
from truesky.numerics.cache import cached_arrays, content_key
from truesky.numerics.code_fingerprints import code_key

# Lowest and highest valid value of each property that a catalogue can contain. _REQUIRED_KEYS lists groups of which
# exactly one property is required.
KEYS = {
    "ra": (-360.0, 360.0), "dec": (-90.0, 90.0),  # deg, ICRS
    "l": (-360.0, 360.0), "b": (-90.0, 90.0),  # deg, Galactic
    "mag_h": (-10.0, 40.0),  # 2MASS H, Vega, before extinction
    "mag_h_seen": (-10.0, 60.0),  # 2MASS H, Vega, with the extinction a_v
    "teff": (300.0, 1e5),  # K
    "log_teff": (2.4, 5.0),
    "distance": (0.0, 1e6),  # pc
    "distance_kpc": (0.0, 1e3),
    "log_g": (-1.0, 10.0),
    "metallicity": (-5.0, 1.5),  # [M/H]
    "a_v": (0.0, 40.0),  # extinction A(V) by the Milky Way, mag, R_V = 3.1; by default from the dust map
    "age_class": (1.0, 10.0),  # code of the Besancon model: 1-7 thin disc, 8 thick disc, 9 spheroid, 10 bulge
    "luminosity_class": (1.0, 7.0),  # code of the Besancon model: 1-3 giants; 4, 5, 7 main sequence; 6 white dwarfs
}  # fmt: skip
_REQUIRED_KEYS = (("ra", "l"), ("dec", "b"), ("mag_h", "mag_h_seen"), ("teff", "log_teff"))
_COMPONENT = np.array([0] * 8 + [1, 2, 5])
_STAGE = np.array([0, 1, 1, 1, 0, 0, 2, 0])
_LONGEST_LINE = 100_000
# The line with the column names must be among this number of lines at the beginning of the file. Programs such as the
# Besancon model write their settings before it.
_MAX_HEADER_LINES = 10_000
KIND = "catalogue of stars"


@dataclass(frozen=True, slots=True, eq=False)
class StarCatalogue:
    """Stars of a user's catalogue, sorted by position.

    Attributes
    ----------
    index : int array, shape (n,)
        Position: nested index of the HEALPix cell of order 29.
    values : mapping of str to array, shape (n,)
        Properties that the file contains, by name: ra, dec (deg), mag_h (Vega, without extinction), teff (K), and if
        present distance (pc), log_g (cm s-2), metallicity ([M/H]), a_v (mag), component (code of the population, such
        as the thin disc) and stage (code of the evolutionary stage).
    """

    index: Int
    values: Mapping[str, Array]


def check_columns(columns: Mapping[str, str]) -> None:
    """Raise BadInput if a mapping from properties to column names is incomplete, or has properties not in `KEYS`.

    Required are a position, an H magnitude and a temperature. A magnitude with extinction also requires the extinction.
    """
    path = "stars.catalogue.columns"
    messages = [
        f"{path}.{key} is not a known property: {spelling.choices(key, list(KEYS))}"
        for key in columns
        if key not in KEYS
    ]
    for alternatives in _REQUIRED_KEYS:
        if sum(key in columns for key in alternatives) != 1:
            messages.append(f"{path} must have one of {' and '.join(alternatives)}")
    if ("ra" in columns) != ("dec" in columns):
        messages.append(f"{path} must have ra and dec, or l and b")
    if "mag_h_seen" in columns and "a_v" not in columns:
        messages.append(f"{path}: mag_h_seen requires a_v")
    refuse_mistakes(messages)


def load(file: Path, sha256: str, columns: Mapping[str, str]) -> StarCatalogue:
    """Read and check the stars of a catalogue, or map them from the disc cache if the file has been read before.

    Parameters
    ----------
    file : Path
        File of the catalogue: FITS (.fits or .fit), otherwise text.
    sha256 : str
        SHA-256 of the file, by which the cache recognises it.
    columns : mapping of str to str
        Column name in the file by property; `check_columns` checks it.

    Returns
    -------
    StarCatalogue
        The stars.

    Raises
    ------
    BadInput
        If the file cannot be read or has no such columns, or if a value is missing or outside the range in `KEYS`. For
        values, there is one message for each column, with the file, the first bad row, and the number of further ones.
    """
    key = content_key(code_key(__name__), sha256, canonical(dict(columns)))
    arrays = cached_arrays("star_catalogue", key, lambda: _read(file, columns))
    return StarCatalogue(arrays["index"], {name: values for name, values in arrays.items() if name != "index"})


def star_counts(stars: StarCatalogue, cells: npt.ArrayLike) -> Float:
    """Return the number of the catalogue's stars in order-8 cells (nested indices), as floats."""
    edges = np.stack([np.asarray(cells, np.int64), np.asarray(cells, np.int64) + 1])
    first, last = np.searchsorted(stars.index, edges << 2 * (sky.MAX_ORDER - GENERATION_ORDER))
    return np.asarray(last - first, float)


def stars_of_cell(stars: StarCatalogue, cell: int) -> dict[str, Array]:
    """Return the stars in an order-8 cell: their order-29 cells as `index`, and the properties in `stars.values`."""
    rows = slice(*np.searchsorted(stars.index, sky.cell_range(GENERATION_ORDER, cell)))
    return {"index": stars.index[rows], **{name: values[rows] for name, values in stars.values.items()}}


def _read(file: Path, columns: Mapping[str, str]) -> dict[str, Array]:
    try:
        table = _read_table(file, list(columns.values()))
    except BadInput as error:
        raise error.with_prefix("stars.catalogue") from None
    labels = {key: title if title == key else f"{title} ({key})" for key, title in columns.items()}
    find_out_of_bounds(
        file,
        {labels[key]: table[title] for key, title in columns.items()},
        {labels[key]: KEYS[key] for key in columns},
    ).refuse()
    values: dict[str, Array] = {key: table[title] for key, title in columns.items()}
    if "l" in values:
        values["ra"], values["dec"] = sky.equatorial(values.pop("l"), values.pop("b"))
    values["ra"], values["dec"] = sky.check_positions(values["ra"], values["dec"])
    if "log_teff" in values:
        values["teff"] = 10.0 ** values.pop("log_teff")
    if "distance_kpc" in values:
        values["distance"] = 1e3 * values.pop("distance_kpc")
    if "mag_h_seen" in values:
        values["mag_h"] = values.pop("mag_h_seen") - _h_over_v() * values["a_v"]
    if "age_class" in values:
        values["component"] = _COMPONENT[values.pop("age_class").astype(int)]
    if "luminosity_class" in values:
        values["stage"] = _STAGE[values.pop("luminosity_class").astype(int)]
    values["index"] = sky.healpix_29(values["ra"], values["dec"])
    order = np.argsort(values["index"], kind="stable")
    return {key: column[order] for key, column in values.items()}


def _h_over_v() -> float:
    return float(parameters.section("milky_way.toml", "extinction")["h_over_v"])


def _read_table(file: Path, titles: list[str]) -> Mapping[str, Float]:
    if file.suffix.lower() in (".fits", ".fit"):
        columns = external.read_numbers(file, KIND)
        if absent := [title for title in titles if title not in columns]:
            listed = ", ".join(f"{title}{synonyms.suggest_title(title, list(columns))}" for title in absent)
            raise BadInput(f"{file}: has no column {listed}; it has {', '.join(columns)}")
        return columns
    return _read_text(file, titles)


def _read_text(file: Path, titles: list[str]) -> Mapping[str, Float]:
    with user_files.open_file(file, KIND) as binary, TextIOWrapper(binary, "utf-8", "replace") as stream:
        lines = iter(lambda: stream.readline(_LONGEST_LINE), "")
        head: list[str] = []
        similar: list[str] = []
        previous: list[str] = []
        probable_head: list[str] = []
        for line in islice(lines, _MAX_HEADER_LINES):
            candidate = _split_line(line)
            if set(titles) <= set(candidate):
                head = candidate
                break
            similar = max(similar, candidate, key=lambda names: len(set(titles) & set(names)))
            if not probable_head and len(candidate) == len(previous) > 1 and _has_number(candidate):
                probable_head = [] if _has_number(previous) else previous
            previous = candidate
        if not head:
            # The line with the names of the columns has at least half of them.
            if 2 * len(set(titles) & set(similar)) >= len(set(titles)):
                check_column_names(file, similar, titles)
            if probable_head:
                check_column_names(file, probable_head, titles)
            raise BadInput(f"{file}: none of the first {_MAX_HEADER_LINES} lines has the columns {', '.join(titles)}")
        if duplicates := [title for title in titles if head.count(title) > 1]:
            raise BadInput(f"{file}: the column name {duplicates[0]} must not occur twice")
        values, mistakes = {title: array("d") for title in titles}, TableMistakes()
        for line in lines:
            fields = _split_line(line)
            if len(fields) != len(head):
                break
            for title in titles:
                text = fields[head.index(title)]
                try:
                    values[title].append(float(text))
                except ValueError:
                    values[title].append(np.nan)
                    problem = f"column {title} of row {len(values[title])} is {text[:40]!r}, must be a number"
                    mistakes.add_row(file, title, "number", f"{file}: {problem}")
    mistakes.refuse()
    return {title: np.array(column) for title, column in values.items()}


def _has_number(fields: Sequence[str]) -> bool:
    return any(re.fullmatch(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", field, re.IGNORECASE) for field in fields)


def _split_line(line: str) -> list[str]:
    return [field.strip() for field in line.split(",")] if "," in line else line.split()
