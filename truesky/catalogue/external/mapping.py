"""Map the columns of a user's table to properties of galaxies or halos, and check the values.

A mapping says for each property (key), such as "z_true", from which column of the table it is computed and how. The
mappings of known catalogue formats are in ingest_formats.toml, and a request can override their entries. For tables of
halos and of training galaxies, the whole mapping is in the request. Each value is checked; an error names the file, the
column and the row.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from lake_schema import user_files
from lake_schema.arrays import Array
from lake_schema.errors import BadInput
from lake_schema.external import rows as external_rows
from lake_schema.external.rows import RowBatch
from lake_schema.tables.galaxies import GALAXIES
from truesky.fluxes import cosmology

Bounds = Mapping[str, tuple[float, float]]

_FILE = Path(__file__).with_name("ingest_formats.toml")
IDENTIFIER_KEYS = ("origin_id", "halo")
_FIELD_KEYS = (
    "column", "plus", "minus", "over", "kpc_at", "power10", "log10", "scale", "offset", "unit", "value", "beside",
)  # fmt: skip
_FORMAT_KEYS = ("source", "columns", "band", "beside", "seen_over_v", "lines_magnified")
_SED = ("sed_1", "frac_1", "ext_law_1", "ebv_1", "sed_2", "frac_2", "ext_law_2", "ebv_2")
# Properties of table `galaxies` that cannot be mapped, because they are computed or follow from other properties.
_NOT_MAPPED = ("id", "halo_id", "_healpix_29", "ra_true", "dec_true")
GALAXY_BOUNDS: Bounds = {
    **{c.name: (c.lo, c.hi) for c in GALAXIES.columns if c.lo is not None and c.hi is not None},
    "ra": (-360.0, 360.0),
    "ra_lensed": (-360.0, 360.0),
    "dec_lensed": (-90.0, 90.0),
    "position_angle": (-360.0, 360.0),
    "kind": (0, 1),
    "sed": (0.0, 1000.0),
    "sed_1": (0, 1000),
    "sed_2": (0, 1000),
    "ext_law": (0, 4),
    "ebv": (0.0, 3.0),
    "mag": (-5.0, 60.0),
    "origin_id": (-(2.0**63), 2.0**63),
    "halo": (-(2.0**63), 2.0**63),
    "stamp": (-1, 1e6),
}
NULLABLE = tuple(c.name for c in GALAXIES.columns if c.nullable)
HALO_BOUNDS: Bounds = {
    "ra": (-360.0, 360.0),
    "dec": (-90.0, 90.0),
    "z_true": (0.0, 15.0),
    "z_obs": (-0.02, 15.0),
    "velocity": (-1e4, 1e4),
    "log_mass": (8.0, 16.5),
    "origin_id": (-(2.0**63), 2.0**63),
}
TRAINING_BOUNDS: Bounds = {
    "z_true": (0.0, 15.0),
    "abs_mag_r01": (-30.0, 5.0),
    "color_gr_01": (-2.0, 4.0),
    "sed": (0.0, 1000.0),
    "ext_law": (0, 4),
    "ebv": (0.0, 3.0),
}
_INTEGERS = ("kind", "ext_law", "ext_law_1", "ext_law_2", "sed_1", "sed_2", "stamp")


@dataclass(frozen=True, slots=True)
class Field:
    """Entry of a mapping: how one property is computed from columns of the user's table.

    The value is scale * f((column + plus - minus) / over) + offset, where f is 10^x, log10 or no function. The columns
    `plus`, `minus` and `over` are optional. With the column `kpc_at` (redshift), the argument of f is a length in kpc,
    which is first converted to arcsec. With `value`, the property has this constant value. ingest_formats.toml explains
    all attributes.
    """

    column: str = ""
    plus: str = ""
    minus: str = ""
    over: str = ""
    kpc_at: str = ""
    power10: bool = False
    log10: bool = False
    scale: float = 1.0
    offset: float = 0.0
    unit: str = ""
    value: float | None = None
    beside: bool = False

    def titles(self) -> list[str]:
        """Return the names of the file's columns from which the property is computed; none for a constant value."""
        return [title for title in (self.column, self.plus, self.minus, self.over, self.kpc_at) if title]


@dataclass(frozen=True, slots=True)
class Columns:
    """Mapping from the columns of a user's table to properties of galaxies or halos.

    Attributes
    ----------
    fields : mapping of str to Field
        How each property is computed, by name of the property.
    bounds : mapping of str to (float, float)
        Lowest and highest valid value of each property.
    nullable : tuple of str
        Properties whose values may be missing (NaN).
    band : str
        Passband of the property `mag`; "" without it.
    companion_prefixes : tuple of str
        Beginning of the names of the table's files, and of their companion files, which have further columns of the
        same rows. Empty without companion files.
    seen_over_v : float or None
        Extinction ratio A(band) / A(V), if `mag` is an observed magnitude, which includes magnification and the Milky
        Way's extinction. None if `mag` includes neither.
    lines_magnified : bool
        True if the fluxes of emission lines include magnification.
    """

    fields: Mapping[str, Field]
    bounds: Bounds
    nullable: tuple[str, ...] = ()
    band: str = ""
    companion_prefixes: tuple[str, ...] = ()
    seen_over_v: float | None = None
    lines_magnified: bool = False

    def titles(self, in_companion: bool) -> list[str]:
        """Return the names of the columns to read from a file (`in_companion` False) or from its companion file (True).

        Each name occurs once.
        """
        titles = [title for field in self.fields.values() if field.beside is in_companion for title in field.titles()]
        return list(dict.fromkeys(titles))


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


def formats() -> dict[str, dict[str, Any]]:
    """Return the known catalogue formats from ingest_formats.toml, by name of the format."""
    return _formats(_FILE.read_text(encoding="utf-8"))


@cache
def _formats(text: str) -> dict[str, dict[str, Any]]:
    """Parse the text of ingest_formats.toml; the result is cached."""
    return user_files.parse_toml(text)


def galaxy_columns(name: str, overrides: Mapping[str, str]) -> Columns:
    """Return which columns of a user's catalogue give which properties of galaxies, and with which conversion.

    Parameters
    ----------
    name : str
        Name of a format in ingest_formats.toml; "" for none.
    overrides : mapping of str to str
        For each property or setting that the request gives: its column or value as JSON text. They override the
        format.

    Returns
    -------
    Columns
        The column, unit and conversion of each property.

    Raises
    ------
    BadInput
        If the format is unknown, a text in `overrides` is wrong, or a required property is missing. Required are ra,
        dec, a redshift and a magnitude. Some properties are only allowed together, such as kappa, gamma1 and gamma2.
    """
    all_formats = formats()
    if name and name not in all_formats:
        raise BadInput(f"ingest.galaxies.format = {name!r} is not one of {', '.join(all_formats)}")
    shipped = all_formats.get(name, {"columns": {}})
    overriding_fields = {key: json.loads(text) for key, text in overrides.items() if key not in _FORMAT_KEYS}
    settings = {**shipped, **{key: json.loads(text) for key, text in overrides.items() if key in _FORMAT_KEYS}}
    fields = _fields({**shipped["columns"], **overriding_fields}, GALAXY_BOUNDS, "ingest.galaxies.columns")
    _require(
        fields, "ingest.galaxies.columns", ("ra",), ("dec",), ("z_true", "z_obs"), ("abs_mag_r01", "mag_r01", "mag")
    )
    for group in (("ra_lensed", "dec_lensed"), ("kappa", "gamma1", "gamma2"), ("sed", "ext_law", "ebv"), _SED):
        present = [key for key in group if key in fields]
        if present and len(present) < len(group):
            missing = next(key for key in group if key not in fields)
            raise BadInput(f"ingest.galaxies.columns: {present[0]} requires {missing}")
    if "mag" in fields and not settings.get("band"):
        raise BadInput("ingest.galaxies.columns: mag requires band")
    companion_prefixes, seen_over_v = tuple(settings.get("beside", ())), settings.get("seen_over_v")
    lines = bool(settings.get("lines_magnified", False))
    return Columns(fields, GALAXY_BOUNDS, NULLABLE, settings.get("band", ""), companion_prefixes, seen_over_v, lines)


def drop_lensed_positions(columns: Columns) -> Columns:
    """Return `columns` without the observed (lensed) positions; galaxies are then observed at their true positions."""
    fields = {key: field for key, field in columns.fields.items() if not key.endswith("_lensed")}
    return replace(columns, fields=fields)


def halo_columns(entries: Mapping[str, str]) -> Columns:
    """Return which columns of a user's table of halos give which properties of halos, and with which conversion.

    `entries` contains for each property that the request gives its column or value, as JSON text. Raises BadInput if
    such a text is wrong, or if ra, dec, z_true or log_mass is missing.
    """
    fields = _fields({key: json.loads(text) for key, text in entries.items()}, HALO_BOUNDS, "ingest.halos.columns")
    _require(fields, "ingest.halos.columns", ("ra",), ("dec",), ("z_true",), ("log_mass",))
    return Columns(fields, HALO_BOUNDS)


def training_columns(entries: Mapping[str, str]) -> Columns:
    """Return which columns of a user's training table give which properties of galaxies, and with which conversion.

    `entries` contains for each property that the request gives its column or value, as JSON text. Raises BadInput if
    such a text is wrong, or if one of the properties in TRAINING_BOUNDS is missing.
    """
    parsed = {key: json.loads(text) for key, text in entries.items()}
    fields = _fields(parsed, TRAINING_BOUNDS, "ingest.training.columns")
    _require(fields, "ingest.training.columns", *((key,) for key in TRAINING_BOUNDS))
    return Columns(fields, TRAINING_BOUNDS)


def read(files: Sequence[Path], columns: Columns) -> Iterator[Rows]:
    """Yield the rows of files in batches, as checked values by property.

    Codes, template indices and stamp numbers become int64, most other values float64. Raises BadInput for a value that
    is missing or out of range, a wrong unit, or a companion file with other rows.
    """
    identifier_columns = [columns.fields[key].column for key in IDENTIFIER_KEYS if key in columns.fields]
    for file in files:
        pieces = external_rows.read_batches(file, columns.titles(in_companion=False), identifier_columns)
        for piece in _with_companion(file, pieces, columns) if columns.companion_prefixes else pieces:
            _check_units(piece, columns)
            yield Rows(file, piece.first_row, _checked_values(piece, columns))


def companion_file(file: Path, prefixes: Sequence[str]) -> Path:
    """Return the path of the companion file, which has further columns of the same rows as `file`.

    `prefixes` are the beginnings of the names of both files. Raises BadInput if the name of `file` begins otherwise.
    """
    if not file.name.startswith(prefixes[0]):
        raise BadInput(f"{file}: the name must begin with {prefixes[0]}")
    return file.with_name(prefixes[1] + file.name.removeprefix(prefixes[0]))


def _fields(table: Mapping[str, Any], bounds: Bounds, path: str) -> dict[str, Field]:
    legal = [key for key in bounds if key not in _NOT_MAPPED] + [key for key in NULLABLE if bounds is GALAXY_BOUNDS]
    fields = {}
    for key, entry in table.items():
        if key not in legal:
            raise BadInput(f"{path}.{key} is not one of {', '.join(dict.fromkeys(legal))}")
        if entry in ("", {}):
            # With an empty text or table, the request says that the catalogue lacks the column that the format names.
            continue
        fields[key] = _field({"column": entry} if isinstance(entry, str) else entry, f"{path}.{key}")
    return fields


def _field(entry: Any, path: str) -> Field:
    if not isinstance(entry, dict):
        raise BadInput(f"{path} must be the name of a column or a table, got {entry!r}"[:300])
    for name, value in entry.items():
        if name not in _FIELD_KEYS:
            raise BadInput(f"{path}.{name} is not one of {', '.join(_FIELD_KEYS)}")
        types = {"power10": bool, "log10": bool, "beside": bool, "scale": float, "offset": float, "value": float}
        expected_type = types.get(name, str)
        if not isinstance(value, (int, float) if expected_type is float else expected_type) or (
            expected_type is float and value != value
        ):
            raise BadInput(f"{path}.{name} must be a {expected_type.__name__}, got {value!r}"[:300])
    field = Field(**entry)
    if bool(field.column) == (field.value is not None):
        raise BadInput(f"{path} must have either column or value")
    if field.unit:
        _unit(field.unit, path)
    return field


def _require(fields: Mapping[str, Field], path: str, *groups: tuple[str, ...]) -> None:
    for alternatives in groups:
        if not any(key in fields for key in alternatives):
            raise BadInput(f"{path} must have {' or '.join(alternatives)}")


def _unit(text: str, where: str) -> Any:
    # Import here, because astropy is slow to import and only needed for external catalogues.
    from astropy import units
    from astropy.cosmology.units import littleh

    try:
        # Enable the unit littleh only for this call, because it changes the units of the whole process.
        with units.add_enabled_units([littleh]):
            return units.Unit(text.replace("Msun", "solMass").replace("/h", " / littleh"))
    except ValueError:
        raise BadInput(f"{where}: unit {text!r} must be a unit of astropy") from None


def _check_units(piece: RowBatch, columns: Columns) -> None:
    for key, field in columns.fields.items():
        file_unit = piece.units.get(field.column, "")
        if not field.unit or not file_unit:
            continue
        where = f"{piece.file}: column {field.column}"
        if _unit(file_unit, where) != _unit(field.unit, where):
            raise BadInput(f"{where} ({key}) has unit {file_unit!r}, but the mapping has {field.unit!r}")


def _checked_values(piece: RowBatch, columns: Columns) -> dict[str, Array]:
    rows = len(next(iter(piece.columns.values())))
    by_key = {key: _value(key, field, piece.columns, rows) for key, field in columns.fields.items()}
    for k in "12":
        # If a template has the flux fraction 0, set its index and its dust to 0, because they may have invalid values.
        if f"frac_{k}" in by_key:
            dark = by_key[f"frac_{k}"] == 0.0
            for name in (f"sed_{k}", f"ext_law_{k}", f"ebv_{k}"):
                by_key[name] = np.where(dark, 0.0, by_key[name])
    for key, values in by_key.items():
        _check_bounds(piece, key, columns, values)
    return {key: values.astype(np.int64) if key in _INTEGERS else values for key, values in by_key.items()}


def _value(key: str, field: Field, columns: Mapping[str, Array], rows: int) -> Array:
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
            values = values / _kpc_per_arcsec(columns[field.kpc_at])
        if field.power10:
            values = 10.0**values
        if field.log10:
            values = np.log10(values)
        return np.asarray(field.scale * values + field.offset)


def _kpc_per_arcsec(z: Array) -> Array:
    """Return the proper length per angle (kpc/arcsec) at redshifts.

    It is NaN at redshifts of 0 or less or beyond the largest redshift of the cosmology. Later checks refuse NaN.
    """
    valid = (z > 0.0) & (z <= cosmology.Z_MAX)
    return np.where(valid, cosmology.kpc_per_arcsec(np.where(valid, z, 1.0)), np.nan)


def _check_bounds(piece: RowBatch, key: str, columns: Columns, values: Array) -> None:
    lo, hi = columns.bounds.get(key, (-np.inf, np.inf))
    single = key in GALAXIES.names and GALAXIES.column(key).type == "float32"
    slack = 1e-6 * max(abs(lo), abs(hi)) if single and np.isfinite(hi - lo) else 0.0
    bad = ~((values >= lo - slack) & (values <= hi + slack))
    if key in columns.nullable:
        bad &= ~np.isnan(values) if values.dtype.kind == "f" else True
    if key in (*IDENTIFIER_KEYS, *_INTEGERS) and values.dtype.kind == "f":
        bad |= values != np.floor(values)
    if bad.any():
        row = int(bad.argmax())
        where = f"{piece.file}: column {' and '.join(columns.fields[key].titles()) or key} ({key})"
        allowed = f"in [{lo:g}, {hi:g}]" if key not in IDENTIFIER_KEYS else "an integer"
        raise BadInput(f"{where} of row {piece.first_row + row} is {values[row]:g}, must be {allowed}")
    if slack:
        np.clip(values, lo, hi, out=values)


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
