"""The benchmark of NISP-S measures the default selection of sources, and the selection by flux limits."""

from benchmarks import nisp_s
from lake_schema.mission.configuration import resolve
from truesky.request.from_toml import parse

NAME = "nisp.spectra.selection"


def selection(tmp_path, **options):
    file = tmp_path / "request.toml"
    file.write_text(nisp_s.request_text(True, **options), encoding="utf-8")
    overrides = {key: (override.value, override.unit) for key, override in parse(file).mission.overrides}
    return resolve(overrides=overrides).value(NAME, "")


def test_the_default_selection_is_that_of_users(tmp_path):
    assert selection(tmp_path, selection=nisp_s.NOTICEABLE) == resolve().value(NAME, "")


def test_other_figures_are_of_sources_above_flux_limits(tmp_path):
    assert selection(tmp_path) == selection(tmp_path, selection=nisp_s._FLUX_LIMITED) == 1.0
