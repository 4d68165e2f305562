"""Where sources are: seen by a telescope, or in truth; which columns say so, in lakes of this and of an earlier time.

named           columns by the names that they have, whichever they were asked by;  aliases_in : a text that asks
columns         ra and dec of the one or the other place
is_indexed_by_true    does a table lie in files by true positions, as earlier ones do?
refuse_earlier  such a table, where another is to be made of it
refuse_mixed    a table by observed positions beside one by true ones
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any, Protocol

from lake_schema import tables as declarations
from lake_schema.columns import Table
from lake_schema.errors import BadInput

# "lensed" is an earlier name of the first.
ON = ("observed", "true", "lensed")
_JOBS = {"galaxies": "build_galaxies", "quarantine": "build_galaxies", "strong_lenses": "build_strong_lenses"}
_BY_TRUE = "is indexed by true positions, as earlier versions of truesky wrote it"


class Published(Protocol):
    """A version of a table, and its manifest."""

    @property
    def table(self) -> str: ...
    @property
    def manifest(self) -> dict[str, Any]: ...


def named(table: str, asked: Sequence[str], there: Sequence[str]) -> list[str]:
    """What columns are called in a table that has those that are there; a name that is unknown stays as it is.

    table : its name;  asked : names, some of them earlier ones
    """
    aliases = dict(known.aliases) if (known := declarations.find(table, there)) else {}
    return [name if name in there else aliases.get(name, name) for name in asked]


def aliases_in(table: str, there: Sequence[str], text: str) -> tuple[tuple[str, str], ...]:
    """(earlier name, name) of columns that a text names as they were called.

    table, there : as of `named`;  text : such as a query
    """
    known = declarations.find(table, there)
    words = set(re.findall(r"\w+", text.lower())) if known is not None and known.aliases else set()
    return tuple((name, own) for name, own in known.aliases if name in words and own in there) if known else ()


def columns(version: Published, there: Sequence[str], on: str = "observed") -> tuple[str, str]:
    """Columns of right ascension and declination; of what nothing lenses both places are one.

    version : of a catalogue;  there : names of its columns;  on : one of ON
    Errors  : BadInput where it does not have this place
    """
    if on not in ON:
        raise BadInput(f"on = {on!r} is not one of {', '.join(ON)}")
    if on == "true":
        return ("ra_true", "dec_true") if "ra_true" in there else ("ra", "dec")
    if "ra_lensed" in there:
        return "ra_lensed", "dec_lensed"
    if is_indexed_by_true(version):
        raise BadInput(f"table {version.table} {_BY_TRUE}, and has no observed ones: take those of table galaxies")
    return "ra", "dec"


def is_indexed_by_true(version: Published) -> bool:
    """Are a catalogue's files, and its ra and dec, of true positions, although its sources are seen elsewhere?"""
    known = _known(version)
    return known is not None and int(version.manifest["version"]) <= known.version


def _known(version: Published) -> Table | None:
    """The earlier declaration of a table that has one."""
    known = declarations.find(version.table)
    return None if known is None else known.earlier


def refuse_earlier(version: Published) -> None:
    """Raise BadInput where a table is indexed by true positions: what is made of it now would be by observed ones."""
    if is_indexed_by_true(version):
        raise BadInput(f"table {version.table} {_BY_TRUE}: run {_job(version)} first")


def refuse_mixed(versions: Iterable[Published]) -> None:
    """Raise BadInput, which names both, where some tables are indexed by true positions and others by observed ones."""
    every = [version for version in versions if _known(version) is not None]
    earlier = [version for version in every if is_indexed_by_true(version)]
    if earlier and len(earlier) < len(every):
        now = next(version for version in every if not is_indexed_by_true(version))
        what = f"table {earlier[0].table} {_BY_TRUE}, table {now.table} by observed ones"
        raise BadInput(f"{what}: run {_job(earlier[0])} first")


def _job(version: Published) -> str:
    return _JOBS.get(version.table, "compute_fluxes")
