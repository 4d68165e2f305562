"""Messages about places outside a catalogue name the middle of the catalogue."""

import numpy as np
import pytest

from lake_schema import sky
from lake_schema.errors import BadInput
from truesky.catalogue.cells import GENERATION_ORDER
from truesky.render.sources import catalogue_rows
from truesky.render.windows import inputs

TASK = {"ra": 120.0, "dec": 40.0, "radius": 0.1}


@pytest.mark.parametrize(
    ("circles", "place"),
    [
        ([(53.1, -27.8, 2.0)], "ra 53.1, dec -27.8"),
        ([(0.0, -10.0, 3.0)], "ra (360|0|359.9).0?, dec -(10.0|9.9)"),
        # The middle of two fields is in neither of them, so the place is in one of them.
        ([(53.1, -27.8, 2.0), (200.0, 1.0, 0.4)], "ra 5[0-9].., dec -2[5-9]"),
    ],
)
def test_the_middle_of_the_catalogue_is_named(circles, place, monkeypatch):
    cells = np.concatenate([sky.cells_in_cone(*circle, GENERATION_ORDER) for circle in circles])
    monkeypatch.setattr(catalogue_rows, "drawn_cells", lambda catalogue: set(cells.tolist()))
    with pytest.raises(BadInput, match=f"outside the area of the catalogue, which is near {place}"):
        inputs.refuse_uncovered(None, TASK)
