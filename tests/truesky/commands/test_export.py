"""truesky export: every form of every catalogue is written, and other combinations are one line."""

import pytest

from lake_schema.store import read
from lake_schema.tables.galaxies import GALAXIES
from tests.truesky.catalogue.exports.conftest import galaxies, published
from tests.truesky.survey_maps import planned
from truesky.catalogue.exports import euclid, fits_files, gaia_archive, skycatalogs
from truesky.command_line import exports
from truesky.commands import __main__ as truesky
from truesky.render import grisms
from truesky.survey_maps import depth_lookup, euclid_maps, healsparse_files


@pytest.fixture
def calls(tmp_path, monkeypatch):
    """Return a list of the functions that write, with the names of the request."""
    called = []
    monkeypatch.setattr(read, "version", lambda *given, **more: None)
    monkeypatch.setattr(depth_lookup, "choose_bands", lambda *given: ["lsst_r"])
    for module, name, result in (
        (fits_files, "write", ["a.fits"]),
        (skycatalogs, "write", ["a.parquet"]),
        (euclid, "write_galaxies", euclid.Written(["a.fits"], 1200, 30)),
        (euclid, "write_stars", euclid.Written(["a.fits"], 1200, 0)),
        (gaia_archive, "write", 1200),
        (healsparse_files, "write", ["a.hsp"]),
        (euclid_maps, "write", "a.fits"),
        (grisms, "write", 12),
    ):
        label = f"{module.__name__.rpartition('.')[2]}.{name}"
        monkeypatch.setattr(module, name, lambda *given, _label=label, _result=result: called.append(_label) or _result)
    return called


WRITERS = {
    ("galaxies", "fits"): "fits_files.write",
    ("galaxies", "skycatalogs"): "skycatalogs.write",
    ("galaxies", "euclid"): "euclid.write_galaxies",
    ("stars", "fits"): "fits_files.write",
    ("stars", "euclid"): "euclid.write_stars",
    ("gaia", "table"): "gaia_archive.write",
    ("gaia", "ldac"): "gaia_archive.write",
    ("depth", "healsparse"): "healsparse_files.write",
    ("depth", "euclid"): "euclid_maps.write",
    ("grisms", "grismconf"): "grisms.write",
}


def test_every_form_has_its_writer(calls, tmp_path):
    assert [*WRITERS] == [(what, form) for what, forms in exports.FORMS.items() for form in forms]
    for (what, form), writer in WRITERS.items():
        out = tmp_path / f"{what}_{form}"
        more = ["--exposure", "3"] if what == "grisms" else []
        assert truesky.main(["export", what, str(tmp_path), "--form", form, "--out", str(out), *more]) == 0
        assert calls.pop() == writer
    for what, forms in exports.FORMS.items():
        where = [] if what == "grisms" else ["--lake", str(tmp_path)]
        assert truesky.main(["export", what, *where, "--out", str(tmp_path / f"{what}_x")]) == 0
        assert calls.pop() == WRITERS[what, forms[0]]


def test_releases_are_those_of_the_writer():
    assert tuple(gaia_archive.RELEASES) == exports.RELEASES


def test_left_out_galaxies_are_counted(calls, tmp_path, capsys):
    truesky.main(["export", "galaxies", str(tmp_path), "--form", "euclid", "--out", str(tmp_path / "x")])
    assert capsys.readouterr().out.endswith("x: 1 files, 1,200 galaxies, without 30 of kinds that the format lacks\n")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["stars", "--form", "skycatalogs"], "--form skycatalogs: stars can be written as fits, euclid"),
        (["gaia", "--form", "lda"], '--form lda: gaia can be written as table, ldac; did you mean "ldac"?'),
        (["galaxies", "--epoch", "2020"], "--epoch is an option of gaia only"),
        (["stars", "--bands", "lsst_r"], "--bands and --columns are options of depth only"),
        (["stars", "--detectors", "DET11"], "--exposure and --detectors are options of grisms only"),
        (["gaia", "--form", "ldac", "--release", "dr3"], "--release is an option of gaia as a table only"),
    ],
)
def test_other_combinations_are_one_line(words, said, tmp_path, capsys):
    assert truesky.main(["export", words[0], str(tmp_path), *words[1:], "--out", str(tmp_path / "x")]) == 2
    assert capsys.readouterr().err == f"truesky export: {said}\n"
    assert not list(tmp_path.iterdir())


def test_a_missing_lake_is_one_line(tmp_path, capsys):
    assert truesky.main(["export", "stars", "--out", str(tmp_path / "x")]) == 2
    assert capsys.readouterr().err == "truesky export: LAKE is missing: write truesky export stars LAKE --out PATH\n"


def test_an_address_of_object_storage_does_not_become_a_local_folder(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert truesky.main(["export", "galaxies", str(tmp_path), "--form", "euclid", "--out", "s3://bucket/x"]) == 2
    assert "give its path, not an address" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


def test_galaxies_without_fluxes_are_written_as_fits_only(tmp_path, capsys):
    lake, out = tmp_path / "lake", tmp_path / "out"
    lake.mkdir()
    published(lake, GALAXIES, galaxies(), {})
    assert truesky.main(["export", "galaxies", str(lake), "--form", "euclid", "--out", str(out)]) == 2
    assert "galaxy_fluxes" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["lake"]
    assert truesky.main(["export", "galaxies", str(lake), "--out", str(out)]) == 0
    assert len(list(out.iterdir())) == 2


def test_depth_maps_are_written_to_a_new_folder(tmp_path, capsys):
    lake, out = tmp_path / "lake", tmp_path / "maps"
    lake.mkdir()
    planned.depth(lake, planned.request(planned.POINTINGS[2:]))
    words = ["export", "depth", str(lake), "--bands", "lsst_r", "--columns", "depth_point", "covered", "--out"]
    for form, ending in (("euclid", "fits"), ("healsparse", "hsp")):
        folder = out / form
        assert truesky.main([*words, str(folder), "--form", form]) == 0
        assert sorted(path.name for path in folder.iterdir()) == [
            f"lsst_r_covered.{ending}",
            f"lsst_r_depth_point.{ending}",
        ]
    assert truesky.main([*words, str(folder), "--form", "euclid"]) == 2
    assert "healsparse: exists already; give the name of a new folder" in capsys.readouterr().err
    assert truesky.main([*words[:3], "--bands", "lsst_u", "--form", "euclid", "--out", str(out / "none")]) == 2
    assert not (out / "none").exists()
