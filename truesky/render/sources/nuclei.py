"""Read active nuclei and lensed quasars, which are drawn as stars, and quasars of the catalogue that vary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema import units
from lake_schema.arrays import Array, Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from truesky.fluxes.passbands import Passband
from truesky.fluxes.sources import table_magnification
from truesky.render.sources import catalogue_rows, point_light, selection
from truesky.render.sources.point_light import OwnSpectra, PointLight
from truesky.render.sources.transients import LENSED_IMAGES
from truesky.variability import active_nuclei

# Name of the table of nuclei, which a lake may lack.
ACTIVE_NUCLEI = "active_nuclei"
COLUMNS = tuple(dict.fromkeys((*active_nuclei.FLUX_COLUMNS, "point_id", "kind", "ra", "dec")))
# Columns of the table `galaxies` of a quasar without a row in the table of nuclei.
QUASAR_COLUMNS = ("id", "z_obs", "mag_r01", "sed_1", "a_v")
# Columns of the table `lensed_images` of a lensed quasar.
IMAGE_COLUMNS = ("id", "ra", "dec", "type", "source_id", "magnification", "delay")
QUASAR_KIND, _TYPE_1 = 2, 1
# Faintest AB magnitude at 1450 A in the rest frame of nuclei that are drawn, and largest difference between this
# magnitude and that in a band: nearby nuclei are 5.2 mag brighter at 24000 A.
_FAINTEST, _LARGEST_EXCESS = 37.0, 5.3


@dataclass(frozen=True, slots=True, eq=False)
class Nuclei:
    """Active nuclei and quasars around a detector.

    Attributes
    ----------
    points : Table
        Point sources that are not in the table `galaxies`: nuclei of type 1 in galaxies, and lensed images of quasars.
        Columns `active_nuclei.FLUX_COLUMNS`, ra, dec, `magnification` (a factor of the flux), `delay` (days) and
        `point_light.MIN_F_NU`.
    quasars : Table
        Quasars of the table `galaxies` that vary; columns `active_nuclei.FACTOR_COLUMNS` and id.
    """

    points: pa.Table
    quasars: pa.Table

    def without(self, left_out: pa.Array) -> Nuclei:
        """Return the sources without the point sources with the identifiers `left_out`."""
        return Nuclei(self.points.filter(pc.invert(pc.is_in(self.points["id"], left_out))), self.quasars)


def read_nuclei(
    versions: Mapping[str, read.Version], task: Mapping[str, Any], reach_arcsec: float, min_f_nu: tuple[float, float]
) -> Nuclei | None:
    """Read the active nuclei around a detector, and the lensed images of quasars.

    Parameters
    ----------
    versions : mapping of str to Version
        Stored versions of the tables of the lake, by name. `active_nuclei` and `lensed_images` may be missing.
    task : mapping
        Row of the table `tasks`: the detector, with the `ra`, `dec` and `radius` (deg) of a circle around it.
    reach_arcsec : float
        Distance beyond the circle, in arcsec, up to which sources are read.
    min_f_nu : (float, float)
        Fluxes inside and outside the circle below which point sources are left out, microjansky; infinite if no source
        is visible.

    Returns
    -------
    Nuclei or None
        The sources; None if the lake has neither table.
    """
    if ACTIVE_NUCLEI not in versions and LENSED_IMAGES not in versions:
        return None
    deflection = catalogue_rows.max_deflection(versions["galaxies"])
    cells = selection.cells_within_reach(task, deflection, reach_arcsec) if np.isfinite(min_f_nu).any() else []

    def read_nearby(table: str, columns: Sequence[str]) -> pa.Table:
        return point_light.select_nearby(
            versions[table].rows_in_cells(cells, GENERATION_ORDER, columns), task, reach_arcsec
        )

    parts, quasars = [], None
    if ACTIVE_NUCLEI in versions:
        rows = read_nearby(ACTIVE_NUCLEI, COLUMNS)
        parts.append(nuclei_in_galaxies(rows))
        quasars = rows.filter(pc.equal(rows["kind"], QUASAR_KIND))
    if LENSED_IMAGES in versions:
        images = read_nearby(LENSED_IMAGES, IMAGE_COLUMNS)
        images = images.filter(pc.is_null(images["type"]))
        parts.append(lensed_quasars(images, *_sources_of(images, versions)))
    points = pa.concat_tables(parts)
    quasars = points.slice(0, 0) if quasars is None else quasars
    return Nuclei(
        point_light.add_flux_limits(points, task, min_f_nu), quasars.select([*active_nuclei.FACTOR_COLUMNS, "id"])
    )


def _sources_of(images: pa.Table, versions: Mapping[str, read.Version]) -> tuple[pa.Table, pa.Table | None]:
    """Return the rows of the tables `galaxies` and `active_nuclei` (None without it) of lensed quasars."""
    sources = pc.unique(images["source_id"])
    cells = selection.cells_of_ids(sources.to_numpy(), is_moved=True)
    tables: list[pa.Table] = []
    for name, columns in (("galaxies", (*QUASAR_COLUMNS, "kind")), (ACTIVE_NUCLEI, COLUMNS)):
        if name not in versions:
            return tables[0], None
        rows = versions[name].rows_in_cells(cells, GENERATION_ORDER, columns)
        tables.append(rows.filter(pc.is_in(rows["id"], sources)))
    return tables[0], tables[1]


def nuclei_in_galaxies(rows: pa.Table) -> pa.Table:
    """Return the nuclei that are drawn in addition to galaxies, from rows of the table `active_nuclei`."""
    shines = pc.and_(pc.equal(rows["type"], _TYPE_1), pc.less(rows["mag_1450"], _FAINTEST))
    return as_points(rows.filter(pc.and_(shines, pc.not_equal(rows["kind"], QUASAR_KIND))))


def as_points(rows: pa.Table) -> pa.Table:
    """Return rows of the table `active_nuclei` as rows of `Nuclei.points`."""
    ones = np.ones(len(rows))
    return _points(rows, rows["point_id"], rows, ones, 0.0 * ones)


def lensed_quasars(images: pa.Table, galaxies: pa.Table, nuclei: pa.Table | None) -> pa.Table:
    """Return the images of lensed quasars as rows of `Nuclei.points`.

    Parameters
    ----------
    images : Table
        Rows of the table `lensed_images` with the columns IMAGE_COLUMNS.
    galaxies : Table
        Rows of the table `galaxies` with the columns QUASAR_COLUMNS and kind. Images of other quasars are left out.
    nuclei : Table, optional
        Rows of the table `active_nuclei` with the light curves of the quasars; None if they are constant.

    Returns
    -------
    Table
        The images.
    """
    quasars = galaxies.filter(pc.equal(galaxies["kind"], QUASAR_KIND))
    images = images.filter(pc.is_in(images["source_id"], quasars["id"]))
    sources = quasars.take(pc.index_in(images["source_id"], quasars["id"].combine_chunks()))
    n = len(images)
    columns: dict[str, Any] = {"id": sources["id"], "z_obs": sources["z_obs"], "a_v": sources["a_v"]}
    columns |= {"mag_1450": sources["mag_r01"], "template": sources["sed_1"], "type": np.full(n, _TYPE_1, np.int8)}
    # Without a light curve, the source is as luminous as it needs to be; type 1 makes its continuum visible.
    columns |= {"m_1450": np.full(n, np.nan), "log_black_hole_mass": np.full(n, np.nan)}
    columns |= {"light_curve_key": np.zeros(n, np.int64)}
    if nuclei is not None and len(nuclei):
        row = pc.index_in(images["source_id"], nuclei["id"].combine_chunks())
        has_row = nuclei.take(row)
        for name in ("m_1450", "log_black_hole_mass"):
            columns[name] = has_row[name]
        # A column with null would become decimal numbers, which have too few digits for keys.
        columns["light_curve_key"] = pc.fill_null(has_row["light_curve_key"], 0)
    # The magnification by the strong lens replaces weak lensing.
    columns |= {name: np.zeros(n) for name in ("kappa", "gamma1", "gamma2")}
    place = pa.table({"ra": images["ra"], "dec": images["dec"]})
    return _points(pa.table(columns), images["id"], place, images["magnification"], images["delay"])


def _points(rows: pa.Table, ids: Any, place: pa.Table, magnification: Any, delay: Any) -> pa.Table:
    """Return a table of point sources with the light of `rows`, identifiers `ids` and the positions `place`."""
    columns = {name: rows[name] for name in active_nuclei.FLUX_COLUMNS if name != "id"}
    columns |= {"id": ids, "ra": place["ra"], "dec": place["dec"], "magnification": magnification, "delay": delay}
    table = pa.table(columns)
    fields = [(name, pa.int64() if name in ("id", "light_curve_key") else pa.float64()) for name in table.column_names]
    return table.cast(pa.schema(fields))


def light_at(nuclei: Nuclei, band: Passband, mjd: float) -> PointLight:
    """Return the light of active nuclei and lensed quasars at a date.

    Parameters
    ----------
    nuclei : Nuclei
        The point sources.
    band : Passband
        Passband of the exposure.
    mjd : float
        The date, MJD.

    Returns
    -------
    PointLight
        Their light, without sources that do not shine or are too faint.
    """
    points, dates = nuclei.points, np.full((len(nuclei.points), 1), mjd)
    columns = _arrays(points)
    largest = units.f_nu_of_mag(columns["mag_1450"] - _LARGEST_EXCESS) * table_magnification(points)
    largest *= _flux_factors(columns, band, dates)[:, 0] * columns["magnification"]
    candidates = pa.array(np.flatnonzero(largest >= columns[point_light.MIN_F_NU]))
    points = points.take(candidates)
    f_nu = point_fluxes(points, band, dates[: len(points)])[:, 0]
    shining = (f_nu > 0.0) & (f_nu >= points[point_light.MIN_F_NU].to_numpy())
    columns = _arrays(points.filter(pa.array(shining)))

    def spectra_of(indices: Int) -> Float:
        chosen = {name: values[indices] for name, values in columns.items()}
        return active_nuclei.mean_spectra(chosen, int(band.wavelength[0]), int(band.wavelength[-1]))

    ids, ra, dec = (columns[name] for name in ("id", "ra", "dec"))
    return PointLight(ids, ra, dec, f_nu[shining], OwnSpectra(len(ids), spectra_of))


def point_fluxes(points: pa.Table, band: Passband, mjd: Float) -> Float:
    """Return the fluxes of point sources at dates.

    Parameters
    ----------
    points : Table
        n rows of `Nuclei.points`.
    band : Passband
        The passband.
    mjd : float array, shape (n, m)
        Dates of each source, MJD.

    Returns
    -------
    float array, shape (n, m)
        f_nu in microjansky.
    """
    return mean_fluxes(points, band)[:, None] * _flux_factors(_arrays(points), band, mjd)


def _flux_factors(columns: Mapping[str, Array], band: Passband, mjd: Float) -> Float:
    """Return the fluxes of point sources at dates, shape (n, m), relative to their mean fluxes."""
    # Lensed quasars of a lake without the table of nuclei are constant.
    varies = np.flatnonzero(np.isfinite(columns["m_1450"]))
    factors = np.ones(mjd.shape)
    chosen = {name: values[varies] for name, values in columns.items()}
    factors[varies] = active_nuclei.flux_factors(chosen, band, mjd[varies] - chosen["delay"][:, None])
    return factors


def mean_fluxes(points: pa.Table, band: Passband) -> Float:
    """Return the mean fluxes over time of n rows of `Nuclei.points`, f_nu in microjansky, shape (n,)."""
    columns = _arrays(points)
    return np.asarray(active_nuclei.mean_fluxes(columns, (band,))[:, 0] * columns["magnification"])


def _arrays(points: pa.Table) -> dict[str, Array]:
    return {name: points[name].to_numpy(zero_copy_only=False) for name in points.column_names}


def quasar_fluxes(fluxes: pa.Table, quasars: pa.Table, bands: Mapping[str, Passband], mjd: float) -> pa.Table:
    """Return the fluxes of galaxies; quasars have the flux of a date.

    Parameters
    ----------
    fluxes : Table
        Fluxes of rows of the table `galaxies`.
    quasars : Table
        Rows of `Nuclei.quasars`, also of quasars that are not in `fluxes`.
    bands : mapping of str to Passband
        Passbands of the columns f_nu_<band> that are scaled, by name.
    mjd : float
        The date, MJD.

    Returns
    -------
    Table
        The fluxes.
    """
    row = pc.index_in(fluxes["id"], quasars["id"].combine_chunks()).to_numpy(zero_copy_only=False)
    has_row = np.isfinite(row)
    if not has_row.any():
        return fluxes
    chosen = quasars.take(pa.array(row[has_row].astype(np.int64)))
    columns = {name: chosen[name].to_numpy() for name in active_nuclei.FACTOR_COLUMNS}
    for name, band in bands.items():
        at = fluxes.schema.get_field_index(f"f_nu_{name}")
        field = fluxes.schema.field(at)
        values = fluxes[at].to_numpy().copy()
        values[has_row] = values[has_row] * active_nuclei.flux_factors(columns, band, mjd)
        fluxes = fluxes.set_column(at, field, pa.array(values, field.type))
    return fluxes
