"""Validate a lake, and publish the results as the table `validation` of the lake with an HTML report."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pyarrow as pa

from lake_schema.store import publish as store
from lake_schema.store import read
from lake_schema.store.plan import Json, Output, Plan, Task
from lake_schema.store.provenance import code_version
from lake_schema.tables.validation import VALIDATION
from truesky.validation.lake.measure.rows import Row
from truesky.validation.lake.suite import inventory, report, running
from truesky.validation.lake.suite.inventory import LakeContents

# Name of the HTML report in the folder of the table `validation`.
REPORT = "report.html"
# Name of the only Parquet file of the table `validation`.
_PART = "all.parquet"


def plan(contents: LakeContents, exposures: Sequence[int] = ()) -> Plan:
    """Return the plan of the table `validation`: everything on which its content depends, and its only file.

    The content depends on the versions of the input tables, the selected exposures (() for all) and the code.
    """
    facts = {"inputs": contents.version_keys, "exposures": sorted(exposures), "code": code_version()}
    return Plan(VALIDATION, facts, (Task(_PART, {}),))


def publish(root: Path, request: str | None = None, exposures: Sequence[int] = (), processes: int = 2) -> read.Version:
    """Run all checks of a lake, and publish the table `validation` with a report.

    If the table already exists for the same input tables, exposures and code, it is returned without new checks.

    Parameters
    ----------
    root : Path
        Folder of the lake.
    request : str, optional
        Name of the request (simulation job) whose tables are read. It is required if requests have different tables.
    exposures : sequence of int
        Numbers of the exposures to validate; () for all.
    processes : int
        Number of parallel processes for the checks.

    Returns
    -------
    Version
        The published table. BadInput is raised if the lake has nothing to validate, or if its table `products` has no
        image of one of the given exposures.
    """
    contents = inventory.read_contents(root, request, exposures)
    table_plan = plan(contents, exposures)

    def build_output(lake: Path, facts: Json) -> Output:
        results = running.run_checks(contents, processes)
        page = report.page(lake.name, results)

        def write(path: Path) -> None:
            path.write_text(page, encoding="utf-8")

        return Output(build_table(results.rows), {REPORT: write})

    store.make_version(root, table_plan, build_output, name=request)
    return read.version(root, VALIDATION.name, table_plan.key)


def build_table(rows: Sequence[Row]) -> pa.Table:
    """Convert rows (measured values with expected values and verdicts) to the table `validation`.

    Numbers that are not finite are stored as null.
    """
    numbers = {
        name: np.ma.masked_invalid(np.array([getattr(row, name) for row in rows], float))
        for name in ("value", "error", "expected", "tolerance")
    }
    places = {
        name: [getattr(row.place, name) for row in rows] for name in ("channel", "band", "exposure_id", "detector")
    }
    return VALIDATION.build(
        {
            "check_name": [row.check for row in rows],
            "quantity": [row.quantity for row in rows],
            "place": [row.place.text for row in rows],
            **places,
            **numbers,
            "kind": [row.kind for row in rows],
            "value_unit": [row.unit for row in rows],
            "source": [row.source for row in rows],
            "note": [row.note for row in rows],
            "known": [row.known_failure for row in rows],
            "verdict": [row.verdict for row in rows],
        }
    )
