"""Publish, fail, die, resume, read, verify and clean in any order: versions are complete at every step."""

import os
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, invariant, multiple, rule, run_state_machine_as_test

from lake_schema.errors import BadInput, LakeError
from lake_schema.store import garbage, read
from tests.faults import promise
from tests.faults.disc import Disc, Killed

SEEDS = st.integers(1, 4)
CALL = st.integers(1, 70)


class Lake(RuleBasedStateMachine):
    """State machine of one table; its model is the set of keys that may be current."""

    opened = Bundle("opened")

    def __init__(self):
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.root = Path(self.folder.name)
        self.may_be = {None}

    def _make(self, seed, **accident):
        with Disc(self.root, **accident):
            promise.make(self.root, "plain", seed)

    @rule(seed=SEEDS)
    def make(self, seed):
        self._make(seed)
        self.may_be = {promise.key("plain", seed)}

    @rule(seed=SEEDS, n=CALL)
    def fail(self, seed, n):
        try:
            self._make(seed, fail_at=n)
            self.may_be = {promise.key("plain", seed)}
        except (OSError, LakeError):
            self.may_be |= {promise.key("plain", seed)}

    @rule(seed=SEEDS, n=CALL)
    def die(self, seed, n):
        try:
            self._make(seed, die_at=n)
            self.may_be = {promise.key("plain", seed)}
        except Killed:
            self.may_be |= {promise.key("plain", seed)}

    @rule()
    def clean(self):
        if any((self.root / "plain").glob("*")):
            garbage.collect(self.root, "plain", delete=True)
        else:
            # The run was not started, or was killed before it wrote files: gc reports that there is no table.
            with pytest.raises(BadInput, match="no table plain"):
                garbage.collect(self.root, "plain", delete=True)

    @rule(n=st.integers(1, 25))
    def die_cleaning(self, n):
        if any((self.root / "plain").glob("*")):
            try:
                with Disc(self.root, die_at=n):
                    garbage.collect(self.root, "plain", delete=True)
            except Killed:
                pass

    @rule(target=opened)
    def open(self):
        return read.version(self.root, "plain") if promise.current(self.root, "plain") else multiple()

    @rule(version=opened)
    def read_on(self, version):
        """A version that was opened earlier is still whole, or gone, but never another."""
        try:
            rows = version.rows()
        except LakeError:
            assert not version.folder.exists()
            return
        assert set(rows["value"].to_pylist()) == {float(version.manifest["facts"]["seed"])}
        assert rows.num_rows == version.num_rows

    @invariant()
    def promise_holds(self):
        now = promise.current(self.root, "plain")
        assert now in self.may_be
        self.may_be = {now}

    def teardown(self):
        self.folder.cleanup()


@pytest.mark.parametrize(
    ("sequences", "steps"),
    [pytest.param(8, 12, id="short"), pytest.param(200, 20, id="long", marks=pytest.mark.nightly)],
)
def test_versions_stay_complete_in_any_order_of_operations(sequences, steps):
    profile = settings(max_examples=sequences, stateful_step_count=steps, deadline=None)
    run_state_machine_as_test(Lake, settings=profile)


def test_the_state_machine_detects_a_bad_publisher():
    """A publisher that changes the link before the folder is complete is detected."""

    class Broken(Lake):
        def _make(self, seed, **accident):
            plan = promise.KINDS["plain"][0](seed)
            folder = self.root / "plain" / f"v-{plan.key}"
            folder.mkdir(parents=True, exist_ok=True)
            link = self.root / "plain" / "current"
            link.unlink(missing_ok=True)
            os.symlink(folder.name, link)

    with pytest.raises(LakeError):
        run_state_machine_as_test(Broken, settings=settings(max_examples=5, database=None, deadline=None))
