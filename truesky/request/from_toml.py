"""Read a simulation request: a TOML file in which a user describes a simulation. Every number has limits.

All keys::

    name = "demo"      seed = 2024      noise_seed = 1 (default: seed)
    accuracy = "survey" | "quicklook" | "draft" | "reference"
               | {flux = .., shape = .., position = .., background = ..}
    [area]         polygon = [[ra, dec], ..] | cone = {ra, dec, radius} | box = {ra = [from, to], dec = [from, to]}
                   tile = number | patches = [[ra, dec, radius], ..] | wide = true
    [universe]     galaxy_limit, galaxy_band, star_limit (H, Vega), z_max, box_cells
                   structure_below_cells  true | false   clustering and lensing below 4 Mpc/h, default: true
                   lensing_nside         64 to 2048, default: by area and accuracy (lensing_resolution.py)
                   high_redshift_boost, quasar_boost, alignment
                   lensing = "box" | "none" | {g1, g2}   constant reduced shear of all galaxies, frame (east, north)
                   rotation       deg, added to the position angle of every galaxy before lensing
                   transients = {start, end, kinds = ["ia", "core_collapse"], boost, light_curves = "file.parquet"}
                                  supernovae that shine between two dates (MJD), default: none
                   variables = true | false   stars and active nuclei vary, default: false
    [universe.cosmology]  omega_m, omega_b, h, sigma_8, n_s, w0, wa   flat universe, by default that of Flagship
                   m_nu           sum of the masses of three equal neutrinos, eV, default: 0
                   power = "camb" | "eisenstein98"   source of the linear power spectrum
    [stars]        density, brown_dwarf_boost, tycho2 = [..], catalogue = {file, columns}, plane_limit, rows_a_file
                   bright_limit   H (Vega, as observed); brighter stars are omitted
    [ingest.galaxies]  files = [..]  finished catalogue that replaces ours: Parquet, FITS, CSV, HDF5, a HATS folder
                       format = "flagship1" | "flagship2" | "euclid" | "skycatalogs" | "opencosmo"
                       columns = {ours = theirs, ..}
    [ingest.halos]     files = [..]  columns = {ra, dec, z_true, log_mass, ..}   halo light-cone that replaces ours
    [ingest.training]  files = [..]  columns = {z_true, abs_mag_r01, color_gr_01, sed, ext_law, ebv}
                       observed galaxies; each galaxy of ours has the spectrum of a similar one
    [ingest.dust]      file, column, quantity = "ebv" | "a_v"   HEALPix map of the Milky Way's dust that replaces ours
    [sources]      only = "table" | "grid"   galaxies = "file.csv"  stars = "file.csv"   all sources of the simulation
                   band   of their magnitudes (AB), default: "euclid_vis"   spacing   of the grid in arcsec
    [structure]    arms = true | {contrast, knots, number, least_radius}   spiral arms and knots of large discs
                   (truesky/request/structure.py), default: smooth discs
                   stamps = {file, nearest, least_radius}   user's galaxies (truesky/render/sources/galaxy_stamps.py)
    [strong_lenses]  boost   density of strong lenses relative to nature
    [mission]      ladder = ["CBE", ..]   overrides = {"vis.read_noise" = {value = 5.0, unit = "electron"}}
                   for one detector "vis.dark_current@3-4", amplifier "vis.gain.E", or both "vis.gain@3-4.E"
                   cameras = ["my_camera/"]   user's ground cameras (lake_schema/mission/camera_folder.py)
    [fluxes]       bands = [..]           in addition to the bands of the pointings and observations; default without
                                          exposures: euclid_vis, euclid_y, euclid_j, euclid_h, lsst_u .. lsst_y
                   intergalactic = true   intergalactic hydrogen absorbs the light of galaxies
    [fluxes.passbands.NAME]        user's filter, column f_nu_NAME: file, medium = "air" | "vacuum", format
    [fluxes.templates]             user's galaxy spectra, earliest type first, counted by sed_1 and sed_2: files, format
    [fluxes.stars]                 user's dwarf spectra: basel (models, .cor), irtf = [..] (their infrared, by Y - H)
    [fluxes.extinction.CODE]       user's law that replaces law 1 .. 4: file, format
    [psf]          BAND = "file.fits"   user's PSF in a band: a cube of planes (its card PSFFRAME states its axes) or a
                   PSFEx file; from a list of files, each exposure uses one at random (truesky/render/psf/from_file.py);
                   {detector} in the name is replaced by the detector's name
    [solar_system] bodies = "file"      user's moving bodies that replace ours (truesky/render/sources/ephemerides.py)
    [effects]      on = [..]  off = [..]  effects forced on or off, default: what a scene needs
                   off = ["all"]          all except those in `on` and effects that every image needs, such as
                                          analogue-to-digital conversion (ALWAYS_ON in truesky/request/schema.py)
    [explore]      accuracy = [..]  "effects.<name>" = [true, false]  "vis.gain" = {values = [..], unit = ".."}
    [[pointing]]   channel, camera, band, ra, dec, position_angle, mjd, detectors, centre_on, exposure_time_s,
                   band           default: euclid_vis, euclid_h, nisp_red, or the r band of a ground camera;
                                  RGS000, RGS180 and BGS000 are nisp_red and nisp_blue at the grism's angle
                   mjd            default: Euclid: first date the Sun allows; ground: first transit at night
                   grism_angle    direction of NISP-S spectra in the focal plane: -4, 0, 180, 184 deg
                   realisations   number of exposures that differ only in their noise
    [[observation]]
        channels = ["VIS", "NISP-P", "NISP-S"] | ["EXT"]
        image_type = "science" | "deep" | "bias" | "dark" | "flat" | "charge_injection" | "self_calibration"
                     | "standard_star" | "planetary_nebula" | "trap_pumping" | "defocus" | "bleeding"
                     | "stray_light" | "white_dwarf" | "persistence"
        survey = "wide" | "deep" | "edf_north" | .. | "des" | ..     area = {..}
                     default: the area of the request, or of the deep field if survey = "edf_north" ..
        ra, dec, position_angle    user's field instead of the fields of the survey (docs/own_field.md)
        pointings = "file.csv"     table of pointings instead of both (truesky/request/exposures/pointing_tables.py)
        dither = "S" | "J" | "none" | [[x, y], ..] arcsec   fields, visits, exposures, short, flat, blue, bands,
        detectors, mjd, exposure_time_s, realisations
        lamps = [..], intensities = [..] of flat and persistence; exposures flats of each lamp, band and intensity
        macc = [groups, reads, drops] of NISP-P, or of NISP-S alone
        delays_s = [..], bright = "flat" | "sky" of persistence
        phase_times_s = [..] of trap_pumping     defocus_nm = [..] of defocus
        magnitude of bleeding, white_dwarf, stray_light     distance_deg of stray_light
    [products]     truth = ["noise_free", "stars", "sky", "cosmic_rays", "ghosts", "satellites", "saturation",
                            "persistence", "ramp", "traps", "dipoles", "order_1", "order_0", "order_2", "order_m1"]
                   compression = "none" | "rice"   lossless, for integer images
                   wcs = "sip" | "tpv"   convention for distortion in headers, default: the instrument pipeline's;
                                         source-extractor, SCAMP and SWarp read TPV, or the .head file of the image
                   files = "detector" | "exposure"   also one file with all science images of an exposure
                   names = "truesky" | "euclid"   names and headers of these files, as Euclid's raw frames
                   readout = "raw" | "amplifiers" | "electrons"   for ground cameras: one array, one extension per
                                         amplifier, or electrons before the readout

A right ascension may be a text in hours ("03:32:28", "3h32m28s"), a declination a text in degrees ("-27:48:30"), and a
date (mjd) an ISO date in UTC ("2027-01-01") instead of an MJD (UTC).

File names are relative to the folder of the request; truesky/fluxes/libraries/spectrum_formats.toml has their formats.
An unknown key, a wrong type or a number out of bounds is refused. All mistakes are reported together, each in one line
with the full path of the key::

    truesky check FILE [--plan]
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from lake_schema import user_files
from lake_schema.errors import BadInput, Mistakes, bad_input
from lake_schema.store import layout
from truesky.request import area as areas
from truesky.request import bands as request_bands
from truesky.request import checks, files, instruments, lensing_resolution, request_lines, structure, transients
from truesky.request.accuracy import ALLOWED, SURVEY, Accuracy, fastest_row, preset
from truesky.request.area import Area
from truesky.request.exposures import observations, pointings
from truesky.request.schema import (
    ALWAYS_ON,
    BOX_CELLS,
    COMPRESSIONS,
    DENSITY_MODELS,
    EFFECTS,
    FILE_LAYOUTS,
    LADDER,
    LENSING_NSIDES,
    MAX_SHEAR,
    READOUTS,
    STATUSES,
    TRUTH_CONTENTS,
    WCS_CONVENTIONS,
    Effects,
    MissionChoice,
    Override,
    Request,
    Stars,
    Universe,
)
from truesky.request.section_reader import RequestReader
from truesky.request.toml_values import Toml
from truesky.request.toml_values import as_table as _as_table
from truesky.request.toml_values import boolean as _boolean
from truesky.request.toml_values import checked_number as _checked_number
from truesky.request.toml_values import integer as _integer
from truesky.request.toml_values import integer_choice as _integer_choice
from truesky.request.toml_values import number as _number
from truesky.request.toml_values import optional_number as _optional_number
from truesky.request.toml_values import quote_value as _quote_value
from truesky.request.toml_values import refuse_name as _refuse_name
from truesky.request.toml_values import required_value as _required_value
from truesky.request.toml_values import string as _string
from truesky.request.toml_values import strings as _strings

__all__ = ["Area", "Override", "Request", "ValidParts", "parse", "parse_valid_parts"]

_MAX_VARIANTS = 10_000
_MAX_SEED = 2**63 - 1
_ALL = "all"
# Keys of a request for which the mission parameters are needed.
_MISSION_KEYS = frozenset({"mission", "explore", "pointing", "observation"})
# Names that a request must not have: SQL queries (truesky/explore) use the request's name as the schema of its tables,
# and these schemas exist already.
_RESERVED_NAMES = ("information_schema", "main", "memory", "pg_catalog", "system", "temp")


@dataclass(frozen=True, slots=True)
class ValidParts:
    """A request that may have mistakes.

    Attributes
    ----------
    request : Request or None
        The request, in which default values replace the sections and lists with mistakes. None if the area, or a
        section that defines instruments or passbands, has mistakes, so that exposures cannot be planned.
    messages : tuple of str
        One line for each mistake in the order of the file, () for a valid request.
    invalid : frozenset of str
        Keys of the request, such as "universe" or "pointing", whose values have mistakes.
    """

    request: Request | None
    messages: tuple[str, ...]
    invalid: frozenset[str]

    def valid_request(self) -> Request:
        """Return the request; raise BadInput with all mistakes if there are any."""
        if self.request is None or self.messages:
            raise bad_input(self.messages)
        return self.request


def parse_valid_parts(path: Path) -> ValidParts:
    """Read the valid parts of a request file, and collect all mistakes.

    Raises BadInput if the file cannot be read or is not TOML.
    """
    return read_valid_parts(read_file(path), path.resolve().parent)


def parse(path: Path) -> Request:
    """Read and check a request file; raises BadInput if it is not valid, with lines that name file and key."""
    parts = parse_valid_parts(path)
    try:
        return parts.valid_request()
    except BadInput as error:
        raise request_lines.with_request_file(error, path) from None


def read_file(path: Path) -> Toml:
    """Return the table of a request file; raises BadInput if it cannot be read or is not TOML."""
    try:
        return user_files.read_toml(path, "request")
    except BadInput as error:
        raise BadInput(f"request {error}") from None


def _name(table: Toml) -> str:
    name = _string(table, "name")
    if not layout.is_name(name):
        form = 'small letters, digits, "_" and "-", at most 64, such as "my_field"'
        raise BadInput(f"name = {_quote_value(name)} must have only {form}")
    if name in _RESERVED_NAMES:
        raise BadInput(f"name = {name!r} is reserved in SQL; these names are not allowed: {', '.join(_RESERVED_NAMES)}")
    return name


def from_table(table: Toml, folder: Path = Path()) -> Request:
    """Check a parsed TOML table and convert it to a request.

    Parameters
    ----------
    table : Toml
        The whole request.
    folder : Path, optional
        Folder to which file names in the request are relative; by default the current folder.

    Returns
    -------
    Request
        The checked request.

    Raises
    ------
    BadInput
        If keys are missing or unknown, or have values that are not allowed. There is one line for each mistake, which
        names the key.
    """
    return read_valid_parts(table, folder).valid_request()


def read_valid_parts(table: Toml, folder: Path = Path()) -> ValidParts:
    """Read the valid parts of a request, and collect all mistakes.

    Parameters
    ----------
    table : Toml
        The whole request.
    folder : Path, optional
        Folder to which file names in the request are relative; by default the current folder.

    Returns
    -------
    ValidParts
        The request and its mistakes.
    """
    reader = RequestReader(table)
    read, section = reader.read, reader.section
    reader.check_top_keys()
    explore = read("explore", _explore, section("explore"))
    choice = read("mission", _mission, section("mission"), folder)
    # The import of the mission parameters takes half a second, so that they are read only if the request uses them.
    mission = None
    if choice is not None and not _MISSION_KEYS.isdisjoint(table):
        mission = read("mission", checks.check_mission, choice)
    if mission is not None:
        read("explore", checks.check_explored, explore or (), mission)
    fluxes = section("fluxes")
    bands = read("fluxes", _strings, fluxes, "fluxes.bands")
    curves = read("fluxes", files.parse_curves, fluxes, folder)
    user_bands = [] if curves is None else [name for name, _ in curves.passbands]
    # Without the user's passbands, the names of bands and detectors are not checked.
    named = None if curves is None else mission
    pointing_list = read("pointing", pointings.parse_pointings, table, named, user_bands) or ()
    blocks = read("observation", observations.parse_observations, table, folder, named, user_bands) or ()
    area = read("area", areas.parse, table.get("area"))
    values = _values(reader, folder, area)
    invalid = reader.invalid
    if area is None or explore is None or choice is None or curves is None or bands is None or "mission" in invalid:
        return ValidParts(None, reader.messages(), frozenset(invalid))
    request = Request(
        area=area,
        mission=choice,
        # Values that are not valid would be reported a second time by the plan.
        explore=() if "explore" in invalid else explore,
        bands=bands,
        curves=curves,
        pointings=pointing_list,
        observations=blocks,
        **values,
    )
    with_curves = read("fluxes", _with_camera_passbands, request) or request
    read("sources", checks.check_sources, with_curves)
    read("pointing", checks.check_bands, with_curves)
    read("pointing", checks.check_places, with_curves)
    if mission is not None:
        # Images need the fluxes in their bands, also if the request names others.
        bands = (*bands, *(read("observation", request_bands.requested_bands, with_curves, mission) or ()))
    added = (name for name, _ in with_curves.curves.passbands)
    all_bands = tuple(dict.fromkeys((*bands, *added))) or request_bands.DEFAULT_BANDS
    return ValidParts(replace(with_curves, bands=all_bands), reader.messages(), frozenset(invalid))


def _values(reader: RequestReader, folder: Path, area: Area | None) -> dict[str, Any]:
    """Read the keys and sections that no other section needs. Return values of `Request` by name, without mistakes.

    `area` is None if the section `area` has a mistake.
    """
    read, table = reader.read, reader.table
    products, solar_system, lenses = (reader.section(key) for key in ("products", "solar_system", "strong_lenses"))
    accuracy = read("accuracy", _accuracy, table.get("accuracy"), "accuracy") or SURVEY
    nside = Universe().lensing_nside if area is None else lensing_resolution.default_nside(area, accuracy)
    universe_table = reader.section("universe")
    universe = read("universe", _universe, universe_table, nside)
    star_limit = math.inf if universe is None else universe.star_limit
    values = {
        "name": read("name", _name, table) or "request",
        "seed": read("seed", _integer, table, "seed", 0, _MAX_SEED) or 0,
        "noise_seed": read("noise_seed", _integer, table, "noise_seed", 0, _MAX_SEED)
        if "noise_seed" in table
        else None,
        "accuracy": accuracy,
        "universe": universe,
        "transients": read("universe", transients.parse, universe_table.get("transients"), folder),
        "stars": read("stars", _stars, reader.section("stars"), folder, star_limit),
        "effects": read("effects", _effects, reader.section("effects")),
        "ingest": read("ingest", files.parse_ingest, reader.section("ingest"), folder),
        "bodies": read("solar_system", _bodies, solar_system, folder) if solar_system else None,
        "sources": read("sources", files.parse_sources, reader.section("sources"), folder),
        "structure": read("structure", structure.parse, reader.section("structure"), folder),
        "psfs": read("psf", files.parse_psfs, reader.section("psf"), folder),
        "strong_lens_boost": read("strong_lenses", _number, lenses, "strong_lenses.boost", 1e-3, 1e5, 1.0),
        **(read("products", _products, products) or {"truth": ()}),
    }
    defaults = {"universe": Universe(), "stars": Stars()}
    return {name: value for name, value in {**defaults, **_without_none(values)}.items()}


def _without_none(values: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in values.items() if value is not None}


def _products(table: Toml) -> dict[str, Any]:
    """Read the section `products`, and return its values by name of the attribute of `Request`."""
    with Mistakes() as mistakes:
        read = mistakes.read
        values = {
            "truth": read(_truth, table),
            "compression": read(_string, table, "products.compression", COMPRESSIONS, "none"),
            "wcs": read(_string, table, "products.wcs", WCS_CONVENTIONS) if "wcs" in table else None,
            "files": read(_string, table, "products.files", FILE_LAYOUTS, "detector"),
            "file_names": read(checks.parse_file_names, table),
            "readout": read(_string, table, "products.readout", READOUTS, "raw"),
        }
    return values


def _bodies(table: Toml, folder: Path) -> Path:
    return files.resolve_path(folder, _string(table, "solar_system.bodies"))


def _with_camera_passbands(request: Request) -> Request:
    """Return the request with the passbands of the user's cameras in which it has exposures or fluxes."""
    tables = (block.table for block in request.observations if block.table is not None)
    bands = {
        *request.bands,
        *(pointing.band for pointing in request.pointings),
        *(band for table in tables for band in table.bands),
    }
    return replace(request, curves=files.with_camera_passbands(request.curves, request.mission.cameras, bands))


# The functions below read one section or key of a request each. They raise BadInput, which names the key, if a value is
# not allowed.


def _accuracy(value: object, path: str) -> Accuracy:
    if value is None:
        return SURVEY
    if isinstance(value, str):
        return preset(value)
    if not isinstance(value, dict):
        raise BadInput(f"{path} = {_quote_value(value)} is not one of {ALLOWED}")
    table = _as_table(value, path, Accuracy.__slots__)
    with Mistakes() as mistakes:
        numbers = {key: mistakes.read(_number, table, f"{path}.{key}", 1e-12, 1.0) for key in Accuracy.__slots__}
    accuracy = Accuracy(**numbers)
    # Call `fastest_row` only for its check: it raises BadInput if no drawing settings reach this accuracy.
    fastest_row(accuracy)
    return accuracy


def _universe(table: Toml, lensing_nside: int) -> Universe:
    """Read the section `universe`; `lensing_nside` is the resolution of the lensing maps without this key."""
    default = Universe()
    with Mistakes() as mistakes:
        read, boosts = mistakes.read, (0.0, 1e5)
        universe = Universe(
            galaxy_limit=read(_number, table, "universe.galaxy_limit", 10.0, 30.0, default.galaxy_limit, "mag"),
            galaxy_band=read(_string, table, "universe.galaxy_band", default=default.galaxy_band),
            star_limit=read(_number, table, "universe.star_limit", 0.0, 30.0, default.star_limit, "mag"),
            z_max=read(_number, table, "universe.z_max", 0.01, 6.0, default.z_max),
            box_cells=read(_integer_choice, table, "universe.box_cells", BOX_CELLS, default.box_cells),
            structure_below_cells=read(
                _boolean, table, "universe.structure_below_cells", default.structure_below_cells
            ),
            high_redshift_boost=read(
                _number, table, "universe.high_redshift_boost", *boosts, default.high_redshift_boost
            ),
            quasar_boost=read(_number, table, "universe.quasar_boost", *boosts, default.quasar_boost),
            lensing_nside=read(_integer_choice, table, "universe.lensing_nside", LENSING_NSIDES, lensing_nside),
            lensing=read(_lensing, table.get("lensing", "box")),
            alignment=read(_number, table, "universe.alignment", 0.0, 10.0, default.alignment),
            rotation=read(_number, table, "universe.rotation", -360.0, 360.0, default.rotation, "deg"),
            cosmology=read(checks.parse_cosmology, table.get("cosmology", {})),
            variables=read(_boolean, table, "universe.variables", default.variables),
        )
    return universe


def _lensing(value: object) -> tuple[float, float] | None:
    """Read the key `universe.lensing`: "box", "none" or a constant reduced shear {g1, g2}.

    Return None for "box" (lensing by the simulated matter), (0, 0) for "none", and else (g1, g2).
    """
    path = "universe.lensing"
    if isinstance(value, str):
        return None if _string({"lensing": value}, path, ("box", "none")) == "box" else (0.0, 0.0)
    if not isinstance(value, dict):
        form = '"box", "none" or a table such as { g1 = 0.02, g2 = 0.0 }'
        raise BadInput(f"{path} must be {form}, got {_quote_value(value)}")
    table = _as_table(value, path, ("g1", "g2"))
    with Mistakes() as mistakes:
        g1, g2 = (mistakes.read(_number, table, f"{path}.{key}", -MAX_SHEAR, MAX_SHEAR) for key in ("g1", "g2"))
    if (size := math.hypot(g1, g2)) > MAX_SHEAR:
        raise BadInput(f"{path} = {_quote_value(value)}: |g| = {size:.4g} must be at most {MAX_SHEAR}")
    return g1, g2


def _stars(table: Toml, folder: Path, star_limit: float) -> Stars:
    default = Stars()
    with Mistakes() as mistakes:
        read = mistakes.read
        bright_limit = read(_optional_number, table, "stars.bright_limit", -10.0, 30.0, "mag")
        if bright_limit is not None and bright_limit >= star_limit:
            problem = f"stars.bright_limit = {bright_limit:g} leaves no star up to star_limit = {star_limit:g}"
            mistakes.add(BadInput(f"{problem}: it must be smaller"))
        tycho2 = read(_strings, table, "stars.tycho2") or ()
        catalogue, columns = read(_star_catalogue, table, folder) or (None, ())
        stars = Stars(
            density=read(_string, table, "stars.density", DENSITY_MODELS, default.density),
            brown_dwarf_boost=read(_number, table, "stars.brown_dwarf_boost", 0.0, 1e4, default.brown_dwarf_boost),
            tycho2=tuple(files.resolve_path(folder, name) for name in tycho2),
            catalogue=catalogue,
            columns=columns,
            plane_limit=read(_optional_number, table, "stars.plane_limit", 0.0, 30.0, "mag"),
            bright_limit=bright_limit,
            rows_a_file=read(_integer, table, "stars.rows_a_file", 1, 3_000_000, default.rows_a_file),
        )
    return stars


def _star_catalogue(table: Toml, folder: Path) -> tuple[Path | None, tuple[tuple[str, str], ...]]:
    """Return file and columns of the user's catalogue of stars, None and () without a catalogue."""
    path = "stars.catalogue"
    catalogue = _as_table(table.get("catalogue", {}), path, ("file", "columns"))
    columns = _as_table(catalogue.get("columns", {}), f"{path}.columns", None)
    with Mistakes() as mistakes:
        file = mistakes.read(_string, catalogue, f"{path}.file") if catalogue else None
        names = tuple((key, mistakes.read(_string, columns, f"{path}.columns.{key}")) for key in sorted(columns))
    return None if file is None else files.resolve_path(folder, file), names


def _mission(table: Toml, folder: Path) -> MissionChoice:
    with Mistakes() as mistakes:
        read = mistakes.read
        ladder = read(_strings, table, "mission.ladder", STATUSES) or LADDER
        overrides = read(_as_table, table.get("overrides", {}), "mission.overrides", None) or {}
        cameras = read(files.read_cameras, read(_strings, table, "mission.cameras") or (), folder)
        # Without the user's cameras, the names of their parameters are not known.
        units = instruments.parameter_units(cameras) if overrides and cameras is not None else {}
        values = {
            name: read(checks.parse_override, value, name, name == key, units)
            for key, entry in (overrides.items() if units else ())
            for name, value in instruments.override_values(key, entry)
        }
        chosen = tuple(sorted(_without_none(values).items()))
        if len(chosen) < len(values):
            read(checks.check_mission, MissionChoice(ladder, chosen, cameras))
    return MissionChoice(ladder, chosen, cameras)


def _truth(table: Toml) -> tuple[str, ...]:
    return _strings(table, "products.truth", TRUTH_CONTENTS)


def _effects(table: Toml) -> Effects:
    with Mistakes() as mistakes:
        on = mistakes.read(_strings, table, "effects.on", EFFECTS)
        off = mistakes.read(_strings, table, "effects.off", (_ALL, *EFFECTS))
    if off == (_ALL,):
        return Effects(on, tuple(name for name in EFFECTS if name not in (*ALWAYS_ON, *on)))
    if _ALL in off:
        raise BadInput("effects.off: 'all' must be the only item")
    if required := [name for name in off if name in ALWAYS_ON]:
        raise bad_input(f"effects.off: {name!r} cannot be switched off: every image needs it" for name in required)
    if conflicts := sorted(set(on) & set(off)):
        raise BadInput(f"effects: {conflicts[0]!r} is both on and off")
    return Effects(on, off)


def _explore(table: Toml) -> tuple[tuple[str, tuple[str, ...]], ...]:
    with Mistakes() as mistakes:
        explored = tuple((key, mistakes.read(_distinct_choices, key, table[key])) for key in sorted(table))
    if (count := math.prod(len(values) for _, values in explored)) > _MAX_VARIANTS:
        key = max(explored, key=lambda entry: len(entry[1]))[0]
        raise BadInput(f"explore.{key}: the values give {count} combinations, more than {_MAX_VARIANTS}")
    return explored


def _distinct_choices(key: str, value: object) -> tuple[str, ...]:
    values = _choices(key, value)
    if not values:
        raise BadInput(f"explore.{key} has no value")
    if len(set(values)) != len(values):
        raise BadInput(f"explore.{key} contains a value twice")
    return values


def _choices(key: str, value: object) -> tuple[str, ...]:
    """Read a key of the section `explore`: the name of a parameter, and the values that it takes.

    Return the values as JSON texts: an accuracy as an object, a switch of an effect as true or false, and a mission
    parameter as [number, unit].
    """
    path = f"explore.{key}"
    if isinstance(value, dict) and not value.keys() & {"values", "unit"}:
        name, _ = next(instruments.override_values(key, value))
        form = "[true, false]" if key == "effects" else '{ values = [..], unit = ".." }'
        raise BadInput(f'{path}: write the name in quotes, such as "{name}" = {form}')
    if key != "accuracy" and not key.startswith("effects."):
        table = _as_table(value, path, ("values", "unit"))
        unit, numbers = _string(table, f"{path}.unit"), _required_value(table, f"{path}.values")
        if not isinstance(numbers, list):
            raise BadInput(f"{path}.values must be a list of numbers, got {_quote_value(numbers)}")
        checked = [_checked_number(n, f"{path}.values[{i}]", -math.inf, math.inf) for i, n in enumerate(numbers)]
        return tuple(json.dumps([number, unit]) for number in checked)
    if not isinstance(value, list):
        form = f"; write [{json.dumps(value)}]" if isinstance(value, (str, bool)) else ""
        raise BadInput(f"{path} must be a list, got {_quote_value(value)}{form}")
    if key == "accuracy":
        return tuple(json.dumps(asdict(_accuracy(item, f"{path}[{i}]"))) for i, item in enumerate(value))
    effect = key.removeprefix("effects.")
    if effect not in EFFECTS:
        raise BadInput(f"explore.effects: {_refuse_name(effect, EFFECTS)}")
    switches = [_boolean({f"{effect}[{i}]": item}, f"{path}[{i}]", True) for i, item in enumerate(value)]
    if effect in ALWAYS_ON and False in switches:
        raise BadInput(f"{path} = {_quote_value(value)}: the effect cannot be switched off: every image needs it")
    return tuple(json.dumps(switch) for switch in switches)
