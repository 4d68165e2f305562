"""Wait for a state, and not for a time after which it is expected: other programs may keep the machine busy."""

import asyncio
import time

# Longest time (s) that a test waits for a state, a thread or an answer. Only a test that fails waits so long.
PATIENCE = 300.0


def until(condition):
    """Wait in a test with threads until `condition()` is true; an AssertionError is raised after 300 s."""
    ended = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < ended
        time.sleep(0.02)


async def reach(condition):
    """Wait as `until` does in a test with an event loop, which runs on meanwhile."""
    ended = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < ended
        await asyncio.sleep(0.01)
