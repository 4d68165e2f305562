"""Files of a grism, as grismconf reads them."""

import grismconf
import numpy as np

from lake_schema.mission.configuration import resolve
from truesky.render.camera import traces
from truesky.render.camera.detectors import detector, detectors
from truesky.render.dispersing import grism_files
from truesky.render.dispersing.draw import Order

MISSION = resolve()
DETECTOR = detector("nisp", "DET23", MISSION)


def test_grismconf_reads_the_same_places(tmp_path):
    for grism, tilt, one in (("RGS000", 0.0, DETECTOR), ("RGS180", 4.0, detectors("nisp", MISSION)[-1])):
        found = traces.traces(grism, tilt, one, MISSION)
        orders = [Order(trace, 12060, np.full(6861, 1.5)) for trace in found]
        read = grismconf.Config(str(grism_files.write(tmp_path, grism, orders, (2040, 2040))))
        t = np.linspace(0.0, 1.0, 11)
        for trace in found:
            name = f"{trace.order:+d}" if trace.order else "0"
            for column, row in ((0.0, 0.0), (1000.0, 30.0), (2039.0, 2039.0), (-500.0, 100.0)):
                waves = read.DISPL(name, column, row, t)
                x, y = trace.offsets(column, row, waves)
                np.testing.assert_allclose(read.DISPX(name, column, row, t), x, atol=1e-6)
                np.testing.assert_allclose(read.DISPY(name, column, row, t), y, atol=1e-6)
            assert read.SENS[name](15000.0) == 1.5
