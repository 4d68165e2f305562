"""Write the miniature lake that later versions must still read: python -m tests.make_old_lake FOLDER.

Run it when a table's declaration changes before it was ever released; afterwards give the table a new version instead.
"""

import sys
from pathlib import Path

from lake_schema.store import layout, publish
from lake_schema.store.plan import Output, Part, Plan
from lake_schema.tables.galaxies import GALAXIES
from tests.universe import plain_plan, plain_work, rows_of

OLD_LAKE = Path(__file__).parent / "lake_schema" / "old_lake"


def write(root):
    root.mkdir(parents=True)
    publish.make(root, plain_plan(), plain_work)
    part = Part(layout.cell_file(5, 1607), {})
    publish.make(root, Plan(GALAXIES, {"seed": 1}, (part,)), lambda lake, facts: Output(rows_of(GALAXIES, 12)))
    for lock in root.glob("*/.lock"):
        lock.unlink()


if __name__ == "__main__":
    write(Path(sys.argv[1]))
