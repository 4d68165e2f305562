"""Cached arrays are computed again if any code that affects them changes."""

import ast
import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from lake_schema.errors import LakeError
from tests.truesky import nightly
from truesky.numerics import code_fingerprints

ROOT = Path(__file__).resolve().parents[3]
SOURCES = {
    ".".join(path.relative_to(ROOT).with_suffix("").parts): path for path in sorted((ROOT / "truesky").rglob("*.py"))
}


def calls(path, name):
    # Most do not name it at all.
    if name not in (text := path.read_text()):
        return []
    tree = ast.parse(text)
    found = (node for node in ast.walk(tree) if isinstance(node, ast.Call))
    return [node for node in found if ast.unparse(node.func).split(".")[-1] == name]


KEYED = [name for name, path in SOURCES.items() if calls(path, "code_key")]


@nightly.parametrize("name", KEYED, (0, 4, 9, 14, 19))
def test_a_byte_of_any_module_changes_the_key(name, monkeypatch):
    real, key = code_fingerprints._source, code_fingerprints.code_key.__wrapped__
    before, listed = key(name), code_fingerprints.required_modules(name)
    assert name in listed
    for other in listed:
        with monkeypatch.context() as patch:
            patch.setattr(
                code_fingerprints, "_source", lambda module, other=other: real(module) + b"\nx = 1" * (module == other)
            )
            assert key(name) != before, other
    assert key(name) == before


@pytest.mark.parametrize(
    ("name", "some"),
    [
        (
            "truesky.render.psf.euclid",
            {"truesky.render.psf.model", "truesky.render.psf.sub_bands", "truesky.fluxes.passbands"},
        ),
        ("truesky.fluxes.libraries.templates", {"truesky.fluxes.libraries.vega", "truesky.fluxes.libraries.rest_grid"}),
        (
            "truesky.catalogue.matter.density_box",
            {"truesky.catalogue.matter.linear_theory", "truesky.cosmology"},
        ),
        (
            "truesky.catalogue.galaxies.lensing",
            {"truesky.catalogue.matter.convergence", "truesky.catalogue.matter.lightcone"},
        ),
        ("truesky.catalogue.external.ingest", {"lake_schema.external.rows", "lake_schema.fits.external"}),
    ],
)
def test_what_a_module_imports_is_in_its_key(name, some):
    assert some | {name} <= set(code_fingerprints.required_modules(name))


DATA = {path.name: path for path in (ROOT / "truesky").rglob("*") if path.suffix in (".csv", ".toml")}


@pytest.mark.parametrize("name", KEYED)
def test_a_byte_of_any_table_changes_the_key(name, monkeypatch):
    """This includes every table that the source of a listed module names, whole or by its suffix."""
    real, key = code_fingerprints._content, code_fingerprints.code_key.__wrapped__
    before, found = key(name), set(code_fingerprints.data_files(name))
    for other in code_fingerprints.required_modules(name):
        text = code_fingerprints._source(other).decode()
        assert {path for file, path in DATA.items() if f'"{file}"' in text} <= found, other
        beside = code_fingerprints._file(other).with_suffix(".csv")
        assert 'with_suffix(".csv")' not in text or beside in found, other
    for table in found:
        with monkeypatch.context() as patch:
            patch.setattr(code_fingerprints, "_content", lambda file, table=table: real(file) + b" " * (file == table))
            assert key(name) != before, table
    assert key(name) == before


def test_every_table_is_found_by_its_name():
    """Names of tables are unique, and the code names each one whole, unless it has the name of its module."""
    paths = [path for path in (ROOT / "truesky").rglob("*") if path.suffix in (".csv", ".toml")]
    assert len(paths) == len(DATA)
    named = {file for name in SOURCES for file in code_fingerprints._scan(name.removesuffix(".__init__"))[1]}
    assert {path.name for path in set(paths) - named} == {"psf_positions.csv", "psf_positions_nisp.csv"}


# Makes what is cached, in an empty cache, and tells which tables are opened while which modules are at work.
OPENING = """
import json, sys
from pathlib import Path
root, found = Path.cwd() / "truesky", set()

def hook(event, args):
    if event == "open" and str(args[0]).startswith(str(root)) and str(args[0]).endswith((".csv", ".toml")):
        frame = sys._getframe()
        while frame is not None:
            found.add((frame.f_globals.get("__name__", ""), str(args[0])))
            frame = frame.f_back

sys.addaudithook(hook)
from truesky.fluxes import passbands
from truesky.fluxes.libraries import from_files, stellar, templates
from truesky.fluxes.spectra import intergalactic, lines
from truesky.fluxes.tables import build_tables
library = templates.galaxy_library()
build_tables.library_key(library)
passbands.load("lsst_r"), stellar.fingerprint(), lines.line_list(), intergalactic.lyman_series(), from_files.formats()
if sys.argv[1:]:
    templates.stellar_library()
print(json.dumps(sorted(found)))
"""


@pytest.mark.parametrize("more", [[], pytest.param(["stars"], marks=pytest.mark.nightly)], ids=["galaxies", "stars"])
def test_tables_that_are_opened_are_in_the_key(tmp_path, more):
    """The test reads the tables of galaxies; the nightly test also those of stars, which takes 9 s more."""
    told = subprocess.run(
        [sys.executable, "-c", OPENING, *more], cwd=ROOT, env={**os.environ, "TRUESKY_CACHE": str(tmp_path)},
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    opened = {(module, Path(file)) for module, file in json.loads(told.stdout) if module in KEYED}
    assert {"truesky.fluxes.passbands", "truesky.fluxes.libraries.stellar", "truesky.fluxes.libraries.templates"} <= {
        module for module, _ in opened
    }
    for module, file in opened:
        assert file in code_fingerprints.data_files(module), (module, file)


# Names from irrelevant modules that other modules may use, in addition to exceptions, types of arrays and declared
# tables: functions that store or hash data, or refuse input; records of the request and of the mission (whose values
# are in the keys), and names.
KEEPING = {
    "truesky.numerics.cache.cache_dir", "truesky.numerics.cache.cached_arrays", "truesky.numerics.cache.content_key",
    "truesky.numerics.code_fingerprints.code_key", "lake_schema.store.layout", "lake_schema.store.read",
    "lake_schema.store.provenance.canonical", "lake_schema.errors.one_line",
    "lake_schema.store.provenance.file_sha256", "lake_schema.store.provenance.machine",
    "lake_schema.store.provenance.code_version",
    "lake_schema.errors.Mistakes", "lake_schema.errors.bad_input", "lake_schema.errors.refuse_mistakes",
    "truesky.request.toml_values.refuse_name", "truesky.request.instruments",
    "truesky.request.instruments.GROUND_CHANNEL",
    "lake_schema.store.object_storage.s3.Folder", "lake_schema.store.object_storage.s3.ObjectPath",
}  # fmt: skip
# Labels, by which forecasts find entries of the cache; no array depends on them.
LABELS = "truesky.numerics.cache_labels"
RECORDS = {
    "truesky.request.files.Catalogue", "truesky.request.files.Curves", "truesky.request.files.DustMap",
    "truesky.request.files.UserCurves",
    # Only checks use the area of a request, to refuse catalogues outside it.
    "truesky.request.area.Area",
    # Shapes of galaxies, on which no cached array depends: only the PSF of an exposure is cached.
    "truesky.request.schema.MAX_SHEAR", "truesky.request.structure.Arms", "truesky.request.structure.Stamps",
    "lake_schema.mission.configuration.MissionConfiguration", "lake_schema.mission.parameter.SPACE_CAMERAS",
    "lake_schema.mission.parameter.Parameter",
    "lake_schema.mission.detector_overrides", "lake_schema.mission.detector_overrides.DetectorPlace",
}  # fmt: skip


def is_harmless(name):
    if name in KEEPING | RECORDS or name.startswith(("lake_schema.tables.", LABELS)):
        return True
    module, _, attribute = name.rpartition(".")
    if module == "lake_schema.arrays":
        return attribute[0].isupper()
    value = getattr(importlib.import_module(module), attribute, None) if module else None
    is_module = name in ("truesky.numerics.cache", "truesky.numerics.cache_entries")
    return is_module or (isinstance(value, type) and issubclass(value, LakeError))


def test_irrelevant_modules_provide_only_allowed_names():
    used = set()
    for module in {other for name in KEYED for other in code_fingerprints.required_modules(name)}:
        for node in ast.walk(ast.parse(code_fingerprints._source(module))):
            if isinstance(node, ast.ImportFrom) and node.module:
                used |= {f"{node.module}.{alias.name}" for alias in node.names}
            elif isinstance(node, ast.Import):
                used |= {alias.name for alias in node.names}
    left_out = {
        name for name in used if any(f"{name}.".startswith(f"{other}.") for other in code_fingerprints._IRRELEVANT)
    }
    left_out = {
        name for name in left_out if not f"{name}.".startswith(tuple(f"{m}." for m in code_fingerprints._RELEVANT))
    }
    assert "truesky.numerics.cache.content_key" in left_out
    assert {name for name in left_out if not is_harmless(name)} == set()


def test_every_module_that_caches_arrays_puts_code_into_the_key():
    caching = {name for name, path in SOURCES.items() if calls(path, "cached_arrays")}
    assert {"truesky.render.psf.euclid", "truesky.render.sources.sersic", "truesky.fluxes.passbands"} <= caching
    assert caching <= set(KEYED)


def test_no_key_is_of_a_single_file():
    for name, path in SOURCES.items():
        assert [ast.unparse(call) for call in calls(path, "read_bytes") if "__file__" in ast.unparse(call)] == [], name


def test_the_error_names_a_missing_module():
    with pytest.raises(ImportError, match=r"no module truesky\.nothing"):
        code_fingerprints.required_modules("truesky.nothing")
