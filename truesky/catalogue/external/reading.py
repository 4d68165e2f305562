"""Read a user's tables with a mapping of their columns, and check every value.

The tables are read in batches. If a value is wrong, the rest of the files is only checked, and one error reports all
mistakes: the file, the column and the first row of each, see `lake_schema.external.mistakes`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from lake_schema import user_files
from lake_schema.arrays import Array
from lake_schema.errors import BadInput, Mistakes, bad_input
from lake_schema.external import rows as external_rows
from lake_schema.external.files import check_column_names
from lake_schema.external.mistakes import TableMistakes, format_number, format_range
from lake_schema.external.rows import RowBatch
from lake_schema.tables.galaxies import GALAXIES
from truesky.catalogue.external import ellipticity
from truesky.catalogue.external.mapping import (
    GALAXY_BOUNDS,
    IDENTIFIER_KEYS,
    INTEGER_KEYS,
    MIN_AXIS_RATIO,
    WHOLE_GALAXY,
    Columns,
    Field,
    companion_file,
    factor_of_unit,
    flux_entry,
    parse_unit,
    unit_of,
)
from truesky.cosmology import Z_MAX, Cosmology

# Redshift from which the distances of galaxies with smaller redshifts are computed.
MIN_REDSHIFT = 1e-4
# Path of a key of a request, and largest number of keys whose missing columns have a message each.
_IS_KEY, _MAX_KEYS = re.compile(r"[\w.]+"), 6


@dataclass(frozen=True, slots=True)
class Rows:
    """Checked rows of one file of a user's table.

    Attributes
    ----------
    file : Path
        The file.
    first : int
        Number of the first of these rows in the file, from which error messages count.
    values : mapping of str to array
        Values by name of the property.
    """

    file: Path
    first: int
    values: Mapping[str, Array]


def read(files: Sequence[Path], columns: Columns, kind: str = "catalogue") -> Iterator[Rows]:
    """Yield the rows of files in batches, as checked values by property.

    Parameters
    ----------
    files : sequence of Path
        Files of the table, without companion files.
    columns : Columns
        Mapping from the columns of the files to properties.
    kind : str, optional
        Type of file, a key of `user_files.MAX_BYTES`, which limits its size.

    Yields
    ------
    Rows
        Codes, template indices and stamp numbers are int64, most other values float64. Properties of a whole galaxy,
        such as `e1` and `e2`, become properties of its bulge and disc.

    Raises
    ------
    BadInput
        If a value is missing or out of range, a column is missing, a unit is wrong, or a companion file has other rows.
        After the first mistake, no further rows are yielded. The error is raised after all files have been checked, or
        after the first file that cannot be read, and has one message for each column and kind of mistake.
    """
    mistakes = TableMistakes()
    for file in files:
        try:
            for piece, present in _read_file(file, columns, kind, mistakes):
                values = check_batch(piece, present, mistakes)
                if not mistakes:
                    yield Rows(file, piece.first_row, values)
        except BadInput as error:
            # Other files probably have the same mistake, for example a missing column.
            mistakes.add(error)
            break
    mistakes.refuse()


def _read_file(file: Path, columns: Columns, kind: str, mistakes: TableMistakes) -> Iterator[tuple[RowBatch, Columns]]:
    """Yield the batches of a file, and the mapping without the properties whose columns are missing in the file."""
    try:
        yield from _read_batches(file, columns, kind)
    except BadInput as error:
        names = external_rows.column_names(file, kind)
        present = _with_present_columns(names, columns)
        if len(present.fields) == len(columns.fields):
            raise
        missing = {key: field for key, field in columns.fields.items() if key not in present.fields}
        error = _with_keys(error, file, replace(columns, fields=missing), names)
        if not present.fields:
            raise error from None
        mistakes.add(error)
        yield from _read_batches(file, present, kind)


def _with_keys(error: BadInput, file: Path, missing: Columns, names: Sequence[str]) -> BadInput:
    """Return an error about missing columns of a file with the keys of the request that name them.

    `missing` has the properties whose columns are missing, and `names` are the columns of the file.
    """
    if not _IS_KEY.fullmatch(missing.path):
        return error
    if len(missing.fields) > _MAX_KEYS:
        return error.with_prefix(missing.path)
    listed = Mistakes()
    for key, field in missing.fields.items():
        try:
            check_column_names(file, names, field.titles())
        except BadInput as absent:
            listed.add(absent.with_prefix(f"{missing.path}.{key}"))
    return bad_input(listed.messages)


def _read_batches(file: Path, columns: Columns, kind: str) -> Iterator[tuple[RowBatch, Columns]]:
    identifier_columns = [columns.fields[key].column for key in IDENTIFIER_KEYS if key in columns.fields]
    pieces = external_rows.read_batches(file, columns.titles(in_companion=False), identifier_columns, kind=kind)
    for piece in _with_companion(file, pieces, columns) if columns.companion_prefixes else pieces:
        yield piece, _with_stored_units(piece, columns)


def _with_present_columns(names: Sequence[str], columns: Columns) -> Columns:
    """Return a mapping without the properties whose columns are not among the names of a file's columns."""
    return replace(
        columns,
        fields={
            key: field
            for key, field in columns.fields.items()
            if field.beside or all(title in names for title in field.titles())
        },
    )


def _with_stored_units(piece: RowBatch, columns: Columns) -> Columns:
    """Return a mapping that converts the units of a file to the units of the properties.

    Raises BadInput if a unit does not convert, or if it is not the unit that the mapping states.
    """
    fields = dict(columns.fields)
    with Mistakes() as mistakes:
        for key, field in columns.fields.items():
            if file_unit := piece.units.get(field.column, ""):
                fields[key] = mistakes.read(_with_stored_unit, piece.file, key, field, file_unit)
    return columns if fields == columns.fields else replace(columns, fields=fields)


def _with_stored_unit(file: Path, key: str, field: Field, file_unit: str) -> Field:
    where = f"{user_files.format_path(file)}: column {field.column}"
    if field.is_plain():
        try:
            return replace(field, scale=factor_of_unit(key, file_unit))
        except BadInput as error:
            raise BadInput(f"{where}{'' if field.column == key else f' ({key})'} {error}") from None
    if field.unit and parse_unit(file_unit, where) != parse_unit(field.unit, where):
        raise BadInput(f"{where} ({key}) has unit {file_unit!r}, but the mapping has {field.unit!r}")
    return field


def check_batch(piece: RowBatch, columns: Columns, mistakes: TableMistakes) -> dict[str, Array]:
    """Return the values of a batch of rows by property; after a mistake, the result is empty.

    Parameters
    ----------
    piece : RowBatch
        The rows.
    columns : Columns
        Mapping from the columns of the rows to properties.
    mistakes : TableMistakes
        Wrong values are added to it.

    Returns
    -------
    dict of str to array
        Values by name of the property, as in `Rows`.
    """
    rows = len(next(iter(piece.columns.values())))
    by_key = {key: _value(key, field, columns, piece.columns, rows) for key, field in columns.fields.items()}
    for k in "12":
        # If a template has the flux fraction 0, set its index and its dust to 0, because they may have invalid values.
        if f"frac_{k}" in by_key:
            dark = by_key[f"frac_{k}"] == 0.0
            for name in (f"sed_{k}", f"ext_law_{k}", f"ebv_{k}"):
                if name in by_key:
                    by_key[name] = np.where(dark, 0.0, by_key[name])
    _convert_ellipticities(piece, columns, by_key, mistakes)
    for key, values in by_key.items():
        _check_bounds(piece, key, columns, values, mistakes)
    _check_absolute_magnitude(piece, columns, by_key, mistakes)
    if mistakes:
        return {}
    for key in ("axis_ratio", "half_light_radius"):
        if key in by_key:
            values = by_key.pop(key)
            by_key |= {name: values for name in WHOLE_GALAXY[key] if name != "inclination"}
    return {key: values.astype(np.int64) if key in INTEGER_KEYS else values for key, values in by_key.items()}


def _convert_ellipticities(
    piece: RowBatch, columns: Columns, by_key: dict[str, Array], mistakes: TableMistakes
) -> None:
    """Replace the properties e1 and e2 by axis_ratio and position_angle."""
    if not {"e1", "e2"} <= set(by_key):
        return
    e1, e2 = by_key.pop("e1"), by_key.pop("e2")
    ratio = ellipticity.axis_ratio(columns.ellipticity, e1, e2)
    is_wrong = ~(ratio >= MIN_AXIS_RATIO * (1.0 - 1e-6))
    limit = ellipticity.largest(columns.ellipticity, MIN_AXIS_RATIO)
    allowed = f"must be at most {limit:.4g}, for an axis ratio of {MIN_AXIS_RATIO:g}"
    titles, noun = column_titles(columns, "e1", "e2"), "the ellipticity |e| from columns"
    mistakes.add_rows(piece.file, piece.first_row, titles, is_wrong, np.hypot(e1, e2), allowed, noun)
    by_key["axis_ratio"] = np.where(is_wrong, 1.0, np.clip(ratio, MIN_AXIS_RATIO, 1.0))
    by_key["position_angle"] = np.where(is_wrong, 0.0, ellipticity.position_angle(columns.frame, e1, e2))


def column_titles(columns: Columns, *keys: str) -> str:
    """Return the names of the user's columns from which properties are computed, joined by "and"."""
    titles = [title for key in keys if key in columns.fields for title in columns.fields[key].titles()]
    return " and ".join(dict.fromkeys(titles)) or " and ".join(keys)


def _value(key: str, field: Field, mapped: Columns, columns: Mapping[str, Array], rows: int) -> Array:
    if field.value is not None:
        return np.full(rows, field.value)
    values = columns[field.column]
    if key in IDENTIFIER_KEYS:
        return values.astype(np.int64) if values.dtype.kind in "iu" else values
    values = values.astype(np.float64)
    with np.errstate(all="ignore"):
        if field.plus:
            values = values + columns[field.plus]
        if field.minus:
            values = values - columns[field.minus]
        if field.over:
            values = values / columns[field.over]
        if field.kpc_at:
            values = values / _kpc_per_arcsec(mapped.cosmology, columns[field.kpc_at])
        if field.power10:
            values = 10.0**values
        if field.log10:
            values = np.log10(values)
        return np.asarray(field.scale * values + field.offset)


def _kpc_per_arcsec(cosmology: Cosmology, z: Array) -> Array:
    """Return the proper length per angle (kpc/arcsec) at redshifts.

    It is NaN at redshifts of 0 or less or beyond the largest redshift of the cosmology. Later checks refuse NaN.
    """
    valid = (z > 0.0) & (z <= Z_MAX)
    return np.where(valid, cosmology.kpc_per_arcsec(np.where(valid, z, 1.0)), np.nan)


def _check_bounds(piece: RowBatch, key: str, columns: Columns, values: Array, mistakes: TableMistakes) -> None:
    """Add values that are out of bounds or not whole numbers to `mistakes`.

    Values beyond a bound by less than the rounding error of float32 are set to the bound.
    """
    lo, hi = columns.bounds.get(key, (-np.inf, np.inf))
    single = key in WHOLE_GALAXY or (key in GALAXIES.names and GALAXIES.column(key).type == "float32")
    slack = 1e-6 * max(abs(lo), abs(hi)) if single and np.isfinite(hi - lo) else 0.0
    outside = ~((values >= lo - slack) & (values <= hi + slack))
    missing = np.isnan(values) if values.dtype.kind == "f" else np.zeros(values.size, bool)
    titles = column_titles(columns, key)
    column = titles if titles == key else f"{titles} ({key})"

    def add(is_wrong: Array, allowed: str) -> None:
        mistakes.add_rows(piece.file, piece.first_row, column, is_wrong, values, allowed)

    if key in IDENTIFIER_KEYS:
        with np.errstate(invalid="ignore"):
            return add(outside | (values != np.floor(values)), "must be an integer")
    unit = unit_of(key) if unit_of(key) in ("deg", "arcsec") else ""
    if key not in columns.nullable:
        # A missing value is another kind of mistake than a value out of bounds, so the texts differ.
        add(missing, f"must be {format_range(lo, hi, unit)}")
    add(outside & ~missing, f"must be {format_range(lo, hi, unit).removeprefix('a number ')}")
    if key in INTEGER_KEYS:
        add(~outside & (values != np.floor(values)), f"must be a whole number from {lo:g} to {hi:g}")
    if slack:
        np.clip(values, lo, hi, out=values)
    return None


def _check_absolute_magnitude(
    piece: RowBatch, columns: Columns, by_key: Mapping[str, Array], mistakes: TableMistakes
) -> None:
    """Add galaxies to `mistakes` whose redshift and apparent magnitude give an impossible absolute magnitude.

    The absolute magnitude is that of a spectrum with constant f_lambda. It is not checked if the table has absolute
    magnitudes.
    """
    magnitude = next((key for key in ("mag_r01", "mag") if key in by_key), "")
    z_key = next((key for key in ("z_true", "z_obs") if key in by_key), "")
    if "abs_mag_r01" in by_key or not magnitude or not z_key:
        return
    z, apparent = by_key[z_key], by_key[magnitude]
    (z_lo, z_hi), (lo, hi) = columns.bounds[z_key], columns.bounds[magnitude]
    valid = (z >= z_lo) & (z <= z_hi) & (apparent >= lo) & (apparent <= hi)
    z = np.clip(np.where(valid, z, 1.0), MIN_REDSHIFT, None)
    absolute = apparent - columns.cosmology.distance_modulus(z) - 2.5 * np.log10(1.0 + z)
    lo, hi = GALAXY_BOUNDS["abs_mag_r01"]
    titles, noun = column_titles(columns, magnitude, z_key), "the absolute magnitude from columns"
    allowed = f"must be from {lo:g} to {hi:g}"
    mistakes.add_rows(piece.file, piece.first_row, titles, valid & (absolute > hi), absolute, allowed, noun)
    too_bright = valid & ~(absolute >= lo)
    if too_bright.any():
        field, row = columns.fields[magnitude], int(np.argmax(too_bright))
        problem = f"is {format_number(absolute[row])} ({magnitude} = {format_number(apparent[row])})"
        can_be_flux = magnitude == "mag" and field.is_plain()
        flux = f": if {field.column} is a flux, write {flux_entry(field.column)}" if can_be_flux else ""
        mistakes.add_rows(piece.file, piece.first_row, titles, too_bright, problem, f"{allowed}{flux}", noun)


def _with_companion(file: Path, pieces: Iterator[RowBatch], columns: Columns) -> Iterator[RowBatch]:
    """Yield the batches of a file with the columns of its companion file added.

    Raises BadInput if the companion file has fewer rows, or if the identifiers of both files differ in a row.
    """
    companion = companion_file(file, columns.companion_prefixes)
    name = columns.fields["origin_id"].column
    titles = [name, *columns.titles(in_companion=True)]
    buffered: dict[str, Array] = {title: np.zeros(0) for title in titles}
    stream = external_rows.read_batches(companion, titles, [name])
    for piece in pieces:
        row_count = len(piece.columns[name])
        while len(buffered[name]) < row_count:
            next_piece = next(stream, None)
            if next_piece is None:
                row = piece.first_row + len(buffered[name])
                raise BadInput(f"{companion}: column {name} ends before row {row} of {file}")
            buffered = (
                {title: np.concatenate([buffered[title], next_piece.columns[title]]) for title in titles}
                if len(buffered[name])
                else dict(next_piece.columns)
            )
        companion_rows = {title: values[:row_count] for title, values in buffered.items()}
        buffered = {title: values[row_count:] for title, values in buffered.items()}
        differ = companion_rows[name] != piece.columns[name]
        if differ.any():
            row = piece.first_row + int(differ.argmax())
            raise BadInput(f"{companion}: column {name} of row {row} must equal the same row of {file.name}")
        yield RowBatch(file, piece.first_row, {**companion_rows, **piece.columns}, piece.units)
