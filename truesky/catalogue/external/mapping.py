"""Map the columns of a user's table to properties of galaxies or halos.

A mapping says for each property (key), such as "z_true", from which column of the table it is computed and how. The
mappings of known catalogue formats are in ingest_formats.toml, and a request can override their entries. For tables of
halos and of training galaxies, the whole mapping is in the request.
"""

from __future__ import annotations

import json
import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

from lake_schema import user_files
from lake_schema.errors import BadInput, refuse_mistakes
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.texts import spelling, synonyms
from truesky.catalogue.external.ellipticity import CONVENTIONS, FRAMES
from truesky.cosmology import Cosmology
from truesky.fluxes import passbands

Bounds = Mapping[str, tuple[float, float]]

_FILE = Path(__file__).with_name("ingest_formats.toml")
# Pattern of a unit of surface brightness.
_PER_AREA = re.compile(r"/|arcsec|deg|sr")
# Names of flux densities in a band, which truesky has only as magnitudes.
_BAND_FLUX = re.compile(r"(flux|f_?nu)(es)?(_[a-z]|_\w+_[a-z])?")
IDENTIFIER_KEYS = ("origin_id", "halo")
_FIELD_KEYS = (
    "column", "plus", "minus", "over", "kpc_at", "power10", "log10", "scale", "offset", "unit", "value", "beside",
)  # fmt: skip
# Settings of a mapping, which stand between its columns in a request.
SETTINGS = ("band", "beside", "seen_over_v", "lines_magnified", "ellipticity", "frame")
# Groups of properties that are only allowed together.
_TOGETHER = (
    ("ra_lensed", "dec_lensed"),
    ("kappa", "gamma1", "gamma2"),
    ("sed", "ext_law", "ebv"),
    ("sed_1", "frac_1", "ext_law_1", "ebv_1", "sed_2", "frac_2", "ext_law_2", "ebv_2"),
    ("e1", "e2"),
)
# Properties of table `galaxies` that cannot be mapped, because they are computed or follow from other properties.
_NOT_MAPPED = ("id", "halo_id", "_healpix_29", "ra_true", "dec_true")
# Smallest axis ratio of bulges and discs in the table `galaxies`.
MIN_AXIS_RATIO = float(GALAXIES.column("disk_axis_ratio").lo or 0.0)
# Properties of a whole galaxy, and the properties of its components that they replace.
WHOLE_GALAXY = {
    "e1": ("axis_ratio", "bulge_axis_ratio", "disk_axis_ratio", "inclination", "position_angle"),
    "axis_ratio": ("bulge_axis_ratio", "disk_axis_ratio", "inclination"),
    "half_light_radius": ("bulge_half_light_radius", "disk_half_light_radius"),
}
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
    "axis_ratio": (MIN_AXIS_RATIO, 1.0),
    "half_light_radius": (0.0, 120.0),
    "e1": (-4.0, 4.0),
    "e2": (-4.0, 4.0),
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
INTEGER_KEYS = ("kind", "ext_law", "ext_law_1", "ext_law_2", "sed_1", "sed_2", "stamp")
# Units of properties that are not columns of table `galaxies`.
_UNITS = {
    "ra_lensed": "deg", "dec_lensed": "deg", "half_light_radius": "arcsec", "mag": "mag", "ebv": "mag",
    "velocity": "km / s", "teff": "K",
}  # fmt: skip


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

    def is_plain(self) -> bool:
        """Return True if the property is a column of the file, for which the mapping states no unit or computation."""
        return bool(self.column) and self == Field(self.column, beside=self.beside)


@dataclass(frozen=True, slots=True)
class Columns:
    """Mapping from the columns of a user's table to properties of galaxies or halos.

    Attributes
    ----------
    fields : mapping of str to Field
        How each property is computed, by name of the property.
    bounds : mapping of str to (float, float)
        Lowest and highest valid value of each property.
    cosmology : Cosmology
        Parameters of the universe in which distances follow from redshifts.
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
    ellipticity : str
        Convention of the properties `e1` and `e2`, one of `CONVENTIONS` in ellipticity.py; "" without them.
    frame : str
        Axes of the ellipticities, one of `FRAMES` in ellipticity.py.
    path : str
        Key of the request that contains the mapping, for messages.
    """

    fields: Mapping[str, Field]
    bounds: Bounds
    cosmology: Cosmology
    nullable: tuple[str, ...] = ()
    band: str = ""
    companion_prefixes: tuple[str, ...] = ()
    seen_over_v: float | None = None
    lines_magnified: bool = False
    ellipticity: str = ""
    frame: str = FRAMES[0]
    path: str = ""

    def titles(self, in_companion: bool) -> list[str]:
        """Return the names of the columns to read from a file (`in_companion` False) or from its companion file (True).

        Each name occurs once.
        """
        titles = [title for field in self.fields.values() if field.beside is in_companion for title in field.titles()]
        return list(dict.fromkeys(titles))


def formats() -> dict[str, dict[str, Any]]:
    """Return the known catalogue formats from ingest_formats.toml, by name of the format."""
    return _formats(_FILE.read_text(encoding="utf-8"))


@cache
def _formats(text: str) -> dict[str, dict[str, Any]]:
    """Parse the text of ingest_formats.toml; the result is cached."""
    return user_files.parse_toml(text)


def galaxy_columns(name: str, overrides: Mapping[str, str], cosmology: Cosmology) -> Columns:
    """Return which columns of a user's catalogue give which properties of galaxies, and with which conversion.

    Parameters
    ----------
    name : str
        Name of a format in ingest_formats.toml; "" for none.
    overrides : mapping of str to str
        For each property or setting that the request gives: its column or value as JSON text. They override the
        format.
    cosmology : Cosmology
        Parameters of the universe in which distances follow from redshifts.

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
        hint = spelling.suggestion(name, all_formats)
        raise BadInput(f"ingest.galaxies.format = {name!r} is not one of {', '.join(all_formats)}{hint}")
    shipped = all_formats.get(name, {"columns": {}})
    requested = {key: json.loads(text) for key, text in overrides.items()}
    entries = {**{key: value for key, value in shipped.items() if key in SETTINGS}, **shipped["columns"], **requested}
    required = ("ra",), ("dec",), ("z_true", "z_obs"), ("abs_mag_r01", "mag_r01", "mag")
    path = "ingest.galaxies.columns"
    return parse_columns(entries, GALAXY_BOUNDS, cosmology, path, required, NULLABLE, SETTINGS)


def parse_columns(
    entries: Mapping[str, Any],
    bounds: Bounds,
    cosmology: Cosmology,
    path: str,
    required: Sequence[Sequence[str]],
    nullable: tuple[str, ...] = (),
    legal_settings: Sequence[str] = (),
) -> Columns:
    """Check the entries of a mapping, and return the mapping.

    Parameters
    ----------
    entries : mapping of str to object
        Column or definition of each property, and settings (`SETTINGS`), as in a TOML file.
    bounds : mapping of str to (float, float)
        Allowed properties with the lowest and highest valid value.
    cosmology : Cosmology
        Parameters of the universe in which distances follow from redshifts.
    path : str
        Key of the request that contains the entries, for messages.
    required : sequence of sequence of str
        Groups of properties, of each of which at least one is required.
    nullable : tuple of str, optional
        Allowed properties whose values may be missing.
    legal_settings : sequence of str, optional
        Allowed settings.

    Returns
    -------
    Columns
        The mapping.

    Raises
    ------
    BadInput
        If entries are wrong or required ones are missing. There is one message for each mistake.
    """
    messages: list[str] = []
    # With an empty text or table, the request says that the catalogue lacks the column that the format names.
    entries = {key: entry for key, entry in entries.items() if entry not in ("", {})}
    settings = {key: entry for key, entry in entries.items() if key in legal_settings}
    legal = dict.fromkeys([*(key for key in bounds if key not in _NOT_MAPPED), *nullable, *legal_settings])
    fields, suggested = {}, set()
    for key, entry in entries.items():
        if key not in legal:
            meant, hint = _explain_property(key, entry, legal, entries)
            suggested |= {*meant}
            messages.append(f"{path}.{key} is not a known property: {hint}")
        elif key not in legal_settings:
            try:
                field = _field({"column": entry} if isinstance(entry, str) else entry, f"{path}.{key}")
                fields[key] = _with_stated_unit(key, field, f"{path}.{key}")
            except BadInput as error:
                messages.append(str(error))
    messages += _wrong_settings(settings, path)
    # A required property is not missing if an unknown key was meant to be it.
    messages += _missing_keys({*entries, *suggested}, path, required)
    if "mag" in fields and "band" in legal_settings and "band" not in settings:
        messages.append(f'{path}: mag requires band, the name of its passband: add a line such as band = "euclid_vis"')
    messages += _excluded_keys(fields, settings, path)
    refuse_mistakes(messages)
    companion_prefixes = tuple(settings.pop("beside", ()))
    return Columns(fields, bounds, cosmology, nullable, companion_prefixes=companion_prefixes, path=path, **settings)


def _explain_property(
    key: str, entry: object, legal: Collection[str], given: Collection[str]
) -> tuple[Sequence[str], str]:
    """Return the properties that a user may have meant by an unknown one, and the end of an error message about it.

    Parameters
    ----------
    key : str
        The unknown property.
    entry : object
        Column or definition that the request gives for it.
    legal : collection of str
        Properties that exist.
    given : collection of str
        All keys of the mapping.

    Returns
    -------
    (sequence of str, str)
        The properties and the end of the message.
    """
    if isinstance(entry, str) and entry in legal and entry not in given:
        return [entry], f'the key is the property, and the value its column: write {entry} = "{key}"'
    if meant := synonyms.find_columns(key, ("given_galaxies", "galaxies", "halos"), legal):
        return meant, f"did you mean {' or '.join(meant)}?"
    if "mag" in legal and _BAND_FLUX.fullmatch(key.lower()):
        fluxes = flux_entry(entry if isinstance(entry, str) else "..")
        return ["mag"], f"write mag for AB magnitudes; for fluxes write {fluxes}"
    return spelling.closest_names(key, legal, 1), spelling.choices(key, list(legal))


def flux_entry(column: str) -> str:
    """Return the entry of a mapping that converts a column of flux densities to AB magnitudes, for a message."""
    entry = f'mag = {{ column = "{column}", log10 = true, scale = -2.5, offset = 23.9 }}'
    return f"{entry} (microjansky; offset = -48.6 for erg/s/cm2/Hz)"


def _with_stated_unit(key: str, field: Field, path: str) -> Field:
    """Return an entry that converts the unit which the request states for a column that is not computed."""
    if not field.unit or not replace(field, unit="").is_plain():
        return field
    try:
        return replace(field, scale=factor_of_unit(key, field.unit))
    except BadInput as error:
        raise BadInput(f"{path} {error}") from None


def with_last_template(columns: Columns, last: int) -> Columns:
    """Return `columns` with template indices limited to the library, whose last template is `last`."""
    limited = {key: (0.0, float(last)) for key in ("sed", "sed_1", "sed_2") if key in columns.bounds}
    return replace(columns, bounds={**columns.bounds, **limited})


def drop_lensed_positions(columns: Columns) -> Columns:
    """Return `columns` without the observed (lensed) positions; galaxies are then observed at their true positions."""
    fields = {key: field for key, field in columns.fields.items() if not key.endswith("_lensed")}
    return replace(columns, fields=fields)


def halo_columns(entries: Mapping[str, str], cosmology: Cosmology) -> Columns:
    """Return which columns of a user's table of halos give which properties of halos, and with which conversion.

    `entries` contains for each property that the request gives its column or value, as JSON text. Distances follow from
    redshifts in `cosmology`. Raises BadInput if such a text is wrong, or if ra, dec, z_true or log_mass is missing.
    """
    parsed = {key: json.loads(text) for key, text in entries.items()}
    required = ("ra",), ("dec",), ("z_true",), ("log_mass",)
    return parse_columns(parsed, HALO_BOUNDS, cosmology, "ingest.halos.columns", required)


def training_columns(entries: Mapping[str, str], cosmology: Cosmology) -> Columns:
    """Return which columns of a user's training table give which properties of galaxies, and with which conversion.

    `entries` contains for each property that the request gives its column or value, as JSON text. Distances follow from
    redshifts in `cosmology`. Raises BadInput if such a text is wrong, or if one of the properties in TRAINING_BOUNDS is
    missing.
    """
    parsed = {key: json.loads(text) for key, text in entries.items()}
    required = [(key,) for key in TRAINING_BOUNDS]
    return parse_columns(parsed, TRAINING_BOUNDS, cosmology, "ingest.training.columns", required)


def companion_file(file: Path, prefixes: Sequence[str]) -> Path:
    """Return the path of the companion file, which has further columns of the same rows as `file`.

    `prefixes` are the beginnings of the names of both files. Raises BadInput if the name of `file` begins otherwise.
    """
    if not file.name.startswith(prefixes[0]):
        raise BadInput(f"{file}: the name must begin with {prefixes[0]}")
    return file.with_name(prefixes[1] + file.name.removeprefix(prefixes[0]))


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
        parse_unit(field.unit, path)
    return field


def _missing_keys(entries: Collection[str], path: str, required: Sequence[Sequence[str]]) -> list[str]:
    missing = [" or ".join(group) for group in required if not any(key in entries for key in group)]
    example = f'add the name of its column, such as {missing[0].partition(" ")[0]} = ".."' if missing else ""
    messages = [f"{path} must have {', '.join(missing)}: {example}"] if missing else []
    for group in _TOGETHER:
        first = next((key for key in group if key in entries), None)
        messages += [f"{path}: {first} requires {key}" for key in group if first and key not in entries]
    return messages


def _excluded_keys(fields: Mapping[str, Field], settings: Mapping[str, Any], path: str) -> list[str]:
    """Return messages about properties that exclude each other, and about settings that are missing or without use."""
    messages = []
    for key, replaced in WHOLE_GALAXY.items():
        if key in fields and (both := [other for other in replaced if other in fields]):
            name = "e1, e2" if key == "e1" else key
            messages.append(f'{path}: {name} replaces {", ".join(both)}: remove them, or set {both[0]} = ""')
    if "e1" in fields and "ellipticity" not in settings:
        messages.append(f"{path}: e1, e2 require ellipticity, their convention: one of {', '.join(CONVENTIONS)}")
    messages += [
        f"{path}.{key} requires e1 and e2" for key in ("ellipticity", "frame") if key in settings and "e1" not in fields
    ]
    if "beside" in settings:
        if "origin_id" not in fields:
            messages.append(f"{path}: beside requires origin_id, by which the rows of both files are compared")
    else:
        companions = [key for key, field in fields.items() if field.beside]
        messages += [
            f"{path}.{key}: beside = true requires the setting beside, the beginnings of two file names"
            for key in companions
        ]
    return messages


def _wrong_settings(settings: Mapping[str, Any], path: str) -> list[str]:
    choices = {"ellipticity": CONVENTIONS, "frame": FRAMES, "band": passbands.names()}
    messages = []
    for key, value in settings.items():
        if key in choices:
            wrong = value not in choices[key]
            hint = spelling.suggestion(str(value), choices[key])
            allowed = f"one of {', '.join(choices[key])}{hint}"
            if key == "band" and hint:
                # A suggestion replaces the list, because there are many passbands.
                allowed = f"the name of a passband{hint}"
        elif key == "beside":
            wrong = not (isinstance(value, list) and len(value) == 2 and all(isinstance(text, str) for text in value))
            allowed = "the beginnings of two file names"
        elif key == "lines_magnified":
            wrong, allowed = not isinstance(value, bool), "true or false"
        else:
            wrong = isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 100.0
            allowed = "a number"
        if wrong:
            messages.append(f"{path}.{key} = {value!r}"[:200] + f" must be {allowed}")
    return messages


def unit_of(key: str) -> str:
    """Return the unit of a property, such as "deg"; "" for a number without a unit."""
    return _UNITS.get(key) or (GALAXIES.column(key).unit if key in GALAXIES.names else "")


def factor_of_unit(key: str, stored: str) -> float:
    """Return the factor that converts the numbers of a column with a unit to the unit of a property.

    Parameters
    ----------
    key : str
        Name of the property.
    stored : str
        Unit that the file gives; "" or "-" for none.

    Returns
    -------
    float
        The factor, such as 60 for a radius in arcmin. It is 1 for codes and logarithms, whose units are not checked.

    Raises
    ------
    BadInput
        If the stored unit does not convert to the unit of the property.
    """
    text, expected = stored.strip(), unit_of(key)
    if key in (*IDENTIFIER_KEYS, *INTEGER_KEYS, "sed") or key.startswith("log_") or not text.strip("-"):
        return 1.0
    if expected == "mag" and "mag" in text.lower() and not _PER_AREA.search(text):
        # Magnitudes have many spellings, such as "mag(AB)" and "ABmag".
        return 1.0
    from astropy import units

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", units.UnitsWarning)
        for spelling_of_unit in (text, text.lower(), text.lower().rstrip("s")):
            try:
                return float(units.Unit(spelling_of_unit).to(expected))
            except (ValueError, ArithmeticError):
                # The text is not a unit of astropy, or does not convert, or the factor exceeds the range of numbers.
                continue
    if expected:
        raise BadInput(f"has the unit {text[:40]}, but must be in {expected} or a unit that converts to it")
    if _is_unit(text):
        raise BadInput(f"has the unit {text[:40]}, but must be a number without a unit")
    return 1.0


def _is_unit(text: str) -> bool:
    try:
        return bool(parse_unit(text, ""))
    except BadInput:
        return False


def parse_unit(text: str, where: str) -> Any:
    """Return an astropy unit for a text; raise BadInput, with the place `where`, if it is not a unit.

    "Msun" and "/h" are also understood.
    """
    # Import here, because astropy is slow to import and only needed for external catalogues.
    from astropy import units
    from astropy.cosmology.units import littleh

    try:
        # Enable the unit littleh only for this call, because it changes the units of the whole process.
        with units.add_enabled_units([littleh]):
            return units.Unit(text.replace("Msun", "solMass").replace("/h", " / littleh"))
    except ValueError:
        raise BadInput(f"{where}: unit {text!r} must be a unit of astropy") from None
