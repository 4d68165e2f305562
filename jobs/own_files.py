"""Files of spectra, filters and extinction laws that a request names.

Curves, OwnCurves    what is named;  parse : of the request's section `fluxes`
file_of              a file beside the request
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from jobs.toml_values import Toml, string, strings, table_of
from lake_schema import layout
from lake_schema.errors import BadInput


@dataclass(frozen=True, slots=True)
class Curves:
    """Files of spectra, of a filter or of an extinction law; medium : of a filter's wavelengths, "air" or "vacuum"."""

    files: tuple[Path, ...]
    format: str
    medium: str = ""


@dataclass(frozen=True, slots=True)
class OwnCurves:
    """What stands beside the embedded passbands, and in place of the embedded galaxies, extinction laws and dwarfs.

    basel : models of dwarfs;  irtf : spectra of stars whose infrared the dwarfs are given
    """

    passbands: tuple[tuple[str, Curves], ...] = ()
    templates: Curves | None = None
    extinction: tuple[tuple[int, Curves], ...] = ()
    basel: Path | None = None
    irtf: tuple[Path, ...] = ()


def file_of(folder: Path, name: str) -> Path:
    """A file by its name, found from the request's folder."""
    return folder / Path(name).expanduser()


def parse(table: Toml, folder: Path) -> OwnCurves:
    """The section `fluxes`; files are found from `folder`.  BadInput names the key."""
    filters = table_of(table.get("passbands", {}), "fluxes.passbands", None)
    laws = table_of(table.get("extinction", {}), "fluxes.extinction", set("1234"))
    passbands = [_curves(value, f"fluxes.passbands.{layout.name(key)}", folder, True) for key, value in filters.items()]
    extinction = [_curves(value, f"fluxes.extinction.{key}", folder) for key, value in laws.items()]
    templates = None
    if "templates" in table:
        path = "fluxes.templates"
        given = table_of(table["templates"], path, {"files", "format"})
        files = strings(given, f"{path}.files", distinct=False)
        if not files:
            raise BadInput(f"{path}.files is missing")
        templates = Curves(tuple(file_of(folder, file) for file in files), string(given, f"{path}.format"))
    stars = table_of(table.get("stars", {}), "fluxes.stars", {"basel", "irtf"})
    if "stars" in table and not stars:
        raise BadInput("fluxes.stars names neither basel nor irtf")
    return OwnCurves(
        tuple(zip(filters, passbands, strict=True)),
        templates,
        tuple(zip(map(int, laws), extinction, strict=True)),
        file_of(folder, string(stars, "fluxes.stars.basel")) if "basel" in stars else None,
        tuple(file_of(folder, name) for name in strings(stars, "fluxes.stars.irtf")),
    )


def _curves(value: object, path: str, folder: Path, has_medium: bool = False) -> Curves:
    table = table_of(value, path, {"file", "format", *(["medium"] if has_medium else [])})
    medium = string(table, f"{path}.medium", ("air", "vacuum")) if has_medium else ""
    return Curves((file_of(folder, string(table, f"{path}.file")),), string(table, f"{path}.format"), medium)
