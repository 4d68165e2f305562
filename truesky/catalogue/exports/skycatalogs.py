"""Write the galaxies and stars of a lake in the format of LSST DESC skyCatalogs 2 (schema 1.3.0).

`write` makes the files galaxy_N.parquet, galaxy_flux_N.parquet, pointsource_N.parquet and pointsource_flux_N.parquet
for each HEALPix pixel N (Nside 32, RING ordering) that contains observed positions. It also makes the folder seds/ with
the spectra of the stars, and skyCatalog.yaml.

The components of a galaxy are a bulge and a disk, whose spectra add up to the galaxy's spectrum; there are no knots.
skyCatalogs computes fluxes from the spectra, except in the LSST bands that the flux files contain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import yaml

from lake_schema import __version__, sky, user_files
from lake_schema.arrays import Float
from lake_schema.errors import BadInput
from lake_schema.store import layout
from lake_schema.units import LIGHT_KM_S, electron_rate
from truesky.catalogue.exports import catalogues, stellar_spectra, tophat
from truesky.catalogue.exports.catalogues import Catalogue
from truesky.cosmology import Cosmology, from_facts
from truesky.fluxes import bulges, inputs, passbands
from truesky.fluxes.spectra.extinction import MILKY_WAY_R_V

# HEALPix order of the pixels into which the files are divided (Nside 32).
ORDER = 5
# Number of rows per row group of the Parquet files; skyCatalogs reads one row group at a time.
_ROW_GROUP_SIZE = 20_000
# Smallest half-light radius, arcsec, because GalSim cannot draw a size of 0.
_MIN_SIZE = 1e-3
_Maker = Callable[[pa.Table], pa.Table]


def write(lake: Path, folder: Path, request: str | None = None) -> list[Path]:
    """Write all files for skyCatalogs; existing files are replaced atomically, and skyCatalog.yaml is written last.

    Parameters
    ----------
    lake : Path
        Folder of the lake.
    folder : Path
        Folder to write to; it is created if it does not exist.
    request : str, optional
        Name of the request to export; None if the lake contains only one.

    Returns
    -------
    list of Path
        Files written.

    Raises
    ------
    BadInput
        If the lake has no table `galaxies`, if the tables of fluxes are missing, have no LSST band or belong to other
        rows, or if the lake has massive neutrinos or dark energy that is not a cosmological constant.
    """
    opened = {
        kind: _catalogue(lake, table, request)
        for kind, table in (("galaxy", "galaxies"), ("star", "stars"))
        if catalogues.has_table(lake, table, request)
    }
    if "galaxy" not in opened:
        raise BadInput(f"lake {lake} has no table galaxies")
    cosmology = from_facts(opened["galaxy"].rows.manifest["facts"])
    if not cosmology.has_constant_dark_energy:
        # skyCatalogs computes distances with w = -1, so that fluxes would be wrong.
        raise BadInput(
            f"lake {lake}: w0 = {cosmology.w0:g}, wa = {cosmology.wa:g}; skyCatalogs knows w0 = -1, wa = 0 only"
        )
    if cosmology.m_nu > 0.0:
        raise BadInput(f"lake {lake}: m_nu = {cosmology.m_nu:g}; skyCatalogs has no massive neutrinos")
    folder.mkdir(parents=True, exist_ok=True)
    written, object_types, templates = [], {}, set[int]()
    for kind, catalogue in opened.items():
        makers = _galaxy_rows(lake, catalogue) if kind == "galaxy" else _star_rows(lake, catalogue)
        stem = {"galaxy": "galaxy", "star": "pointsource"}[kind]
        for pixel, rows in _by_pixel(catalogue):
            number = sky.ring_index(ORDER, pixel)
            if kind == "star":
                templates.update(np.unique(rows["sed"].to_numpy()).tolist())
            for name, maker in zip((f"{stem}_{number}", f"{stem}_flux_{number}"), makers, strict=True):
                written.append(_parquet(folder / f"{name}.parquet", rows, maker))
        object_types[kind] = _object_type(kind, stem, from_facts(catalogue.rows.manifest["facts"]))
    if "star" in opened:
        library = inputs.stellar_library_from_facts(lake, opened["star"].fluxes.manifest["facts"])
        written += stellar_spectra.write(folder, library, sorted(templates))
    document = folder / "skyCatalog.yaml"
    text = f"# Written by truesky {__version__}\n" + yaml.safe_dump(_document(object_types), sort_keys=False)
    written.append(_write_staged(document, lambda path: path.write_text(text, encoding="utf-8")))
    return written


def _catalogue(lake: Path, table: str, request: str | None) -> Catalogue:
    catalogue = catalogues.open_catalogue(lake, table, request, "lsst_")
    if not catalogue.bands:
        name = catalogues.FLUXES[table]
        raise BadInput(f"table {name} has no LSST band: put lsst_r into fluxes.bands and run truesky fluxes")
    return catalogue


def _by_pixel(catalogue: Catalogue) -> Iterator[tuple[int, pa.Table]]:
    """Yield the nested index and the rows of every HEALPix pixel (Nside 32) that contains sources."""
    for partitions in _group_by_pixel(catalogue.rows.partitions):
        rows = pa.concat_tables([catalogue.read_partition(partition) for partition in partitions])
        pixels = sky.parent(rows["_healpix_29"].to_numpy(), sky.MAX_ORDER, ORDER)
        for pixel in np.unique(pixels).tolist():
            yield pixel, rows.filter(pa.array(pixels == pixel))


def _group_by_pixel(partitions: Iterable[str]) -> list[list[str]]:
    """Group the names of partitions (files of sky cells) that are in the same HEALPix pixel with Nside 32.

    A partition that is larger than a pixel is a separate group.
    """
    groups: dict[tuple[int, int], list[str]] = {}
    for partition in partitions:
        order, cell = layout.cell_of_file(partition)
        coarse = min(order, ORDER)
        groups.setdefault((coarse, cell >> 2 * (order - coarse)), []).append(partition)
    return list(groups.values())


def _galaxy_rows(lake: Path, catalogue: Catalogue) -> tuple[_Maker, _Maker]:
    library = inputs.galaxy_library_from_facts(lake, catalogue.fluxes.manifest["facts"])
    cosmology = from_facts(catalogue.rows.manifest["facts"])

    def rows(galaxies: pa.Table) -> pa.Table:
        light = tophat.luminosities(galaxies, library, cosmology)
        share = bulges.fractions_in_bins(galaxies, tophat.templates_in_bins(library), library)
        spectra = {"sed_val_bulge": _list_column(light * share), "sed_val_disk": _list_column(light * (1.0 - share))}
        return pa.table({**_shapes(galaxies), **spectra})

    return rows, _fluxes("galaxy_id", catalogue.bands)


def _shapes(galaxies: pa.Table) -> dict[str, Any]:
    """Return the columns of skyCatalogs for galaxies, except for their spectra.

    Notes
    -----
    Sizes are half-light radii. Shears are in GalSim's frame, whose x axis points west. Ellipticities are
    (a - b) / (a + b) along north and north-east, because skyCatalogs rotates them by 90 degrees.
    """
    c: dict[str, Any] = {
        name: galaxies[name].to_numpy() for name in galaxies.column_names if not galaxies[name].null_count
    }
    angle = c["position_angle"].astype(float)
    columns = {
        "galaxy_id": c["id"],
        "ra": c["ra"],
        "dec": c["dec"],
        "redshift": c["z_obs"].astype(np.float64),
        "redshift_hubble": np.maximum(c["z_true"].astype(np.float64), tophat.MIN_REDSHIFT),
        "peculiar_velocity": LIGHT_KM_S * ((1.0 + c["z_obs"].astype(float)) / (1.0 + c["z_true"]) - 1.0),
        "shear_1": c["gamma1"].astype(np.float64),
        "shear_2": -c["gamma2"].astype(np.float64),
        "convergence": c["kappa"].astype(np.float64),
        "position_angle_unlensed": (angle + 90.0) % 180.0,
        "MW_rv": np.full_like(c["a_v"], MILKY_WAY_R_V),
        "MW_av": c["a_v"],
        "sersic_bulge": c["bulge_sersic_index"],
        "sersic_disk": np.ones_like(c["a_v"]),
    }
    for name in ("bulge", "disk"):
        size, ratio = np.maximum(c[f"{name}_half_light_radius"], np.float32(_MIN_SIZE)), c[f"{name}_axis_ratio"]
        ellipticity = (1.0 - ratio.astype(float)) / (1.0 + ratio.astype(float))
        columns[f"size_{name}_true"] = size
        columns[f"size_minor_{name}_true"] = size * ratio
        columns[f"ellipticity_1_{name}_true"] = ellipticity * np.cos(2.0 * np.radians(angle))
        columns[f"ellipticity_2_{name}_true"] = ellipticity * np.sin(2.0 * np.radians(angle))
    return columns


def _star_rows(lake: Path, catalogue: Catalogue) -> tuple[_Maker, _Maker]:
    library = inputs.stellar_library_from_facts(lake, catalogue.fluxes.manifest["facts"])

    def rows(stars: pa.Table) -> pa.Table:
        n, sed = stars.num_rows, stars["sed"].to_numpy()
        return pa.table(
            {
                "object_type": pa.array(["star"] * n),
                "id": stars["id"],
                "ra": stars["ra"],
                "dec": stars["dec"],
                "magnorm": stellar_spectra.magnorm(stars, library),
                "MW_rv": np.full(n, MILKY_WAY_R_V, np.float32),
                "MW_av": stars["a_v"],
                "sed_filepath": pa.array([stellar_spectra.relative_path(k) for k in sed.tolist()]),
            }
        )

    return rows, _fluxes("id", catalogue.bands)


def _fluxes(identifier: str, bands: list[str]) -> _Maker:
    """Return a function that makes the table of fluxes from rows with the columns f_nu_<band>.

    Fluxes are in photons per second and cm2 through the whole system (atmosphere, telescope and camera), and include
    magnification and extinction. `identifier` is the name of the column with the identifiers.
    """
    width = {band: passbands.log_width(passbands.load(band)) for band in bands}

    def rows(sources: pa.Table) -> pa.Table:
        columns = {
            f"lsst_flux_{band[-1]}": electron_rate(sources[f"f_nu_{band}"].to_numpy(), 1.0, width[band])
            for band in bands
        }
        return pa.table({identifier: sources["id"], **{k: v.astype(np.float32) for k, v in columns.items()}})

    return rows


def _list_column(values: Float) -> pa.Array:
    offsets = np.arange(len(values) + 1, dtype=np.int32) * np.int32(values.shape[1])
    return pa.ListArray.from_arrays(offsets, values.astype(np.float32).ravel())


def _document(object_types: dict[str, Any]) -> dict[str, Any]:
    return {
        "catalog_name": "skyCatalog",
        "catalog_dir": ".",
        "skycatalog_root": ".",
        "schema_version": "1.3.0",
        "object_types": object_types,
    }


def _object_type(kind: str, stem: str, cosmology: Cosmology) -> dict[str, Any]:
    common = {
        "file_template": rf"{stem}_(?P<healpix>\d+).parquet",
        "flux_file_template": rf"{stem}_flux_(?P<healpix>\d+).parquet",
        "data_file_type": "parquet",
        "area_partition": {"type": "healpix", "ordering": "ring", "nside": 1 << ORDER},
        "MW_extinction": "F19",
        "provenance": {"versioning": {"schema_version": "1.3.0", "code_version": f"truesky {__version__}"}},
    }
    if kind == "star":
        spectra = {"sed_model": "file_nm", "file_nm": {"units": "nm"}, "sed_file_root_env_var": "SIMS_SED_LIBRARY_DIR"}
        return {**common, **spectra, "internal_extinction": "None"}
    edges = tophat.edges()
    bins = np.stack([edges[:-1], np.diff(edges)], axis=1).tolist()
    return {
        **common,
        "composite": {"bulge": "required", "disk": "required"},
        "Cosmology": {
            "H0": 100.0 * cosmology.h,
            "Om0": cosmology.omega_m,
            "Ob0": cosmology.omega_b,
            "sigma8": cosmology.sigma_8,
            "n_s": cosmology.n_s,
        },
        "tophat": {"units": "angstrom", "bin_parameters": ["start", "width"], "bins": bins},
    }


def _parquet(path: Path, rows: pa.Table, maker: _Maker) -> Path:
    """Write the rows that `maker` makes to a Parquet file, one row group at a time.

    Files with the same number of rows have the same row groups, which skyCatalogs requires of each file of sources and
    its file of fluxes.
    """

    def fill(temporary: Path) -> None:
        first = maker(rows.slice(0, _ROW_GROUP_SIZE))
        with pq.ParquetWriter(temporary, first.schema, compression="zstd") as out:
            out.write_table(first, row_group_size=_ROW_GROUP_SIZE)
            for start in range(_ROW_GROUP_SIZE, rows.num_rows, _ROW_GROUP_SIZE):
                out.write_table(maker(rows.slice(start, _ROW_GROUP_SIZE)), row_group_size=_ROW_GROUP_SIZE)

    return _write_staged(path, fill)


def _write_staged(path: Path, fill: Callable[[Path], Any]) -> Path:
    with user_files.replace_atomically(path) as temporary:
        fill(temporary)
    return path
