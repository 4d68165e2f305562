"""What is cached is made anew when any of the code that shapes it changes."""

import ast
from pathlib import Path

import pytest

from jobs import code_keys

ROOT = Path(__file__).resolve().parents[2]
SOURCES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts): ast.parse(path.read_text())
    for path in sorted((ROOT / "jobs").rglob("*.py"))
}


def calls(tree, name):
    found = (node for node in ast.walk(tree) if isinstance(node, ast.Call))
    return [node for node in found if ast.unparse(node.func).split(".")[-1] == name]


KEYED = [name for name, tree in SOURCES.items() if calls(tree, "code_key")]


@pytest.mark.parametrize("name", KEYED)
def test_a_byte_of_any_module_changes_the_key(name, monkeypatch):
    real, key = code_keys._source, code_keys.code_key.__wrapped__
    before, listed = key(name), code_keys.modules(name)
    assert name in listed
    for other in listed:
        with monkeypatch.context() as patch:
            patch.setattr(code_keys, "_source", lambda module, other=other: real(module) + b" " * (module == other))
            assert key(name) != before, other
    assert key(name) == before


@pytest.mark.parametrize(
    ("name", "some"),
    [
        ("jobs.render.psf.euclid", {"jobs.render.psf.model", "jobs.render.psf.sub_bands", "jobs.fluxes.passbands"}),
        ("jobs.fluxes.libraries.templates", {"jobs.fluxes.libraries.vega", "jobs.fluxes.libraries.rest_grid"}),
        ("jobs.catalogue.matter.density_box", {"jobs.catalogue.matter.linear_theory", "jobs.fluxes.cosmology"}),
        ("jobs.catalogue.galaxies.lensing", {"jobs.catalogue.matter.convergence", "jobs.catalogue.matter.lightcone"}),
        ("jobs.catalogue.external.ingest", {"lake_schema.external.rows", "lake_schema.fits.external"}),
    ],
)
def test_what_a_module_imports_is_in_its_key(name, some):
    assert some | {name} <= set(code_keys.modules(name))


def test_whoever_caches_arrays_puts_code_into_the_key():
    caching = {name for name, tree in SOURCES.items() if calls(tree, "cached_arrays")}
    assert {"jobs.render.psf.euclid", "jobs.render.sources.sersic", "jobs.fluxes.passbands"} <= caching
    assert caching <= set(KEYED)


def test_no_key_is_of_a_single_file():
    for name, tree in SOURCES.items():
        found = [ast.unparse(call) for call in calls(tree, "read_bytes") if "__file__" in ast.unparse(call)]
        assert [text for text in found if ".with_name" not in text] == [], name


def test_a_module_that_is_not_there_is_named():
    with pytest.raises(ImportError, match="no module jobs"):
        code_keys.modules("jobs.nothing")
