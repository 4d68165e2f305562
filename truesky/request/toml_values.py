"""Read and check values of a parsed TOML table, a request (the file in which a user describes a simulation).

Error messages name the full path of the key. The parameter `path` of these functions is the name of a key with its
sections, for example "universe.z_max". The function looks for the last part, here "z_max", in the table of the section.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, cast

from lake_schema import arguments, errors
from lake_schema.errors import BadInput, OutOfRange, bad_input
from lake_schema.texts import spelling

Toml = Mapping[str, Any]
# Keys of a request that are in no section.
TOP_KEYS = ("name", "seed", "noise_seed", "accuracy")
# Keys of a request that are lists of tables.
LIST_KEYS = ("pointing", "observation")
# Message about an unknown key with the key that the user may have meant.
_MEANT = re.compile(
    r"(?P<section>(?:.*\.)?)[^.]* is not a key of a request; did you mean \[{0,2}(?P<name>\w+)(?:\]{0,2}| = .*)\?"
)
# Largest number of allowed keys that are listed after a suggestion.
_MAX_LISTED = 8
# Other names of keys, which users know from other programs.
_SYNONYMS = {
    "pa": "position_angle", "filter": "band", "filters": "bands", "exptime": "exposure_time_s", "depth": "galaxy_limit",
    "mag_limit": "galaxy_limit", "instrument": "channel", "instruments": "channels",
    "date": "mjd", "date_obs": "mjd",
    "sigma8": "sigma_8", "ns": "n_s", "om0": "omega_m", "ob0": "omega_b", "w": "w0", "mnu": "m_nu",
    "gamma1": "g1", "gamma2": "g2", "gamma_1": "g1", "gamma_2": "g2", "shear1": "g1", "shear2": "g2",
}  # fmt: skip
# Keys that users know from other programs and that a request does not have, with the reason.
_FIXED = {
    **dict.fromkeys(("h0", "hubble"), "it is h = H0 / 100 in [universe.cosmology]"),
    **dict.fromkeys(("omega_lambda", "omega_k"), "the universe is flat: give omega_m in [universe.cosmology]"),
    "a_s": "the power spectrum is normalised by sigma_8 in [universe.cosmology]",
    "omega_c": "give omega_m (all matter) and omega_b in [universe.cosmology]",
    **dict.fromkeys(("star_band", "stars_band"), "star_limit is always in H (Vega)"),
}  # fmt: skip
# Other names of values: ground cameras and surveys belong to one channel, cameras to a survey, and I_E is euclid_vis.
_VALUES = {
    **dict.fromkeys(("lsst", "des", "ground"), ("EXT",)),
    **dict.fromkeys(("rubin", "lsstcam", "lsst_cam"), ("EXT", "lsst")), "decam": ("EXT", "des"),
    "hsc": ("EXT", "wishes"), "megacam": ("EXT", "cfis"), "gpc1": ("EXT", "ps1"),
    **dict.fromkeys(("pan-starrs", "panstarrs"), ("EXT", "ps1")),
    **dict.fromkeys(("off", "no", "false"), ("none",)), "noiseless": ("noise_free",),
    "noise": ("poisson", "read_noise", "group_noise", "injection_noise"),
    **{f"{filter}{mark}e": (band,) for mark in ("", "_") for filter, band in
       (("i", "euclid_vis"), ("y", "euclid_y"), ("j", "euclid_j"), ("h", "euclid_h"))},
}  # fmt: skip
quote_value = errors.quote_value
# Number of decimals of an angle in a message, which replaces a text such as "17 arcmin".
_ANGLE_DIGITS = 4
_NO_PLACES: Mapping[str, str] = {}


def check_keys(table: Toml, path: str, keys: Iterable[str], places: Mapping[str, str] = _NO_PLACES) -> None:
    """Check that a table has no unknown keys.

    Parameters
    ----------
    table : Toml
        The table of a section.
    path : str
        Name of the section with the sections around it, for the error message; "" for the whole request.
    keys : iterable of str
        Keys that are allowed. They need not be present.
    places : mapping of str to str, optional
        Where keys belong that are not allowed here, for the error message: a section such as "[universe]" by key, or a
        question such as "did you mean cone?".

    Raises
    ------
    BadInput
        If the table has other keys. There is one line for each, with the most similar allowed key.
    """
    allowed = sorted(keys)
    unknown = [key for key in table if key not in allowed]
    if unknown:
        missing = [key for key in allowed if key not in table]
        hints = {key: _hint(key, path, missing, allowed, places) for key in unknown}
        raise bad_input(_describe_unknown(key, path, hints[key], allowed) for key in unknown)


def _hint(key: str, path: str, missing: Sequence[str], allowed: Sequence[str], places: Mapping[str, str]) -> str:
    """Return where an unknown key belongs, or which allowed key the user may have meant, preferably a missing one."""
    if path and key in TOP_KEYS:
        return "it belongs at the top of the file, before the first [section]; "
    if key.lower() in _FIXED:
        return f"{_FIXED[key.lower()]}; "
    if other := next((name for name in missing if path and name in (f"{key}s", key.removesuffix("s"))), ""):
        return f"did you mean {other}?{' ' if len(allowed) <= _MAX_LISTED else ''}"
    if key in places:
        place = places[key]
        return place if place.endswith("?") else f"it belongs in {place}; "
    if _SYNONYMS.get(key) in missing:
        return f"did you mean {_SYNONYMS[key]}?{' ' if len(allowed) <= _MAX_LISTED else ''}"
    for names in (missing, allowed):
        longer = [name for name in missing if name.startswith(key)]
        if similar := longer or spelling.closest_names(key, names, 1):
            listed = len(allowed) <= _MAX_LISTED
            return f"did you mean {similar[0] if path else _as_written(similar[0])}?{' ' if listed else ''}"
    return ""


def _as_written(key: str) -> str:
    """Return a key of the whole request as a user writes it: "seed", "[area]" or "[[pointing]]"."""
    if key in TOP_KEYS:
        return key
    return f"[[{key}]]" if key in LIST_KEYS else f"[{key}]"


def _describe_unknown(key: str, path: str, hint: str, allowed: Sequence[str]) -> str:
    printable_key = quote_value(key)[1:-1]
    key_path = f"{path}.{printable_key}" if path else printable_key
    names = allowed if path else map(_as_written, allowed)
    listed = "" if hint.endswith("?") else f"allowed here: {', '.join(names)}"
    return f"{key_path} is not a key of a request; {hint}{listed}"


def meant_key(message: str) -> str:
    """Return the path of the key that a message of `check_keys` suggests for an unknown key, else ""."""
    match = _MEANT.match(message)
    return f"{match['section'] or ''}{match['name']}" if match else ""


def section(table: Toml, key: str, keys: Iterable[str] | None, places: Mapping[str, str] = _NO_PLACES) -> Toml:
    """Return a section of a request as a table, empty if the section is missing.

    Parameters
    ----------
    table : Toml
        Table that contains the section, such as the whole request.
    key : str
        Name of the section.
    keys : iterable of str or None
        Keys that are allowed in the section; None for any.
    places : mapping of str to str, optional
        Where keys belong that are not allowed here, as in `check_keys`.

    Returns
    -------
    Toml
        The table of the section.

    Raises
    ------
    BadInput
        If the value is not a table, or the section has another key.
    """
    return as_table(table.get(key, {}), key, keys, places)


def as_table(value: object, path: str, keys: Iterable[str] | None, places: Mapping[str, str] = _NO_PLACES) -> Toml:
    """Check that a value is a table, and return it.

    Parameters
    ----------
    value : object
        Value of a key in the request.
    path : str
        Path of the key, for error messages.
    keys : iterable of str or None
        Keys that are allowed in the table; None for any.
    places : mapping of str to str, optional
        Where keys belong that are not allowed here, as in `check_keys`.

    Returns
    -------
    Toml
        The value.

    Raises
    ------
    BadInput
        If the value is not a table, or the table has another key.
    """
    if not isinstance(value, dict):
        form = f"{path} = {{ {', '.join(f'{key} = ..' for key in keys)} }}" if keys else "{ key = value, .. }"
        hint = f"; write [{path}] once" if isinstance(value, list) and "." not in path else f" such as {form}"
        raise BadInput(f"{path} must be a table{hint}, got {quote_value(value)}")
    if keys is not None:
        check_keys(value, path, keys, places)
    return cast(Toml, value)


def table_list(table: Toml, key: str, max_tables: int) -> list[object]:
    """Return a list of tables, such as [[pointing]] in TOML, empty if the key is missing.

    Parameters
    ----------
    table : Toml
        Table with the key.
    key : str
        Name of the key.
    max_tables : int
        Largest length of the list.

    Returns
    -------
    list of object
        The list. It is not checked that its items are tables.

    Raises
    ------
    BadInput
        If the value is not a list, or is too long.
    """
    entries = table.get(key, [])
    if not isinstance(entries, list) or len(entries) > max_tables:
        if isinstance(entries, dict):
            raise BadInput(f"{key} must be a list of tables: write [[{key}]] instead of [{key}]")
        raise BadInput(f"{key} must be a list of at most {max_tables} tables")
    return entries


def has_key(table: Toml, path: str) -> bool:
    """Return True if the table has the key at the end of `path`: "z_max" for "universe.z_max"."""
    return path.rpartition(".")[2] in table


def required_value(table: Toml, path: str, allowed: str = "") -> object:
    """Return the value of a key, of any type.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    allowed : str, optional
        Description of the values that are allowed, for the error message.

    Returns
    -------
    object
        The value.

    Raises
    ------
    BadInput
        If the table has no such key.
    """
    key = path.rpartition(".")[2]
    if key not in table:
        raise BadInput(f"{path} is missing: {allowed}" if allowed else f"{path} is missing")
    return table[key]


def string(table: Toml, path: str, legal: Sequence[str] = (), default: str | None = None) -> str:
    """Read the value of a key that must be text.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    legal : sequence of str, optional
        Texts that are allowed; empty for any text.
    default : str, optional
        Value if the key is missing, which is not checked; None if the key is required.

    Returns
    -------
    str
        The text.

    Raises
    ------
    BadInput
        If the key is missing without a default, or the value is not an allowed text.
    """
    if default is not None and not has_key(table, path):
        return default
    text = required_value(
        table, path, f"it must be one of {', '.join(legal)}" if legal else "it must be text in quotes"
    )
    if not isinstance(text, str):
        one_of = f", one of {', '.join(legal)}" if legal else ""
        raise BadInput(f"{path} must be text in quotes{one_of}, got {quote_value(text)}")
    if legal and text not in legal:
        raise BadInput(f"{path} = {refuse_name(text, legal)}")
    return text


def known_name(name: str, legal: Collection[str]) -> str:
    """Return the legal value that is known by another name, such as "EXT" for "DECam"; the name itself otherwise."""
    return next((other for other in _VALUES.get(name.lower(), ()) if other in legal), name)


def refuse_name(name: str, legal: Sequence[str]) -> str:
    """Return the end of an error message about a name: the most similar legal name, if any, and the legal names."""
    meant = [other for other in _VALUES.get(name.lower(), ()) if other in legal]
    if len(meant) > 1:
        return f"{quote_value(name)} is not allowed: did you mean {spelling.join_words(meant)}?"
    if meant:
        return f"{quote_value(name)} is not allowed: {spelling.choices(meant[0], legal)}"
    if spelling.related_bands(name, legal) or spelling.did_you_mean(name, legal):
        return f"{quote_value(name)} is not allowed: {spelling.choices(name, legal)}"
    return f"{quote_value(name)} is not one of {', '.join(legal)}"


def strings(table: Toml, path: str, legal: Sequence[str] = (), distinct: bool = True) -> tuple[str, ...]:
    """Read the value of a key that must be a list of texts; return () if the key is missing.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    legal : sequence of str, optional
        Texts that are allowed; empty for any texts.
    distinct : bool, optional
        If True, no text may occur twice in the list.

    Returns
    -------
    tuple of str
        The texts.

    Raises
    ------
    BadInput
        If the value is not a list of allowed texts, or if `distinct` is True and a text occurs twice.
    """
    texts = table.get(path.rpartition(".")[2], [])
    if not isinstance(texts, list) or not all(isinstance(item, str) for item in texts):
        raise BadInput(f"{path} must be a list of texts such as {_list_form(texts, legal)}, got {quote_value(texts)}")
    if unknown := [item for item in texts if legal and item not in legal]:
        raise bad_input(f"{path}: {refuse_name(item, legal)}" for item in unknown)
    if distinct and len(set(texts)) != len(texts):
        raise BadInput(f"{path} = {quote_value(texts)} contains a text twice")
    return tuple(texts)


def _list_form(value: object, legal: Sequence[str]) -> str:
    """Return an example of a list of texts: a text alone, or the legal text that it means, becomes a list."""
    if not isinstance(value, str):
        return '[".."]'
    if not legal or value in legal:
        return f"[{quote_value(value)}]"
    meant = spelling.closest_names(known_name(value, legal), legal, 1) or legal
    return f"[{quote_value(meant[0])}] (allowed: {', '.join(legal)})"


def number(table: Toml, path: str, lo: float, hi: float, default: float | None = None, unit: str = "") -> float:
    """Read the value of a key that must be a finite number.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    lo, hi : float
        Smallest and largest number that is allowed.
    default : float, optional
        Value if the key is missing, which is not checked; None if the key is required.
    unit : str, optional
        Unit of the number, for error messages.

    Returns
    -------
    float
        The number.

    Raises
    ------
    BadInput
        If the key is missing without a default, or the value is not a number.
    OutOfRange
        If the number is outside its limits, NaN or infinite.
    """
    if default is not None and not has_key(table, path):
        return default
    value = required_value(table, path, f"it must be {_describe_range(lo, hi, unit)}")
    return checked_number(value, path, lo, hi, unit)


def optional_number(table: Toml, path: str, lo: float, hi: float, unit: str = "") -> float | None:
    """Read the value of a key that must be a finite number; return None if the key is missing.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    lo, hi : float
        Smallest and largest number that is allowed.
    unit : str, optional
        Unit of the number, for error messages.

    Returns
    -------
    float or None
        The number, or None.

    Raises
    ------
    BadInput
        If the value is not a number.
    OutOfRange
        If the number is outside its limits, NaN or infinite.
    """
    return number(table, path, lo, hi, unit=unit) if has_key(table, path) else None


def checked_number(value: object, path: str, lo: float, hi: float, unit: str = "") -> float:
    """Check that a value is a finite number, and return it as float.

    Parameters
    ----------
    value : object
        Value in the request.
    path : str
        Path of the key, for error messages.
    lo, hi : float
        Smallest and largest number that is allowed.
    unit : str, optional
        Unit of the number, for error messages.

    Returns
    -------
    float
        The number.

    Raises
    ------
    BadInput
        If the value is not a number; true and false are not numbers.
    OutOfRange
        If the number is outside its limits, NaN or infinite.
    """
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        hint = _quotes_hint(value, path, float)
        if unit in ("deg", "arcsec") and hint.endswith("quotes"):
            form = _describe_range(lo, hi, unit).removeprefix("a number ")
            arguments.refuse_angle(path, value, form, unit, _ANGLE_DIGITS)
        raise BadInput(f"{path} must be {_describe_range(lo, hi, unit)}, got {quote_value(value)}{hint}")
    # Compare before the conversion to float, which fails for huge whole numbers. TOML has no upper limit for them.
    if not lo <= value <= hi or not abs(value) <= sys.float_info.max:
        raise OutOfRange(path, quote_value(value), lo, hi, unit)
    return float(value)


def _quotes_hint(value: object, path: str, number_type: type[int] | type[float]) -> str:
    """Return words about the quotes around a number, which a text has, or "" for another value."""
    if not isinstance(value, str):
        return ""
    try:
        number_type(value)
    except ValueError:
        return " in quotes"
    return f" in quotes: write it without quotes, {path.rpartition('.')[2]} = {value[:40].strip()}"


def _describe_range(lo: float, hi: float, unit: str) -> str:
    """Return "a number from 1 to 2 deg", or "a number" if the limits are infinite."""
    limits = f" from {lo:g} to {hi:g}" if math.isfinite(lo) and math.isfinite(hi) else ""
    return f"a number{limits}{' ' if unit else ''}{unit}"


def integer(table: Toml, path: str, lo: int, hi: int, default: int | None = None) -> int:
    """Read the value of a key that must be a whole number.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    lo, hi : int
        Smallest and largest number that is allowed.
    default : int, optional
        Value if the key is missing, which is not checked; None if the key is required.

    Returns
    -------
    int
        The number.

    Raises
    ------
    BadInput
        If the key is missing without a default, or the value is not a whole number.
    OutOfRange
        If the number is outside its limits.
    """
    if default is not None and not has_key(table, path):
        return default
    return checked_integer(required_value(table, path, f"it must be a whole number from {lo} to {hi}"), path, lo, hi)


def checked_integer(value: object, path: str, lo: int, hi: int) -> int:
    """Check that a value is a whole number, and return it.

    Parameters
    ----------
    value : object
        Value in the request.
    path : str
        Path of the key, for error messages.
    lo, hi : int
        Smallest and largest number that is allowed.

    Returns
    -------
    int
        The number.

    Raises
    ------
    BadInput
        If the value is not a whole number; true, false and 2.0 are not whole numbers.
    OutOfRange
        If the number is outside its limits.
    """
    if isinstance(value, bool) or not isinstance(value, int):
        hint = _quotes_hint(value, path, int)
        raise BadInput(f"{path} must be a whole number from {lo} to {hi}, got {quote_value(value)}{hint}")
    if not lo <= value <= hi:
        raise OutOfRange(path, quote_value(value), lo, hi)
    return value


def boolean(table: Toml, path: str, default: bool) -> bool:
    """Read the value of a key that must be true or false.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    default : bool
        Value if the key is missing.

    Returns
    -------
    bool
        The value.

    Raises
    ------
    BadInput
        If the value is not a boolean.
    """
    flag = table.get(path.rpartition(".")[2], default)
    if not isinstance(flag, bool):
        raise BadInput(f"{path} must be true or false without quotes, got {quote_value(flag)}")
    return flag


def integer_choice(table: Toml, path: str, legal: Sequence[int], default: int) -> int:
    """Read the value of a key that must be one of a few whole numbers.

    Parameters
    ----------
    table : Toml
        Table of the section with the key.
    path : str
        Path of the key.
    legal : sequence of int
        Numbers that are allowed.
    default : int
        Value if the key is missing; it must be one of `legal`.

    Returns
    -------
    int
        The number.

    Raises
    ------
    BadInput
        If the value is not one of the allowed numbers.
    """
    selected = table.get(path.rpartition(".")[2], default)
    if isinstance(selected, bool) or not isinstance(selected, int) or selected not in legal:
        raise BadInput(f"{path} = {quote_value(selected)} is not one of {', '.join(map(str, legal))}")
    return selected
