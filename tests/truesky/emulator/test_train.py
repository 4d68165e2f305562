"""Test the facts that `truesky train` derives from measured frames."""

import numpy as np
import pytest

from tests.truesky.emulator import samples
from truesky.emulator import train
from truesky.emulator.frame_examples import FrameExamples


def frame_with(examples):
    """Return the examples of a frame; only their features matter here."""
    empty = np.zeros(0)
    return FrameExamples(examples, empty.astype(np.int64), empty, empty, {})


def test_the_faintest_example_is_one_to_which_all_frames_with_examples_have_some():
    """A frame without any source, such as a small one between stars, says nothing about the end of the catalogue."""
    examples = samples.examples(200)
    deep, shallow = (examples.select(examples.features.brightness < limit) for limit in (9.0, 0.5))
    frames = [frame_with(part) for part in (deep, shallow, examples.select(np.zeros(0, int)))]
    assert train._faintest(frames) == pytest.approx(shallow.features.brightness.max(), rel=1e-12, abs=0)
    assert train._faintest(frames) < deep.features.brightness.max()
