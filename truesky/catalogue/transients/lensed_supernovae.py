"""Draw the supernovae in galaxies behind strong lenses, and their images."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa

from lake_schema.arrays import Float
from truesky.catalogue.transients import supernovae
from truesky.catalogue.transients.supernovae import Window
from truesky.cosmology import Cosmology
from truesky.variability import lensed_rows, supernova_light
from truesky.variability.supernova_light import Supernovae

# Longest delay of an image, days, for which images of supernovae before the window are drawn. The longest delay of 1200
# random systems is 960 days (assumed as a limit).
LONGEST_DELAY = 3000.0
_LIGHT = ("z_obs", "peak_mjd", "mag_b", "stretch", "ebv", "magnification", "a_v")


def draw(cell: int, galaxies: pa.Table, lenses: pa.Table, seed: int, window: Window, cosmology: Cosmology) -> pa.Table:
    """Draw the images of lensed supernovae in one order-8 cell.

    Parameters
    ----------
    cell : int
        Nested index of the order-8 cell.
    galaxies : Table
        Rows of table `galaxies` in the cell, with the columns `supernovae.COLUMNS`.
    lenses : Table
        Rows of table `strong_lenses` in the cell, with the columns `lensed_rows.LENS_COLUMNS`.
    seed : int
        Seed of the request.
    window : Window
        Window of time, kinds and boost.
    cosmology : Cosmology
        Parameters of the universe.

    Returns
    -------
    Table
        Rows of table `lensed_images`, sorted by position: all images that shine in the window.

    Notes
    -----
    The supernovae are rows of the table `transients`, and earlier ones of which an image arrives in the window.
    """
    hosts = galaxies.filter(pa.array(np.isin(galaxies["id"].to_numpy(), lenses["source_id"].to_numpy())))
    earlier = replace(window, start=window.start - LONGEST_DELAY)
    sources = lensed_rows.transients(supernovae.draw(cell, hosts, seed, earlier, cosmology))
    columns = {name: lenses[name].to_numpy() for name in lensed_rows.LENS_COLUMNS}
    images = lensed_rows.image_rows(columns, sources, cosmology)
    first, last = supernova_light.first_and_last_day(light(images), window.templates)
    return images.filter(pa.array((last >= window.start) & (first <= window.end)))


def light(images: pa.Table) -> Supernovae:
    """Return the properties of images of supernovae on which their light depends.

    `images` are rows of table `lensed_images` whose source is a supernova.
    """

    def numbers(name: str) -> Float:
        return np.asarray(images[name].to_numpy(), float)

    return Supernovae(images["type"].to_numpy(), *(numbers(name) for name in _LIGHT))
