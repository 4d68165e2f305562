"""Test the job: fluxes by cell and row, and the accuracy in the manifest."""

import hashlib

import numpy as np
import pytest

from lake_schema import ids, sky
from lake_schema.errors import BadInput
from lake_schema.store import layout, plan, publish, read
from lake_schema.tables.galaxies import GALAXIES
from lake_schema.tables.stars import STARS
from tests import requests
from tests.truesky.fluxes.libraries.test_from_files import BAND, RESPONSE, WAVELENGTH, ascii_file
from tests.truesky.fluxes.libraries.test_stars_from_files import black_bodies, irtf_file
from tests.universe import rows_of
from truesky.fluxes import band_fluxes, compute_fluxes, inputs
from truesky.fluxes.spectra import lines
from truesky.request.accuracy import REFERENCE
from truesky.request.from_toml import from_table, parse
from truesky.running import submitted_job

CELLS = (1607, 1608)
BANDS = ["euclid_vis", "euclid_h"]


def wanted(**keys):
    area = {"cone": {"ra": 10.0, "dec": 10.0, "radius": 1.0}}
    return from_table({"name": "test", "seed": 1, "area": area, "fluxes": {"bands": BANDS}} | keys)


def catalogue(lake, declared, columns):
    """A small catalogue of two cells."""

    def work(root, facts):
        cell, n = facts["cell"], 40
        index, ra, dec = sky.random_in_cell(5, cell, n, np.random.default_rng(cell))
        kind = 5 if declared is STARS else 0
        place = {"_healpix_29": index, "ra": ra, "dec": dec, "id": ids.source_id(kind, cell << 6, np.arange(n))}
        rows = rows_of(declared, n, cell)
        given = {name: np.full(n, value).astype(declared.column(name).type) for name, value in columns.items()}
        if declared is GALAXIES:
            place |= {"ra_true": ra, "dec_true": dec}
        return plan.Output(declared.build({name: rows[name] for name in declared.names} | place | given))

    parts = tuple(plan.Task(layout.cell_file(5, cell), {"cell": cell}) for cell in CELLS)
    publish.make_version(lake, plan.Plan(declared, {"seed": wanted().seed, "columns": sorted(columns)}, parts), work)


@pytest.fixture
def filled(lake):
    galaxy = {
        "kind": 0,
        "kappa": 0.1,
        "gamma1": 0.0,
        "gamma2": 0.0,
        "z_obs": 0.7,
        "sed_1": 3,
        "sed_2": 2,
        "mag_r01": 21.0,
    }
    galaxy |= dict.fromkeys(lines.columns(), 1e-17)
    catalogue(lake, GALAXIES, galaxy | {"frac_1": 0.3, "frac_2": 0.7, "a_v": 0.2, "ebv_1": 0.1, "ebv_2": 0.1})
    mixed = {"sed_2": 450, "frac_2": 0.3, "sed_3": 21, "frac_3": 0.1, "sed_4": 22, "frac_4": 0.0}
    catalogue(lake, STARS, {"sed": 20, "a_v": 0.3, "mag_h": 18.0, **mixed})
    return lake


def run(lake, asked, sources=False):
    for step in compute_fluxes.steps(lake, asked):
        # Inputs are read from the lake only if the request has user files.
        if sources or step.plan.table.is_catalogue:
            publish.make_version(lake, step.plan, step.run_task)


def test_every_source_has_fluxes_in_the_same_row(filled):
    run(filled, wanted())
    for kind, name in compute_fluxes.CATALOGUES:
        source, made = read.version(filled, name), read.version(filled, f"{kind}_fluxes")
        assert made.num_rows == source.num_rows == 80
        assert made.partitions == source.partitions
        assert made.rows()["id"].equals(source.rows()["id"])
        assert all((made.rows()[f"f_nu_{band}"].to_numpy() > 0.0).all() for band in BANDS)


def test_the_manifest_says_how_exact_it_is(filled):
    run(filled, wanted())
    facts = read.version(filled, "galaxy_fluxes").manifest["facts"]
    assert facts["accuracy"]["flux"] == 1e-3
    assert set(facts["errors"]) == set(BANDS)
    assert all(0.0 < error["largest"] <= 1e-3 and len(error["setting"]) == 3 for error in facts["errors"].values())
    assert facts["covered"]["ebv"] == [0.0, 0.6]
    assert read.version(filled, "star_fluxes").manifest["facts"]["errors"]["euclid_h"]["largest"] <= 1e-5


def test_the_accuracy_of_the_request_is_used(filled, library):
    run(filled, wanted(accuracy="draft"))
    draft = read.version(filled, "galaxy_fluxes")
    run(filled, wanted(accuracy="reference"))
    exact = read.version(filled, "galaxy_fluxes")
    assert draft.key != exact.key
    assert all(error["setting"] is None for error in exact.manifest["facts"]["errors"].values())
    truth = band_fluxes.galaxy_fluxes(read.version(filled, "galaxies").rows(), BANDS, library, REFERENCE)
    for band in BANDS:
        slow, fast = (version.rows()[f"f_nu_{band}"].to_numpy() for version in (exact, draft))
        np.testing.assert_array_equal(slow, truth[f"f_nu_{band}"].to_numpy())
        np.testing.assert_allclose(fast, slow, rtol=5e-3)
        assert (fast != slow).any()


def test_inputs_are_published_with_fluxes(filled):
    run(filled, wanted(), sources=True)
    made = read.version(filled, "galaxy_fluxes").manifest["facts"]["sources"]
    for name in ("templates", "extinction_laws", "emission_lines", "passbands"):
        version = read.version(filled, name)
        assert version.key == made[name]
        assert all(len(row["sha256"]) == 64 and row["source"] for row in version.rows(["source", "sha256"]).to_pylist())


def test_files_of_the_user_make_the_fluxes(filled, tmp_path, library):
    """A filter, two galaxies and a law of the user are used by the lake, the tables and the workers."""
    slope = WAVELENGTH / 5500.0
    for name, values in (("early", slope), ("late", 1.0 / slope)):
        ascii_file(tmp_path / f"{name}.sed", value=values)
    ascii_file(tmp_path / "mine.dat", BAND, RESPONSE)
    ascii_file(tmp_path / "law.dat", value=4.05 / slope)
    more = f"""
[fluxes]
bands = {BANDS}
[fluxes.passbands.mine]
file = "mine.dat"
format = "passband_ascii"
medium = "vacuum"
[fluxes.templates]
files = ["early.sed", "late.sed", "late.sed", "early.sed"]
format = "cosmos"
[fluxes.extinction.2]
file = "law.dat"
format = "extinction"
"""
    path = requests.written(tmp_path, more)
    asked = parse(path)
    run(filled, asked, sources=True)
    made = read.version(filled, "galaxy_fluxes")
    assert [name for name in made.rows().column_names if name.startswith("f_nu")] == [
        *(f"f_nu_{band}" for band in BANDS), "f_nu_mine",
    ]  # fmt: skip
    facts = made.manifest["facts"]
    assert facts["files"]["fluxes.passbands.mine"] == hashlib.sha256((tmp_path / "mine.dat").read_bytes()).hexdigest()
    assert all(0.0 < error["largest"] <= 1e-3 / 1.5 for error in facts["errors"].values())
    own = inputs.read(asked.curves)
    truth = band_fluxes.galaxy_fluxes(
        read.version(filled, "galaxies").rows(), [*BANDS, own.passbands["mine"]], own.library, REFERENCE
    )
    embedded = band_fluxes.galaxy_fluxes(read.version(filled, "galaxies").rows(), BANDS, library, REFERENCE)
    for band in (*BANDS, "mine"):
        column = f"f_nu_{band}"
        np.testing.assert_allclose(made.rows()[column], truth[column], rtol=1e-3)
    assert np.abs(np.log(np.asarray(truth["f_nu_euclid_h"]) / np.asarray(embedded["f_nu_euclid_h"]))).min() > 0.1
    assert (read.version(filled, "star_fluxes").rows()["f_nu_mine"].to_numpy() > 0.0).all()
    # The renderer of the galaxies also loads their spectra.
    np.testing.assert_array_equal(inputs.galaxy_library_from_facts(filled, facts).flux, own.library.flux)
    # A file with the same name and other contents gives another table.
    ascii_file(tmp_path / "mine.dat", BAND, RESPONSE**2)
    assert compute_fluxes.flux_step("galaxy", filled, parse(path)).plan.key != made.key


@pytest.mark.nightly
def test_stars_of_the_user_make_the_fluxes(filled, tmp_path, stars_library):
    """Models and an infrared spectrum of the user are used for the stars in the lake."""
    black_bodies(tmp_path / "synthetic.cor")
    irtf_file(tmp_path / "star.txt", -2.5, wiggle=0.3)
    own = "[fluxes.stars]\nbasel = 'synthetic.cor'\nirtf = ['star.txt']\n"
    asked = parse(requests.written(tmp_path, f"fluxes.bands = {BANDS}\n{own}"))
    own = inputs.read(asked.curves)
    for step in (*compute_fluxes.source_steps(own), compute_fluxes.flux_step("star", filled, asked)):
        publish.make_version(filled, step.plan, step.run_task)
    made, rows = read.version(filled, "star_fluxes"), read.version(filled, "stars").rows()
    truth = band_fluxes.star_fluxes(rows, BANDS, own.stars, REFERENCE)
    embedded = band_fluxes.star_fluxes(rows, BANDS, stars_library, REFERENCE)
    for band in BANDS:
        np.testing.assert_allclose(made.rows()[f"f_nu_{band}"], truth[f"f_nu_{band}"], rtol=1e-5)
    assert np.abs(np.log(np.asarray(truth["f_nu_euclid_vis"]) / np.asarray(embedded["f_nu_euclid_vis"]))).min() > 0.05
    facts = made.manifest["facts"]
    assert facts["files"]["fluxes.stars.irtf.0"] == hashlib.sha256((tmp_path / "star.txt").read_bytes()).hexdigest()
    np.testing.assert_array_equal(inputs.stellar_library_from_facts(filled, facts).flux, own.stars.flux)


def test_published_fluxes_are_not_prepared_again(filled, monkeypatch):
    run(filled, wanted())
    monkeypatch.setattr(band_fluxes, "prepare", None)
    run(filled, wanted())


def test_bands_may_be_named_on_the_command_line(filled, tmp_path, monkeypatch, capsys):
    asked = []
    monkeypatch.setattr(submitted_job, "_run_step", lambda job, step, *_: asked.append(step.plan.table))
    line = ["--lake", str(filled), "--request", str(requests.written(tmp_path)), "--bands"]
    assert submitted_job.main(compute_fluxes.JOB, [*line, "lsst_r", "euclid_h"]) == 0
    assert asked[-1].names[-3:] == ["f_nu_lsst_r", "f_nu_euclid_h", "integrated"]
    assert submitted_job.main(compute_fluxes.JOB, [*line, "lsst_q"]) == 2
    assert "fluxes.bands: 'lsst_q' is not allowed: allowed with lsst: lsst_u" in capsys.readouterr().err


def test_an_unknown_band_is_refused_before_anything_is_made(filled):
    with pytest.raises(BadInput, match=r"fluxes\.bands: 'nonsense' is not one of euclid_vis"):
        compute_fluxes.steps(filled, wanted(fluxes={"bands": ["nonsense"]}))
