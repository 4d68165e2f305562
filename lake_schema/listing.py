"""What a lake holds: every version of every table, with the requests that it belongs to and what it was made of.

rows    a mapping a version, for whoever wants it as JSON
text    the same in aligned columns
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from lake_schema.errors import BadInput, LakeError
from lake_schema.store import garbage, layout, manifest, names
from lake_schema.store.object_storage.s3 import MANIFEST, Folder

_HEADS = ("names", "table", "version", "current", "published", "rows", "bytes", "made of")
_RIGHT = {"rows", "bytes"}
# Digits of a key that tell versions apart on a page.
_SHORT = 8


def rows(root: Folder) -> list[dict[str, Any]]:
    """Versions by table, and in a table by date.

    names     : of the requests that it belongs to
    current   : whether it was published last
    published : UTC, ISO 8601; bytes : of its files, those that it shares with others among them
    made_of   : table -> keys of the versions that it was made of
    error     : why it cannot be read, where it cannot
    """
    if not (there := garbage.tables(root)):
        raise BadInput(f"lake {root} holds no table")
    return [row for name in there for row in sorted(_of_table(root, name, there), key=lambda row: row["published"])]


def _of_table(root: Folder, name: str, there: Sequence[str]) -> list[dict[str, Any]]:
    current, held, found = layout.current_key(root, name), names.holders(root, name), []
    for folder in layout.table(root, name).glob("v-*"):
        key = folder.name.removeprefix("v-")
        own = sorted(request for request, held_key in held.items() if held_key == key)
        row: dict[str, Any] = {"table": name, "version": key, "names": own, "current": key == current}
        try:
            about = manifest.load(folder, name)
            moment = datetime.fromtimestamp((folder / MANIFEST).stat().st_mtime, UTC)
            row |= {
                "published": f"{moment:%Y-%m-%dT%H:%M:%SZ}",
                "rows": about["rows"],
                "bytes": sum(entry["bytes"] for entry in about["files"]),
                "made_of": _made_of(root, about["facts"], there),
            }
        except (LakeError, OSError) as error:
            row |= {"published": "", "rows": None, "bytes": None, "made_of": {}, "error": str(error)}
        found.append(row)
    return found


def _made_of(root: Folder, facts: Mapping[str, Any], there: Sequence[str]) -> dict[str, list[str]]:
    keys = sorted(set(names.keys_in(facts)))
    found = {name: [key for key in keys if layout.version(root, name, key).exists()] for name in there}
    return {name: own for name, own in found.items() if own}


def text(found: Sequence[Mapping[str, Any]]) -> str:
    """Rows in aligned columns, a head above them."""
    lines = [_HEADS, *(_cells(row) for row in found)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    right = [head in _RIGHT for head in _HEADS]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(line, widths, right, strict=True)
        ).rstrip()
        for line in lines
    )


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    made_of = [f"{name} {key[:_SHORT]}" for name, keys in row["made_of"].items() for key in keys]
    return (
        ",".join(row["names"]) or "-",
        row["table"],
        row["version"],
        "yes" if row["current"] else "no",
        row["published"][:16].replace("T", " ") or "-",
        "-" if row["rows"] is None else f"{row['rows']:,}",
        "-" if row["bytes"] is None else f"{row['bytes']:,}",
        row.get("error") or ", ".join(made_of) or "-",
    )
