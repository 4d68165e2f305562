"""Check tables of sources that are added to a given frame; their columns are the same as in the section `sources`.

A frame has one band, in which `mag` is the AB magnitude. Columns that describe spectra are therefore allowed, but have
no effect. The extinction `a_v` must be 0, and galaxies cannot have images (`stamp`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema import user_files
from lake_schema.arrays import Array, Float, Int
from lake_schema.errors import BadInput, Mistakes
from lake_schema.external import rows as external_rows
from lake_schema.external.mistakes import TableMistakes
from lake_schema.tables.galaxies import DISK_SCALE_HEIGHT
from lake_schema.texts import spelling
from truesky.catalogue import given_sources
from truesky.catalogue.external.ellipticity import CONVENTIONS, FRAMES
from truesky.catalogue.galaxies import morphology
from truesky.cosmology import FIDUCIAL
from truesky.request.files import SOURCES_KIND
from truesky.request.toml_values import refuse_name

TABLES = ("galaxies", "stars")
# Columns of galaxies that distinguish a table of galaxies from a table of stars, because stars do not have them.
_GALAXY_COLUMNS = ({*given_sources.GALAXIES} - {*given_sources.STARS}) | {"axis_ratio", "half_light_radius", "e1", "e2"}
# Columns that are allowed but have no effect, because they describe spectra.
_SPECTRA = ("z_true", "sed", "ext_law", "ebv", "teff")
# Columns that must have one value, with this value and the reason.
_FIXED = {
    "a_v": (0.0, "must be 0: give magnitudes that include the extinction"),
    "stamp": (-1.0, "must be -1: images of galaxies cannot be drawn"),
}
# Units of columns that may have units.
_UNITS = {
    "ra": "deg", "dec": "deg", "position_angle": "deg", "half_light_radius": "arcsec",
    "bulge_half_light_radius": "arcsec", "disk_half_light_radius": "arcsec",
}  # fmt: skip
# Whole numbers up to this one are exact as floating-point numbers.
_MAX_ID = 2.0**53


@dataclass(frozen=True, slots=True)
class InjectedRows:
    """Checked rows of a table of galaxies or stars.

    Attributes
    ----------
    name : str
        "galaxies" or "stars".
    ids : int array, shape (n,)
        Identifiers: the column `id`, by default the numbers of the rows, from 1.
    values : mapping of str to float array, shape (n,)
        Properties by name. Galaxies also have the `inclination` of their discs, deg.
    """

    name: str
    ids: Int
    values: Mapping[str, Float]


def read_rows(rows: Any, ellipticity: str | None = None, axes: str | None = None) -> list[InjectedRows]:
    """Return the checked rows of tables of galaxies and stars.

    Parameters
    ----------
    rows : table, str, Path or mapping
        A table (pandas, astropy, Arrow, or a mapping of columns), the path of a Parquet, FITS, CSV or HDF5 file, or a
        mapping of the names "galaxies" and "stars" to such tables. A single table with a column that only galaxies have
        contains galaxies, any other one stars.
    ellipticity : str, optional
        Convention of the columns e1 and e2, which must be given with these columns.
    axes : str, optional
        Axes of the ellipticities, such as "east_north".

    Returns
    -------
    list of InjectedRows
        The tables in the order galaxies, stars, without empty ones.

    Raises
    ------
    BadInput
        If a table cannot be read, a column is unknown or missing, or a value is missing or out of range.
    """
    for name, setting, allowed in (("ellipticity", ellipticity, CONVENTIONS), ("axes", axes, FRAMES)):
        if setting is not None and setting not in allowed:
            raise BadInput(f"{name}: {refuse_name(str(setting), allowed)}")
    settings = {key: value for key, value in (("ellipticity", ellipticity), ("frame", axes)) if value is not None}
    with Mistakes() as mistakes:
        checked = {
            name: mistakes.read(_check, columns, name, place, settings)
            for name, (place, columns) in read_columns(rows).items()
        }
    return [checked[name] for name in TABLES if name in checked and len(checked[name].ids)]


def read_columns(rows: Any, argument: str = "rows") -> dict[str, tuple[Path, dict[str, Float]]]:
    """Return the columns of tables of galaxies and stars, which are not checked.

    Parameters
    ----------
    rows : table, str, Path or mapping
        Tables as in `read_rows`.
    argument : str, optional
        Name of the argument with the tables, for messages.

    Returns
    -------
    dict of str to (Path, dict of str to float array)
        For "galaxies" and "stars", the name of the table for messages, and its columns by name.

    Raises
    ------
    BadInput
        If a table cannot be read.
    """
    tables = rows if isinstance(rows, Mapping) and rows and set(rows) <= set(TABLES) else {"": rows}
    named = {}
    with Mistakes() as mistakes:
        for given_name, table in tables.items():
            named_columns = mistakes.read(table_columns, table, given_name or argument)
            if named_columns is not None:
                titles = named_columns[1]
                is_galaxies = _GALAXY_COLUMNS & {*titles, *chain(*map(given_sources.find_columns, titles))}
                named[given_name or ("galaxies" if is_galaxies else "stars")] = named_columns
    return named


def _check(columns: Mapping[str, Array], name: str, place: Path, settings: Mapping[str, str]) -> InjectedRows:
    count = len(next(iter(columns.values()), ()))
    properties = {title: values for title, values in columns.items() if title != "id"}
    options = settings if "e1" in properties or "e2" in properties else {}
    if "e1" in properties and "ellipticity" not in settings:
        conventions = spelling.join_words(CONVENTIONS)
        raise BadInput(f"{place}: columns e1 and e2 require the argument ellipticity, their convention: {conventions}")
    # No distance follows from a redshift, because redshifts are ignored: any cosmology gives the same result.
    values = given_sources.check_arrays(properties, name, place, FIDUCIAL, options, _SPECTRA)
    mistakes = TableMistakes()
    for title, (allowed, text) in _FIXED.items():
        if title in values:
            mistakes.add_rows(place, 1, title, values[title] != allowed, values[title], text)
    ids = columns.get("id", np.arange(1.0, count + 1.0))
    is_wrong = ~((ids == np.floor(ids)) & (np.abs(ids) <= _MAX_ID))
    mistakes.add_rows(place, 1, "id", is_wrong, ids, "must be a whole number")
    mistakes.refuse()
    if name == "galaxies":
        values["inclination"] = morphology.inclination(values["disk_axis_ratio"], DISK_SCALE_HEIGHT)
    return InjectedRows(name, ids.astype(np.int64), {key: np.asarray(v, float) for key, v in values.items()})


def table_columns(
    table: Any, name: str, is_wanted: Callable[[str], bool] = lambda _: True
) -> tuple[Path, dict[str, Float]]:
    """Return the columns of a table as numbers.

    Parameters
    ----------
    table : table, str, Path or mapping
        A table (pandas, astropy, Arrow, or a mapping of columns), or the path of a Parquet, FITS, CSV or HDF5 file.
    name : str
        Name of the argument, for messages.
    is_wanted : callable, optional
        Function that returns True for the names of the columns to read. By default all are read.

    Returns
    -------
    (Path, dict of str to float array)
        The name of the table for messages, and its columns by name; missing values are NaN.

    Raises
    ------
    BadInput
        If the table cannot be read, a column has no numbers, or columns have different numbers of rows.
    """
    if isinstance(table, str | Path):
        return _columns_of_file(user_files.check_file(Path(table), SOURCES_KIND, name), is_wanted)
    place = Path(name)
    titles = [title for title in _titles(table, name) if is_wanted(title)]
    with Mistakes() as mistakes:
        columns = {title: mistakes.read(_numbers, table[title], f"{place}: column {title}", title) for title in titles}
    lengths = {title: len(values) for title, values in columns.items()}
    if len(set(lengths.values())) > 1:
        counts = ", ".join(map(str, lengths.values()))
        raise BadInput(f"{place}: columns {', '.join(lengths)} have different numbers of rows: {counts}")
    return place, columns


def _titles(table: Any, name: str) -> list[str]:
    for attribute in ("column_names", "colnames", "columns", "keys"):
        titles = getattr(table, attribute, None)
        if titles is not None and not isinstance(table, np.ndarray):
            return [str(title) for title in (titles() if callable(titles) else titles)]
    if isinstance(table, np.ndarray) and table.dtype.names:
        return list(table.dtype.names)
    kind, example = type(table).__name__, '{"ra": [53.1], "dec": [-27.8]}'
    raise BadInput(f"{name} must be a table, a mapping of columns or a file, got {kind}; for example: {example}")


def _columns_of_file(file: Path, is_wanted: Callable[[str], bool]) -> tuple[Path, dict[str, Float]]:
    titles = external_rows.column_names(file, SOURCES_KIND)
    if not titles:
        raise BadInput(f"{file}: has no columns")
    titles = [title for title in titles if is_wanted(title)]
    batches = list(external_rows.read_batches(file, titles, kind=SOURCES_KIND))
    empty = np.zeros(0)
    return file, {t: np.concatenate([empty, *(np.asarray(b.columns[t], float) for b in batches)]) for t in titles}


def _numbers(column: Any, where: str, title: str) -> Float:
    """Return a column as floating-point numbers in the unit of the property; missing values are NaN."""
    unit = getattr(column, "unit", None)
    try:
        if unit is not None and title in _UNITS:
            from astropy import units

            factor = units.Unit(unit).to(_UNITS[title])
            column = getattr(column, "value", column)
        else:
            factor = 1.0
            column = getattr(column, "value", column) if unit is not None else column
        values = column.to_numpy() if hasattr(column, "to_numpy") else column
        numbers = np.ma.filled(np.ma.asarray(values, float), np.nan) * factor
    except (TypeError, ValueError, ArithmeticError) as error:
        raise BadInput(f"{where} must hold numbers: {' '.join(str(error).split())[:200]}") from None
    if numbers.ndim != 1:
        got = "one number" if numbers.ndim == 0 else f"an array of shape {numbers.shape}"
        remedy = f": write [{column}]" if numbers.ndim == 0 else ""
        raise BadInput(f"{where} must be one number per row, got {got}{remedy}")
    return np.asarray(numbers)
