"""Draw supernovae as stars: with the flux and the spectrum that they have in the middle of an exposure."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from lake_schema.arrays import Float, Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from truesky.fluxes.passbands import Passband
from truesky.render.sources import point_light, selection
from truesky.render.sources.point_light import OwnSpectra, PointLight
from truesky.variability import spectral_series, supernova_light
from truesky.variability.supernova_light import Supernovae
from truesky.variability.supernova_templates import Template

# Names of the tables of supernovae and of their images behind strong lenses, which a lake may lack.
TRANSIENTS, LENSED_IMAGES = "transients", "lensed_images"
CHANGING_TABLES = TRANSIENTS, LENSED_IMAGES, "active_nuclei"
# Columns of the table on which the light depends.
COLUMNS = (
    "id", "ra", "dec", "type", "z_obs", "peak_mjd", "mag_b", "stretch", "ebv", "magnification", "a_v",
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Transients:
    """Supernovae around a detector.

    Attributes
    ----------
    rows : Table
        Rows of the table `transients`, with the columns COLUMNS and `point_light.MIN_F_NU`.
    templates : mapping of int to Template
        Spectra by kind.
    """

    rows: pa.Table
    templates: Mapping[int, Template]


def read_transients(
    versions: Mapping[str, read.Version], task: Mapping[str, Any], reach_arcsec: float, min_f_nu: tuple[float, float]
) -> Transients | None:
    """Read the supernovae around a detector, and the images of those behind strong lenses.

    Parameters
    ----------
    versions : mapping of str to Version
        Stored versions of the tables of the lake, by name. `lensed_images` may be missing.
    task : mapping
        Row of the table `tasks`: the detector, with the `ra`, `dec` and `radius` (deg) of a circle around it.
    reach_arcsec : float
        Distance beyond the circle, in arcsec, up to which supernovae are read.
    min_f_nu : (float, float)
        Fluxes inside and outside the circle below which supernovae are left out, microjansky; infinite if no source is
        visible.

    Returns
    -------
    Transients or None
        The supernovae, whether or not they shine at the date of the exposure. Images by a strong lens replace the
        supernova. None if there is no table `transients`.

    Raises
    ------
    BadInput
        If the user's file of spectra has changed since the table was made.
    """
    if TRANSIENTS not in versions:
        return None
    table = versions[TRANSIENTS]
    cells = selection.cells_within_reach(task, 0.0, reach_arcsec) if np.isfinite(min_f_nu).any() else []
    rows = table.rows_in_cells(cells, GENERATION_ORDER, COLUMNS)
    if LENSED_IMAGES in versions:
        images = versions[LENSED_IMAGES].rows_in_cells(cells, GENERATION_ORDER, [*COLUMNS, "source_id"])
        images = images.filter(pc.is_valid(images["type"]))
        rows = rows.filter(pc.invert(pc.is_in(rows["id"], pc.unique(images["source_id"]))))
        rows = pa.concat_tables([rows, images.select(COLUMNS).cast(rows.schema)])
    rows = point_light.add_flux_limits(point_light.select_nearby(rows, task, reach_arcsec), task, min_f_nu)
    return Transients(rows, spectral_series.templates_from_facts(table.manifest["facts"]))


def supernovae(rows: pa.Table) -> Supernovae:
    """Return the properties of supernovae on which their light depends, from rows of the table `transients`."""
    names = ("z_obs", "peak_mjd", "mag_b", "stretch", "ebv", "magnification", "a_v")
    return Supernovae(rows["type"].to_numpy(), *(np.asarray(rows[name].to_numpy(), float) for name in names))


def light_at(transients: Transients, band: Passband, mjd: float) -> PointLight:
    """Return the light of supernovae at a date.

    Parameters
    ----------
    transients : Transients
        The supernovae.
    band : Passband
        Passband of the exposure.
    mjd : float
        The date, MJD.

    Returns
    -------
    PointLight
        Their light, without sources that do not shine or are too faint.
    """
    light, min_f_nu = supernovae(transients.rows), transients.rows[point_light.MIN_F_NU].to_numpy()
    largest = supernova_light.upper_limits(light, band, mjd, transients.templates)
    candidates = np.flatnonzero((largest > 0.0) & (largest >= min_f_nu))
    light = light.select(candidates)
    f_nu = supernova_light.fluxes(light, band, np.array([[mjd]]), transients.templates)[:, 0]
    shining = np.flatnonzero((f_nu > 0.0) & (f_nu >= min_f_nu[candidates]))
    rows = transients.rows.take(pa.array(candidates[shining]))
    light = light.select(shining)

    def spectra_of(indices: Int) -> Float:
        return supernova_light.spectra(light.select(indices), band.wavelength, mjd, transients.templates)

    ids, ra, dec = (rows[name].to_numpy() for name in ("id", "ra", "dec"))
    return PointLight(ids, ra, dec, f_nu[shining], OwnSpectra(len(ids), spectra_of))


def without(transients: Transients, left_out: pa.Array) -> Transients:
    """Return the supernovae without those with the identifiers `left_out`."""
    rows = transients.rows
    return Transients(rows.filter(pc.invert(pc.is_in(rows["id"], left_out))), transients.templates)
