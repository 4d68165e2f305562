"""What a lake holds: every version of every table, with the requests that it belongs to and what it was made of.

rows    a mapping a version, for whoever wants it as JSON
text    the same in aligned columns
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from typing import Any

from lake_schema.errors import BadInput, LakeError
from lake_schema.store import garbage, layout, manifest, request_links
from lake_schema.store.object_storage.s3 import MANIFEST, Folder

_HEADINGS = ("names", "table", "version", "current", "published", "rows", "bytes", "made of")
_RIGHT_ALIGNED = {"rows", "bytes"}
# Digits of a key that tell versions apart on a page.
_KEY_DIGITS = 8


def rows(root: Folder) -> list[dict[str, Any]]:
    """Versions by table, and in a table by date.

    names     : of the requests that it belongs to
    current   : whether it was published last
    published : UTC, ISO 8601; bytes : of its files, those that it shares with others among them
    made_of   : table -> keys of the versions that it was made of
    error     : why it cannot be read, where it cannot
    """
    if not (table_names := garbage.table_names(root)):
        raise BadInput(f"lake {root} holds no table")
    return [
        row
        for name in table_names
        for row in sorted(_version_rows(root, name, table_names), key=lambda row: row["published"])
    ]


def _version_rows(root: Folder, name: str, table_names: Sequence[str]) -> list[dict[str, Any]]:
    current, keys_by_request, version_rows = (
        layout.current_key(root, name),
        request_links.keys_by_request(root, name),
        [],
    )
    for folder in layout.table_folder(root, name).glob("v-*"):
        key = folder.name.removeprefix("v-")
        requests = sorted(request for request, held_key in keys_by_request.items() if held_key == key)
        row: dict[str, Any] = {"table": name, "version": key, "names": requests, "current": key == current}
        try:
            contents = manifest.load(folder, name)
            published_at = datetime.fromtimestamp((folder / MANIFEST).stat().st_mtime, UTC)
            row |= {
                "published": f"{published_at:%Y-%m-%dT%H:%M:%SZ}",
                "rows": contents["rows"],
                "bytes": sum(entry["bytes"] for entry in contents["files"]),
                "made_of": _input_keys(root, contents["facts"], table_names),
            }
        except (LakeError, OSError) as error:
            row |= {"published": "", "rows": None, "bytes": None, "made_of": {}, "error": str(error)}
        version_rows.append(row)
    return version_rows


def _input_keys(root: Folder, facts: Mapping[str, Any], table_names: Sequence[str]) -> dict[str, list[str]]:
    keys = sorted(set(request_links.version_keys_in(facts)))
    keys_by_table = {
        name: [key for key in keys if layout.version_folder(root, name, key).exists()] for name in table_names
    }
    return {name: existing_keys for name, existing_keys in keys_by_table.items() if existing_keys}


def format_table(version_rows: Sequence[Mapping[str, Any]]) -> str:
    """Rows in aligned columns, a head above them."""
    lines = [_HEADINGS, *(_format_cells(row) for row in version_rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    aligned_right = [head in _RIGHT_ALIGNED for head in _HEADINGS]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if to_right else cell.ljust(width)
            for cell, width, to_right in zip(line, widths, aligned_right, strict=True)
        ).rstrip()
        for line in lines
    )


def _format_cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    made_of = [f"{name} {key[:_KEY_DIGITS]}" for name, keys in row["made_of"].items() for key in keys]
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
