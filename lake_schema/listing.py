"""List the versions of all tables of a lake, with their sizes, their inputs, and the requests that use them.

A version is one publication of a table; a request is a named set of settings for which tables are made.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from datetime import UTC, datetime
from typing import Any

from lake_schema.errors import LakeError
from lake_schema.store import garbage, layout, manifest, request_links
from lake_schema.store.object_storage.s3 import MANIFEST, Folder
from lake_schema.texts import text_tables

_HEADINGS = ("names", "table", "version", "current", "published", "rows", "bytes", "made of")
_NUMBERS = {"rows", "bytes"}
# Number of hexadecimal digits of a version's key that are printed, out of 16. They suffice to tell versions apart.
_KEY_DIGITS = 8


def rows(root: Folder) -> list[dict[str, Any]]:
    """Return one dict per version of each table of a lake, sorted by table and then by time of publication.

    Returns
    -------
    list of dict
        Keys of each dict:

        - ``table``, ``version``: name of the table and key of the version (16 hexadecimal digits)
        - ``names``: names of the requests (named sets of settings) that use the version
        - ``current``: True if the version was published last
        - ``published``: time of publication, UTC, ISO 8601, or "" if the version cannot be read
        - ``rows``: number of rows, or None if the version cannot be read
        - ``bytes``: total size of its files, including files that other versions share, or None if the version
          cannot be read
        - ``made_of``: keys of the existing versions from which it was made, by name of their table
        - ``error``: reason why the version cannot be read; the key is missing for a sound version

    Raises
    ------
    BadInput
        If the lake has no table.
    """
    if not (table_names := garbage.table_names(root)):
        raise layout.missing_table(root)
    existing_keys = {name: garbage.existing_versions(root, name) for name in table_names}
    return [
        row
        for name in table_names
        for row in sorted(_version_rows(root, name, existing_keys), key=lambda row: row["published"])
    ]


def _version_rows(root: Folder, name: str, existing_keys: Mapping[str, Set[str]]) -> list[dict[str, Any]]:
    current, keys_by_request, version_rows = (
        layout.current_key(root, name),
        request_links.keys_by_request(root, name),
        [],
    )
    for key in sorted(existing_keys[name]):
        requests = sorted(request for request, held_key in keys_by_request.items() if held_key == key)
        row: dict[str, Any] = {"table": name, "version": key, "names": requests, "current": key == current}
        try:
            folder = layout.version_folder(root, name, key)
            contents = manifest.load(folder, name)
            published_at = datetime.fromtimestamp((folder / MANIFEST).stat().st_mtime, UTC)
            row |= {
                "published": f"{published_at:%Y-%m-%dT%H:%M:%SZ}",
                "rows": contents["rows"],
                "bytes": sum(entry["bytes"] for entry in contents["files"]),
                "made_of": _input_keys(contents["facts"], existing_keys),
            }
        except (LakeError, OSError) as error:
            row |= {"published": "", "rows": None, "bytes": None, "made_of": {}, "error": str(error)}
        version_rows.append(row)
    return version_rows


def _input_keys(facts: Mapping[str, Any], existing_keys: Mapping[str, Set[str]]) -> dict[str, list[str]]:
    keys = set(request_links.version_keys_in(facts))
    return {name: sorted(keys & existing) for name, existing in existing_keys.items() if keys & existing}


def format_table(version_rows: Sequence[Mapping[str, Any]]) -> str:
    """Format the dicts that `rows` returns as lines of text with aligned columns and a heading."""
    return "\n".join(text_tables.format_table(_HEADINGS, [_format_cells(row) for row in version_rows], _NUMBERS))


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
