"""Read a simulation request: a TOML file in which a user describes a simulation. Every number has limits.

All keys::

    name = "demo"      seed = 2024      noise_seed = 1 (default: seed)
    accuracy = "survey" | "quicklook" | "draft" | "reference"
               | {flux = .., shape = .., position = .., background = ..}
    [area]         polygon = [[ra, dec], ..] | cone = {ra, dec, radius} | box = {ra = [from, to], dec = [from, to]}
                   tile = number | patches = [[ra, dec, radius], ..] | wide = true
    [universe]     galaxy_limit, galaxy_band, star_limit (H, Vega), z_max, box_cells, lensing_nside
                   high_redshift_boost, quasar_boost, alignment
                   lensing = "box" | "none" | {g1, g2}   constant reduced shear of all galaxies, frame (east, north)
                   rotation       deg, added to the position angle of every galaxy before lensing
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
    [fluxes]       bands = [..]           default: the bands of the pointings and observations
                   intergalactic = true   intergalactic hydrogen absorbs the light of galaxies
    [fluxes.passbands.NAME]        user's filter, column f_nu_NAME: file, medium = "air" | "vacuum", format
    [fluxes.templates]             user's galaxy spectra, earliest type first, counted by sed_1 and sed_2: files, format
    [fluxes.stars]                 user's dwarf spectra: basel (models, .cor), irtf = [..] (their infrared, by Y - H)
    [fluxes.extinction.CODE]       user's law that replaces law 1 .. 4: file, format
    [psf]          BAND = "file.fits"   user's PSF in a band: a cube of planes or a PSFEx file; from a list of files,
                   each exposure uses one at random (truesky/render/psf/from_file.py);
                   {detector} in the name is replaced by the detector's name
    [solar_system] bodies = "file"      user's moving bodies that replace ours (truesky/render/sources/ephemerides.py)
    [effects]      on = [..]  off = [..]  effects forced on or off, default: what a scene needs
                   off = ["all"]          all except those in `on` and effects that every image needs, such as
                                          analogue-to-digital conversion (ALWAYS_ON in truesky/request/schema.py)
    [explore]      accuracy = [..]  "effects.<name>" = [true, false]  "vis.gain" = {values = [..], unit = ".."}
    [[pointing]]   channel, camera, band, ra, dec, position_angle, mjd, detectors, centre_on, exposure_time_s,
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
        pointings = "file.csv"     table of pointings instead of both (truesky/request/pointing_tables.py)
        dither = "S" | "J" | "none" | [[x, y], ..] arcsec   fields, visits, exposures, short, flat, blue, bands,
        detectors, mjd, exposure_time_s, realisations
        lamps = [..], intensities = [..] of flat and persistence
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
                   readout = "raw" | "amplifiers" | "electrons"   for ground cameras: one array, one extension per
                                         amplifier, or electrons before the readout

File names are relative to the folder of the request; truesky/fluxes/libraries/spectrum_formats.toml has their formats.
An unknown key, a wrong type or a number out of bounds is refused. The message gives the full path of the key::

    truesky check FILE [--plan]
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, replace
from pathlib import Path

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.store import layout
from truesky.request import area as areas
from truesky.request import bands as request_bands
from truesky.request import checks, files, observations, structure
from truesky.request.accuracy import SURVEY, Accuracy, fastest_row, preset
from truesky.request.area import Area
from truesky.request.files import UserSources
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
from truesky.request.toml_values import Toml
from truesky.request.toml_values import as_table as _as_table
from truesky.request.toml_values import boolean as _boolean
from truesky.request.toml_values import check_keys as _check_keys
from truesky.request.toml_values import checked_number as _checked_number
from truesky.request.toml_values import integer as _integer
from truesky.request.toml_values import integer_choice as _integer_choice
from truesky.request.toml_values import number as _number
from truesky.request.toml_values import optional_number as _optional_number
from truesky.request.toml_values import quote_value as _quote_value
from truesky.request.toml_values import required_value as _required_value
from truesky.request.toml_values import section as _section
from truesky.request.toml_values import string as _string
from truesky.request.toml_values import strings as _strings

__all__ = ["Area", "Override", "Request", "parse"]

_MAX_VARIANTS = 10_000
_MAX_SEED = 2**63 - 1
_ALL = "all"
_SECTIONS = (
    "area", "universe", "stars", "ingest", "sources", "strong_lenses", "structure", "mission", "fluxes",
    "psf", "solar_system", "effects", "explore", "products",
)  # fmt: skip
# Names that a request must not have: SQL queries (truesky/explore) use the request's name as the schema of its tables,
# and these schemas exist already.
_RESERVED_NAMES = ("information_schema", "main", "memory", "pg_catalog", "system", "temp")


def parse(path: Path) -> Request:
    """Read and check a request file; raises BadInput if it is not valid, with one line that names file and key."""
    try:
        table = user_files.read_toml(path, "request")
    except BadInput as error:
        raise BadInput(f"request {error}") from None
    try:
        return from_table(table, path.resolve().parent)
    except BadInput as error:
        raise BadInput(f"request {user_files.format_path(path)}: {error}") from None


def _name(table: Toml) -> str:
    name = layout.check_name(_string(table, "name"))
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
        If a key is missing or unknown, or has a value that is not allowed. The message names the key.
    """
    _check_keys(table, "", {"name", "seed", "noise_seed", "accuracy", "pointing", "observation", *_SECTIONS})
    pointings, blocks = observations.parse_pointings(table), observations.parse_observations(table, folder)
    fluxes = _section(table, "fluxes", {"bands", "intergalactic", "passbands", "templates", "stars", "extinction"})
    bands = _strings(fluxes, "fluxes.bands")
    mission = _mission(_section(table, "mission", {"ladder", "overrides", "cameras"}), folder)
    named_bands = {
        *bands,
        *(pointing.band for pointing in pointings),
        *(b for o in blocks if o.table for b in o.table.bands),
    }
    curves = files.with_camera_passbands(files.parse_curves(fluxes, folder), mission.cameras, named_bands)
    products_table = _section(table, "products", {"truth", "compression", "wcs", "files", "readout"})
    solar_system = _section(table, "solar_system", {"bodies"})
    bodies = files.resolve_path(folder, _string(solar_system, "solar_system.bodies")) if solar_system else None
    universe = _universe(_section(table, "universe", set(Universe.__slots__)))
    request = Request(
        name=_name(table),
        seed=_integer(table, "seed", 0, _MAX_SEED),
        accuracy=_accuracy(table.get("accuracy"), "accuracy"),
        area=areas.parse(_section(table, "area", None)),
        universe=universe,
        stars=_stars(_section(table, "stars", set(Stars.__slots__) - {"columns"}), folder, universe.star_limit),
        mission=mission,
        bands=bands,
        pointings=pointings,
        truth=_truth(products_table),
        compression=_string(products_table, "products.compression", COMPRESSIONS, "none"),
        wcs=_string(products_table, "products.wcs", WCS_CONVENTIONS) if "wcs" in products_table else None,
        files=_string(products_table, "products.files", FILE_LAYOUTS, "detector"),
        readout=_string(products_table, "products.readout", READOUTS, "raw"),
        curves=curves,
        observations=blocks,
        effects=_effects(_section(table, "effects", {"on", "off"})),
        explore=_explore(_section(table, "explore", None)),
        ingest=files.parse_ingest(_section(table, "ingest", {"galaxies", "halos", "training", "dust"}), folder),
        bodies=bodies,
        sources=files.parse_sources(_section(table, "sources", {"only", *UserSources.__slots__}), folder),
        structure=structure.parse(_section(table, "structure", set(structure.Structure.__slots__)), folder),
        noise_seed=_integer(table, "noise_seed", 0, _MAX_SEED) if "noise_seed" in table else None,
        psfs=files.parse_psfs(_section(table, "psf", None), folder),
        strong_lens_boost=_number(_section(table, "strong_lenses", {"boost"}), "strong_lenses.boost", 1e-3, 1e5, 1.0),
    )
    checks.check_sources(request)
    checks.check_bands(request)
    default_bands = request_bands.requested_bands(request, checks.check_mission(request))
    user_bands = (name for name, _ in curves.passbands)
    return replace(request, bands=tuple(dict.fromkeys((*(bands or default_bands), *user_bands))))


# The functions below read one section or key of a request each. They raise BadInput, which names the key, if a value is
# not allowed.


def _accuracy(value: object, path: str) -> Accuracy:
    if value is None:
        return SURVEY
    if isinstance(value, str):
        return preset(value)
    table = _as_table(value, path, {"flux", "shape", "position", "background"})
    accuracy = Accuracy(**{key: _number(table, f"{path}.{key}", 1e-12, 1.0) for key in Accuracy.__slots__})
    # Call `fastest_row` only for its check: it raises BadInput if no drawing settings reach this accuracy.
    fastest_row(accuracy)
    return accuracy


def _universe(table: Toml) -> Universe:
    default = Universe()
    return Universe(
        galaxy_limit=_number(table, "universe.galaxy_limit", 10.0, 30.0, default.galaxy_limit),
        galaxy_band=_string(table, "universe.galaxy_band", default=default.galaxy_band),
        star_limit=_number(table, "universe.star_limit", 0.0, 30.0, default.star_limit),
        z_max=_number(table, "universe.z_max", 0.01, 6.0, default.z_max),
        box_cells=_integer_choice(table, "universe.box_cells", BOX_CELLS, default.box_cells),
        high_redshift_boost=_number(table, "universe.high_redshift_boost", 0.0, 1e5, default.high_redshift_boost),
        quasar_boost=_number(table, "universe.quasar_boost", 0.0, 1e5, default.quasar_boost),
        lensing_nside=_integer_choice(table, "universe.lensing_nside", LENSING_NSIDES, default.lensing_nside),
        lensing=_lensing(table.get("lensing", "box")),
        alignment=_number(table, "universe.alignment", 0.0, 10.0, default.alignment),
        rotation=_number(table, "universe.rotation", -360.0, 360.0, default.rotation),
    )


def _lensing(value: object) -> tuple[float, float] | None:
    """Read the key `universe.lensing`: "box", "none" or a constant reduced shear {g1, g2}.

    Return None for "box" (lensing by the simulated matter), (0, 0) for "none", and else (g1, g2).
    """
    path = "universe.lensing"
    if isinstance(value, str):
        return None if _string({"lensing": value}, path, ("box", "none")) == "box" else (0.0, 0.0)
    table = _as_table(value, path, {"g1", "g2"})
    g1, g2 = (_number(table, f"{path}.{key}", -1.0, 1.0) for key in ("g1", "g2"))
    if (size := math.hypot(g1, g2)) > MAX_SHEAR:
        raise BadInput(f"{path} = {_quote_value(value)}: |g| = {size:.4g} must be at most {MAX_SHEAR}")
    return g1, g2


def _stars(table: Toml, folder: Path, star_limit: float) -> Stars:
    default = Stars()
    bright_limit = _optional_number(table, "stars.bright_limit", -10.0, 30.0)
    if bright_limit is not None and bright_limit >= star_limit:
        raise BadInput(f"stars.bright_limit = {bright_limit:g} leaves no star up to star_limit = {star_limit:g}")
    rows = _integer(table, "stars.rows_a_file", 1, 3_000_000) if "rows_a_file" in table else default.rows_a_file
    plane_limit = _number(table, "stars.plane_limit", 0.0, 30.0, math.nan)
    catalogue_table = _as_table(table.get("catalogue", {}), "stars.catalogue", {"file", "columns"})
    columns = _as_table(catalogue_table.get("columns", {}), "stars.catalogue.columns", None)
    return Stars(
        density=_string(table, "stars.density", DENSITY_MODELS) if "density" in table else default.density,
        brown_dwarf_boost=_number(table, "stars.brown_dwarf_boost", 0.0, 1e4, default.brown_dwarf_boost),
        tycho2=tuple(files.resolve_path(folder, name) for name in _strings(table, "stars.tycho2")),
        catalogue=files.resolve_path(folder, _string(catalogue_table, "stars.catalogue.file"))
        if catalogue_table
        else None,
        columns=tuple((key, _string(columns, f"stars.catalogue.columns.{key}")) for key in sorted(columns)),
        plane_limit=None if math.isnan(plane_limit) else plane_limit,
        bright_limit=bright_limit,
        rows_a_file=rows,
    )


def _mission(table: Toml, folder: Path) -> MissionChoice:
    ladder = _strings(table, "mission.ladder", STATUSES) or LADDER
    overrides = _as_table(table.get("overrides", {}), "mission.overrides", None)
    chosen = tuple(sorted((key, _override(value, key)) for key, value in overrides.items()))
    return MissionChoice(ladder, chosen, files.read_cameras(_strings(table, "mission.cameras"), folder))


def _override(value: object, key: str) -> Override:
    path = f"mission.overrides.{key}"
    table = _as_table(value, path, {"value", "unit"})
    return Override(_number(table, f"{path}.value", -math.inf, math.inf), _string(table, f"{path}.unit"))


def _truth(table: Toml) -> tuple[str, ...]:
    return _strings(table, "products.truth", TRUTH_CONTENTS)


def _effects(table: Toml) -> Effects:
    on, off = _strings(table, "effects.on", EFFECTS), _strings(table, "effects.off", (_ALL, *EFFECTS))
    if off == (_ALL,):
        return Effects(on, tuple(name for name in EFFECTS if name not in (*ALWAYS_ON, *on)))
    if _ALL in off:
        raise BadInput("effects.off: 'all' must be the only item")
    if conflicts := sorted(set(on) & set(off)):
        raise BadInput(f"effects: {conflicts[0]!r} is both on and off")
    return Effects(on, off)


def _explore(table: Toml) -> tuple[tuple[str, tuple[str, ...]], ...]:
    explored, count = [], 1
    for key in sorted(table):
        values = _choices(key, table[key])
        if not values:
            raise BadInput(f"explore.{key} has no value")
        if len(set(values)) != len(values):
            raise BadInput(f"explore.{key} contains a value twice")
        count *= len(values)
        if count > _MAX_VARIANTS:
            raise BadInput(f"explore.{key}: the values give more than {_MAX_VARIANTS} combinations")
        explored.append((key, values))
    return tuple(explored)


def _choices(key: str, value: object) -> tuple[str, ...]:
    """Read a key of the section `explore`: the name of a parameter, and the values that it takes.

    Return the values as JSON texts: an accuracy as an object, a switch of an effect as true or false, and a mission
    parameter as [number, unit].
    """
    path = f"explore.{key}"
    if key != "accuracy" and not key.startswith("effects."):
        table = _as_table(value, path, {"values", "unit"})
        unit, numbers = _string(table, f"{path}.unit"), _required_value(table, f"{path}.values")
        if not isinstance(numbers, list):
            raise BadInput(f"{path}.values must be a list of numbers, got {_quote_value(numbers)}")
        checked = [_checked_number(n, f"{path}.values[{i}]", -math.inf, math.inf) for i, n in enumerate(numbers)]
        return tuple(json.dumps([number, unit]) for number in checked)
    if not isinstance(value, list):
        raise BadInput(f"{path} must be a list, got {_quote_value(value)}")
    if key == "accuracy":
        return tuple(json.dumps(asdict(_accuracy(item, f"{path}[{i}]"))) for i, item in enumerate(value))
    if key.removeprefix("effects.") not in EFFECTS:
        raise BadInput(f"{path} is not one of the effects {', '.join(EFFECTS)}")
    return tuple(json.dumps(_boolean({"x": item}, f"{path}[{i}].x", True)) for i, item in enumerate(value))
