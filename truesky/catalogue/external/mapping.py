"""Map the columns of a user's table to keys of this package, with mappings from a TOML file and from the request.

The mappings in ingest_formats.toml are the shipped formats. Entries of the request override them. Halos and training
tables have no shipped format. Each value is checked; an error names the file, the column and the row.
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
# Keys that are computed, or that other keys determine.
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
    """Entry of a mapping; ingest_formats.toml explains the keys."""

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
        """Return the columns of the file from which the field is computed."""
        return [title for title in (self.column, self.plus, self.minus, self.over, self.kpc_at) if title]


@dataclass(frozen=True, slots=True)
class Columns:
    """A complete mapping.

    Attributes
    ----------
    fields : mapping of str to Field
        Fields by key.
    bounds : mapping of str to (float, float)
        Lowest and highest valid value by key.
    nullable : tuple of str
        Keys whose values may be missing.
    band : str
        Passband of `mag`; "" without one.
    companion_prefixes : tuple of str
        Prefix of the names of the files, and of their companion files; empty without companion files.
    seen_over_v : float or None
        A(band) / A(V), if `mag` is an observed magnitude with magnification and extinction; None otherwise.
    lines_magnified : bool
        True if line fluxes include magnification.
    """

    fields: Mapping[str, Field]
    bounds: Bounds
    nullable: tuple[str, ...] = ()
    band: str = ""
    companion_prefixes: tuple[str, ...] = ()
    seen_over_v: float | None = None
    lines_magnified: bool = False

    def titles(self, in_companion: bool) -> list[str]:
        """Return the columns to read from a file, or from its companion file."""
        titles = [title for field in self.fields.values() if field.beside is in_companion for title in field.titles()]
        return list(dict.fromkeys(titles))


@dataclass(frozen=True, slots=True)
class Rows:
    """Checked rows of one file by key; `first` is the number of the first row in the file."""

    file: Path
    first: int
    values: Mapping[str, Array]


def formats() -> dict[str, dict[str, Any]]:
    """Return the content of ingest_formats.toml by name of the format."""
    return _formats(_FILE.read_text(encoding="utf-8"))


@cache
def _formats(text: str) -> dict[str, dict[str, Any]]:
    """Parse the text of ingest_formats.toml."""
    return user_files.parse_toml(text)


def galaxy_columns(name: str, overrides: Mapping[str, str]) -> Columns:
    """Return the mapping of a catalogue of galaxies.

    Parameters
    ----------
    name : str
        Shipped format, "" for none.
    overrides : mapping of str to str
        Entries of the request as JSON, which override the format.

    Returns
    -------
    Columns
        The mapping.

    Raises
    ------
    BadInput
        If an entry is wrong or missing; the message names the key.
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
    """Return the mapping without the observed positions."""
    fields = {key: field for key, field in columns.fields.items() if not key.endswith("_lensed")}
    return replace(columns, fields=fields)


def halo_columns(entries: Mapping[str, str]) -> Columns:
    """Return the mapping of a request's catalogue of halos, with entries as JSON."""
    fields = _fields({key: json.loads(text) for key, text in entries.items()}, HALO_BOUNDS, "ingest.halos.columns")
    _require(fields, "ingest.halos.columns", ("ra",), ("dec",), ("z_true",), ("log_mass",))
    return Columns(fields, HALO_BOUNDS)


def training_columns(entries: Mapping[str, str]) -> Columns:
    """Return the mapping of a request's training table, with entries as JSON; all its keys are required."""
    parsed = {key: json.loads(text) for key, text in entries.items()}
    fields = _fields(parsed, TRAINING_BOUNDS, "ingest.training.columns")
    _require(fields, "ingest.training.columns", *((key,) for key in TRAINING_BOUNDS))
    return Columns(fields, TRAINING_BOUNDS)


def read(files: Sequence[Path], columns: Columns) -> Iterator[Rows]:
    """Read and check the rows of files; integers become int64, other values float64."""
    identifier_columns = [columns.fields[key].column for key in IDENTIFIER_KEYS if key in columns.fields]
    for file in files:
        pieces = external_rows.read_batches(file, columns.titles(in_companion=False), identifier_columns)
        for piece in _with_companion(file, pieces, columns) if columns.companion_prefixes else pieces:
            _check_units(piece, columns)
            yield Rows(file, piece.first_row, _checked_values(piece, columns))


def companion_file(file: Path, prefixes: Sequence[str]) -> Path:
    """Return the path of the file with the other columns of the same rows."""
    if not file.name.startswith(prefixes[0]):
        raise BadInput(f"{file}: the name must begin with {prefixes[0]}")
    return file.with_name(prefixes[1] + file.name.removeprefix(prefixes[0]))


# ------------------------------------------------------------------------------------------------ fields


def _fields(table: Mapping[str, Any], bounds: Bounds, path: str) -> dict[str, Field]:
    legal = [key for key in bounds if key not in _NOT_MAPPED] + [key for key in NULLABLE if bounds is GALAXY_BOUNDS]
    fields = {}
    for key, entry in table.items():
        if key not in legal:
            raise BadInput(f"{path}.{key} is not one of {', '.join(dict.fromkeys(legal))}")
        if entry in ("", {}):
            # An empty entry removes a column of the format that this catalogue does not have.
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
        # Enable h as a unit only here.
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


# ------------------------------------------------------------------------------------------------ values


def _checked_values(piece: RowBatch, columns: Columns) -> dict[str, Array]:
    rows = len(next(iter(piece.columns.values())))
    by_key = {key: _value(key, field, piece.columns, rows) for key, field in columns.fields.items()}
    for k in "12":
        # The spectrum of a component without light has no meaning and may be invalid.
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
    """Scale in kpc per arcsec; NaN, which is refused later, at redshifts without a valid scale."""
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
    """Yield batches with the columns of the companion file; the identifiers of both files must agree row by row."""
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
