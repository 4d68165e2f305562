"""Errors and help of the demo. The jobs are tested with `truesky run`."""

import pytest

from lake_schema import __version__
from truesky.commands import demo, examples
from truesky.running import supervise


def test_the_demo_is_a_run_with_all_results_in_one_folder(monkeypatch):
    calls = []
    monkeypatch.setattr(supervise, "supervise", lambda *arguments: calls.append(arguments) or 3)
    assert demo.main(["--out", "out/my demo"]) == 3
    request = str(examples.request_file("demo"))
    words = [request, "--lake", "out/my demo/lake", "--pictures", "out/my demo"]
    again = f"python -m truesky.commands.demo --request {request} --out 'out/my demo'"
    assert calls == [("demo", ["-m", "truesky.commands.local_run", *words], again)]


def test_help_tells_the_version(capsys):
    with pytest.raises(SystemExit, match="0"):
        demo.main(["--help"])
    assert f"truesky {__version__}" in capsys.readouterr().out
