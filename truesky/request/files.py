"""Read the sections of a request that name external files: spectra, filters, catalogues, PSFs, sources and cameras."""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.store import layout
from lake_schema.store.provenance import file_sha256
from truesky.request.toml_values import Toml, as_table, boolean, number, quote_value, string, strings

if TYPE_CHECKING:
    from lake_schema.mission.camera_folder import Camera

# Kind of file in messages of lake_schema.user_files.
SOURCES_KIND = "table of sources"


@dataclass(frozen=True, slots=True)
class Curves:
    """Files of spectra, of a filter or of an extinction law.

    Attributes
    ----------
    files : tuple of Path
        The files.
    format : str
        Format of the files, a key of truesky/fluxes/libraries/spectrum_formats.toml.
    medium : str
        Medium in which a filter's wavelengths are measured, "air" or "vacuum".
    location : str
        Table and line that name the file, for messages; "" if a key of the request names it.
    """

    files: tuple[Path, ...]
    format: str
    medium: str = ""
    location: str = ""


@dataclass(frozen=True, slots=True)
class UserCurves:
    """User files that add passbands or replace the built-in galaxy templates, extinction laws and dwarf stars.

    Attributes
    ----------
    passbands : tuple of (str, Curves)
        Name and file of each passband.
    templates : Curves, optional
        Spectra of galaxies.
    extinction : tuple of (int, Curves)
        Number of the law that is replaced (1 to 4), and its file.
    basel : Path, optional
        File of model spectra of dwarf stars (BaSeL).
    irtf : tuple of Path
        Spectra of stars (IRTF) that replace the infrared part of the dwarf spectra.
    intergalactic : bool
        True if the intergalactic hydrogen absorbs the light of galaxies.
    """

    passbands: tuple[tuple[str, Curves], ...] = ()
    templates: Curves | None = None
    extinction: tuple[tuple[int, Curves], ...] = ()
    basel: Path | None = None
    irtf: tuple[Path, ...] = ()
    intergalactic: bool = False


@dataclass(frozen=True, slots=True)
class Catalogue:
    """Files of an external catalogue.

    Attributes
    ----------
    files : tuple of Path
        The files.
    format : str
        Format of a catalogue of galaxies, a key of ingest_formats.toml; "" for none.
    columns : tuple of (str, str)
        Name of our column and its replacement as JSON, in addition to the columns of the format.
    """

    files: tuple[Path, ...]
    format: str = ""
    columns: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class DustMap:
    """A HEALPix map of E(B-V) or A(V).

    Attributes
    ----------
    file : Path
        The file.
    column : str
        Name of the column.
    quantity : str
        "ebv" or "a_v".
    ordering : str
        "RING" or "NESTED": the header must have this value, or none. "" to use the value in the header.
    coordinates : str
        "G" (Galactic) or "C" (equatorial): the header must have this value, or none. "" to use the value in the header.
    """

    file: Path
    column: str
    quantity: str = "ebv"
    ordering: str = ""
    coordinates: str = ""


@dataclass(frozen=True, slots=True)
class Ingest:
    """External catalogues and maps that replace simulated ones.

    Attributes
    ----------
    galaxies : Catalogue, optional
        A finished catalogue of galaxies.
    halos : Catalogue, optional
        A light-cone of halos.
    training : Catalogue, optional
        Observed galaxies; each simulated galaxy gets the spectrum of one of these.
    dust : DustMap, optional
        Map of the dust of the Milky Way.
    """

    galaxies: Catalogue | None = None
    halos: Catalogue | None = None
    training: Catalogue | None = None
    dust: DustMap | None = None


@dataclass(frozen=True, slots=True)
class UserSources:
    """Tables that contain all sources of a simulation.

    Attributes
    ----------
    galaxies, stars : Path, optional
        CSV files (truesky/catalogue/given_sources.py).
    band : str
        Passband of their magnitudes.
    spacing : float
        Spacing in arcsec of the grid on which the rows are placed in turn; 0 if the tables have positions.
    """

    galaxies: Path | None
    stars: Path | None
    band: str
    spacing: float

    def facts(self, bounds: tuple[float, float, float]) -> dict[str, Any]:
        """Return the facts about these sources for the key of a plan; `bounds` is the bounding circle of the area."""
        files = {"galaxies": self.galaxies, "stars": self.stars}
        checksums = {
            name: file_sha256(_check_csv(file, f"sources.{name}")) for name, file in files.items() if file is not None
        }
        grid = {"spacing": self.spacing, "bounds": list(bounds)} if self.spacing else {}
        return {"sha256": checksums, "band": self.band, **grid}


def _check_csv(file: Path, key: str) -> Path:
    if file.suffix.lower() != ".csv":
        raise BadInput(f"{key}: {user_files.format_path(file)}: the file name must end with .csv")
    return user_files.check_file(file, SOURCES_KIND, key)


def resolve_path(folder: Path, name: str) -> Path:
    """Return the path of a file that is named relative to the folder of the request."""
    return user_files.expand_path(name, folder)


def read_cameras(names: Sequence[str], folder: Path) -> tuple[Camera, ...]:
    """Read the folders of user cameras.

    Parameters
    ----------
    names : sequence of str
        Folders, as the request names them.
    folder : Path
        Folder of the request; other paths are relative to it.

    Returns
    -------
    tuple of Camera
        The cameras, in the order of `names`.

    Raises
    ------
    BadInput
        If a folder is not a valid camera, or two have one name. The message names the file and the line.
    """
    if not names:
        return ()
    # Importing the unit parser takes a second, so requests without cameras skip it.
    from lake_schema.mission import camera_folder

    user_cameras: list[Camera] = []
    for i, name in enumerate(names):
        try:
            user_cameras.append(camera_folder.read(resolve_path(folder, name)))
        except BadInput as error:
            raise BadInput(f"mission.cameras[{i}]: {error}") from None
        if user_cameras[-1].name in [camera.name for camera in user_cameras[:-1]]:
            raise BadInput(f"mission.cameras[{i}]: two cameras have the name {user_cameras[-1].name}")
    return tuple(user_cameras)


# Format by file name extension, a key of truesky/fluxes/libraries/spectrum_formats.toml.
_CURVE_FORMATS = {".ecsv": "passband_ecsv", ".xml": "passband_svo", ".vot": "passband_svo"}


def with_camera_passbands(
    user_curves: UserCurves, user_cameras: Sequence[Camera], bands: Collection[str]
) -> UserCurves:
    """Add the passbands of user cameras in which a request observes.

    Parameters
    ----------
    user_curves : UserCurves
        The section `fluxes` of the request.
    user_cameras : sequence of Camera
        The user's cameras.
    bands : collection of str
        Bands that the request names.

    Returns
    -------
    UserCurves
        The section with these passbands added.

    Raises
    ------
    BadInput
        If two passbands have one name.
    """
    passbands = dict(user_curves.passbands)
    camera_curves = [
        (i, curve) for i, camera in enumerate(user_cameras) for curve in camera.curves if curve.band in bands
    ]
    for i, curve in camera_curves:
        location = f"mission.cameras[{i}]: {curve.location}"
        form = _CURVE_FORMATS.get(curve.file.suffix.lower(), "passband_ascii")
        if curve.band in passbands:
            other = passbands[curve.band].location or f"fluxes.passbands.{curve.band}"
            problem = f"band {curve.band} has another curve in {other}: all curves must have different names"
            raise BadInput(f"{location}: {problem}")
        passbands[curve.band] = Curves((curve.file,), form, curve.medium, location)
    return replace(user_curves, passbands=tuple(passbands.items()))


def parse_curves(table: Toml, folder: Path) -> UserCurves:
    """Read the section `fluxes`; `folder` is the folder of the request.

    Raises
    ------
    BadInput
        If the section is not valid. The message names the key.
    """
    filters = as_table(table.get("passbands", {}), "fluxes.passbands", None)
    laws = as_table(table.get("extinction", {}), "fluxes.extinction", set("1234"))
    passbands = [
        _curves(value, f"fluxes.passbands.{layout.check_name(key)}", folder, True) for key, value in filters.items()
    ]
    extinction = [_curves(value, f"fluxes.extinction.{key}", folder) for key, value in laws.items()]
    templates = None
    if "templates" in table:
        path = "fluxes.templates"
        templates_table = as_table(table["templates"], path, {"files", "format"})
        files = strings(templates_table, f"{path}.files", distinct=False)
        if not files:
            raise BadInput(f"{path}.files is missing")
        templates = Curves(
            tuple(resolve_path(folder, file) for file in files), string(templates_table, f"{path}.format")
        )
    stars = as_table(table.get("stars", {}), "fluxes.stars", {"basel", "irtf"})
    if "stars" in table and not stars:
        raise BadInput("fluxes.stars must have basel or irtf")
    return UserCurves(
        tuple(zip(filters, passbands, strict=True)),
        templates,
        tuple(zip(map(int, laws), extinction, strict=True)),
        resolve_path(folder, string(stars, "fluxes.stars.basel")) if "basel" in stars else None,
        tuple(resolve_path(folder, name) for name in strings(stars, "fluxes.stars.irtf")),
        boolean(table, "fluxes.intergalactic", False),
    )


def _curves(value: object, path: str, folder: Path, has_medium: bool = False) -> Curves:
    table = as_table(value, path, {"file", "format", *(["medium"] if has_medium else [])})
    medium = string(table, f"{path}.medium", ("air", "vacuum")) if has_medium else ""
    return Curves((resolve_path(folder, string(table, f"{path}.file")),), string(table, f"{path}.format"), medium)


def parse_ingest(table: Toml, folder: Path) -> Ingest:
    """Read the section `ingest`; `folder` is the folder of the request.

    Raises
    ------
    BadInput
        If the section is not valid. The message names the key.
    """
    galaxies = _catalogue(table["galaxies"], "ingest.galaxies", folder) if "galaxies" in table else None
    halos, training = (
        _catalogue(table[name], f"ingest.{name}", folder) if name in table else None for name in ("halos", "training")
    )
    if galaxies and halos:
        raise BadInput("ingest.halos is not allowed with ingest.galaxies, a finished catalogue")
    if galaxies and training:
        raise BadInput("ingest.training is not allowed with ingest.galaxies, whose galaxies have spectra")
    dust = None
    if "dust" in table:
        dust_table = as_table(table["dust"], "ingest.dust", set(DustMap.__slots__))
        dust = DustMap(
            resolve_path(folder, string(dust_table, "ingest.dust.file")),
            string(dust_table, "ingest.dust.column"),
            string(dust_table, "ingest.dust.quantity", ("ebv", "a_v"), "ebv"),
            string(dust_table, "ingest.dust.ordering", ("RING", "NESTED"), "RING") if "ordering" in dust_table else "",
            string(dust_table, "ingest.dust.coordinates", ("G", "C"), "G") if "coordinates" in dust_table else "",
        )
    return Ingest(galaxies, halos, training, dust)


def parse_psfs(table: Toml, folder: Path) -> tuple[tuple[str, str], ...]:
    """Read the section `psf` and return pairs (band, file); `folder` is the folder of the request.

    A band with a list of files has one pair for each file.

    Raises
    ------
    BadInput
        If the section is not valid. The message names the key.
    """
    band_files = []
    for band in sorted(table):
        path = f"psf.{band}"
        is_list = isinstance(table[band], list)
        names = strings(table, path) if is_list else (string(table, path),)
        if not names:
            raise BadInput(f"{path} names no file")
        band_files += [(layout.check_name(band), str(resolve_path(folder, name))) for name in names]
    return tuple(band_files)


def parse_sources(table: Toml, folder: Path) -> UserSources | None:
    """Read the section `sources`; `folder` is the folder of the request. Return None if the section is empty.

    Raises
    ------
    BadInput
        If the section is not valid. The message names the key.
    """
    if not table:
        return None
    grid = string(table, "sources.only", ("table", "grid")) == "grid"
    if "spacing" in table and not grid:
        raise BadInput('sources.spacing requires only = "grid": with only = "table" the rows have positions')
    spacing = number(table, "sources.spacing", 0.01, 3600.0) if grid else 0.0
    files = {
        name: resolve_path(folder, string(table, f"sources.{name}")) for name in ("galaxies", "stars") if name in table
    }
    if not files:
        raise BadInput("sources must have galaxies or stars")
    band = string(table, "sources.band", default="euclid_vis")
    return UserSources(files.get("galaxies"), files.get("stars"), band, spacing)


def _catalogue(value: object, path: str, folder: Path) -> Catalogue:
    table = as_table(value, path, {"files", "columns", *(["format"] if path.endswith("galaxies") else [])})
    files = strings(table, f"{path}.files")
    if not files:
        raise BadInput(f"{path}.files is missing or empty")
    columns = as_table(table.get("columns", {}), f"{path}.columns", None)
    return Catalogue(
        tuple(resolve_path(folder, name) for name in files),
        string(table, f"{path}.format", default=""),
        tuple((key, _to_json(columns[key], f"{path}.columns.{key}")) for key in sorted(columns)),
    )


def _to_json(value: object, path: str) -> str:
    try:
        return json.dumps(value, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError):
        raise BadInput(f"{path} must contain only texts, numbers and tables, got {quote_value(value)}") from None
