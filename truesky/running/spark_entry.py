"""Run one job under spark-submit: spark_entry.py MODULE --lake LAKE --request REQUEST.

The command `truesky` submits this file, since a wheel contains no `jobs/` folder.
"""

import sys
from importlib import import_module
from pathlib import Path

if __name__ == "__main__":
    # Python puts the folder of this file first, where its modules could hide others of the same name.
    if sys.path[:1] == [str(Path(__file__).resolve().parent)]:
        del sys.path[0]
    from lake_schema import command
    from truesky.running.submitted_job import main

    command.exit_with_status(main, import_module(sys.argv[1]).JOB, sys.argv[2:])
