"""Check the tables of supernovae and active nuclei: identifiers, hosts, and the rate of type Ia supernovae."""

from __future__ import annotations

import numpy as np

from lake_schema import sky
from lake_schema.arrays import Int
from lake_schema.ids import GENERATION_ORDER
from lake_schema.store import read
from truesky.cosmology import Cosmology, from_facts
from truesky.validation.lake.measure.rows import Place, Row, not_applicable

# Name of this check in the table `validation` (measured values with expected values and verdicts).
NAME = "changing_sources"
# Sources of the expected values.
HOSTS_SOURCE = "a supernova or nucleus has a row in table galaxies, and an identifier of its own"
RATE_SOURCE = "Frohmaier et al. 2019, MNRAS 486, 2308, with the growth of Perrett et al. 2012, AJ 144, 59"
# Type Ia supernovae per year and Mpc^3 at z = 0.073 for h = 0.7, and their growth as a power of 1 + z.
_RATE, _RATE_Z, _RATE_H, _GROWTH = 2.43e-5, 0.073, 0.7, 2.11
# Allowed deviation: the rate has errors of 12 % (statistics) and 14 % (systematics), and the growth to z = 0.3 of 5 %.
_TOLERANCE = 0.35
# Largest redshift at which nearly all hosts are brighter than a limit in I_E, and this limit (AB mag).
_Z_MAX, _LIMIT = 0.3, 23.5
# Relative scatter of the mass of all galaxies to z = 0.3 in 1 deg2; it falls as the root of the area (assumed).
_SCATTER = 0.4
# Smallest number of expected supernovae for a verdict; the errors of smaller ones are far from Gaussian.
_FEWEST = 10.0
# Facts of galaxies whose haloes or masses are the user's, so that no rate per volume is expected.
_GIVEN = ("ingest", "halos", "training")
_TYPE_IA = 1


def supernova_rows(transients: read.Version, galaxies: read.Version) -> list[Row]:
    """Check the table `transients` of a lake.

    Parameters
    ----------
    transients, galaxies : Version
        Tables of the lake.

    Returns
    -------
    list of Row
        Repeated identifiers, supernovae whose host is missing, and the number of type Ia supernovae at z < 0.3 over
        the number that the observed rate per volume gives.
    """
    if transients.manifest["facts"].get("galaxies") != galaxies.key:
        return [_other_galaxies(transients)]
    table = transients.rows(["id", "host_id", "type", "z_true", "peak_mjd"])
    ids, hosts, types, z, peak = (table[name].to_numpy() for name in table.column_names)
    galaxy_ids = galaxies.rows(["id"])["id"].to_numpy()
    return [*_identity_rows("supernovae", ids, hosts, galaxy_ids), _rate_row(transients, galaxies, (types, z, peak))]


def nucleus_rows(nuclei: read.Version, galaxies: read.Version) -> list[Row]:
    """Check the table `active_nuclei` of a lake: repeated identifiers, and nuclei that are not in table `galaxies`."""
    if nuclei.manifest["facts"].get("galaxies") != galaxies.key:
        return [_other_galaxies(nuclei)]
    ids = nuclei.rows(["id"])["id"].to_numpy()
    return _identity_rows("nuclei", ids, ids, galaxies.rows(["id"])["id"].to_numpy())


def _other_galaxies(version: read.Version) -> Row:
    why = f"table {version.table} was drawn in galaxies of another request"
    return not_applicable(NAME, Place(), why, HOSTS_SOURCE, version.table)


def _identity_rows(name: str, ids: Int, hosts: Int, galaxy_ids: Int) -> list[Row]:
    repeated, missing = len(ids) - len(np.unique(ids)), int((~np.isin(hosts, galaxy_ids)).sum())
    return [
        Row(NAME, f"{name}_{what}", Place(), float(count), 0.0, 0.0, 0.0, "", HOSTS_SOURCE, note=f"{len(ids)} rows")
        for what, count in (("ids", repeated), ("without_host", missing))
    ]


def _rate_row(transients: read.Version, galaxies: read.Version, columns: tuple[Int, Int, Int]) -> Row:
    facts, galaxy_facts = transients.manifest["facts"], galaxies.manifest["facts"]
    quantity = "type_ia_rate"
    if "ia" not in facts["kinds"]:
        return not_applicable(NAME, Place(), "type Ia supernovae were not drawn", RATE_SOURCE, quantity)
    if given := [name for name in _GIVEN if name in galaxy_facts]:
        return not_applicable(NAME, Place(), f"galaxies depend on your {given[0]}", RATE_SOURCE, quantity)
    band, limit = galaxy_facts.get("galaxy_band", "euclid_vis"), galaxy_facts.get("galaxy_limit", -np.inf)
    if band != "euclid_vis" or limit < _LIMIT:
        why = f"hosts end at {limit:g} in {band}; the rate needs galaxies to {_LIMIT:g} in euclid_vis"
        return not_applicable(NAME, Place(), why, RATE_SOURCE, quantity)
    types, z, peak = columns
    z_max = min(_Z_MAX, galaxy_facts.get("z_max", _Z_MAX))
    counted = (types == _TYPE_IA) & (z < z_max) & (peak >= facts["start"]) & (peak < facts["end"])
    cells = {cell for part in transients.manifest["parts"] for cell in part["facts"]["generation_cells"]}
    area, years = len(cells) * sky.cell_area(GENERATION_ORDER), (facts["end"] - facts["start"]) / 365.25
    expected = _expected_per_deg2(from_facts(galaxy_facts), z_max) * area * years * facts["boost"]
    number = int(counted.sum())
    note = f"{number} at z < {z_max:g} in {area:.3g} deg2 and {years:.3g} years; {expected:.3g} are expected"
    if expected < _FEWEST:
        return not_applicable(NAME, Place(), f"{note}, and {_FEWEST:g} are needed", RATE_SOURCE, quantity)
    error = np.hypot(np.sqrt(max(number, expected)) / expected, _SCATTER / np.sqrt(area))
    return Row(
        NAME, quantity, Place(), number / expected, float(error), 1.0, _TOLERANCE, "", RATE_SOURCE, note=note
    )  # fmt: skip


def _expected_per_deg2(cosmology: Cosmology, z_max: float) -> float:
    """Return the observed number of type Ia supernovae per deg2 and year up to a redshift."""
    edges = np.linspace(0.0, z_max, 31)
    middle = 0.5 * (edges[:-1] + edges[1:])
    # Volumes in (Mpc/h)^3. An observer sees time pass 1 + z times more slowly.
    volume = np.diff(cosmology.comoving_volume(np.zeros(31), edges)) / _RATE_H**3
    rate = _RATE * ((1.0 + middle) / (1.0 + _RATE_Z)) ** _GROWTH / (1.0 + middle)
    return float(np.sum(volume * rate) * np.radians(1.0) ** 2)
