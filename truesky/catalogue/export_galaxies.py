"""Export the table `galaxies` in formats that other programs read.

python -m truesky.catalogue.export_galaxies LAKE --out FOLDER --form FORM

fits         one binary table per Nside-32 cell (nested) with all columns, units (TUNIT) and UCDs (TUCD)
skycatalogs  LSST DESC skyCatalogs 2: galaxies, and stars if the lake contains them, with spectra and LSST fluxes;
             open skyCatalog.yaml with skyCatalogs (docs/exports.md)
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from lake_schema import __version__, command, user_files
from lake_schema.fits.tables import table_to_fits
from lake_schema.store import layout, read
from lake_schema.tables.galaxies import GALAXIES
from truesky.catalogue.exports import skycatalogs
from truesky.command_line.parser import Parser

FORMS = ("fits", "skycatalogs")


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit status: 0 success, 1 a problem in the lake, 2 wrong arguments."""
    parser = Parser(
        prog="export_galaxies",
        description=__doc__,
        epilog=f"truesky {__version__}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_lake()
    parser.add_argument(
        "--out", required=True, type=Path, help="folder to write to; it is created if it does not exist"
    )
    parser.add_argument("--form", required=True, choices=FORMS)
    parser.add_argument("--name", help="name of the request to export, if the lake contains several")
    options = parser.parse_args(argv)
    return command.run("export_galaxies", lambda: _run_export(options))


def _run_export(options: argparse.Namespace) -> int:
    out = options.out
    written = export(layout.resolve_lake(options.lake), user_files.check_folder(out), options.form, options.name)
    print(f"{out}: {len(written)} files")
    return 0


def export(lake: Path, folder: Path, form: str, request: str | None = None) -> list[Path]:
    """Write the table `galaxies` of a lake to files of another format; existing files are replaced atomically.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    folder : Path
        Folder to write to; it is created if it does not exist.
    form : str
        "fits" (one FITS table per partition) or "skycatalogs" (files for skyCatalogs, also of the stars).
    request : str, optional
        Name of the request to export; None if the lake contains only one.

    Returns
    -------
    list of Path
        Files written.
    """
    if form == "skycatalogs":
        return skycatalogs.write(lake, folder, request)
    version = read.version(lake, GALAXIES.name, request=request)
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for partition in version.partitions:
        path = folder / f"galaxies_nside32_nest_{layout.cell_of_file(partition)[1]}.fits"
        table_to_fits(path, version.rows(partitions=[partition]), GALAXIES)
        written.append(path)
    return written


if __name__ == "__main__":
    command.exit_with_status(main)
