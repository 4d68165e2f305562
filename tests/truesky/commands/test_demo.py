"""Errors and help of the demo. The jobs are tested with `truesky run`."""

from pathlib import Path

import pytest

from lake_schema import __version__
from truesky.commands import demo, run


def test_a_folder_that_is_none_is_refused_before_the_first_job(tmp_path, capsys, monkeypatch):
    monkeypatch.delattr(run, "run")
    (tmp_path / "file").touch()
    for out in (tmp_path / "file", Path("s3://bucket/x")):
        assert demo.main(["--out", str(out)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2


def test_help_tells_the_version(capsys):
    with pytest.raises(SystemExit, match="0"):
        demo.main(["--help"])
    assert f"truesky {__version__}" in capsys.readouterr().out
