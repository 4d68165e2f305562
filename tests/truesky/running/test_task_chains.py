"""Division of tasks into lists for workers: chains stay together, long ones are cut, and no task is lost."""

from hypothesis import given
from hypothesis import strategies as st

from lake_schema.store.plan import Task
from truesky.running import task_chains
from truesky.running.task_chains import Link


def tasks_of(chains):
    """Return tasks and the function of their links, for lists of seconds by name of the chain."""
    links = {
        f"{name}-{i}": Link(name, (float(i), i), seconds)
        for name, chain in chains.items()
        for i, seconds in enumerate(chain)
    }
    return [Task(name, {}) for name in links], lambda task: links[task.name]


def divided(chains, workers, reverse=False):
    tasks, link_of = tasks_of(chains)
    return [
        [task.name for task in piece]
        for piece in task_chains.divide(tasks[::-1] if reverse else tasks, link_of, workers)
    ]


def test_tasks_without_chains_are_alone_and_keep_their_order():
    tasks = [Task(name, {}) for name in "cab"]
    assert task_chains.divide(tasks, None, 2) == [[task] for task in tasks]
    assert task_chains.divide([], None, 2) == []


def test_chains_stay_together_in_their_order():
    """The list with the longest time is first; a chain that takes longer than a quarter of the time is cut."""
    even = {name: [1.0] * 3 for name in "abcd"}
    whole = [[f"{name}-{i}" for i in range(3)] for name in "abcd"]
    assert divided(even, 1) == whole
    assert divided(even, 1, reverse=True) == whole[::-1]
    # A quarter of the time of all tasks is 3.75 s.
    uneven = {"a": [1.0, 2.0], "b": [3.0, 3.0], "c": [1.0, 1.0], "d": [2.0, 2.0]}
    assert divided(uneven, 1) == [["a-0", "a-1"], ["b-0"], ["b-1"], ["c-0", "c-1"], ["d-0"], ["d-1"]]


def test_a_long_chain_is_cut_into_equal_lists():
    pieces = divided({"a": [1.0] * 16}, 2)
    assert [len(piece) for piece in pieces] == [2] * 8
    assert sorted(name for piece in pieces for name in piece) == sorted(f"a-{i}" for i in range(16))
    # On many workers, each task is alone, the longest first.
    assert divided({"a": [1.0, 3.0, 2.0]}, 100) == [["a-1"], ["a-2"], ["a-0"]]


@given(
    st.dictionaries(st.integers(0, 20), st.lists(st.floats(0.0, 1e4), min_size=1, max_size=30), min_size=1, max_size=8),
    st.integers(0, 40),
)
def test_every_task_is_in_one_list_and_chains_are_in_order(chains, workers):
    tasks, link_of = tasks_of(chains)
    pieces = task_chains.divide(tasks, link_of, workers)
    assert sorted(task.name for piece in pieces for task in piece) == sorted(task.name for task in tasks)
    seconds = [sum(link_of(task).seconds for task in piece) for piece in pieces]
    assert seconds == sorted(seconds, reverse=True)
    target = min(sum(seconds) / (4 * max(workers, 1)), 1800.0)
    for piece, own in zip(pieces, seconds, strict=True):
        links = [link_of(task) for task in piece]
        assert len({link.chain for link in links}) == 1
        # Consecutive tasks of the chain.
        first = int(links[0].order[1])
        assert [link.order[1] for link in links] == list(range(first, first + len(links)))
        assert len(links) == 1 or own <= target * (1.0 + 1e-9)
