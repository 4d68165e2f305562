"""The cache: one make a key, published whole, mapped read-only."""

import errno
import os
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from lake_schema.errors import BadInput
from lake_schema.store import blocks
from truesky.numerics import cache


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))


def stored_names():
    """The names in the cache's folder, but for that with the names of the entries in use."""
    return sorted(name for name in os.listdir(cache.cache_dir()) if name != ".in_use")


def test_folder_is_named_by_the_environment(monkeypatch, tmp_path):
    assert cache.cache_dir() == tmp_path / "cache"
    monkeypatch.delenv("TRUESKY_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.cache_dir() == tmp_path / "xdg" / "truesky"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache.cache_dir() == tmp_path / ".cache" / "truesky"


def test_old_entries_alone_are_removed_between_runs(tmp_path):
    """The script of continuous integration leaves what is no entry of the cache, however old it is."""
    root, folder = Path(__file__).resolve().parents[3], cache.cache_dir()
    cache.cached_arrays("new", "ab", lambda: {"a": np.zeros(1)})
    cache.cached_arrays("old", "ab", lambda: {"a": np.zeros(1)})
    code = ("numba/0123456789abcdef", "numba/fedcba9876543210", "numba/other", "documents")
    for name in code:
        (folder / name).mkdir(parents=True)
    new, old = (next(folder.glob(f"{name}-*")) for name in ("new", "old"))
    for path in (old, *(folder / name for name in code if not name.endswith("f"))):
        os.utime(path, (0, 0))
    subprocess.run([root / ".ci" / "trim_cache", folder], check=True)
    left = {path.relative_to(folder).as_posix() for path in (*folder.iterdir(), *(folder / "numba").iterdir())}
    left.discard(".in_use")
    assert left == {new.name, "numba", "documents", "numba/other", "numba/0123456789abcdef"}


def test_keys_tell_parts_types_and_shapes_apart():
    flat = np.arange(6.0)
    keys = [
        cache.content_key("ab", "c"),
        cache.content_key("a", "bc"),
        cache.content_key(b"ab", "c"),
        cache.content_key("abc"),
        cache.content_key(1),
        cache.content_key(1.0),
        cache.content_key("1"),
        cache.content_key(flat),
        cache.content_key(flat.reshape(2, 3)),
        cache.content_key(flat.astype(np.float32)),
        cache.content_key(flat, flat),
    ]
    assert len(set(keys)) == len(keys)


def test_key_is_of_the_content_not_of_the_memory_layout():
    square = np.arange(9.0).reshape(3, 3)
    assert cache.content_key(square.T) == cache.content_key(np.ascontiguousarray(square.T))
    assert cache.content_key(square.T) != cache.content_key(square)


@pytest.mark.parametrize("part", [None, True, {"a": 1}, np.array([object()])])
def test_keys_refuse_unsupported_types(part):
    with pytest.raises(BadInput):
        cache.content_key(part)


def test_made_once_then_mapped():
    calls = []

    def make():
        calls.append(1)
        return {"flux": np.arange(5.0), "names": np.array(["a", "b"])}

    first = cache.cached_arrays("thing", cache.content_key("k"), make)
    again = cache.cached_arrays("thing", cache.content_key("k"), make)
    assert len(calls) == 1
    np.testing.assert_array_equal(first["flux"], again["flux"])
    assert list(again["names"]) == ["a", "b"]
    with pytest.raises(ValueError, match="read-only"):
        again["flux"][0] = 1.0
    cache.cached_arrays("thing", cache.content_key("other"), make)
    assert len(calls) == 2


def test_a_failed_make_leaves_nothing():
    def make():
        raise RuntimeError("no")

    with pytest.raises(RuntimeError):
        cache.cached_arrays("thing", "0" * 64, make)
    with pytest.raises(ValueError, match="allow_pickle"):
        cache.cached_arrays("thing", "0" * 64, lambda: {"a": np.ones(2), "b": np.array([object()])})
    with pytest.raises(BadInput, match="returned no arrays"):
        cache.cached_arrays("thing", "0" * 64, dict)
    assert stored_names() == []


def test_a_full_disc_is_named(tmp_path):
    """The file of the array is a device that is always full."""

    def make():
        (staged,) = cache.cache_dir().glob(".making-thing-*")
        (staged / "a.npy").symlink_to("/dev/full")
        return {"a": np.zeros(5000)}

    with pytest.raises(OSError, match=f"No space left on device: '{tmp_path / 'cache'}'") as caught:
        cache.cached_arrays("thing", "0" * 64, make)
    assert caught.value.errno == errno.ENOSPC
    assert stored_names() == []


def test_stored_files_are_those_of_numpy(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3).T, "b": np.array(["x", "yz"]), "c": np.zeros((0, 2)), "d": np.array(1)}
    cache.cached_arrays("thing", "0" * 64, lambda: arrays)
    for name, array in arrays.items():
        np.save(tmp_path / name, np.ascontiguousarray(array))
        (stored,) = cache.cache_dir().glob(f"thing-*/{name}.npy")
        assert stored.read_bytes() == (tmp_path / f"{name}.npy").read_bytes()


def test_the_loser_of_a_race_uses_the_winners_arrays(monkeypatch):
    """Processes that do not wait for each other, as on file systems without locks, use what was stored first."""
    key = "1" * 64
    monkeypatch.setattr(cache, "_MAX_WAIT_S", 0.0)

    def slow():
        cache.cached_arrays("thing", key, lambda: {"a": np.full(3, 1.0)})
        return {"a": np.full(3, 2.0)}

    assert cache.cached_arrays("thing", key, slow)["a"].tolist() == [1.0, 1.0, 1.0]
    assert len(stored_names()) == 1


def test_others_wait_for_the_one_that_computes():
    calls, results = [], []

    def make():
        calls.append(1)
        time.sleep(0.3)
        assert any(name.startswith(".making-thing-") for name in stored_names())
        return {"a": np.ones(3)}

    def load():
        results.append(cache.cached_arrays("thing", "9" * 64, make)["a"].tolist())

    threads = [threading.Thread(target=load) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (len(calls), results) == (1, 3 * [[1.0, 1.0, 1.0]])
    assert len(stored_names()) == 1


MAKER = """
import sys
from truesky.numerics import cache
cache.cached_arrays("thing", "a" * 64, lambda: print("making", flush=True) or sys.stdin.read())
"""


def test_a_killed_process_does_not_hold_the_others_up():
    root = Path(__file__).resolve().parents[3]
    with subprocess.Popen([sys.executable, "-c", MAKER], stdin=-1, stdout=-1, cwd=root, env={**os.environ}) as maker:
        assert maker.stdout.readline() == b"making\n"
        maker.kill()
    start = time.perf_counter()
    assert cache.cached_arrays("thing", "a" * 64, lambda: {"a": np.ones(1)})["a"] == 1.0
    assert time.perf_counter() - start < 10.0
    # The rest of the killed process remains for a day.
    assert [name[:13] for name in stored_names()] == [".making-thing", f"thing-{stored_names()[1][6:13]}"]


def test_entries_are_made_without_locks_where_there_are_none(monkeypatch):
    def refuse(descriptor, operation):
        raise OSError(95, "Operation not supported")

    monkeypatch.setattr(cache.fcntl, "flock", refuse)
    assert cache.cached_arrays("thing", "b" * 64, lambda: {"a": np.ones(1)})["a"] == 1.0
    assert list((cache.cache_dir() / ".in_use").iterdir()) == []


def test_an_array_cut_short_is_made_again():
    key = "2" * 64
    cache.cached_arrays("thing", key, lambda: {"a": np.arange(1000.0)})
    (file,) = cache.cache_dir().glob("t*/a.npy")
    file.write_bytes(file.read_bytes()[:200])
    assert cache.cached_arrays("thing", key, lambda: {"a": np.zeros(3)})["a"].tolist() == [0.0] * 3


def made_again(key, value):
    """The arrays of a key, made of this value where they are made."""
    return cache.cached_arrays("thing", key, lambda: {"a": np.full(1000, value), "b": np.full(3, value)})


@pytest.mark.parametrize("step", [1009, pytest.param(7, marks=pytest.mark.nightly)])
def test_files_with_a_changed_bit_are_computed_again_with_a_warning(caplog, monkeypatch, step):
    """Bits change in the arrays, in their headers, and in the list of checksums."""
    monkeypatch.setattr(os, "fsync", lambda descriptor: None)
    key, files = "4" * 64, 0
    made_again(key, 1.0)
    for path in sorted(cache.cache_dir().glob("t*/*")):
        whole = path.read_bytes()
        for bit in range(0, 8 * len(whole), step):
            data = bytearray(whole)
            data[bit // 8] ^= 1 << bit % 8
            path.write_bytes(data)
            caplog.clear()
            found = made_again(key, 2.0)
            if path.suffix == ".npy" or found["a"][0] == 2.0:
                assert set(found["a"].tolist()) == set(found["b"].tolist()) == {2.0}, f"bit {bit} of {path}"
                (line,) = (record.getMessage() for record in caplog.records)
                assert str(path.parent) in line
                assert line.endswith(": computed again")
                assert "\n" not in line
            else:
                # White space of the list.
                assert set(found["a"].tolist()) == set(found["b"].tolist()) == {1.0}
            made = cache.cache_dir() / path.parent.name
            assert stored_names() == [made.name]
            if found["a"][0] == 2.0:
                for file in made.iterdir():
                    file.unlink()
                made.rmdir()
            else:
                path.write_bytes(whole)
            made_again(key, 1.0)
        files += 1
    assert files == 3


def test_zeroed_blocks_are_made_again():
    key = "5" * 64
    cache.cached_arrays("thing", key, lambda: {"a": np.arange(1e5)})
    (file,) = cache.cache_dir().glob("t*/a.npy")
    with file.open("r+b") as stream:
        stream.seek(4096 * 20)
        stream.write(bytes(4096))
    again = cache.cached_arrays("thing", key, lambda: {"a": np.arange(1e5)})
    np.testing.assert_array_equal(again["a"], np.arange(1e5))


def test_a_process_compares_a_file_once(monkeypatch):
    key, seen = "6" * 64, []
    made_again(key, 1.0)
    real = blocks.crc32
    monkeypatch.setattr(blocks, "crc32", lambda path: seen.append(path.name) or real(path))
    for _ in range(3):
        made_again(key, 2.0)
    assert seen == []
    for path in cache.cache_dir().glob("t*/*.npy"):
        os.utime(path)
    for _ in range(3):
        assert made_again(key, 2.0)["a"][0] == 1.0
    assert sorted(seen) == ["a.npy", "b.npy"]


def test_what_is_stored_is_synced_before_it_has_its_name(monkeypatch):
    calls = []
    rename, fsync = os.rename, os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: calls.append(os.readlink(f"/proc/self/fd/{fd}")) or fsync(fd))
    monkeypatch.setattr(os, "rename", lambda a, b: calls.append(f"rename {b}") or rename(a, b))
    made_again("7" * 64, 1.0)
    (last,) = (i for i, call in enumerate(calls) if call.startswith("rename"))
    synced = {os.path.basename(call) for call in calls[:last]}
    assert {"a.npy", "b.npy"} <= synced
    assert any(call.endswith((".tmp", "sums.json")) for call in calls[:last])
    assert str(cache.cache_dir()) in calls[last:]


def test_arrays_without_a_seal_are_made_again(caplog):
    key = "8" * 64
    made_again(key, 0.0)
    (seal,) = cache.cache_dir().glob("t*/sums.json")
    seal.unlink()
    assert made_again(key, 1.0)["a"][0] == 1.0
    assert "sums.json" in caplog.text
    assert "computed again" in caplog.text


@pytest.mark.parametrize("name", ["../evil", "a/b", "", ".hidden"])
def test_names_stay_inside(name):
    with pytest.raises(BadInput):
        cache.cached_arrays(name, "3" * 64, lambda: {"a": np.zeros(1)})
    with pytest.raises(BadInput):
        cache.cached_arrays("fine", "3" * 64, lambda: {name: np.zeros(1)})


def test_another_kind_of_machine_makes_its_own(monkeypatch):
    def made(value):
        return cache.cached_arrays("toy", "k" * 32, lambda: {"a": np.array([value])})["a"][0]

    assert [made(1), made(2)] == [1, 1]
    monkeypatch.setattr(cache, "machine", lambda: "another")
    assert [made(3), made(4)] == [3, 3]
    monkeypatch.undo()
