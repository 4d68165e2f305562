"""Whose column is which: from a user's table to keys that we know, by a mapping that is data.

formats     the mappings that are shipped (ingest_formats.toml)
galaxies    a shipped mapping with a request's own entries over it, checked
halos, training     the same for halos and training tables, which have no shipped one
read        the rows of files by key, checked: a wrong value is refused with its file, column and row
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
# Computed by us, or another key's affair.
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
    """One entry of a mapping (ingest_formats.toml says what it means)."""

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
        """Columns of the file that the field is made of."""
        return [title for title in (self.column, self.plus, self.minus, self.over, self.kpc_at) if title]


@dataclass(frozen=True, slots=True)
class Columns:
    """A whole mapping: fields by key; band, seen_over_v, beside, lines_magnified : as in ingest_formats.toml."""

    fields: Mapping[str, Field]
    bounds: Bounds
    nullable: tuple[str, ...] = ()
    band: str = ""
    companion_prefixes: tuple[str, ...] = ()
    seen_over_v: float | None = None
    lines_magnified: bool = False

    def titles(self, in_companion: bool) -> list[str]:
        """Columns of the file that are read; beside : of the file beside it."""
        titles = [title for field in self.fields.values() if field.beside is in_companion for title in field.titles()]
        return list(dict.fromkeys(titles))


@dataclass(frozen=True, slots=True)
class Rows:
    """Checked rows of one file: values by key; first : number of the first row in the file."""

    file: Path
    first: int
    values: Mapping[str, Array]


def formats() -> dict[str, dict[str, Any]]:
    """Name -> what ingest_formats.toml says of it."""
    return _formats(_FILE.read_text(encoding="utf-8"))


@cache
def _formats(text: str) -> dict[str, dict[str, Any]]:
    """The formats in the text of the file."""
    return user_files.parse_toml(text)


def galaxy_columns(name: str, overrides: Mapping[str, str]) -> Columns:
    """The mapping of a format ("" = none), the request's entries (JSON) over it.

    Errors: BadInput names the key
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
            raise BadInput(f"ingest.galaxies.columns: {present[0]} wants {missing} beside it")
    if "mag" in fields and not settings.get("band"):
        raise BadInput("ingest.galaxies.columns: mag wants band beside it")
    companion_prefixes, seen_over_v = tuple(settings.get("beside", ())), settings.get("seen_over_v")
    lines = bool(settings.get("lines_magnified", False))
    return Columns(fields, GALAXY_BOUNDS, NULLABLE, settings.get("band", ""), companion_prefixes, seen_over_v, lines)


def drop_lensed_positions(columns: Columns) -> Columns:
    """The same mapping without the observed positions."""
    fields = {key: field for key, field in columns.fields.items() if not key.endswith("_lensed")}
    return replace(columns, fields=fields)


def halo_columns(entries: Mapping[str, str]) -> Columns:
    """The mapping of a request's halos."""
    fields = _fields({key: json.loads(text) for key, text in entries.items()}, HALO_BOUNDS, "ingest.halos.columns")
    _require(fields, "ingest.halos.columns", ("ra",), ("dec",), ("z_true",), ("log_mass",))
    return Columns(fields, HALO_BOUNDS)


def training_columns(entries: Mapping[str, str]) -> Columns:
    """The mapping of a request's training table; each of its keys is needed."""
    parsed = {key: json.loads(text) for key, text in entries.items()}
    fields = _fields(parsed, TRAINING_BOUNDS, "ingest.training.columns")
    _require(fields, "ingest.training.columns", *((key,) for key in TRAINING_BOUNDS))
    return Columns(fields, TRAINING_BOUNDS)


def read(files: Sequence[Path], columns: Columns) -> Iterator[Rows]:
    """The rows of files, one after another; whole numbers as int64, everything else as float64."""
    identifier_columns = [columns.fields[key].column for key in IDENTIFIER_KEYS if key in columns.fields]
    for file in files:
        pieces = external_rows.read_batches(file, columns.titles(in_companion=False), identifier_columns)
        for piece in _with_companion(file, pieces, columns) if columns.companion_prefixes else pieces:
            _check_units(piece, columns)
            yield Rows(file, piece.first_row, _checked_values(piece, columns))


def companion_file(file: Path, prefixes: Sequence[str]) -> Path:
    """The file with a row's other columns."""
    if not file.name.startswith(prefixes[0]):
        raise BadInput(f"{file}: its name does not begin with {prefixes[0]}")
    return file.with_name(prefixes[1] + file.name.removeprefix(prefixes[0]))


# ------------------------------------------------------------------------------------------------ fields


def _fields(table: Mapping[str, Any], bounds: Bounds, path: str) -> dict[str, Field]:
    legal = [key for key in bounds if key not in _NOT_MAPPED] + [key for key in NULLABLE if bounds is GALAXY_BOUNDS]
    fields = {}
    for key, entry in table.items():
        if key not in legal:
            raise BadInput(f"{path}.{key} is not one of {', '.join(dict.fromkeys(legal))}")
        if entry in ("", {}):
            # An entry of the shipped mapping that this catalogue lacks.
            continue
        fields[key] = _field({"column": entry} if isinstance(entry, str) else entry, f"{path}.{key}")
    return fields


def _field(entry: Any, path: str) -> Field:
    if not isinstance(entry, dict):
        raise BadInput(f"{path} wants a column's name or a table, got {entry!r}"[:300])
    for name, value in entry.items():
        if name not in _FIELD_KEYS:
            raise BadInput(f"{path}.{name} is not one of {', '.join(_FIELD_KEYS)}")
        types = {"power10": bool, "log10": bool, "beside": bool, "scale": float, "offset": float, "value": float}
        expected_type = types.get(name, str)
        if not isinstance(value, (int, float) if expected_type is float else expected_type) or (
            expected_type is float and value != value
        ):
            raise BadInput(f"{path}.{name} wants {expected_type.__name__}, got {value!r}"[:300])
    field = Field(**entry)
    if bool(field.column) == (field.value is not None):
        raise BadInput(f"{path} wants column or value, one of them")
    if field.unit:
        _unit(field.unit, path)
    return field


def _require(fields: Mapping[str, Field], path: str, *groups: tuple[str, ...]) -> None:
    for alternatives in groups:
        if not any(key in fields for key in alternatives):
            raise BadInput(f"{path} wants {' or '.join(alternatives)}")


def _unit(text: str, where: str) -> Any:
    # Slow to import, and needed for external catalogues only.
    from astropy import units
    from astropy.cosmology.units import littleh

    try:
        # h is a unit of astropy's, but only where it is asked for.
        with units.add_enabled_units([littleh]):
            return units.Unit(text.replace("Msun", "solMass").replace("/h", " / littleh"))
    except ValueError:
        raise BadInput(f"{where}: unit {text!r} is not one that astropy knows") from None


def _check_units(piece: RowBatch, columns: Columns) -> None:
    for key, field in columns.fields.items():
        file_unit = piece.units.get(field.column, "")
        if not field.unit or not file_unit:
            continue
        where = f"{piece.file}: column {field.column}"
        if _unit(file_unit, where) != _unit(field.unit, where):
            raise BadInput(f"{where} ({key}) is in {file_unit!r}, the mapping says {field.unit!r}")


# ------------------------------------------------------------------------------------------------ values


def _checked_values(piece: RowBatch, columns: Columns) -> dict[str, Array]:
    rows = len(next(iter(piece.columns.values())))
    by_key = {key: _value(key, field, piece.columns, rows) for key, field in columns.fields.items()}
    for k in "12":
        # What a component without light says of its spectrum means nothing.
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
    """NaN, which is refused, where a length has no angle."""
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
        allowed = f"in [{lo:g}, {hi:g}]" if key not in IDENTIFIER_KEYS else "a whole number"
        raise BadInput(f"{where} of row {piece.first_row + row} is {values[row]:g}, wanted {allowed}")
    if slack:
        np.clip(values, lo, hi, out=values)


def _with_companion(file: Path, pieces: Iterator[RowBatch], columns: Columns) -> Iterator[RowBatch]:
    """Pieces with the columns of the file beside theirs; the identifiers of both are compared, row by row."""
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
                raise BadInput(f"{companion}: ends before row {row} of {file}, column {name}")
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
            raise BadInput(f"{companion}: column {name} of row {row} is not that of the same row of {file.name}")
        yield RowBatch(file, piece.first_row, {**companion_rows, **piece.columns}, piece.units)
