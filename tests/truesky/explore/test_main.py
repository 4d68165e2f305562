"""The explorer's command line."""

import os
import shutil
import subprocess
import sys

import pandas as pd
import pytest

from lake_schema.errors import Damaged
from lake_schema.store import read
from truesky.explore.__main__ import main
from truesky.explore.explorer import Explorer


def test_a_table_of_the_tables(explored, capsys):
    assert main(["--lake", str(explored)]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name in ("galaxies", "galaxy_fluxes", "plain"))


def test_a_query_prints_its_rows(explored, capsys):
    assert main(["SELECT count(*) AS n FROM galaxies", "--lake", str(explored)]) == 0
    assert capsys.readouterr().out.split() == ["n", "500", "1", "rows"]


def test_a_file_in_place_of_a_query_is_refused(explored, capsys):
    assert main(["query.sql", "--lake", str(explored)]) == 2
    assert 'must be SQL, not a file: truesky sql LAKE "$(cat query.sql)"' in capsys.readouterr().err


def test_values_are_printed_with_their_digits(explored, capsys):
    query = "SELECT 53.123456789::DOUBLE AS a, 0.1::FLOAT AS b, NULL AS c, repeat('x', 99) AS d FROM range(99)"
    assert main([query, "--lake", str(explored)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].split() == ["a", "b", "c", "d"]
    assert lines[1].split() == ["53.12345679", "0.1", "<NA>", "x" * 47 + "..."]
    # The first and the last 20 rows are printed.
    assert len(lines) == 1 + 20 + 1 + 20 + 1
    assert lines[21].split() == ["..."] * 4


def test_no_process_of_a_query_imports_pandas(explored):
    """The import would take longer than most queries."""
    code = "import sys\nfrom truesky.explore.__main__ import main\nmain(sys.argv[1:])\nprint('pandas' in sys.modules)"
    query = ["SELECT count(*) AS n FROM galaxies", "--lake", str(explored)]
    environment = {**os.environ, "PYTHONPROFILEIMPORTTIME": "1"}
    done = subprocess.run([sys.executable, "-c", code, *query], capture_output=True, text=True, env=environment)
    assert done.stdout.split() == ["n", "500", "1", "rows", "False"]
    worker = [sys.executable, "-m", "truesky.explore.worker", str(explored), "1000000000"]
    done = subprocess.run(worker, input="", capture_output=True, text=True, env=environment)
    modules = [line.rpartition("|")[2].strip() for line in done.stderr.splitlines()]
    assert "pyarrow.dataset" in modules
    assert not [name for name in modules if name.startswith("pandas.")]


def test_a_query_into_a_file(explored, tmp_path, capsys):
    assert main(["SELECT id FROM plain", "--lake", str(explored), "--out", str(tmp_path / "x.csv")]) == 0
    assert "60 rows" in capsys.readouterr().out
    assert len(pd.read_csv(tmp_path / "x.csv")) == 60


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["DROP VIEW plain"], "SELECT"),
        (["SELECT 1", "--out", "x.xlsx"], "x.xlsx: the name of the file must end in .csv, .parquet, .fits or .vot\n"),
        (["SELECT 1", "--memory", "nan"], "memory = nan"),
        (["SELECT 1", "--memory", "inf"], "memory = inf"),
        (["SELECT 1", "--memory", "-1"], "--memory = -1.0 is outside [0.01, 1000000.0]"),
        (["SELECT 1", "--timeout", "nan"], "timeout = nan"),
        (["SELECT 1", "--timeout", "1e12"], "timeout = 1000000000000.0"),
        (["SELECT 1", "--timeout", "-1"], "timeout = -1"),
        (["SELECT 18446744073709551615::UBIGINT AS big", "--out", "x.fits"], "column big"),
        (["SELECT 1 AS a", "--out", "/no/such/folder/x.csv"], "no/such"),
        (
            ["SELECT count(*) FROM range(1000000) a(x), range(1000000) b(y) WHERE x * y < 0", "--timeout", "1"],
            "stopped after 1 s",
        ),
    ],
)
def test_errors_are_one_line(explored, capsys, arguments, words):
    assert main([*arguments, "--lake", str(explored)]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert len(err.strip().splitlines()) == 1


@pytest.mark.parametrize(("lake", "words"), [("", "empty"), (__file__, "not a folder"), ("~nouser/x", "nouser")])
def test_missing_lake_is_one_line(capsys, lake, words):
    assert main(["SELECT 1", "--lake", lake]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert len(err.strip().splitlines()) == 1


def test_an_identifier_beside_a_missing_one_is_printed_whole(explored, capsys):
    assert main([f"SELECT unnest([{2**53 + 1}, NULL]) AS id", "--lake", str(explored)]) == 0
    assert capsys.readouterr().out.split() == ["id", str(2**53 + 1), "<NA>", "2", "rows"]


def test_other_tables_remain_usable_beside_a_damaged_one(explored, capsys, tmp_path):
    shutil.copytree(explored, tmp_path / "lake", symlinks=True)
    shutil.rmtree(read.version(tmp_path / "lake", "plain").folder)
    manifest = read.version(tmp_path / "lake", "galaxy_fluxes").folder / "manifest.json"
    manifest.write_text("{}")
    lake = ["--lake", str(tmp_path / "lake")]
    assert main(lake) == 1
    damaged = [line.split()[0] for line in capsys.readouterr().out.splitlines() if " damaged " in line]
    assert damaged == ["galaxy_fluxes", "plain"]
    assert main(["SELECT count(*) FROM galaxies", *lake]) == 0
    assert main(["SELECT count(*) FROM plain", *lake]) == 1
    assert "which is missing" in capsys.readouterr().err
    assert main(["SELECT count(*) FROM galaxies JOIN galaxy_fluxes USING (id)", *lake]) == 1
    assert "manifest.json" in capsys.readouterr().err
    with Explorer(tmp_path / "lake") as explorer, pytest.raises(Damaged, match="missing"):
        explorer.describe("plain")


def test_a_lake_that_is_not_there(tmp_path, capsys):
    assert main(["SELECT 1", "--lake", str(tmp_path / "none")]) == 2
    assert "does not exist" in capsys.readouterr().err


def test_damage_ends_with_1(explored, capsys, tmp_path):
    shutil.copytree(explored, tmp_path / "lake", symlinks=True)
    version = read.version(tmp_path / "lake", "plain")
    path = version.partition_path(version.partitions[0])
    path.write_bytes(path.read_bytes()[:-1])
    assert main(["SELECT sum(value) FROM plain", "--lake", str(tmp_path / "lake")]) == 1
    assert path.name in capsys.readouterr().err
