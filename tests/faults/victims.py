"""Processes that fail, forked from a clean server so that each takes milliseconds."""

import multiprocessing
import os
import resource
import signal

import numpy as np

from lake_schema.errors import LakeError
from lake_schema.fits import images
from lake_schema.store import garbage, locks, publish
from lake_schema.store.plan import Output
from tests.faults import promise
from tests.faults.disc import Disc
from tests.universe import plain_plan, plain_work

CONTEXT = multiprocessing.get_context("forkserver")
# How long a publisher here waits for another that is paused while it holds the table or its version, s.
PATIENCE = 0.1
CONTEXT.set_forkserver_preload(["tests.faults.victims"])


def start(target, *args):
    """Start a child process."""
    process = CONTEXT.Process(target=target, args=args)
    process.start()
    return process


def _no_fsync(descriptor):
    pass


def run(target, *args):
    """Run a child process and return its exit code."""
    process = start(target, *args)
    process.join()
    return process.exitcode


def kill_at(root, kind, seed, n):
    """Publish a version, and end at the n-th disc call."""
    os.fsync = _no_fsync

    def shoot(call, what, path):
        if call == n:
            os.kill(os.getpid(), signal.SIGKILL)

    with Disc(root, at=shoot):
        promise.make(root, kind, seed)


def stop_at(root, kind, seed, n, base, reached, go, answers):
    """Publish a version, and wait at the n-th disc call for a signal to continue."""
    os.fsync, locks.TABLE_TIMEOUT, locks.SHORT_TIMEOUT = _no_fsync, PATIENCE, PATIENCE

    def wait(call, what, path):
        if call == n:
            reached.set()
            go.wait(60)

    try:
        with Disc(root, at=wait):
            promise.make(root, kind, seed, base=base)
        answers.put((seed, "published"))
    except LakeError as error:
        answers.put((seed, type(error).__name__))
    finally:
        reached.set()


def publish_many(root, kind, versions, stop):
    """Publish versions and sometimes remove old ones until a signal to stop."""
    os.fsync = _no_fsync
    n = 0
    while n < versions or not stop.is_set():
        n += 1
        promise.make(root, kind, n)
        if n % 7 == 0:
            garbage.collect(root, kind, delete=True)


def with_image(root, facts):
    image = images.Image(np.zeros((200, 200), np.float32))
    name = f"images/{facts['part']}.fits"
    return Output(plain_work(root, facts).rows, {name: lambda path: images.write_images(path, [image])})


def on_a_small_disc(root, work, most_bytes, answers):
    """Publish with a limit on the size of files."""
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
    try:
        publish.make_version(root, plain_plan(2), work)
        answers.put("published")
    except LakeError as error:
        answers.put(f"{type(error).__name__}: {error}")
