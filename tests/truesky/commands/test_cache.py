"""The command `truesky cache` lists the entries of the cache and removes some of them."""

import json
import os
import time

import numpy as np
import pytest

from truesky.commands import __main__ as truesky
from truesky.numerics import cache, cache_entries

DAY = 86_400.0


@pytest.fixture(autouse=True)
def entries(tmp_path, monkeypatch):
    """Three entries of three kinds with 1 MB each, which were used 1, 2 and 3 days ago."""
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("TRUESKY_CACHE_LIMIT", raising=False)
    # This process uses the entries; pretend that it does not, so that they can be removed.
    monkeypatch.setattr(cache_entries, "record_use", lambda root, folder: None)
    for days, name in enumerate(("box_g", "lensing_64_1", "sersic"), 1):
        cache.cached_arrays(name, "k", lambda: {"a": np.zeros(125_000)})
        (folder,) = cache.cache_dir().glob(f"{name}-*")
        os.utime(folder / "sums.json", (0, time.time() - days * DAY))
    return cache.cache_dir()


def run(capsys, *arguments):
    status = truesky.main(["cache", *arguments])
    out, err = capsys.readouterr()
    return status, out, err


def kinds():
    return {entry.kind for entry in cache_entries.entries(cache.cache_dir())}


def test_the_list_has_a_line_per_kind(capsys, entries):
    status, out, err = run(capsys)
    lines = out.splitlines()
    assert (status, err) == (0, "")
    assert lines[0].split() == ["kind", "contents", "entries", "GB", "last", "use"]
    assert {line.split()[0] for line in lines[1:4]} == {"box", "lensing", "psf"}
    assert next(line for line in lines if line.startswith("lensing")).endswith("1    0.001  2 days ago")
    assert lines[4] == f"{entries}: 3 entries, 0.003 GB; limit 5 GB"
    assert max(map(len, lines[:4])) <= 80


def test_json_has_the_same_numbers(capsys, entries):
    described = json.loads(run(capsys, "--json", "--entries")[1])
    assert described["folder"] == str(entries)
    assert described["limit_bytes"] == 5e9
    assert described["bytes"] == sum(row["bytes"] for row in described["kinds"].values()) > 3e6
    assert {kind: row["entries"] for kind, row in described["kinds"].items()} == {"box": 1, "lensing": 1, "psf": 1}
    assert [entry["kind"] for entry in described["entries"]] == ["psf", "lensing", "box"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        ((), {"box", "lensing", "psf"}),
        (("--limit", "0.0025"), {"box", "lensing"}),
        (("--limit", "0.0025", "--kind", "box", "psf"), {"box", "lensing", "psf"}),
        (("--all",), set()),
        (("--all", "--kind", "lensing"), {"box", "psf"}),
        (("--older-than", "1.5"), {"box"}),
    ],
)
def test_prune_removes_the_selected_entries(capsys, arguments, expected):
    status, out, _ = run(capsys, "--prune", *arguments)
    assert status == 0
    assert kinds() == expected
    assert out.startswith(f"removed {3 - len(expected)} ")


def test_the_limit_of_the_environment_counts(capsys, monkeypatch):
    monkeypatch.setenv("TRUESKY_CACHE_LIMIT", "0.0015")
    assert "limit 0.0015 GB" in run(capsys, "--prune")[1]
    assert kinds() == {"box"}


def test_entries_in_use_are_kept_and_reported(capsys, monkeypatch):
    monkeypatch.setattr(cache_entries, "used_names", lambda root: {next(root.glob("box_g-*")).name})
    assert "kept 1 entry, 0.001 GB, which a running process uses" in run(capsys, "--prune", "--all")[1]
    assert kinds() == {"box"}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--all",), "--all, --limit and --older-than require --prune"),
        (("--prune", "--limit", "-1"), "--limit -1 must be at least 0"),
        (("--prune", "--older-than", "nan"), "--older-than nan must be at least 0"),
    ],
)
def test_wrong_options_are_refused_in_one_line(capsys, arguments, message):
    assert run(capsys, *arguments) == (2, "", f"truesky cache: {message}\n")
    assert kinds() == {"box", "lensing", "psf"}


def test_an_empty_cache_is_listed(capsys, monkeypatch, tmp_path):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "none"))
    status, out, _ = run(capsys)
    assert status == 0
    assert out.splitlines()[-1] == f"{tmp_path / 'none'}: 0 entries, 0.000 GB; limit 5 GB"
