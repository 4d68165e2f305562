"""The cache: one make a key, published whole, mapped read-only."""

import os

import numpy as np
import pytest

from jobs import cache
from lake_schema.errors import BadInput


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("TRUESKY_CACHE", str(tmp_path / "cache"))


def test_folder_is_named_by_the_environment(monkeypatch, tmp_path):
    assert cache.cache_dir() == tmp_path / "cache"
    monkeypatch.delenv("TRUESKY_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "xdg"))
    assert cache.cache_dir() == tmp_path / "xdg" / "truesky"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache.cache_dir() == tmp_path / ".cache" / "truesky"


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
def test_keys_refuse_what_has_no_canonical_bytes(part):
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
    with pytest.raises(BadInput, match="nothing to store"):
        cache.cached_arrays("thing", "0" * 64, dict)
    assert os.listdir(cache.cache_dir()) == []


def test_the_loser_of_a_race_uses_the_winners_arrays():
    key = "1" * 64

    def slow():
        cache.cached_arrays("thing", key, lambda: {"a": np.full(3, 1.0)})
        return {"a": np.full(3, 2.0)}

    assert cache.cached_arrays("thing", key, slow)["a"].tolist() == [1.0, 1.0, 1.0]
    assert len(os.listdir(cache.cache_dir())) == 1


def test_an_array_cut_short_is_made_again():
    key = "2" * 64
    cache.cached_arrays("thing", key, lambda: {"a": np.arange(1000.0)})
    (file,) = cache.cache_dir().glob("*/a.npy")
    file.write_bytes(file.read_bytes()[:200])
    assert cache.cached_arrays("thing", key, lambda: {"a": np.zeros(3)})["a"].tolist() == [0.0] * 3


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
