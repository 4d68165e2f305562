"""Run readers of user files on mutations of valid files, of their structure and of their bytes.

A reader returns or raises a LakeError of one line (for several mistakes, one line each), within bounds of time and
memory, and writes nothing. Mutations are numbered: the same number of a target is the same input, on any machine.

    python -m tests.faults.fuzz [TARGET ...] [--runs 20000 | --total 1000000] [--first 0]

prints a table of the targets, with the number of inputs that were refused and accepted, the violations, and the inputs
per second. What broke is printed below its target, and its input is kept in the folder of temporary files. A run that
was stopped goes on if --first is the number of mutations that each target has had.
"""

import argparse
import faulthandler
import json
import os
import random
import re
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from lake_schema.errors import BadInput, LakeError
from tests.faults import frame_targets, fuzz_targets, lake_targets

MOST_SECONDS, MOST_BYTES, MOST_CHARACTERS = 10.0, 512 << 20, 2000
# Wall time after which a mutation's process is ended: one that waits takes no CPU time.
MOST_WAIT = 300
NUMBERS = (
    "0", "-1", "1", "2", "-0.0", "nan", "inf", "-inf", "1e308", "1e-320", "1e400", "9" * 18, "9" * 19, "9" * 40,
    "9" * 5000, "2147483648", "4294967296", "-9223372036854775808", "9223372036854775807", "0x7f", "1_0", "1e", "0.5",
    "360", "90.1",
)  # fmt: skip
WORDS = (
    "\0", "\n", "\r\n", "\ufeff", "\u00e9", "\U0001f300", '"', "'", "\\", "\\u0000", "[", "]", "{", "}", "(", ")", ",",
    ";", "=", ".", "..", "/", "~x", "../", "#", "<", ">", "&", "%", "|", "true", "null", "NaN", "", " " * 80, "x" * 300,
    "a." * 50, "[" * 50, "{a=" * 50, "T", "F", "P", "Q", "PE(9)", "1D", "0D", "9999999D", "A", "XTENSION", "END",
    "NAXIS", "TDIM1",
)  # fmt: skip
_NUMBER = re.compile(rb"[+-]?\d[\d.eE+_-]*")
_WORD = re.compile(rb"[A-Za-z_][\w-]*")


@dataclass(frozen=True)
class Target:
    """Reader of a kind of file, and inputs for it.

    `seeds` returns valid inputs. `read` reads a file whose name has the given ending. `may_die` is true if the program
    runs this reader in a separate process, which may crash.
    """

    seeds: Callable[[], list[bytes]]
    read: Callable[[Path], object]
    ending: str = ""
    may_die: bool = False


TARGETS = {
    name: Target(*rest) for name, rest in (fuzz_targets.TARGETS | lake_targets.TARGETS | frame_targets.TARGETS).items()
}


# ------------------------------------------------------------------------------------------------ mutations


def mutated(seeds, number):
    """Return mutation `number`: one to six changes of one of the seeds."""
    rng = random.Random(number)
    data = rng.choice(seeds)
    for _ in range(rng.choice((1, 1, 1, 2, 3, 6))):
        data = rng.choice(CHANGES)(data, rng, seeds)
    return data[: 4 << 20]


def _place(data, rng):
    return rng.randrange(len(data) + 1)


def _span(data, rng):
    start = _place(data, rng)
    return start, min(len(data), start + rng.choice((1, 1, 2, 4, 8, 16, 80, 81, 500, 2880)))


def flip(data, rng, seeds):
    at = _place(data, rng)
    return data[:at] + bytes(b ^ (1 << rng.randrange(8)) for b in data[at : at + 1]) + data[at + 1 :]


def strange(data, rng, seeds):
    start, stop = _span(data, rng)
    fill = rng.choice((b"\0", b"\xff", b"\x80", b" ", rng.randbytes(1)))
    return data[:start] + fill * (stop - start) + data[stop:]


def cut(data, rng, seeds):
    start, stop = _span(data, rng)
    return rng.choice((data[:start], data[:start] + data[stop:], data[start:]))


def repeat(data, rng, seeds):
    start, stop = _span(data, rng)
    return data[:start] + data[start:stop] * rng.choice((2, 3, 50, 1000)) + data[stop:]


def move(data, rng, seeds):
    start, stop = _span(data, rng)
    rest = data[:start] + data[stop:]
    at = _place(rest, rng)
    return rest[:at] + data[start:stop] + rest[at:]


def splice(data, rng, seeds):
    other = rng.choice(seeds)
    return data[: _place(data, rng)] + other[_place(other, rng) :]


def insert(data, rng, seeds):
    at = _place(data, rng)
    return data[:at] + rng.choice(WORDS).encode() + data[at:]


def _replaced(pattern, choices, data, rng, same_length):
    found = [match.span() for match in pattern.finditer(data[: 1 << 16])]
    if not found:
        return data
    start, stop = rng.choice(found)
    new = rng.choice(choices).encode()
    # Half of the replacements keep the length, because some formats have columns of fixed width.
    if same_length:
        new = new[: stop - start].rjust(stop - start)
    return data[:start] + new + data[stop:]


def number(data, rng, seeds):
    return _replaced(_NUMBER, NUMBERS, data, rng, rng.random() < 0.5)


def word(data, rng, seeds):
    return _replaced(_WORD, WORDS, data, rng, rng.random() < 0.5)


def line(data, rng, seeds):
    lines = data.split(b"\n")
    a, b = rng.randrange(len(lines)), rng.randrange(len(lines))
    lines[a], lines[b] = rng.choice(
        ((lines[b], lines[a]), (lines[b], lines[b]), (b"", lines[b]), (lines[a] * 9, lines[b]))
    )
    return b"\n".join(lines)


def card(data, rng, seeds):
    """Replace the value of a FITS card, or move the card."""
    if not data.startswith(b"SIMPLE"):
        return number(data, rng, seeds)
    end = 80 * rng.choice((30, 40, 80))
    cards = [i for i in range(0, min(len(data), end), 80) if data[i + 8 : i + 10] == b"= "]
    if len(cards) < 2:
        return data
    a, b = rng.choice(cards), rng.choice(cards)
    if rng.random() < 0.3:
        return data[:a] + data[b : b + 80] + data[a + 80 :]
    value = rng.choice((*NUMBERS, *(f"'{text}'" for text in WORDS))).encode()[:70]
    return data[: a + 10] + value.ljust(70) + data[a + 80 :]


CHANGES = (flip, strange, cut, repeat, move, splice, insert, number, number, word, word, line, card, card)


# ------------------------------------------------------------------------------------------------ running


def _too_long(signum, frame):
    raise TimeoutError("has not come back in time")


def judged(target, path):
    """Return the fault of a reader for a file ("" if the reader is correct), and whether it refused the file."""
    started, is_refused = time.process_time(), False
    signal.setitimer(signal.ITIMER_PROF, 5 * MOST_SECONDS)
    try:
        target.read(path)
    except LakeError as error:
        is_refused, said = True, str(error)
        mistakes = error.messages if isinstance(error, BadInput) else (said,)
        if len(said.splitlines()) > len(mistakes) or max(map(len, mistakes)) > MOST_CHARACTERS:
            return f"says {len(said.splitlines())} lines, {len(said)} characters: {said[:200]!r}", True
    except BaseException as error:
        calls = [f"{call.filename}:{call.lineno}" for call in traceback.extract_tb(error.__traceback__)]
        ours = next((call for call in reversed(calls) if "site-packages" not in call), "")
        return f"{type(error).__name__}: {str(error)[:150]} ({calls[-1]}; {ours})", False
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
    seconds = time.process_time() - started
    return f"takes {seconds:.1f} s" if seconds > MOST_SECONDS else "", is_refused


def _child(target, seeds, folder, numbers, report):
    """Run mutations in a separate process, which may crash."""
    faulthandler.disable()
    signal.signal(signal.SIGPROF, _too_long)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    path = folder / "in" / f"x{target.ending}"
    base = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    for n in numbers:
        path.write_bytes(mutated(seeds, n))
        (folder / "number").write_text(str(n))
        signal.alarm(MOST_WAIT)
        wrong, is_refused = judged(target, path)
        if not wrong and (peak := resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10) > base + MOST_BYTES:
            wrong, base = f"takes {(peak - base) >> 20} MB", peak
        there = sorted(p.name for p in (*(folder / "in").iterdir(), *(folder / "empty").iterdir()))
        if there != [path.name] and not wrong:
            wrong = f"leaves {there}"
        report.write(json.dumps([n, wrong, is_refused]) + "\n")
        report.flush()


def run(name, first, count, keep=None, outcomes=None):
    """Return (number, fault) of mutations that a target handles wrongly; inputs are kept in the folder `keep`.

    The numbers of refused and of accepted inputs are added to the Counter `outcomes`. An input whose process died
    counts as refused if the target may die.
    """
    target, outcomes = TARGETS[name], Counter() if outcomes is None else outcomes
    folder = Path(tempfile.mkdtemp(prefix="fuzz-"))
    try:
        (folder / "in").mkdir()
        (folder / "empty").mkdir()
        seeds = target.seeds()
        for seed in seeds:
            (folder / "in" / f"x{target.ending}").write_bytes(seed)
            # Imports and caches are slow only the first time.
            target.read(folder / "in" / f"x{target.ending}")
        found, last = [], first + count
        while first < last:
            (folder / "report").write_text("")
            if not (child := os.fork()):
                _in_child(target, seeds, folder, range(first, last))
            status = os.waitpid(child, 0)[1]
            entries = [json.loads(entry) for entry in (folder / "report").read_text().splitlines()]
            found += [(n, wrong) for n, wrong, _ in entries if wrong]
            outcomes.update("refused" if is_refused else "accepted" for _, wrong, is_refused in entries if not wrong)
            first = last
            if status:
                first = int((folder / "number").read_text()) + 1
                outcomes["refused"] += target.may_die
                if not target.may_die:
                    found.append((first - 1, f"its process died, status {status}"))
        for n, _ in found if keep else ():
            (keep / f"{name.replace(' ', '_')}-{n}{target.ending}").write_bytes(mutated(seeds, n))
        return found
    finally:
        shutil.rmtree(folder)


def _in_child(target, seeds, folder, numbers):
    status = 1
    try:
        os.chdir(folder / "empty")
        null = os.open(os.devnull, os.O_WRONLY)
        os.dup2(null, 1)
        os.dup2(null, 2)
        with (folder / "report").open("a") as report:
            _child(target, seeds, folder, numbers, report)
        status = 0
    finally:
        os._exit(status)


def main(argv):
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("targets", nargs="*", default=list(TARGETS))
    parser.add_argument("--runs", type=int, default=20_000)
    parser.add_argument("--total", type=int, help="number of inputs of all targets together, instead of --runs")
    parser.add_argument("--first", type=int, default=0)
    options = parser.parse_args(argv)
    keep, broken = Path(tempfile.mkdtemp(prefix="fuzz-found-")), 0
    runs = -(-options.total // len(options.targets)) if options.total else options.runs
    print(f"{'target':26} {'cases':>9} {'refused':>9} {'accepted':>9} {'violations':>10} {'cases/s':>8}")
    for name in options.targets:
        started, outcomes = time.monotonic(), Counter()
        found = run(name, options.first, runs, keep, outcomes)
        broken += len(found)
        counts = (runs, outcomes["refused"], outcomes["accepted"], len(found))
        rate = runs / (time.monotonic() - started)
        print(f"{name:26} {counts[0]:9,} {counts[1]:9,} {counts[2]:9,} {counts[3]:10,} {rate:8.1f}", flush=True)
        seen = set()
        for n, what in found:
            if (kind := re.sub(r"\d+", "9", what)[:160]) not in seen:
                seen.add(kind)
                print(f"    {n}: {what}", flush=True)
    print(f"inputs of what broke: {keep}" if broken else "nothing broke")
    return int(bool(broken))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
