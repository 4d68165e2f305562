"""truesky export: write catalogues, depth maps and grisms in the formats of other programs."""

from __future__ import annotations

import argparse
from pathlib import Path

from lake_schema import user_files
from lake_schema.errors import BadInput
from lake_schema.store import layout, read
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.stars import STARS
from truesky.catalogue.exports import euclid, fits_files, gaia_archive, skycatalogs
from truesky.command_line import exports
from truesky.command_line.parser import suggestion
from truesky.survey_maps import depth_lookup, euclid_maps, healsparse_files


def run_command(options: argparse.Namespace) -> int:
    """Write what the parsed arguments of `truesky export` name, print the number of files or rows, and return 0.

    Raises BadInput if the format or an option does not fit what is written, or a table cannot be exported.
    """
    forms = exports.FORMS[options.what]
    form = options.form or forms[0]
    if form not in forms:
        raise BadInput(f"--form {form}: {options.what} can be written as {', '.join(forms)}{suggestion(form, forms)}")
    _refuse_options(options, form)
    if options.what == "grisms":
        print(f"{options.out}: {_write_grisms(options)} configurations")
        return 0
    lake = layout.resolve_lake(options.lake)
    if options.what == "gaia":
        declared = gaia_archive.RELEASES[options.release or exports.RELEASES[0]]
        rows = gaia_archive.write(lake, options.out, declared, form, options.epoch, options.name)
        summary = f"{rows:,} stars"
    elif options.what == "depth":
        version = read.version(lake, "depth", request=options.name)
        summary = f"{_write_maps(version, form, options.out, options.bands, options.columns)} maps"
    else:
        summary = _write_folder(lake, options.what, form, user_files.check_folder(options.out), options.name)
    print(f"{options.out}: {summary}")
    return 0


def _refuse_options(options: argparse.Namespace, form: str) -> None:
    """Raise BadInput if an option belongs to another export, or LAKE is missing."""
    if options.epoch is not None and options.what != "gaia":
        raise BadInput("--epoch is an option of gaia only")
    if options.release is not None and form != "table":
        raise BadInput("--release is an option of gaia as a table only")
    if (options.bands or options.columns) and options.what != "depth":
        raise BadInput("--bands and --columns are options of depth only")
    if (options.detectors or options.exposure is not None) and options.what != "grisms":
        raise BadInput("--exposure and --detectors are options of grisms only")
    if not options.lake and options.what != "grisms":
        raise BadInput(f"LAKE is missing: write truesky export {options.what} LAKE --out PATH")


def _write_grisms(options: argparse.Namespace) -> int:
    """Write the nominal grisms, or the grisms of an exposure of a lake, and return the number of configurations."""
    from truesky.render import grisms

    if bool(options.lake) != (options.exposure is not None):
        raise BadInput("LAKE and --exposure must be given together, or neither for the nominal grisms")
    if options.name and not options.lake:
        raise BadInput("--name requires LAKE")
    folder, lake = user_files.check_folder(options.out), layout.resolve_lake(options.lake) if options.lake else None
    return grisms.write(folder, lake, options.exposure, options.detectors, options.name)


def _write_folder(lake: Path, what: str, form: str, folder: Path, request: str | None) -> str:
    """Write galaxies or stars to a folder, and return a summary."""
    if form == "fits":
        return f"{len(fits_files.write(lake, GALAXIES if what == 'galaxies' else STARS, folder, request))} files"
    if form == "skycatalogs":
        return f"{len(skycatalogs.write(lake, folder, request))} files"
    write = euclid.write_galaxies if what == "galaxies" else euclid.write_stars
    written = write(lake, folder, request)
    left_out = f", without {written.left_out:,} of kinds that the format lacks" if written.left_out else ""
    return f"{len(written.files)} files, {written.rows:,} {what}{left_out}"


def _write_maps(version: read.Version, form: str, folder: Path, bands: list[str], columns: list[str]) -> int:
    """Write depth maps to a new folder, one file per band and column, and return their number."""
    if user_files.check_folder(folder).exists():
        raise BadInput(f"{user_files.format_path(folder)}: exists already; give the name of a new folder")
    with user_files.create_folder(folder) as staged:
        if form == "healsparse":
            return len(healsparse_files.write(version, staged, bands, columns or healsparse_files.COLUMNS))
        pairs = [
            (band, column)
            for band in depth_lookup.choose_bands(version, bands)
            for column in columns or euclid_maps.QUANTITIES
        ]
        for band, column in pairs:
            euclid_maps.write(version, staged / f"{band}_{column}.fits", band, column)
    return len(pairs)
