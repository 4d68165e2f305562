"""Read the sections of a request (a user's TOML file) that name other files of the user.

These are files of spectra, passbands, catalogues, PSFs, sources and cameras. File names are relative to the folder of
the request. The files of spectra, catalogues and PSFs are not opened here.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lake_schema import user_files
from lake_schema.errors import BadInput, Mistakes
from lake_schema.store import layout
from lake_schema.store.provenance import file_sha256
from truesky.request.toml_values import (
    Toml,
    as_table,
    boolean,
    check_keys,
    number,
    quote_value,
    required_value,
    string,
    strings,
)

if TYPE_CHECKING:
    from lake_schema.mission.camera_folder import Camera

# Formats of a user's passband. This copies truesky/fluxes/libraries/spectrum_formats.toml, because requests must not
# import the fluxes; test_from_files.py compares the two.
PASSBAND_FORMATS = ("passband_ascii", "passband_ecsv", "passband_svo")
# Words by which error messages of lake_schema.user_files name a file of sources.
SOURCES_KIND = "table of sources"


@dataclass(frozen=True, slots=True)
class Curves:
    """User files with galaxy spectra, a passband or an extinction law.

    Attributes
    ----------
    files : tuple of Path
        The files: one per galaxy spectrum, or a single one.
    format : str
        Format of the files, a key of truesky/fluxes/libraries/spectrum_formats.toml.
    medium : str
        Medium in which a passband's wavelengths are measured, "air" or "vacuum"; "" for spectra and laws.
    location : str
        File and line of a camera's table that names the passband, for error messages; "" if a key of the request
        names the file.
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
        Name and file of each additional passband.
    templates : Curves, optional
        Spectra that replace the galaxy templates; None for the built-in templates.
    extinction : tuple of (int, Curves)
        Number of each extinction law that is replaced (1 to 4), and its file.
    basel : Path, optional
        File of model spectra of dwarf stars (BaSeL), which are then used for all gravities and metallicities; None for
        the built-in spectra.
    irtf : tuple of Path
        Spectra of stars (IRTF) that replace the infrared part of the spectra of dwarfs (O9 to M9) and of stars by
        gravity and metallicity; () for none.
    intergalactic : bool
        True if intergalactic hydrogen absorbs the light of galaxies.
    """

    passbands: tuple[tuple[str, Curves], ...] = ()
    templates: Curves | None = None
    extinction: tuple[tuple[int, Curves], ...] = ()
    basel: Path | None = None
    irtf: tuple[Path, ...] = ()
    intergalactic: bool = False

    @property
    def has_stars(self) -> bool:
        """True if spectra of stars come from a user's files."""
        return self.basel is not None or bool(self.irtf)


@dataclass(frozen=True, slots=True)
class Catalogue:
    """Files of a user's catalogue.

    Attributes
    ----------
    files : tuple of Path
        Files, or folders with files.
    format : str
        Format of a catalogue of galaxies, a key of ingest_formats.toml; "" for none.
    columns : tuple of (str, str)
        Pairs of a column name in the lake, and the column of the file or its definition as JSON. They are added to the
        columns of the format, or replace them.
    """

    files: tuple[Path, ...]
    format: str = ""
    columns: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True, slots=True)
class DustMap:
    """A user's HEALPix map of the Milky Way's dust.

    Attributes
    ----------
    file : Path
        FITS file of the map.
    column : str
        Name of the column with the map.
    quantity : str
        Quantity in the map, "ebv" for E(B-V) or "a_v" for A(V), in mag.
    ordering : str
        Order of the pixels, "RING" or "NESTED"; "" to use the value in the file's header. A header with another value
        is refused.
    coordinates : str
        "G" (Galactic) or "C" (equatorial); "" to use the value in the file's header. A header with another value is
        refused.
    """

    file: Path
    column: str
    quantity: str = "ebv"
    ordering: str = ""
    coordinates: str = ""


@dataclass(frozen=True, slots=True)
class Ingest:
    """User catalogues and maps that replace simulated ones. An attribute is None if nothing is replaced.

    Attributes
    ----------
    galaxies : Catalogue, optional
        A complete catalogue of galaxies, which replaces the simulated galaxies.
    halos : Catalogue, optional
        A light-cone of dark-matter halos, which replaces the simulated halos.
    training : Catalogue, optional
        Observed galaxies. Each simulated galaxy gets the spectrum of a similar one among them.
    dust : DustMap, optional
        Map of the dust of the Milky Way.
    """

    galaxies: Catalogue | None = None
    halos: Catalogue | None = None
    training: Catalogue | None = None
    dust: DustMap | None = None


@dataclass(frozen=True, slots=True)
class UserSources:
    """A user's tables that contain all sources of a simulation.

    Attributes
    ----------
    galaxies, stars : Path, optional
        Files (truesky/catalogue/given_sources.py lists their columns); None if there are no such sources.
    band : str
        Passband of the magnitudes in the tables.
    spacing : float
        Spacing in arcsec of a grid that fills the area. The rows of both tables are placed on it in turn, and repeated
        until the grid is full. 0 if the tables have positions.
    galaxy_columns, star_columns : tuple of (str, str)
        Pairs of a property, and the column of the file or its definition as JSON; also settings. If there are no pairs
        or only settings, the columns of the file have the names of the properties.
    """

    galaxies: Path | None
    stars: Path | None
    band: str
    spacing: float
    galaxy_columns: tuple[tuple[str, str], ...] = ()
    star_columns: tuple[tuple[str, str], ...] = ()

    def facts(self, bounds: tuple[float, float, float]) -> dict[str, Any]:
        """Return checksums and options of the tables as JSON values, from which hashes of catalogues are computed.

        `bounds` is the bounding circle of the area in degrees: right ascension, declination and radius. It is included
        only if the sources are on a grid. Raises BadInput if a file does not exist.
        """
        files = {"galaxies": self.galaxies, "stars": self.stars}
        checksums = {
            name: file_sha256(user_files.check_file(file, SOURCES_KIND, f"sources.{name}"))
            for name, file in files.items()
            if file is not None
        }
        mapped = {"galaxies": dict(self.galaxy_columns), "stars": dict(self.star_columns)}
        columns = {name: pairs for name, pairs in mapped.items() if pairs}
        grid = {"spacing": self.spacing, "bounds": list(bounds)} if self.spacing else {}
        return {"sha256": checksums, "band": self.band, **grid, **({"columns": columns} if columns else {})}

    def count_rows(self) -> dict[str, int]:
        """Return the number of rows of each table by its name, "galaxies" or "stars".

        Raises BadInput if a file cannot be read, or has no column of magnitudes.
        """
        # Import here, because the import is slow and few requests have such tables.
        from lake_schema.external import rows

        counts = {}
        for name, file, pairs in (
            ("galaxies", self.galaxies, self.galaxy_columns),
            ("stars", self.stars, self.star_columns),
        ):
            if file is not None:
                title = _column_of_numbers(pairs)
                batches = rows.read_batches(file, [title], kind=SOURCES_KIND)
                counts[name] = sum(len(batch.columns[title]) for batch in batches)
        return counts


def _column_of_numbers(pairs: Sequence[tuple[str, str]]) -> str:
    """Return the name of a column of numbers that a mapping requires; "mag" if it maps no column."""
    entries = {key: json.loads(text) for key, text in pairs}
    for key in ("mag", "ra", "dec"):
        entry = entries.get(key)
        if isinstance(entry, dict) and isinstance(entry.get("column"), str):
            return str(entry["column"])
        if isinstance(entry, str):
            return entry
    return "mag"


def resolve_path(folder: Path, name: str) -> Path:
    """Return the path of a file that a request names; a relative name starts at `folder`, the folder of the request.

    ~ is expanded. It is not checked that the file exists.
    """
    return user_files.expand_path(name, folder)


def read_cameras(names: Sequence[str], folder: Path) -> tuple[Camera, ...]:
    """Read the folders in which a user defines ground cameras.

    Parameters
    ----------
    names : sequence of str
        Folders, one per camera, as the request names them.
    folder : Path
        Folder of the request, at which relative names start.

    Returns
    -------
    tuple of Camera
        The cameras, in the order of `names`.

    Raises
    ------
    BadInput
        If a folder does not define a valid camera, or two cameras have the same name. The message names the key of the
        request and, for a wrong line of a file in the folder, the file and the line.
    """
    if not names:
        return ()
    # Import here, because the import takes a second (it includes a parser of units) and most requests have no cameras.
    from lake_schema.mission import camera_folder

    user_cameras: list[Camera] = []
    with Mistakes() as mistakes:
        for i, name in enumerate(names):
            try:
                camera = camera_folder.read(resolve_path(folder, name))
            except BadInput as error:
                mistakes.add(error.with_prefix(f"mission.cameras[{i}]"))
                continue
            if camera.name in [other.name for other in user_cameras]:
                mistakes.add(BadInput(f"mission.cameras[{i}]: two cameras have the name {camera.name}"))
            user_cameras.append(camera)
    return tuple(user_cameras)


# Format of a camera's passband by the suffix of its file; the names are keys of
# truesky/fluxes/libraries/spectrum_formats.toml.
_CURVE_FORMATS = {".ecsv": "passband_ecsv", ".xml": "passband_svo", ".vot": "passband_svo"}


def with_camera_passbands(
    user_curves: UserCurves, user_cameras: Sequence[Camera], bands: Collection[str]
) -> UserCurves:
    """Add those passbands of user cameras that a request uses to the user's other passbands.

    Parameters
    ----------
    user_curves : UserCurves
        Files in the section `fluxes` of the request.
    user_cameras : sequence of Camera
        The user's cameras, which define passbands.
    bands : collection of str
        Names of the bands of the request.

    Returns
    -------
    UserCurves
        The files with the passbands of the cameras added.

    Raises
    ------
    BadInput
        If two passbands have the same name.
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
    """Read the user files in the section `fluxes` of a request; relative names start at `folder`, the request's folder.

    Raises
    ------
    BadInput
        If a key is missing or unknown, or has a wrong value. The message names the key.
    """
    with Mistakes() as mistakes:
        read = mistakes.read
        curves = UserCurves(
            passbands=read(_passbands, table, folder),
            templates=read(_templates, table["templates"], folder) if "templates" in table else None,
            extinction=read(_extinction_laws, table, folder),
            intergalactic=read(boolean, table, "fluxes.intergalactic", False),
        )
        stars = read(_stars, table, folder)
    return replace(curves, basel=stars[0], irtf=stars[1])


def _passbands(table: Toml, folder: Path) -> tuple[tuple[str, Curves], ...]:
    filters = as_table(table.get("passbands", {}), "fluxes.passbands", None)
    with Mistakes() as mistakes:
        for key in filters:
            mistakes.read(_check_passband_name, key)
        curves = [
            mistakes.read(_curves, value, f"fluxes.passbands.{key}", folder, True) for key, value in filters.items()
        ]
    return tuple(zip(filters, curves, strict=True))


def _check_passband_name(name: str) -> None:
    """Raise BadInput for a name that SQL does not take without quotes, because f_nu_NAME is the name of a column."""
    layout.check_name(name)
    if "-" in name:
        raise BadInput(
            f"fluxes.passbands.{name}: a name has only letters, digits and _: write {name.replace('-', '_')}"
        )


def _extinction_laws(table: Toml, folder: Path) -> tuple[tuple[int, Curves], ...]:
    laws = as_table(table.get("extinction", {}), "fluxes.extinction", ("1", "2", "3", "4"))
    with Mistakes() as mistakes:
        curves = [mistakes.read(_curves, value, f"fluxes.extinction.{key}", folder) for key, value in laws.items()]
    return tuple(zip(map(int, laws), curves, strict=True))


def _templates(value: object, folder: Path) -> Curves:
    path = "fluxes.templates"
    table = as_table(value, path, ("files", "format"))
    with Mistakes() as mistakes:
        files = mistakes.read(_file_list, table, path, folder, distinct=False)
        form = mistakes.read(_format, table, f"{path}.format")
    return Curves(files, form)


def _stars(table: Toml, folder: Path) -> tuple[Path | None, tuple[Path, ...]]:
    """Return the file of BaSeL and the files of IRTF in the section `fluxes.stars`: None and () if it is missing."""
    path = "fluxes.stars"
    stars = as_table(table.get("stars", {}), path, ("basel", "irtf"))
    if "stars" in table and not stars:
        raise BadInput(f"{path} must have basel or irtf")
    with Mistakes() as mistakes:
        basel = mistakes.read(_file, stars, f"{path}.basel", folder) if "basel" in stars else None
        irtf = mistakes.read(strings, stars, f"{path}.irtf")
    return basel, tuple(resolve_path(folder, name) for name in irtf)


def _file(table: Toml, path: str, folder: Path) -> Path:
    return resolve_path(folder, string(table, path))


def _file_list(table: Toml, path: str, folder: Path, distinct: bool = True) -> tuple[Path, ...]:
    """Return the paths in the key `files` of the section `path`; raises BadInput if it names no file."""
    names = strings(table, f"{path}.files", distinct=distinct)
    if not names:
        raise BadInput(f'{path}.files is missing or empty: it must be a list of files such as ["a.fits"]')
    return tuple(resolve_path(folder, name) for name in names)


def _curves(value: object, path: str, folder: Path, has_medium: bool = False) -> Curves:
    table = as_table(value, path, None)
    with Mistakes() as mistakes:
        mistakes.read(check_keys, table, path, ("file", "format", *(("medium",) if has_medium else ())))
        medium = mistakes.read(string, table, f"{path}.medium", ("air", "vacuum")) if has_medium else ""
        file = mistakes.read(_file, table, f"{path}.file", folder)
        form = mistakes.read(_format, table, f"{path}.format")
        if len(mistakes) and file is not None:
            # A file that does not exist is reported with the other mistakes. Else the file is checked when it is read.
            mistakes.read(user_files.check_file, file, "curve", f"{path}.file")
    return Curves((file,), form, medium)


def _format(table: Toml, path: str) -> str:
    kind = "passband" if ".passbands." in path else "extinction" if ".extinction." in path else "spectrum"
    examples = {"passband": '"passband_ascii"', "extinction": '"extinction"', "spectrum": '"spectrum_csv"'}
    required_value(table, path, f"it must be the format of the file, such as {examples[kind]} (docs/own_files.md)")
    return string(table, path, PASSBAND_FORMATS if kind == "passband" else ())


def parse_ingest(table: Toml, folder: Path) -> Ingest:
    """Read the section `ingest` of a request; relative file names start at `folder`, the folder of the request.

    Raises
    ------
    BadInput
        If a key is missing or unknown, or has a wrong value. Also if a complete catalogue of galaxies is combined with
        halos or training galaxies. There is one line for each mistake, which names the key.
    """
    with Mistakes() as mistakes:
        galaxies, halos, training = (
            mistakes.read(_catalogue, table[name], f"ingest.{name}", folder) if name in table else None
            for name in ("galaxies", "halos", "training")
        )
        if "galaxies" in table and "halos" in table:
            mistakes.add(BadInput("ingest.halos is not allowed with ingest.galaxies, a finished catalogue"))
        if "galaxies" in table and "training" in table:
            mistakes.add(BadInput("ingest.training is not allowed with ingest.galaxies, whose galaxies have spectra"))
        dust = mistakes.read(_dust_map, table["dust"], folder) if "dust" in table else None
    return Ingest(galaxies, halos, training, dust)


def _map_column(table: Toml, path: str) -> str:
    required_value(table, path, 'it must be the name of the column with the map, such as "EBV"')
    return string(table, path)


def _dust_map(value: object, folder: Path) -> DustMap:
    path = "ingest.dust"
    table = as_table(value, path, DustMap.__slots__)
    with Mistakes() as mistakes:
        read = mistakes.read
        dust = DustMap(
            read(_file, table, f"{path}.file", folder),
            read(_map_column, table, f"{path}.column"),
            read(string, table, f"{path}.quantity", ("ebv", "a_v"), "ebv"),
            read(string, table, f"{path}.ordering", ("RING", "NESTED")) if "ordering" in table else "",
            read(string, table, f"{path}.coordinates", ("G", "C")) if "coordinates" in table else "",
        )
    return dust


def parse_psfs(table: Toml, folder: Path) -> tuple[tuple[str, str], ...]:
    """Read the section `psf` of a request, and return pairs (band, path of a PSF file), sorted by band.

    A band with a list of files has one pair for each file. Relative file names start at `folder`, the folder of the
    request. The files are not opened.

    Raises
    ------
    BadInput
        If a value is not a file name or a list of them. The message names the key.
    """
    with Mistakes() as mistakes:
        names_by_band = {band: mistakes.read(_psf_names, table, band) for band in sorted(table)}
    return tuple((band, str(resolve_path(folder, name))) for band, names in names_by_band.items() for name in names)


def _psf_names(table: Toml, band: str) -> tuple[str, ...]:
    path = f"psf.{layout.check_name(band)}"
    names = strings(table, path) if isinstance(table[band], list) else (string(table, path),)
    if not names:
        raise BadInput(f"{path} names no file")
    return names


def parse_sources(table: Toml, folder: Path) -> UserSources | None:
    """Read the section `sources` of a request, or return None if it is empty.

    Relative file names start at `folder`, the folder of the request. The files are not opened.

    Raises
    ------
    BadInput
        If a key is missing or has a wrong value. The message names the key.
    OutOfRange
        If the spacing of the grid is out of range.
    """
    if not table:
        return None
    with Mistakes() as mistakes:
        read = mistakes.read
        kind = read(string, table, "sources.only", ("table", "grid"))
        if "spacing" in table and kind == "table":
            problem = 'sources.spacing requires only = "grid": with only = "table" the rows have positions'
            mistakes.add(BadInput(problem))
        spacing = read(number, table, "sources.spacing", 0.01, 3600.0, unit="arcsec") if kind == "grid" else 0.0
        sources = {
            name: read(_source_file, table[name], f"sources.{name}", folder)
            for name in ("galaxies", "stars")
            if name in table
        }
        if not sources:
            mistakes.add(BadInput("sources must have galaxies or stars"))
        band = read(string, table, "sources.band", default="euclid_vis")
    galaxies, galaxy_columns = sources.get("galaxies", (None, ()))
    stars, star_columns = sources.get("stars", (None, ()))
    return UserSources(galaxies, stars, band, spacing, galaxy_columns, star_columns)


def _source_file(value: object, path: str, folder: Path) -> tuple[Path, tuple[tuple[str, str], ...]]:
    """Return the file of galaxies or stars and its columns, from a file name or from a table { file, columns }."""
    if isinstance(value, str):
        return resolve_path(folder, value), ()
    if not isinstance(value, dict):
        raise BadInput(f"{path} must be a file name or a table {{ file, columns }}, got {quote_value(value)}")
    source = as_table(value, path, ("file", "columns"))
    with Mistakes() as mistakes:
        file = mistakes.read(_file, source, f"{path}.file", folder)
        columns = mistakes.read(_columns, source, path)
    return file, columns


def _catalogue(value: object, path: str, folder: Path) -> Catalogue:
    table = as_table(value, path, ("files", "columns", *(("format",) if path.endswith("galaxies") else ())))
    with Mistakes() as mistakes:
        read = mistakes.read
        files = read(_file_list, table, path, folder)
        form = read(string, table, f"{path}.format", default="")
        texts = read(_columns, table, path)
    return Catalogue(files, form, texts)


def _columns(table: Toml, path: str) -> tuple[tuple[str, str], ...]:
    columns = as_table(table.get("columns", {}), f"{path}.columns", None)
    with Mistakes() as mistakes:
        texts = tuple((key, mistakes.read(_to_json, columns[key], f"{path}.columns.{key}")) for key in sorted(columns))
    return texts


def _to_json(value: object, path: str) -> str:
    try:
        return json.dumps(value, sort_keys=True, allow_nan=False)
    except (TypeError, ValueError):
        raise BadInput(f"{path} must contain only texts, numbers and tables, got {quote_value(value)}") from None
