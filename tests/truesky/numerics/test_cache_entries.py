"""The entries of the cache: their kinds, sizes and last use; which are removed, and which a running process keeps."""

import ast
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lake_schema.errors import BadInput
from truesky.numerics import cache, cache_entries

ROOT = Path(__file__).parents[3]
DAY = 86_400.0


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))
    monkeypatch.delenv("TRUESKY_CACHE_LIMIT", raising=False)


def store(name, megabytes=1, age_days=0.0):
    """Let another process store an entry, so that no lease remains, and return its folder."""
    (folder,) = store_each({name: age_days}, megabytes)
    return folder


def store_each(ages, megabytes=1):
    """Let another process store entries by name; `ages` has the days since their last use. Return their folders."""
    code = (
        f"import numpy as np; from truesky.numerics import cache\nfor name in {list(ages)}:\n"
        f"    cache.cached_arrays(name, 'k', lambda: {{'a': np.zeros({int(megabytes * 125_000)})}})"
    )
    environment = {**os.environ, "TRUESKY_CACHE_LIMIT": "none"}
    subprocess.run([sys.executable, "-c", code], check=True, env=environment, cwd=ROOT)
    folders = [next(cache.cache_dir().glob(f"{name}-*")) for name in ages]
    for folder, days in zip(folders, ages.values(), strict=True):
        set_age(folder, days)
    return folders


def set_age(folder, days):
    os.utime(folder / cache_entries.CHECKSUM_FILE, (0, time.time() - days * DAY))


def stored_names():
    return sorted(path.name.partition("-")[0] for path in cache.cache_dir().iterdir() if path.name[0] != ".")


@pytest.mark.parametrize(
    ("text", "expected"),
    [(None, 5e9), ("", 5e9), ("2.5", 2.5e9), ("0", float("inf")), ("none", float("inf")), (" NONE ", float("inf"))],
)
def test_the_limit_is_read_from_the_environment(monkeypatch, text, expected):
    if text is not None:
        monkeypatch.setenv("TRUESKY_CACHE_LIMIT", text)
    assert cache_entries.limit_bytes() == expected


@pytest.mark.parametrize("text", ["5GB", "-1", "nan", "all"])
def test_a_wrong_limit_is_refused_before_anything_is_computed(monkeypatch, text):
    monkeypatch.setenv("TRUESKY_CACHE_LIMIT", text)
    with pytest.raises(BadInput, match=r"TRUESKY_CACHE_LIMIT = .* must be a number of GB >= 0, or none"):
        cache.cached_arrays("box_g", "k", lambda: pytest.fail("computed"))


def test_entries_have_kind_size_and_last_use():
    folder = store("lensing_256_3", age_days=3)
    (entry,) = cache_entries.entries(cache.cache_dir())
    assert (entry.folder, entry.kind) == (folder, "lensing")
    assert entry.size == sum(path.stat().st_size for path in folder.iterdir()) > 1e6
    assert time.time() - entry.last_use == pytest.approx(3 * DAY, abs=60)


def test_every_stored_name_has_a_kind():
    """Every name in a call of `cached_arrays` of the package belongs to a kind; only measured speeds are "other"."""
    names = set()
    for path in (ROOT / "truesky").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Call) and getattr(node.func, "attr", getattr(node.func, "id", "")) in (
                "cached_arrays", "_cached_field", "cached",
            ):  # fmt: skip
                texts = [text for text in node.args if isinstance(text, ast.Constant | ast.JoinedStr)]
                names |= {re.sub(r"\{[^}]*\}", "x", ast.unparse(text).removeprefix("f").strip("'\"")) for text in texts}
    assert len(names) > 20
    # The names of lensing maps begin with a variable.
    kinds = {name: cache_entries._kind(f"{name}-{'0' * 32}") for name in names if not name.startswith("x_")}
    kinds["lensing_256_kappa"] = cache_entries._kind(f"lensing_256_kappa-{'0' * 32}")
    assert {name for name, kind in kinds.items() if kind == "other"} == {"calibration"}
    assert set(kinds.values()) >= {"box", "lensing", "halos", "spectra", "fluxes", "dust", "catalogues"}


def test_machine_code_and_settings_are_entries_and_foreign_folders_are_not():
    root = cache.cache_dir()
    for name in (f"numba/{'a' * 16}/x", f"spark-{'b' * 16}/spark-conf", "colossus/a", "thing/b", "numba/other/x"):
        (root / name).mkdir(parents=True)
        (root / name / "file").write_bytes(bytes(10))
    found = {entry.kind: entry.size for entry in cache_entries.entries(root)}
    assert found == {"code": 10, "spark": 10}
    cache_entries.prune(root, cache_entries.entries(root), 0.0)
    assert not (root / "numba" / ("a" * 16)).exists()
    assert (root / "colossus/a/file").exists()
    assert (root / "numba/other/x/file").exists()


def test_the_least_recently_used_are_removed_first():
    store_each({"box_g": 1, "lensing_64_1": 3, "sersic": 2})
    root = cache.cache_dir()
    removal = cache_entries.prune(root, cache_entries.entries(root), 2.5e6)
    assert [entry.kind for entry in removal.removed] == ["lensing"]
    assert stored_names() == ["box_g", "sersic"]
    assert cache_entries.prune(root, cache_entries.entries(root), 2.5e6).removed == ()


def test_a_use_is_recorded_once_per_process():
    folder = store("sersic", age_days=2)

    def load():
        cache.cached_arrays("sersic", "k", lambda: pytest.fail("computed again"))

    load()
    assert time.time() - (folder / "sums.json").stat().st_mtime < 60
    set_age(folder, 2)
    load()
    assert time.time() - (folder / "sums.json").stat().st_mtime > DAY


def test_storing_an_entry_enforces_the_limit(monkeypatch):
    store_each({"box_g": 2, "box_u0": 1}, megabytes=2)
    monkeypatch.setenv("TRUESKY_CACHE_LIMIT", "0.0035")
    cache.cached_arrays("sersic", "k", lambda: {"a": np.zeros(125_000)})
    assert stored_names() == ["box_u0", "sersic"]
    # The limit is checked again after a minute, or for a large entry.
    store("box_u1", megabytes=3, age_days=1)
    cache.cached_arrays("halo_tables", "k", lambda: {"a": np.zeros(1)})
    assert stored_names() == ["box_u0", "box_u1", "halo_tables", "sersic"]
    os.utime(cache.cache_dir() / ".limit_checked", (0, time.time() - 61))
    cache.cached_arrays("halo_bias", "k", lambda: {"a": np.zeros(1)})
    assert stored_names() == ["halo_bias", "halo_tables", "sersic"]


def test_an_entry_larger_than_the_limit_is_kept_while_it_is_used(monkeypatch):
    """A process whose entries exceed the limit computes each of them once."""
    monkeypatch.setenv("TRUESKY_CACHE_LIMIT", "0.001")
    monkeypatch.setattr(cache_entries, "_LARGE_BYTES", 0.0)
    monkeypatch.setattr(cache_entries, "_RECENT_S", 0.0)
    calls = []
    for name in 2 * ("box_g", "box_u0", "lensing_64_1"):
        cache.cached_arrays(name, "k", lambda name=name: calls.append(name) or {"a": np.zeros(125_000)})
    assert calls == ["box_g", "box_u0", "lensing_64_1"]


USER = """
import sys
from truesky.numerics import cache
cache.cached_arrays("box_g", "k", lambda: sys.exit(3))
print("used", flush=True)
sys.stdin.read()
"""


def test_what_a_running_process_uses_is_kept_and_a_killed_process_keeps_nothing():
    folder, root = store("box_g", age_days=5), cache.cache_dir()
    with subprocess.Popen([sys.executable, "-c", USER], stdin=-1, stdout=-1, cwd=ROOT, env={**os.environ}) as user:
        assert user.stdout.readline() == b"used\n"
        set_age(folder, 5)
        removal = cache_entries.prune(root, cache_entries.entries(root), 0.0)
        assert [entry.folder for entry in removal.in_use] == [folder]
        assert folder.exists()
        user.kill()
    assert cache_entries.prune(root, cache_entries.entries(root), 0.0).in_use == ()
    assert not folder.exists()
    assert list((root / ".in_use").iterdir()) == []


def test_leases_of_ended_processes_do_not_accumulate():
    for number in range(3):
        store(f"box_u{number}")
    assert len(list((cache.cache_dir() / ".in_use").iterdir())) == 1


def test_an_entry_used_since_it_was_listed_is_kept():
    folder, root = store("box_g", age_days=5), cache.cache_dir()
    listed = cache_entries.entries(root)
    set_age(folder, 0)
    assert cache_entries.prune(root, listed, 0.0).removed == ()
    assert folder.exists()


def test_arrays_stay_readable_after_their_entry_is_removed():
    store("box_g", age_days=1)
    arrays = cache.cached_arrays("box_g", "k", lambda: pytest.fail("computed again"))
    cache_entries.remove(next(cache.cache_dir().glob("box_g-*")), cache.cache_dir())
    assert stored_names() == []
    assert not arrays["a"].any()
    assert cache.cached_arrays("box_g", "k", lambda: {"a": np.ones(2)})["a"].tolist() == [1.0, 1.0]


def test_rests_of_killed_processes_are_removed_after_a_day():
    root = cache.cache_dir()
    for name, days in ((".making-box_g-1", 2), (".gone-2", 2), (".making-box_g-3", 0.5)):
        (root / name).mkdir(parents=True)
        (root / name / "a.npy").write_bytes(bytes(10))
        os.utime(root / name, (0, time.time() - days * DAY))
    assert {entry.kind for entry in cache_entries.entries(root)} == {"leftover"}
    cache_entries.prune(root, cache_entries.entries(root), float("inf"))
    assert [path.name for path in root.iterdir() if path.name != ".in_use"] == [".making-box_g-3"]


def test_a_cache_without_write_permission_is_used_without_records(monkeypatch):
    folder = store("box_g", age_days=2)
    monkeypatch.setattr(cache_entries, "_lease", lambda process, root: (_ for _ in ()).throw(PermissionError()))
    cache.cached_arrays("box_g", "k", lambda: pytest.fail("computed again"))
    assert time.time() - (folder / "sums.json").stat().st_mtime > DAY


def test_a_missing_cache_has_no_entries(tmp_path):
    assert cache_entries.entries(tmp_path / "none") == []
