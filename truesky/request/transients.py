"""Read the key `universe.transients` of a request: supernovae that explode during a window of time."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from lake_schema import user_files
from lake_schema.errors import BadInput, Mistakes
from truesky.request import sky_notation
from truesky.request.toml_values import Toml, as_table, number, quote_value, required_value, string, strings

# Families of supernovae.
KINDS = ("ia", "core_collapse")
# Longest window of time, days: 100 years.
MAX_WINDOW = 36525.0
_PATH = "universe.transients"


@dataclass(frozen=True, slots=True)
class Transients:
    """Supernovae of a request.

    Attributes
    ----------
    start, end : float
        First and last date, MJD. All supernovae that shine at any time in between are drawn.
    kinds : tuple of str
        Families of supernovae, from `KINDS`.
    boost : float
        Ratio of the drawn rate to the natural rate.
    light_curves : Path, optional
        Parquet file with spectra of type Ia supernovae that replace the built-in ones; None for the built-in ones.
    """

    start: float
    end: float
    kinds: tuple[str, ...] = KINDS
    boost: float = 1.0
    light_curves: Path | None = None


def parse(value: object, folder: Path) -> Transients | None:
    """Read the key `universe.transients`; file names are relative to `folder`, the folder of the request.

    Returns None if there are no transients (`value` is None).

    Raises
    ------
    BadInput
        If the value is not valid. The message names the key.
    """
    if value is None:
        return None
    table = as_table(value, _PATH, Transients.__slots__)
    with Mistakes() as mistakes:
        read = mistakes.read
        start, end = (read(_date, table, f"{_PATH}.{key}") for key in ("start", "end"))
        kinds = read(strings, table, f"{_PATH}.kinds", KINDS)
        if kinds == () and "kinds" in table:
            mistakes.add(BadInput(f"{_PATH}.kinds is empty: it needs one of {', '.join(KINDS)}"))
        boost = read(number, table, f"{_PATH}.boost", 1e-3, 1e3, 1.0)
        file = read(string, table, f"{_PATH}.light_curves") if "light_curves" in table else None
        if start is not None and end is not None:
            read(_check_window, start, end)
    assert start is not None
    assert end is not None
    assert boost is not None
    path = None if file is None else user_files.expand_path(file, folder)
    return Transients(start, end, kinds or KINDS, boost, path)


def _date(table: Toml, path: str) -> float:
    return sky_notation.mjd(required_value(table, path), path)


def _check_window(start: float, end: float) -> None:
    if not start < end:
        empty = "is empty" if start == end else "ends before it starts"
        raise BadInput(f"{_PATH}: the window of time from {start:.10g} to {end:.10g} {empty}: end must be after start")
    if end - start > MAX_WINDOW:
        years = quote_value(round((end - start) / 365.25, 1))
        raise BadInput(f"{_PATH}: the window of time is {years} years, at most {MAX_WINDOW / 365.25:.0f} are allowed")
