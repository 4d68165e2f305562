"""Write the table `galaxies` in a format of other programs.

python -m truesky.catalogue.export_galaxies --lake LAKE --out FOLDER --form FORM

fits         a binary table for each Nside-32 cell (nested), every column, units (TUNIT) and UCDs (TUCD)
skycatalogs  LSST DESC skyCatalogs 2: galaxies, and stars where the lake has them, with spectra and LSST fluxes;
             skyCatalog.yaml is what it opens (docs/exports.md)
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

FORMS = ("fits", "skycatalogs")


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 done, 1 something is wrong with the lake, 2 the call is wrong."""
    parser = argparse.ArgumentParser(
        prog="export_galaxies",
        description=__doc__,
        epilog=f"truesky {__version__}",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--lake", required=True, help="folder of the lake")
    parser.add_argument("--out", required=True, type=Path, help="folder to write to (made where it is not there)")
    parser.add_argument("--form", required=True, choices=FORMS)
    parser.add_argument("--name", help="of the request whose tables are meant, where the lake has several")
    options = parser.parse_args(argv)
    return command.run("export_galaxies", lambda: _run_export(options))


def _run_export(options: argparse.Namespace) -> int:
    out = options.out
    written = export(layout.resolve_lake(options.lake), user_files.check_folder(out), options.form, options.name)
    print(f"{out}: {len(written)} files")
    return 0


def export(lake: Path, folder: Path, form: str, request: str | None = None) -> list[Path]:
    """Write the published galaxies, a file a cell, each replaced in one rename; returns the files.

    lake : folder of the lake;  folder : to write to;  form : one of FORMS
    request : whose galaxies, where a lake has those of several
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
