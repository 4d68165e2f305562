"""The explorer's command line."""

import pandas as pd
import pytest

from jobs.explore.__main__ import main
from lake_schema import read


def test_a_table_of_the_tables(explored, capsys):
    assert main(["--lake", str(explored)]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in ("galaxies", "galaxy_fluxes", "plain"))


def test_a_query_prints_its_rows(explored, capsys):
    assert main(["SELECT count(*) AS n FROM galaxies", "--lake", str(explored)]) == 0
    assert capsys.readouterr().out.split() == ["n", "500", "1", "rows"]


def test_a_query_into_a_file(explored, tmp_path, capsys):
    assert main(["SELECT id FROM plain", "--lake", str(explored), "--out", str(tmp_path / "x.csv")]) == 0
    assert "60 rows" in capsys.readouterr().out
    assert len(pd.read_csv(tmp_path / "x.csv")) == 60


LONG = "SELECT count(*) FROM range(1000000) a(x), range(1000000) b(y) WHERE x * y < 0"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["DROP VIEW plain"], "SELECT"),
        (["SELECT 1", "--out", "x.doc"], "ending"),
        (["SELECT 1 AS a", "--out", "/no/such/folder/x.csv"], "no/such"),
        (
            ["SELECT count(*) FROM range(1000000) a(x), range(1000000) b(y) WHERE x * y < 0", "--timeout", "3"],
            "stopped after 3 s",
        ),
    ],
)
def test_what_is_wrong_is_one_line(explored, capsys, arguments, words):
    assert main([*arguments, "--lake", str(explored)]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert len(err.strip().splitlines()) == 1


def test_a_lake_that_is_not_there(tmp_path, capsys):
    assert main(["SELECT 1", "--lake", str(tmp_path / "none")]) == 2
    assert "holds no table" in capsys.readouterr().err


def test_damage_ends_with_1(explored, capsys, tmp_path):
    import shutil

    shutil.copytree(explored, tmp_path / "lake", symlinks=True)
    version = read.version(tmp_path / "lake", "plain")
    path = version.path(version.parts[0])
    path.write_bytes(path.read_bytes()[:-1])
    assert main(["SELECT sum(value) FROM plain", "--lake", str(tmp_path / "lake")]) == 1
    assert path.name in capsys.readouterr().err
