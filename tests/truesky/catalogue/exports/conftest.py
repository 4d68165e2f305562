"""A small lake of galaxies of every kind and of stars, with their fluxes in LSST's bands."""

from dataclasses import replace

import numpy as np
import pytest

from lake_schema import ids, sky, units
from lake_schema.store import layout, publish, read
from lake_schema.store.plan import Output, Plan, Task
from lake_schema.tables.fluxes import fluxes
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.stars import STARS
from lake_schema.units import LIGHT_ANGSTROM_S
from truesky.fluxes import band_fluxes, passbands
from truesky.fluxes.libraries import templates

CELL = 8989
BANDS = [f"lsst_{band}" for band in "ugrizy"]
# So many galaxies, the last ones, are seen across the border of the cell in which they are.
STRAYS = 3
# Rows of three galaxies of given shapes, from and to.
DRAWN = 12, 15


def bands():
    """Return the LSST passbands without responses below a thousandth of the peak, which skyCatalogs also leaves out."""
    found = []
    for name in BANDS:
        band = passbands.load(name)
        inside = np.flatnonzero(band.response >= 1e-3 * band.response.max())
        kept = slice(inside[0], inside[-1] + 1)
        found.append(replace(band, wavelength=band.wavelength[kept], response=band.response[kept]))
    return found


def galaxies(n=40, seed=4):
    """Return rows by file: galaxies of four kinds, with lines of up to 100 A of continuum, sheared and behind dust."""
    rng = np.random.default_rng(seed)
    _, ra, dec = sky.random_in_cell(5, CELL, n, rng)
    kind = rng.choice([0, 1, 2, 3], n, p=[0.5, 0.4, 0.05, 0.05])
    kind[:4], kind[slice(*DRAWN)] = range(4), 0
    far, mag = kind >= 2, rng.uniform(17.0, 26.0, n)
    continuum = units.cgs_of_ujy(units.f_nu_of_mag(mag)) * LIGHT_ANGSTROM_S / 7000.0**2
    z = np.where(far, rng.uniform(6.0, 6.5, n), rng.uniform(0.02, 2.3, n))
    values = {c.name: np.full(n, max(c.lo or 0.0, 0.0)) for c in GALAXIES.columns if c.type.startswith("float")}
    values |= {
        "id": np.array([ids.source_id(int(k), CELL << 6, i) for i, k in enumerate(kind)]).ravel(),
        "halo_id": np.arange(n),
        "ra": ra,
        "dec": dec,
        "ra_true": ra.copy(),
        "dec_true": dec.copy(),
        "kind": kind,
        "density_boost": np.ones(n),
        "z_true": z,
        "z_obs": z + 1e-3 * (1 + z) * rng.normal(size=n),
        "mag_r01": mag,
        "abs_mag_r01": rng.uniform(-23.0, -16.0, n),
        "frac_1": np.where(far, 1.0, rng.uniform(0.0, 1.0, n)),
        "bulge_half_light_radius": rng.uniform(0.05, 0.5, n),
        "disk_half_light_radius": rng.uniform(0.3, 1.5, n),
        "bulge_fraction": rng.uniform(0.0, 1.0, n),
        "bulge_color": np.full(n, 0.25),
        "bulge_sersic_index": rng.uniform(0.5, 6.0, n),
        "bulge_axis_ratio": rng.uniform(0.4, 1.0, n),
        "disk_axis_ratio": rng.uniform(0.2, 1.0, n),
        "position_angle": rng.uniform(0.0, 180.0, n),
        "kappa": rng.normal(0.0, 0.03, n),
        "gamma1": rng.normal(0.0, 0.03, n),
        "gamma2": rng.normal(0.0, 0.03, n),
        "a_v": rng.uniform(0.0, 0.5, n),
    }
    values["frac_2"] = 1.0 - values["frac_1"]
    for k in (1, 2):
        values[f"sed_{k}"] = np.where(far, rng.integers(0, 9, n), rng.integers(0, 31, n))
        values[f"ext_law_{k}"] = np.where(far, 0, rng.integers(0, 5, n))
        values[f"ebv_{k}"] = np.where(far, 0.0, rng.uniform(0.0, 0.5, n))
    for name in ("halpha", "hbeta", "oii", "oiii", "nii", "sii"):
        values[f"flux_{name}"] = continuum * rng.choice([0.0, 5.0, 30.0, 100.0], n)
    # Some without a bulge at all, and with the sizes of nothing.
    values["bulge_fraction"][5:8] = values["bulge_half_light_radius"][5:8] = 0.0
    values["ra"][-STRAYS:], values["dec"][-STRAYS:] = sky.cell_centre(5, CELL + 1)
    values["_healpix_29"] = sky.healpix_29(values["ra"], values["dec"])
    _to_be_drawn(values, slice(*DRAWN))
    rows = GALAXIES.build(values)
    return {
        layout.cell_file(5, CELL): rows.slice(0, n - STRAYS),
        layout.cell_file(5, CELL + 1): rows.slice(n - STRAYS),
    }


def _to_be_drawn(values, rows):
    """Return one long galaxy without lensing and two round, sheared ones; their profiles are short."""
    values["bulge_fraction"][rows], values["bulge_sersic_index"][rows] = 0.3, 1.0
    values["bulge_half_light_radius"][rows], values["disk_half_light_radius"][rows] = 0.3, 0.5
    values["bulge_color"][rows] = 0.0
    values["bulge_axis_ratio"][rows] = values["disk_axis_ratio"][rows] = [0.4, 1.0, 1.0]
    values["position_angle"][rows] = 25.0
    values["kappa"][rows], values["gamma1"][rows], values["gamma2"][rows] = 0.0, [0.0, 0.1, 0.0], [0.0, 0.0, 0.1]


def stars(n=30, seed=5):
    """Return stars of one cell with any template, behind up to 0.3 mag of dust."""
    rng = np.random.default_rng(seed)
    index, ra, dec = sky.random_in_cell(5, CELL, n, rng)
    order = np.argsort(index)
    return STARS.build(
        {
            "id": ids.source_id(5, CELL << 6, np.arange(n)),
            "ra": ra[order],
            "dec": dec[order],
            "_healpix_29": index[order],
            "component": np.zeros(n, int),
            "sed": rng.integers(0, 444, n),
            "mag_h": rng.uniform(10.0, 24.0, n),
            "a_v": rng.uniform(0.0, 0.3, n),
            "density_boost": np.ones(n),
        }
    )


def published(lake, table, parts, facts):
    """Publish rows by file and return the key of the version."""
    plan = Plan(table, facts, tuple(Task(name, {"name": name}) for name in parts))
    publish.make_version(lake, plan, lambda root, facts: Output(parts[facts["name"]]))
    return plan.key


@pytest.fixture(scope="module")
def lake(tmp_path_factory):
    root = tmp_path_factory.mktemp("lake")
    rows, points = galaxies(), stars()
    light = {name: band_fluxes.galaxy_fluxes(some, bands(), templates.galaxy_library()) for name, some in rows.items()}
    published(root, fluxes("galaxy", BANDS), light, {"input": published(root, GALAXIES, rows, {})})
    light, name = band_fluxes.star_fluxes(points, bands(), templates.stellar_library()), layout.cell_file(3, CELL >> 4)
    published(root, fluxes("star", BANDS), {name: light}, {"input": published(root, STARS, {name: points}, {})})
    assert read.version(root, "star_fluxes").num_rows == points.num_rows
    return root
