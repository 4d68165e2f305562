"""Declaration of the tables `galaxy_fluxes` and `star_fluxes`: fluxes of all galaxies and stars in each passband.

Their rows are in the same order as the rows of the tables `galaxies` and `stars`.
"""

from __future__ import annotations

from collections.abc import Sequence

from lake_schema.columns import Column, Table
from lake_schema.tables.common import DEC, HEALPIX_29, ID, OBSERVED_DEC, OBSERVED_RA, RA
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.stars import STARS

_CONTENT = {
    "galaxy": "with internal dust, emission lines, magnification and the Milky Way's dust",
    "star": "with the dust on the way to it",
}


INTEGRATED = Column(
    "integrated",
    "bool",
    ucd="meta.code.qual",
    doc="true where no table was used in any band: the source lies outside what the tables cover (facts.covered of the "
    "manifest), is a QSO or a high-redshift galaxy, or the accuracy asked for is finer than any table's",
)


def fluxes(kind: str, bands: Sequence[str]) -> Table:
    """Return the declaration of the table of fluxes of galaxies or stars, with a column f_nu_<band> (uJy) per passband.

    `kind` is "galaxy" or "star"; KeyError is raised for another text if `bands` is not empty.
    """
    columns = [
        Column(
            f"f_nu_{band}",
            "float32",
            "uJy",
            "phot.flux.density",
            f"band-averaged f_nu in {band}, {_CONTENT[kind]}",
            0.0,
            1e15,
        )
        for band in bands
    ]
    catalogue = GALAXIES if kind == "galaxy" else STARS
    place = (OBSERVED_RA, OBSERVED_DEC) if kind == "galaxy" else (RA, DEC)
    return Table(
        f"{kind}_fluxes",
        1,
        (ID, *place, HEALPIX_29, *columns, INTEGRATED),
        f"Band fluxes of the table {catalogue.name}, in the same cells and row order.",
        order=catalogue.order,
        max_order=catalogue.max_order,
    )
