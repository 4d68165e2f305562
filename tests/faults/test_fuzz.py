"""Mutated user files give an error line or a result, in bounded time and memory, without leftover files."""

import pytest

from tests.faults import fuzz

RUNS, MANY_RUNS = 10, 6_000
# Each mutation of a query starts a new DuckDB session for its parser, others copy a folder, and a split reads images.
SLOW = dict.fromkeys(
    ("SQL", "receipt", "area of a request", "catalogue, HATS", "camera, parameters", "partition", "stack, sealed",
     "split, checksums", "split, summary"), 4
)  # fmt: skip


@pytest.mark.parametrize("name", fuzz.TARGETS)
def test_mutations_are_read_or_refused(name):
    assert fuzz.run(name, 0, SLOW.get(name, RUNS)) == []


@pytest.mark.nightly
@pytest.mark.parametrize("name", fuzz.TARGETS)
def test_many_mutations_are_read_or_refused(name, tmp_path):
    assert fuzz.run(name, 0, MANY_RUNS, tmp_path) == []


class Faulty:
    """Readers that violate each of the rules."""

    @staticmethod
    def raises(path):
        raise AttributeError("x")

    @staticmethod
    def leaves(path):
        path.with_name("y").touch()

    @staticmethod
    def dies(path):
        import os

        os.kill(os.getpid(), 11)

    @staticmethod
    def lingers(path):
        while True:
            pass

    @staticmethod
    def says_much(path):
        from lake_schema.errors import BadInput

        # Past the place where every refusal becomes one line.
        error = BadInput("a")
        error.args = ("a\nb",)
        raise error


@pytest.mark.parametrize(
    ("reader", "words"),
    [
        ("raises", "AttributeError: x"), ("leaves", "leaves"), ("dies", "died"), ("says_much", "says 2 lines"),
        ("lingers", "TimeoutError"),
    ],
)  # fmt: skip
def test_violations_of_the_rules_are_detected(monkeypatch, reader, words):
    calls = []

    def read(path):
        # The first is the seed, which is good.
        calls.append(path)
        if len(calls) > 1:
            getattr(Faulty, reader)(path)

    monkeypatch.setattr(fuzz, "MOST_SECONDS", 0.1)
    monkeypatch.setitem(fuzz.TARGETS, "faulty", fuzz.Target(lambda: [b"seed"], read))
    (found,) = fuzz.run("faulty", 0, 1)
    assert found[0] == 0
    assert words in found[1]


def test_mutations_are_reproducible():
    seeds = [b"one = 1", b"two = [2, 3]"]
    assert [fuzz.mutated(seeds, n) for n in range(50)] == [fuzz.mutated(seeds, n) for n in range(50)]
    assert len({fuzz.mutated(seeds, n) for n in range(500)}) > 300


@pytest.mark.parametrize(
    ("name", "number"),
    [
        ("spectrum, FITS", 3610),
        ("PSF, cube", 3633),
        ("PSF, PSFEx", 3153),
        ("manifest", 481),
        ("manifest", 4206),
        ("manifest", 9229),
        ("bodies, FITS", 4175),
        ("path", 156),
        ("path", 816),
        ("path", 9385),
        ("pointings", 865),
        ("pointings", 1436),
        ("pointings", 1856),
        ("Tycho-2", 17636),
        ("cache, array", 28),
        ("cache, array", 176),
        ("receipt", 8),
        ("head file", 1),
        ("area of a request", 37),
        ("master, sealed", 115),
        ("image, sealed", 228),
        ("calibrated image, sealed", 116),
        ("frame with WCS", 659),
        ("stack, sealed", 3021),
        ("stack, sealed", 3580),
    ],
)
def test_inputs_that_once_failed_are_refused(name, number):
    """Examples: a column without numbers, a number of 40 digits, a huge degree, seal, key or number of axes."""
    assert fuzz.run(name, number, 1) == []
