"""Names that could lead out of the lake are refused."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lake_schema.errors import BadInput
from lake_schema.store import layout

BAD = [
    "", ".", "..", "../x", "/etc/x", "a/b", "a\\b", "a\0b", "a\nb", "a b", "A", "Galaxies", "-x", "_x",
    "x" * 65, "x" * 300, "hpx=3", "%2e%2e", "a%2fb", "\u2024\u2024", "\uff0e\uff0e", "\u0430bc", "ga\u0142axy",
    "a\u200bb", "~", "~root", "$HOME", "`ls`", "$(ls)", "a;b", "a|b", "a&b", "a>b", "a*b", "a?b", "a[b]",
    "a{b}", "a'b", 'a"b', "a,b", "a:b", "a@b", "a#b", "a!b", "a+b", "a^b", "a=b", "a.b", "x.parquet", "con.",
    "a\tb", "a\rb", "a\x7fb", " a", "a ", "\ufeffa", "\u202ea", "s3://x", "file:x",
]  # fmt: skip


@pytest.mark.parametrize("text", BAD)
def test_bad_names_are_refused(text):
    with pytest.raises(BadInput, match="name"):
        layout.check_name(text)


@given(st.text())
def test_valid_names_stay_in_the_lake(tmp_path_factory, text):
    root = tmp_path_factory.getbasetemp()
    try:
        name = layout.check_name(text)
    except BadInput:
        return
    for path in (
        layout.table_folder(root, name),
        layout.stage_folder(root, name, name),
        layout.version_folder(root, name, name),
    ):
        assert path.resolve().is_relative_to(root.resolve())
        assert path.resolve() != root.resolve()


def test_a_link_out_of_the_lake_is_refused(tmp_path):
    (tmp_path / "lake").mkdir()
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "lake" / "galaxies").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(BadInput, match="is outside"):
        layout.table_folder(tmp_path / "lake", "galaxies")


@pytest.mark.parametrize("text", ["file://{}/a b", "file:{}/a%20b", "FILE://localhost{}/a b", "{}/a b"])
def test_a_folder_may_be_given_as_spark_names_files(tmp_path, text):
    assert layout.resolve_lake(text.format(tmp_path)) == tmp_path / "a b"


@pytest.mark.parametrize("text", ["s3://bucket/lake", "hdfs://host/lake", "gs://x", "S3A://x", "file://host/x"])
def test_object_stores_are_refused(text):
    with pytest.raises(BadInput, match="POSIX"):
        layout.resolve_lake(text)


@pytest.mark.parametrize(
    ("text", "words"),
    [("", "empty"), ("file", "not a folder"), ("~no-such-user/lake", "lake"), ("loop", "lake"), ("a\0b", "lake")],
)
def test_paths_that_cannot_be_lakes_are_refused(tmp_path, monkeypatch, text, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to("loop")
    with pytest.raises(BadInput, match=words):
        layout.resolve_lake(text)


def test_files_of_cells_have_paths_of_hats():
    assert layout.cell_file(5, 1607) == "Norder=5/Dir=0/Npix=1607.parquet"
    assert layout.cell_file(8, 574968) == "Norder=8/Dir=570000/Npix=574968.parquet"


def test_a_column_is_not_a_table(tmp_path):
    error = layout.missing_table(tmp_path, "z_obs", ["galaxies", "halos", "stars"])
    assert str(error) == f"lake {tmp_path} has no table z_obs; z_obs is a column of galaxies and halos"
