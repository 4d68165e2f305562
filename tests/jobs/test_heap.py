"""Memory that is kept while arrays come and go, and given back."""

import platform
import resource

import numpy as np
import pytest

from jobs import heap
from jobs.measured import forget_peak, peak_gb

MEGABYTES = 64

# Told by the system, not by what is tested: a `heap` that no longer finds the library fails here.
on_gnu = pytest.mark.skipif(
    platform.libc_ver()[0] != "glibc",
    reason="only GNU's C library can be told to keep memory; that others are left alone is tested below, everywhere",
)


def faults_of_new_arrays(count):
    """How often memory had to be asked for, for arrays that live one after the other."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(count):
        np.ones(MEGABYTES << 17)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def held_now():
    forget_peak()
    return peak_gb()


@on_gnu
def test_later_arrays_find_the_memory_of_those_before():
    usual = faults_of_new_arrays(10)
    with heap.kept():
        faults_of_new_arrays(1)
        assert faults_of_new_arrays(10) < 0.2 * usual
    assert faults_of_new_arrays(10) > 0.5 * usual


@on_gnu
def test_it_is_given_back():
    before = held_now()
    with heap.kept():
        faults_of_new_arrays(4)
        assert held_now() > before + 0.8 * MEGABYTES / 1e3
    assert held_now() < before + 0.3 * MEGABYTES / 1e3


@on_gnu
def test_it_is_given_back_after_an_error():
    before = held_now()

    @heap.kept()
    def fails():
        faults_of_new_arrays(1)
        raise KeyError

    with pytest.raises(KeyError):
        fails()
    assert held_now() < before + 0.3 * MEGABYTES / 1e3


def no_such_library(name):
    raise OSError(f"{name}: not found")


@pytest.mark.parametrize("opened", [lambda name: object(), no_such_library])
def test_another_library_is_left_alone(monkeypatch, opened):
    """One without GNU's functions, and none at all: memory is asked for as often as ever."""
    usual = faults_of_new_arrays(4)
    monkeypatch.setattr(heap.ctypes, "CDLL", opened)
    monkeypatch.setattr(heap, "_library", heap._library.__wrapped__)
    with heap.kept():
        faults_of_new_arrays(1)
        assert faults_of_new_arrays(4) > 0.5 * usual
