"""Another cosmology has other matter, halos and galaxies, also if the first one is in the disc cache."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lake_schema import ids, tables
from lake_schema.errors import BadInput
from lake_schema.store.provenance import file_sha256
from lake_schema.store.validate import check_rows
from tests.truesky.catalogue import neutrinos
from truesky.catalogue import build_galaxies, request_checks
from truesky.catalogue.external import ingest, mapping
from truesky.catalogue.galaxies import lensing
from truesky.catalogue.halos import halo_catalogue, halos
from truesky.catalogue.matter import convergence, density_box, linear_theory
from truesky.cosmology import FIDUCIAL
from truesky.numerics import cache
from truesky.request.files import Catalogue
from truesky.request.from_toml import from_table
from truesky.request.schema import Universe
from truesky.validation import theory

ROOT = Path(__file__).resolve().parents[3]
# The fitting formula, because CAMB is not installed: only the spectrum of the fiducial cosmology is shipped.
FIT = replace(FIDUCIAL, power="eisenstein98")
OTHERS = {
    "omega_m": 0.3, "omega_b": 0.045, "h": 0.7, "sigma_8": 0.8, "n_s": 0.97, "w0": -0.9, "wa": 0.2, "power": "camb",
    "m_nu": neutrinos.MASSIVE.m_nu,
}  # fmt: skip
# Settings of a sky that is small enough for a test, without lensing maps.
SMALL = {"box_cells": 48, "lensing": [0.0, 0.0], "galaxy_limit": 20.0, "generation_cells": [12345]}
# Modules that may name the fiducial cosmology, instead of an argument. Those of validation compare the default universe
# with observations.
WITH_DEFAULT = {
    "truesky/cosmology.py",
    "truesky/request/checks.py",
    "truesky/request/schema.py",
    # The cosmology of the shipped table.
    "truesky/catalogue/matter/boltzmann.py",
    # Redshifts of sources that are added to a given image are ignored.
    "truesky/catalogue/injected_rows.py",
    # Names of columns in the format of Euclid, which do not depend on the cosmology.
    "truesky/catalogue/exports/euclid.py",
    # Rates in a galaxy are calibrated with the shipped densities of hosts, in the default cosmology.
    "truesky/catalogue/transients/rates.py",
    "truesky/validation/model/census.py",
    "truesky/validation/model/pictures.py",
}


def box_of(cosmology):
    return density_box.load(1, 16, cosmology)


def halo_tables(cosmology):
    return linear_theory.halo_tables(cosmology, np.linspace(9.0, 15.0, 21), np.array([0.0, 1.0]))


def halo_bias(cosmology):
    return density_box.biased_field(density_box.box_model(cosmology), np.array([0.8, 1.5, 3.0]))[1]


def light_cone(cosmology):
    path = Path("halos.csv")
    path.write_text("ra,dec,z_true,log_mass\n10.0,0.0,0.5,13.0\n")
    columns = mapping.halo_columns({name: f'"{name}"' for name in ("ra", "dec", "z_true", "log_mass")}, cosmology)
    return halo_catalogue.load([path], [file_sha256(path)], columns).chi


def split_catalogue(cosmology):
    path = Path("galaxies.csv")
    path.write_text("ra,dec,z_true,abs_mag_r01,r\n10.0,0.0,0.5,-21.0,5.0\n")
    entries = {name: f'"{name}"' for name in ("ra", "dec", "z_true", "abs_mag_r01")}
    entries["half_light_radius"] = '{"column": "r", "kpc_at": "z_true"}'
    columns = ingest.galaxy_columns(Catalogue((path,), "", tuple(entries.items())), False, cosmology)
    split = ingest.split_by_cell([path], [file_sha256(path)], columns)
    cell = int(next(name for name in split.checksums if name.endswith(".arrow")).split("/")[0])
    rows = [ingest.rows_of_cell(split, 64 * cell + i) for i in range(64)]
    return np.concatenate([row["disk_half_light_radius"] for row in rows if row])


def lens_maps(cosmology):
    return lensing.load(box_of(cosmology), 16).maps[-1]


# Functions whose results are kept: name of the entries in the disc cache ("" for results in memory), and function.
KEPT = {
    "box": ("box_g", lambda cosmology: box_of(cosmology).smoothed[0]),
    "velocities": ("box_u0", lambda cosmology: box_of(cosmology).velocity[0]),
    "tides": ("box_txx", lambda cosmology: density_box.tides(box_of(cosmology))[0]),
    "halo tables": ("halo_tables", lambda cosmology: halo_tables(cosmology)["density"]),
    "halo bias": ("halo_bias", halo_bias),
    "lensing maps": ("lensing_16_3", lens_maps),
    "power": ("", lambda cosmology: linear_theory.power(cosmology, np.array([0.05, 0.3]))),
    "power of halofit": ("", lambda cosmology: theory.matter_power(cosmology, np.array([0.05, 0.3]), 0.5)),
    "light-cone": ("halo_light_cone", light_cone),
    "catalogue": ("ingest", split_catalogue),
}
# Parameters on which a result does not depend: the linear power today depends on dark energy only through sigma_8, and
# distances in Mpc/h neither on the power nor, without kpc, on h. Massive neutrinos are matter for distances.
SAME = {
    **dict.fromkeys(("box", "velocities", "tides", "halo bias", "power"), ("w0", "wa")),
    "light-cone": ("omega_b", "h", "sigma_8", "n_s", "power", "m_nu"),
    "catalogue": ("omega_b", "sigma_8", "n_s", "power", "m_nu"),
}
# Results that do not depend on the power spectrum.
NO_POWER = ("light-cone", "catalogue")


@pytest.fixture
def cheap_maps(monkeypatch):
    """Replace the maps of the convergence by the weights of the layers, which depend on the same parameters."""

    def maps(box, nside, chi, chosen):
        slabs = convergence.layers(box, 0.06, float(chi[-1]), chosen.coarsest, chosen.stretch)
        value = np.float32(np.sum(slabs.weight * slabs.growth_here) * box.smoothed[0].std())
        return {"kappa": np.full((chi.size, 12), value), "transfer": np.ones((chi.size, 2))}

    monkeypatch.setattr(lensing, "_convergence_maps", maps)
    monkeypatch.setattr(lensing, "_plane_of", lambda kappa, nside, gain: lambda: {"field": np.asarray(kappa)[:, None]})


@pytest.mark.parametrize("name", KEPT)
def test_a_kept_result_is_not_that_of_another_cosmology(name, cheap_maps, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(density_box, "_GAIN_CELLS", 24)
    entry, compute = KEPT[name]
    with neutrinos.installed():

        def entries():
            return {path.name for path in cache.cache_dir().glob(f"{entry}-*")}

        first = {}
        for parameter, value in OTHERS.items():
            # Only CAMB has massive neutrinos.
            base = FIDUCIAL if parameter == "m_nu" else FIT
            if base not in first:
                first[base] = np.array(compute(base))
            other, before = replace(base, **{parameter: value}), entries()
            found = np.array(compute(other))
            assert not entry or entries() > before, parameter
            assert np.array_equal(found, first[base]) == (parameter in SAME.get(name, ())), parameter
            assert np.array_equal(compute(base), first[base]), parameter


@pytest.mark.parametrize("name", [name for name, (entry, _) in KEPT.items() if entry and name not in NO_POWER])
def test_a_kept_result_is_not_that_of_another_version_of_camb(name, cheap_maps, monkeypatch):
    monkeypatch.setattr(density_box, "_GAIN_CELLS", 24)
    entry, compute = KEPT[name]
    with neutrinos.installed():

        def count():
            return len([*cache.cache_dir().glob(f"{entry}-*")])

        counts = []
        for version in ("2.0.5", "2.0.6", "2.0.6", "2.0.5"):
            neutrinos.set_version(monkeypatch, version)
            for cosmology in (neutrinos.MASSIVE, FIDUCIAL):
                compute(cosmology)
                counts.append(count())
    assert counts == [1, 2, 3, 3, 3, 3, 3, 3]


@pytest.mark.parametrize("parameter", OTHERS)
def test_versions_of_tables_name_the_cosmology(parameter, monkeypatch, tmp_path):
    """The keys of halos, limits of halos and galaxies differ, so that a lake never mixes two cosmologies."""
    monkeypatch.setattr(build_galaxies, "_universe", lambda *args: None)
    neutrinos.set_version(monkeypatch, neutrinos.VERSION)
    base = {"power": FIDUCIAL.power if parameter == "m_nu" else FIT.power}
    some, other = (request_of(**base | chosen) for chosen in ({}, {parameter: OTHERS[parameter]}))
    for one, two in zip(build_galaxies.steps(tmp_path, some), build_galaxies.steps(tmp_path, other), strict=True):
        assert one.plan.key != two.plan.key, one.plan.table.name
    some = request_of(power=FIT.power)
    assert build_galaxies._universe_section({**some.facts("universe")["universe"]}, ()) == Universe(cosmology=FIT)


def request_of(**cosmology):
    area = {"cone": {"ra": 53.0, "dec": -27.0, "radius": 0.1}}
    return from_table({"name": "a", "seed": 1, "area": area, "universe": {"cosmology": cosmology}})


def test_versions_of_tables_name_the_version_of_camb(monkeypatch, tmp_path):
    """Only if CAMB computes the spectrum, so that the default sky does not depend on the package."""
    monkeypatch.setattr(build_galaxies, "_universe", lambda *args: None)
    plans = {}
    for version in ("2.0.5", "2.0.6"):
        neutrinos.set_version(monkeypatch, version)
        for m_nu in (0.0, neutrinos.MASSIVE.m_nu):
            steps = build_galaxies.steps(tmp_path, request_of(m_nu=m_nu))
            plans[version, m_nu > 0.0] = [step.plan for step in steps]
            # The last table, `quarantine`, has the key of `galaxies` among its facts.
            versions = [plan.facts.get("camb") for plan in plans[version, m_nu > 0.0]]
            assert versions == [version if m_nu else None] * 3 + [None]
    for is_massive in (False, True):
        keys = ([plan.key for plan in plans[version, is_massive]] for version in ("2.0.5", "2.0.6"))
        assert [one != two for one, two in zip(*keys, strict=True)] == [is_massive] * 4


@pytest.mark.parametrize("planned", ["2.0.6", ""])
def test_a_worker_with_another_version_of_camb_is_refused(planned, monkeypatch, tmp_path):
    neutrinos.set_version(monkeypatch, "2.0.5")
    facts = request_of(m_nu=neutrinos.MASSIVE.m_nu).facts("universe")["universe"] | {"camb": planned}
    with pytest.raises(BadInput, match=f"this worker has CAMB 2.0.5, and the driver has {planned or 'none'}: install"):
        build_galaxies.draw_halos(tmp_path, {**facts, **SMALL, "seed": 1})


def test_a_sky_with_massive_neutrinos(monkeypatch, tmp_path):
    """The job makes halos and galaxies in a small box, nearly as many as without massive neutrinos."""
    rows = {}
    for m_nu in (neutrinos.MASSIVE.m_nu, 0.0):
        # Compiled functions are in the cache of all tests.
        with neutrinos.installed(own_cache=False):
            with monkeypatch.context() as patch:
                patch.setattr(build_galaxies, "_universe", lambda *args: None)
                steps = build_galaxies.steps(tmp_path, request_of(m_nu=m_nu))[:3]
            for step in steps:
                facts = {**step.plan.facts, **SMALL}
                rows[step.plan.table.name, m_nu > 0.0] = step.run_task(tmp_path, facts).rows
    for name in ("halos", "halo_limits", "galaxies"):
        massive, massless = rows[name, True], rows[name, False]
        assert massive.num_rows == pytest.approx(massless.num_rows, rel=0.1)
        assert massive.num_rows > 50
        assert not massive.equals(massless)
        check_rows(massive, tables.find_table(name, massive.column_names))


def test_only_some_modules_know_the_default():
    """All other modules get the cosmology as an argument."""
    paths = (path.relative_to(ROOT).as_posix() for path in (ROOT / "truesky").rglob("*.py"))
    assert {path for path in paths if re.search(r"\bFIDUCIAL\b", (ROOT / path).read_text())} == WITH_DEFAULT


def test_halos_of_two_cosmologies_in_one_process():
    """Colossus has one current cosmology, which is set before each use."""
    tables = []
    for cosmology in (FIT, replace(FIT, sigma_8=0.7), FIT):
        with cache.use_temporary_dir():
            tables.append(halo_tables(cosmology)["bias"])
    assert np.array_equal(tables[0], tables[2])
    assert np.all(tables[1][0, 10:] > tables[0][0, 10:])


def test_a_universe_that_is_too_large_for_identifiers_is_refused():
    """The limit is that of `halos.model`: it accepts the largest universe that the check accepts."""
    with pytest.raises(BadInput, match=r"universe.cosmology: the distance to z = 6.1 is \d+ Mpc/h, at most 6276 is"):
        request_checks.check_cosmology(replace(FIT, omega_m=0.236))
    # No package can make such a universe possible.
    with pytest.raises(BadInput, match=r"^universe.cosmology: the distance to z = 6.1"):
        request_checks.check_cosmology(replace(FIDUCIAL, omega_m=0.236))
    for omega_m in (0.238, 0.6):
        cosmology = replace(FIT, omega_m=omega_m)
        request_checks.check_cosmology(cosmology)
        cell = density_box.box_model(cosmology).cell
        steps, _ = halos._radial_steps(cosmology, cell, float(cosmology.comoving_distance(1e-4)))
        assert steps.z.size * 73 <= ids.BLOCK_COUNT
