"""Write the table `galaxies` for others: python -m jobs.catalogue.export_galaxies --lake LAKE --out FOLDER --form FORM

fits         a binary table for each Nside-32 cell (nested), every column, units (TUNIT) and UCDs (TUCD)
skycatalogs  LSST DESC skyCatalogs: galaxy_N.parquet, galaxy_flux_N.parquet for each Nside-32 pixel N (ring), and the
             document skyCatalog.yaml. Spectra in their tophat bins are not made: brightness is in the flux files.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from jobs.fluxes import cosmology, passbands
from jobs.fluxes.spectra.extinction import MILKY_WAY_R_V
from lake_schema import __version__, command, sky, user_files
from lake_schema.errors import BadInput
from lake_schema.fits.tables import table_to_fits
from lake_schema.store import layout, read
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.units import LIGHT_KM_S, electron_rate

FORMS = ("fits", "skycatalogs")
_YAML = """# Written by truesky {version}. No spectra: fluxes are in galaxy_flux_N.parquet, photons/s/cm2.
catalog_name: {name}
catalog_dir: .
skycatalog_root: {root}
Cosmology: {{H0: {h0}, Om0: {om}, Ob0: {ob}, sigma8: 0.83, n_s: 0.96}}
MW_extinction_values: {{r_v: {{mode: constant, value: {r_v}}}, a_v: {{mode: data}}}}
object_types:
  galaxy:
    file_template: 'galaxy_(?P<healpix>\\d+).parquet'
    flux_file_template: 'galaxy_flux_(?P<healpix>\\d+).parquet'
    data_file_type: parquet
    area_partition: {{type: healpix, ordering: ring, nside: 32}}
    composite: {{bulge: required, disk: required}}
"""


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
    options = parser.parse_args(argv)
    return command.status("export_galaxies", lambda: _exported(layout.lake(options.lake), options.out, options.form))


def _exported(lake: Path, out: Path, form: str) -> int:
    written = export(lake, user_files.folder(out), form)
    print(f"{out}: {len(written)} files")
    return 0


def export(lake: Path, folder: Path, form: str) -> list[Path]:
    """Write the published galaxies, a file a cell, each replaced in one rename; returns the files."""
    version = read.version(lake, GALAXIES.name)
    fluxes = _fluxes(lake, version) if form == "skycatalogs" else None
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for part in version.parts:
        order, cell = layout.cell_of_file(part)
        rows = version.rows(parts=[part])
        if fluxes is None:
            path = folder / f"galaxies_nside32_nest_{cell}.fits"
            table_to_fits(path, rows, GALAXIES)
            written.append(path)
            continue
        pixel = sky.ring_of(order, cell)
        written += [
            _parquet(folder / f"galaxy_{pixel}.parquet", _galaxy_rows(rows)),
            _parquet(folder / f"galaxy_flux_{pixel}.parquet", _flux_rows(part, rows, fluxes)),
        ]
    if fluxes is not None:
        about = {"h0": 100.0 * cosmology.HUBBLE, "om": cosmology.OMEGA_M, "ob": cosmology.OMEGA_B, "r_v": MILKY_WAY_R_V}
        document = folder / "skyCatalog.yaml"
        document.write_text(_YAML.format(version=__version__, name="skyCatalog", root=folder, **about))
        written.append(document)
    return written


def _fluxes(lake: Path, galaxies: read.Version) -> read.Version:
    fluxes = read.version(lake, "galaxy_fluxes")
    if fluxes.manifest["facts"].get("input") != galaxies.key:
        raise BadInput("table galaxy_fluxes was computed from another version of galaxies: run compute_fluxes first")
    if not _bands(fluxes):
        raise BadInput("table galaxy_fluxes has no LSST band: put lsst_r into fluxes.bands and run compute_fluxes")
    return fluxes


def _bands(fluxes: read.Version) -> list[str]:
    return [name.removeprefix("f_nu_") for name in fluxes.schema.names if name.startswith("f_nu_lsst_")]


def _galaxy_rows(rows: pa.Table) -> pa.Table:
    """Sizes are half-light radii; shears and position angles in GalSim's frame, whose x axis points west."""
    c: dict[str, Any] = {name: rows[name].to_numpy() for name in rows.column_names if not rows[name].null_count}
    bulge, disc = c["bulge_half_light_radius"], c["disk_half_light_radius"]
    return pa.table(
        {
            "galaxy_id": c["id"],
            "ra": c["ra_lensed"],
            "dec": c["dec_lensed"],
            "redshift": c["z_obs"].astype(np.float64),
            "redshift_hubble": c["z_true"].astype(np.float64),
            "peculiar_velocity": LIGHT_KM_S * ((1.0 + c["z_obs"].astype(float)) / (1.0 + c["z_true"]) - 1.0),
            "shear_1": c["gamma1"].astype(np.float64),
            "shear_2": -c["gamma2"].astype(np.float64),
            "convergence": c["kappa"].astype(np.float64),
            "size_bulge_true": bulge,
            "size_minor_bulge_true": bulge * c["bulge_axis_ratio"],
            "sersic_bulge": c["bulge_sersic_index"],
            "size_disk_true": disc,
            "size_minor_disk_true": disc * c["disk_axis_ratio"],
            "sersic_disk": np.ones_like(disc),
            "position_angle_unlensed": (c["position_angle"].astype(float) + 90.0) % 180.0,
            "MW_rv": np.full_like(disc, MILKY_WAY_R_V),
            "MW_av": c["a_v"],
        }
    )


def _flux_rows(part: str, rows: pa.Table, fluxes: read.Version) -> pa.Table:
    """Photons per second and cm2 through the whole system, magnified and behind the Milky Way's dust."""
    bands = _bands(fluxes)
    found = fluxes.rows(["id", *(f"f_nu_{band}" for band in bands)], [part])
    if not found["id"].equals(rows["id"]):
        raise BadInput(f"table galaxy_fluxes: {part} does not hold the rows of table galaxies")
    width = {band: passbands.log_width(passbands.load(band)) for band in bands}
    columns = {
        f"lsst_flux_{band[-1]}": electron_rate(found[f"f_nu_{band}"].to_numpy(), 1.0, width[band]).astype(np.float32)
        for band in bands
    }
    return pa.table({"galaxy_id": rows["id"], **columns})


def _parquet(path: Path, table: pa.Table) -> Path:
    temporary = path.with_name(f".{os.getpid()}.tmp.{path.name}")
    try:
        pq.write_table(table, temporary)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
    return path


if __name__ == "__main__":
    sys.exit(main())
