"""The simulation request: a TOML file of at most a screen, read into frozen records; every number has bounds.

    name = "demo"      seed = 2024      accuracy = "survey" | "draft" | "reference" | {flux = .., shape = .., ..}
    [area]       polygon = [[ra, dec], ..] | cone = {ra, dec, radius} | box = {ra = [from, to], dec = [from, to]}
    [universe]   galaxy_limit (I_E), star_limit (H, Vega), z_max, box_cells, lensing_nside
    [stars]      density, brown_dwarf_boost, tycho2 = [..], catalogue = {file, columns}, plane_limit, rows_a_file
    [mission]    ladder = ["CBE", ..]   overrides = {"vis.read_noise" = {value = 5.0, unit = "electron"}}
    [fluxes]     bands = [..]           default: the bands of the pointings
    [fluxes.passbands.NAME]             your own filter, column f_nu_NAME: file, medium = "air" | "vacuum", format
    [fluxes.templates]                  your own galaxies, earliest first, counted by sed_1 and sed_2: files, format
    [fluxes.extinction.CODE]            your own law in place of law 1 .. 4: file, format
    [[pointing]] channel, camera, band, ra, dec, position_angle, mjd, detectors, centre_on, exposure_time_s
    [products]   truth = ["noise_free"]

Files are found from the folder of the request; their formats are in jobs/fluxes/spectrum_formats.toml.
A key that is not here, a wrong type or a number out of bounds is refused with the key's full path.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

from jobs.accuracy import SURVEY, Accuracy, preset
from lake_schema import layout, sky
from lake_schema.errors import BadInput, OutOfRange
from lake_schema.ids import GENERATION_ORDER

Toml = Mapping[str, Any]

_MOST_BYTES = 1 << 20
_MOST_POINTINGS = 100_000
STATUSES = ("REQ", "DES", "BLT", "CBE", "SIM")
LADDER = ("CBE", "BLT", "DES", "REQ", "SIM")
CHANNELS = ("VIS", "EXT")
TRUTH = ("noise_free",)
DENSITIES = ("juric", "besancon")
BOX_CELLS = (192, 256, 384)
LENSING_NSIDES = (64, 128, 256, 512, 1024, 2048)


@dataclass(frozen=True, slots=True)
class Area:
    """A convex spherical polygon (vertices), a box (west, east, south, north) or a circle (ra, dec, radius), deg."""

    vertices: tuple[tuple[float, float], ...] = ()
    box: tuple[float, float, float, float] | None = None
    ra: float = 0.0
    dec: float = 0.0
    radius: float = 0.0

    def cells(self, order: int = GENERATION_ORDER) -> list[int]:
        """Nested cells of `order` that the area touches, ascending."""
        if self.box is not None:
            return [int(cell) for cell in sky.cells_in_box(*self.box, order)]
        if self.vertices:
            return [int(cell) for cell in sky.cells_in_polygon(self.vertices, order)]
        return [int(cell) for cell in sky.cells_in_cone(self.ra, self.dec, self.radius, order)]


@dataclass(frozen=True, slots=True)
class Universe:
    """How deep and how fine.

    galaxy_limit, star_limit : I_E (AB, before Milky Way dust), H (Vega, as observed);  z_max : highest redshift
    box_cells                : cells of 4 Mpc/h a side of the box of matter
    lensing_nside            : HEALPix resolution of the lensing maps
    high_redshift_boost, quasar_boost : how many times denser than in nature these kinds are drawn, 0 = not at all
    """

    galaxy_limit: float = 26.0
    star_limit: float = 26.0
    z_max: float = 2.3
    box_cells: int = 256
    lensing_nside: int = 512
    high_redshift_boost: float = 1.0
    quasar_boost: float = 1.0


@dataclass(frozen=True, slots=True)
class Stars:
    """How the Milky Way's stars are drawn.

    density           : whose laws of density
    brown_dwarf_boost : how many times denser than in nature L and T dwarfs are drawn, 0 = not at all
    tycho2            : files of Tycho-2, which replace the model brighter than V = 11
    catalogue         : file of other stars to be taken instead of the model's; columns: (ours, theirs)
    plane_limit       : faintest H (Vega, as observed) within 5 deg of the plane; None = an area there is refused
    rows_a_file       : above so many expected rows a cell's file is split into those of the next HEALPix order
    """

    density: str = "juric"
    brown_dwarf_boost: float = 1.0
    tycho2: tuple[Path, ...] = ()
    catalogue: Path | None = None
    columns: tuple[tuple[str, str], ...] = ()
    plane_limit: float | None = None
    rows_a_file: int = 1_000_000


@dataclass(frozen=True, slots=True)
class Override:
    """A value that replaces what the mission's ladder would choose."""

    value: float
    unit: str


@dataclass(frozen=True, slots=True)
class MissionChoice:
    """Which statuses of the mission's parameters are preferred, and what is overridden."""

    ladder: tuple[str, ...] = LADDER
    overrides: tuple[tuple[str, Override], ...] = ()


@dataclass(frozen=True, slots=True)
class Pointing:
    """One exposure that is asked for.

    ra, dec         : deg, of the boresight, or of the centre of detector `centre_on` where that is given
    position_angle  : deg, of the focal plane's y axis, north through east
    detectors       : names, () = all of the camera
    exposure_time_s : None = the mission's
    """

    channel: str
    camera: str
    band: str
    ra: float
    dec: float
    position_angle: float
    mjd: float
    detectors: tuple[str, ...] = ()
    centre_on: str | None = None
    exposure_time_s: float | None = None


@dataclass(frozen=True, slots=True)
class Curves:
    """Files of spectra, of a filter or of an extinction law; medium : of a filter's wavelengths, "air" or "vacuum"."""

    files: tuple[Path, ...]
    format: str
    medium: str = ""


@dataclass(frozen=True, slots=True)
class OwnCurves:
    """What stands beside the embedded passbands, and in place of the embedded galaxies and extinction laws."""

    passbands: tuple[tuple[str, Curves], ...] = ()
    templates: Curves | None = None
    extinction: tuple[tuple[int, Curves], ...] = ()


@dataclass(frozen=True, slots=True)
class Request:
    """A simulation request, checked."""

    name: str
    seed: int
    accuracy: Accuracy
    area: Area
    universe: Universe
    stars: Stars
    mission: MissionChoice
    bands: tuple[str, ...]
    pointings: tuple[Pointing, ...]
    truth: tuple[str, ...]
    curves: OwnCurves = OwnCurves()

    def facts(self, *parts: str) -> dict[str, Any]:
        """The named parts of the request as JSON values, for the key of what depends on them."""
        everything = asdict(self)
        return {part: everything[part] for part in parts}


def parse(path: Path) -> Request:
    """Read and check a request file.

    Errors : BadInput, one line that names the file and the key
    """
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise BadInput(f"is larger than {_MOST_BYTES} bytes")
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise BadInput(f"request {path}: no such file") from None
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError, RecursionError, BadInput) as error:
        raise BadInput(f"request {path}: {_one_line(error)}") from None
    try:
        return from_table(table, path.resolve().parent)
    except BadInput as error:
        raise BadInput(f"request {path}: {error}") from None


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__


def from_table(table: Toml, folder: Path = Path()) -> Request:
    """A parsed TOML table -> Request; files are found from `folder`.  BadInput names the key."""
    sections = {"area", "universe", "stars", "mission", "fluxes", "pointing", "products"}
    _known(table, "", {"name", "seed", "accuracy", *sections})
    pointings = _pointings(table)
    fluxes = _section(table, "fluxes", {"bands", "passbands", "templates", "extinction"})
    curves = _own_curves(fluxes, folder)
    bands = _strings(fluxes, "fluxes.bands") or tuple(p.band for p in pointings)
    return Request(
        name=layout.name(_string(table, "name")),
        seed=_integer(table, "seed", 0, 2**63 - 1),
        accuracy=_accuracy(table.get("accuracy")),
        area=_area(_section(table, "area", {"polygon", "cone", "box"})),
        universe=_universe(_section(table, "universe", set(Universe.__slots__))),
        stars=_stars(_section(table, "stars", set(Stars.__slots__) - {"columns"}), folder),
        mission=_mission(_section(table, "mission", {"ladder", "overrides"})),
        bands=tuple(dict.fromkeys((*bands, *(name for name, _ in curves.passbands)))),
        pointings=pointings,
        truth=_truth(_section(table, "products", {"truth"})),
        curves=curves,
    )


# ------------------------------------------------------------------------------------------------ sections


def _accuracy(value: object) -> Accuracy:
    if value is None:
        return SURVEY
    if isinstance(value, str):
        return preset(value)
    table = _table(value, "accuracy", {"flux", "shape", "position", "background"})
    return Accuracy(**{key: _number(table, f"accuracy.{key}", 1e-12, 1.0) for key in Accuracy.__slots__})


def _area(table: Toml) -> Area:
    if len(table) != 1:
        raise BadInput("area wants exactly one of polygon, cone, box")
    if "polygon" in table:
        return _polygon(table["polygon"], "area.polygon")
    if "cone" in table:
        cone = _table(table["cone"], "area.cone", {"ra", "dec", "radius"})
        ra = _number(cone, "area.cone.ra", -360.0, 360.0) % 360.0
        dec = _number(cone, "area.cone.dec", -90.0, 90.0)
        radius = _number(cone, "area.cone.radius", 0.0, 180.0)
        return Area(ra=ra, dec=dec, radius=radius)
    box = _table(table["box"], "area.box", {"ra", "dec"})
    west, east = _pair(box, "area.box.ra", -360.0, 360.0)
    south, north = _pair(box, "area.box.dec", -90.0, 90.0)
    if not 0.0 < east - west < 180.0:
        raise BadInput(f"area.box.ra = [{west}, {east}]: the second must be larger, by less than 180")
    if not north > south:
        raise BadInput(f"area.box.dec = [{south}, {north}]: the second must be larger")
    return Area(box=(west % 360.0, east % 360.0, south, north))


def _polygon(value: object, path: str) -> Area:
    if not isinstance(value, list) or not 3 <= len(value) <= 1000:
        raise BadInput(f"{path} wants a list of 3 to 1000 [ra, dec] pairs")
    vertices = []
    for i, pair in enumerate(value):
        if not isinstance(pair, list) or len(pair) != 2:
            raise BadInput(f"{path}[{i}] wants [ra, dec]")
        ra = _checked_number(pair[0], f"{path}[{i}].ra", -360.0, 360.0) % 360.0
        vertices.append((ra, _checked_number(pair[1], f"{path}[{i}].dec", -90.0, 90.0)))
    try:
        sky.cells_in_polygon(vertices, 0)
    except BadInput as error:
        raise BadInput(f"{path}: {error}") from None
    return Area(vertices=tuple(vertices))


def _universe(table: Toml) -> Universe:
    default = Universe()
    return Universe(
        galaxy_limit=_number(table, "universe.galaxy_limit", 10.0, 30.0, default.galaxy_limit),
        star_limit=_number(table, "universe.star_limit", 0.0, 30.0, default.star_limit),
        z_max=_number(table, "universe.z_max", 0.01, 3.0, default.z_max),
        box_cells=_choice(table, "universe.box_cells", BOX_CELLS, default.box_cells),
        high_redshift_boost=_number(table, "universe.high_redshift_boost", 0.0, 1e5, default.high_redshift_boost),
        quasar_boost=_number(table, "universe.quasar_boost", 0.0, 1e5, default.quasar_boost),
        lensing_nside=_choice(table, "universe.lensing_nside", LENSING_NSIDES, default.lensing_nside),
    )


def _stars(table: Toml, folder: Path) -> Stars:
    default = Stars()
    rows = _integer(table, "stars.rows_a_file", 1, 3_000_000) if "rows_a_file" in table else default.rows_a_file
    plane_limit = _number(table, "stars.plane_limit", 0.0, 30.0, math.nan)
    given = _table(table.get("catalogue", {}), "stars.catalogue", {"file", "columns"})
    columns = _table(given.get("columns", {}), "stars.catalogue.columns", None)
    return Stars(
        density=_string(table, "stars.density", DENSITIES) if "density" in table else default.density,
        brown_dwarf_boost=_number(table, "stars.brown_dwarf_boost", 0.0, 1e4, default.brown_dwarf_boost),
        tycho2=tuple(_file(folder, name) for name in _strings(table, "stars.tycho2")),
        catalogue=_file(folder, _string(given, "stars.catalogue.file")) if given else None,
        columns=tuple((key, _string(columns, f"stars.catalogue.columns.{key}")) for key in sorted(columns)),
        plane_limit=None if math.isnan(plane_limit) else plane_limit,
        rows_a_file=rows,
    )


def _file(folder: Path, name: str) -> Path:
    return folder / Path(name).expanduser()


def _mission(table: Toml) -> MissionChoice:
    ladder = _strings(table, "mission.ladder", STATUSES) or LADDER
    if len(set(ladder)) != len(ladder):
        raise BadInput(f"mission.ladder = {list(ladder)} names a status twice")
    overrides = _table(table.get("overrides", {}), "mission.overrides", None)
    return MissionChoice(ladder, tuple(sorted((key, _override(value, key)) for key, value in overrides.items())))


def _override(value: object, key: str) -> Override:
    path = f"mission.overrides.{key}"
    table = _table(value, path, {"value", "unit"})
    return Override(_number(table, f"{path}.value", -math.inf, math.inf), _string(table, f"{path}.unit"))


def _pointings(table: Toml) -> tuple[Pointing, ...]:
    found = table.get("pointing", [])
    if not isinstance(found, list) or len(found) > _MOST_POINTINGS:
        raise BadInput(f"pointing wants a list of at most {_MOST_POINTINGS} tables")
    return tuple(_pointing(value, f"pointing[{i}]") for i, value in enumerate(found))


def _pointing(value: object, path: str) -> Pointing:
    table = _table(value, path, set(Pointing.__slots__))
    channel = _string(table, f"{path}.channel", CHANNELS)
    exposure = _number(table, f"{path}.exposure_time_s", 0.0, 1e6, math.nan)
    return Pointing(
        channel=channel,
        camera=layout.name(_string(table, f"{path}.camera")) if "camera" in table else channel.lower(),
        band=layout.name(_string(table, f"{path}.band")),
        ra=_number(table, f"{path}.ra", -360.0, 360.0) % 360.0,
        dec=_number(table, f"{path}.dec", -90.0, 90.0),
        position_angle=_number(table, f"{path}.position_angle", -360.0, 360.0, 0.0),
        mjd=_number(table, f"{path}.mjd", 40_000.0, 100_000.0),
        detectors=_strings(table, f"{path}.detectors"),
        centre_on=_string(table, f"{path}.centre_on") if "centre_on" in table else None,
        exposure_time_s=None if math.isnan(exposure) else exposure,
    )


def _own_curves(table: Toml, folder: Path) -> OwnCurves:
    filters = _table(table.get("passbands", {}), "fluxes.passbands", None)
    laws = _table(table.get("extinction", {}), "fluxes.extinction", set("1234"))
    passbands = [_curves(value, f"fluxes.passbands.{layout.name(key)}", folder, True) for key, value in filters.items()]
    extinction = [_curves(value, f"fluxes.extinction.{key}", folder) for key, value in laws.items()]
    templates = None
    if "templates" in table:
        path = "fluxes.templates"
        given = _table(table["templates"], path, {"files", "format"})
        files = _strings(given, f"{path}.files")
        if not files:
            raise BadInput(f"{path}.files is missing")
        templates = Curves(tuple(_file(folder, file) for file in files), _string(given, f"{path}.format"))
    return OwnCurves(
        tuple(zip(filters, passbands, strict=True)), templates, tuple(zip(map(int, laws), extinction, strict=True))
    )


def _curves(value: object, path: str, folder: Path, has_medium: bool = False) -> Curves:
    table = _table(value, path, {"file", "format", *(["medium"] if has_medium else [])})
    medium = _string(table, f"{path}.medium", ("air", "vacuum")) if has_medium else ""
    return Curves((_file(folder, _string(table, f"{path}.file")),), _string(table, f"{path}.format"), medium)


def _truth(table: Toml) -> tuple[str, ...]:
    return _strings(table, "products.truth", TRUTH)


# ------------------------------------------------------------------------------------------------ values


def _known(table: Toml, path: str, keys: set[str]) -> None:
    unknown = sorted(set(table) - keys)
    if unknown:
        where = f"{path}.{unknown[0]}" if path else unknown[0]
        raise BadInput(f"{where} is not a key of a request; known here: {', '.join(sorted(keys))}")


def _section(table: Toml, key: str, keys: set[str]) -> Toml:
    return _table(table.get(key, {}), key, keys)


def _table(value: object, path: str, keys: set[str] | None) -> Toml:
    if not isinstance(value, dict):
        raise BadInput(f"{path} wants a table, got {_shown(value)}")
    if keys is not None:
        _known(value, path, keys)
    return cast(Toml, value)


def _value(table: Toml, path: str) -> object:
    key = path.rpartition(".")[2]
    if key not in table:
        raise BadInput(f"{path} is missing")
    return table[key]


def _string(table: Toml, path: str, legal: Sequence[str] = ()) -> str:
    value = _value(table, path)
    if not isinstance(value, str):
        raise BadInput(f"{path} wants text, got {_shown(value)}")
    if legal and value not in legal:
        raise BadInput(f"{path} = {_shown(value)} is not one of {', '.join(legal)}")
    return value


def _strings(table: Toml, path: str, legal: Sequence[str] = ()) -> tuple[str, ...]:
    value = table.get(path.rpartition(".")[2], [])
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise BadInput(f"{path} wants a list of texts, got {_shown(value)}")
    for item in value:
        if legal and item not in legal:
            raise BadInput(f"{path}: {_shown(item)} is not one of {', '.join(legal)}")
    return tuple(value)


def _number(table: Toml, path: str, lo: float, hi: float, default: float | None = None) -> float:
    if default is not None and path.rpartition(".")[2] not in table:
        return default
    return _checked_number(_value(table, path), path, lo, hi)


def _checked_number(value: object, path: str, lo: float, hi: float) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise BadInput(f"{path} wants a number, got {_shown(value)}")
    # Whole numbers are compared before they become floats: TOML's have no largest one.
    if not lo <= value <= hi or not math.isfinite(value):
        raise OutOfRange(path, _shown(value), lo, hi)
    return float(value)


def _integer(table: Toml, path: str, lo: int, hi: int) -> int:
    value = _value(table, path)
    if isinstance(value, bool) or not isinstance(value, int):
        raise BadInput(f"{path} wants a whole number, got {_shown(value)}")
    if not lo <= value <= hi:
        raise OutOfRange(path, value, lo, hi)
    return value


def _choice(table: Toml, path: str, legal: Sequence[int], default: int) -> int:
    if path.rpartition(".")[2] not in table:
        return default
    value = _integer(table, path, min(legal), max(legal))
    if value not in legal:
        raise BadInput(f"{path} = {value} is not one of {', '.join(map(str, legal))}")
    return value


def _pair(table: Toml, path: str, lo: float, hi: float) -> tuple[float, float]:
    value = _value(table, path)
    if not isinstance(value, list) or len(value) != 2:
        raise BadInput(f"{path} wants [from, to], got {_shown(value)}")
    first, second = (_checked_number(item, path, lo, hi) for item in value)
    return first, second


def _shown(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
