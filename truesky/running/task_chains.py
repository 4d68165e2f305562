"""Divide tasks into the lists that Spark workers run, so that tasks with common data run one after the other.

A chain is a sequence of tasks of which each uses data that the previous ones have left in memory. A worker runs the
tasks of a list in their order. Results never depend on the division: a task makes missing data itself.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

from lake_schema.store.plan import Task

# Number of lists per worker process into which the tasks are at least divided, if there are enough tasks, so that all
# workers end at about the same time.
_LISTS_PER_WORKER = 4
# Longest estimated time of a list of several tasks, s. It limits what a lost worker leaves unfinished, and divides the
# tasks for a cluster whose workers start after the driver.
_LONGEST_S = 1800.0


@dataclass(frozen=True, slots=True)
class Link:
    """Place of a task in a chain.

    Attributes
    ----------
    chain : hashable
        Identifies the chain.
    order : tuple of (float, int)
        Tasks of a chain run in ascending order of this value.
    seconds : float
        Estimated CPU time of the task, s.
    """

    chain: Hashable
    order: tuple[float, int]
    seconds: float


LinkFunction = Callable[[Task], Link]


def divide(tasks: Sequence[Task], link_of: LinkFunction | None, workers: int) -> list[list[Task]]:
    """Divide tasks into lists, each of which one worker runs in its order.

    Parameters
    ----------
    tasks : sequence of Task
        The tasks.
    link_of : callable or None
        Function that returns the place of a task in a chain. None if the tasks have no chains.
    workers : int
        Number of worker processes.

    Returns
    -------
    list of list of Task
        Without chains, one list per task, in the given order. Otherwise a list has a chain, or consecutive tasks of a
        chain that is cut, so that no list of several tasks takes longer than half an hour, or than a quarter of the
        time that all tasks take on all workers. The lists with the longest times are first.
    """
    if link_of is None:
        return [[task] for task in tasks]
    chains: dict[Hashable, list[tuple[Link, Task]]] = {}
    for task in tasks:
        link = link_of(task)
        chains.setdefault(link.chain, []).append((link, task))
    total = sum(link.seconds for chain in chains.values() for link, _ in chain)
    longest = min(total / (_LISTS_PER_WORKER * max(workers, 1)), _LONGEST_S)
    pieces = [
        piece
        for chain in chains.values()
        for piece in _cut(sorted(chain, key=lambda pair: (pair[0].order, pair[1].name)), longest)
    ]
    pieces.sort(key=lambda piece: -sum(link.seconds for link, _ in piece))
    return [[task for _, task in piece] for piece in pieces]


def _cut(chain: Sequence[tuple[Link, Task]], longest: float) -> list[list[tuple[Link, Task]]]:
    """Cut a chain into lists that take at most `longest` seconds each, or have one task."""
    pieces: list[list[tuple[Link, Task]]] = []
    used = math.inf
    for link, task in chain:
        if used + link.seconds > longest:
            pieces.append([])
            used = 0.0
        pieces[-1].append((link, task))
        used += link.seconds
    return pieces
