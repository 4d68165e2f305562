"""The end of a process waits for threads that still release what they have read."""

import hashlib
import threading
import time

from lake_schema.store import parquet


def compute_until(stop):
    while not stop.is_set():
        # Hashing a large buffer releases the interpreter, as a thread of Arrow does.
        hashlib.sha256(bytes(1 << 22)).digest()


def test_the_end_waits_for_a_running_thread():
    stop = threading.Event()
    thread = threading.Thread(target=compute_until, args=(stop,))
    thread.start()
    threading.Timer(0.2, stop.set).start()
    parquet._wait_for_threads()
    assert stop.is_set()
    thread.join(10.0)
    assert not thread.is_alive()


def test_the_end_does_not_wait_for_ever(monkeypatch):
    monkeypatch.setattr(parquet, "_LONGEST_WAIT_S", 0.05)
    stop = threading.Event()
    thread = threading.Thread(target=compute_until, args=(stop,))
    thread.start()
    start = time.monotonic()
    parquet._wait_for_threads()
    waited = time.monotonic() - start
    stop.set()
    thread.join(10.0)
    assert 0.05 <= waited < 5.0
