"""Write the table `gaia` under Gaia's own names: python -m jobs.catalogue.export_gaia --lake LAKE --out FILE"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from pyarrow import csv

from jobs.catalogue import parameters
from lake_schema import __version__, command, user_files
from lake_schema.fits.tables import table_to_fits
from lake_schema.store import layout, read
from lake_schema.tables.gaia import EXPORT


def main(argv: Sequence[str] | None = None) -> int:
    """Exit status: 0 done, 1 something is wrong with the lake, 2 the call is wrong."""
    parser = argparse.ArgumentParser(prog="export_gaia", description=__doc__, epilog=f"truesky {__version__}")
    parser.add_argument("--lake", required=True, help="folder of the lake")
    parser.add_argument("--out", required=True, type=Path, help="file to write, .csv or .fits")
    options = parser.parse_args(argv)
    return command.status("export_gaia", lambda: _exported(layout.lake(options.lake), options.out))


def _exported(lake: Path, out: Path) -> int:
    rows = export(lake, out)
    print(f"{out}: {rows:,} stars")
    return 0


def export(lake: Path, path: Path) -> int:
    """Write the published table `gaia` to a file, replaced in one rename; returns its rows.

    Errors : BadInput for another ending than .csv and .fits
    """
    user_files.target(path, (".csv", ".fits"))
    version = read.version(lake, "gaia")
    if path.suffix.lower() == ".fits":
        table_to_fits(path, pa.concat_tables([_named(version, part) for part in version.parts]), EXPORT)
    else:
        _csv(version, path)
    return version.num_rows


def _csv(version: read.Version, path: Path) -> None:
    temporary = path.with_name(f".{os.getpid()}.tmp.{path.name}")
    try:
        with csv.CSVWriter(temporary, EXPORT.arrow()) as writer:
            for part in version.parts:
                writer.write_table(_named(version, part))
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _named(version: read.Version, part: str) -> pa.Table:
    rows = version.rows(parts=[part])
    known = {"source_id": rows["id"], "bp_rp": pc.subtract(rows["phot_bp_mean_mag"], rows["phot_rp_mean_mag"])}
    epoch = np.full(rows.num_rows, parameters.section("gaia.toml", "astrometry")["epoch"])
    columns = {name: rows[name] for name in EXPORT.names if name in rows.column_names}
    return EXPORT.build({**columns, **known, "ref_epoch": epoch})


if __name__ == "__main__":
    sys.exit(main())
