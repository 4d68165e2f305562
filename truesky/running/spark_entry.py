"""Run one job under spark-submit: spark_entry.py MODULE --lake LAKE --request REQUEST.

MODULE is the name of the Python module that defines the job. The command `truesky` submits this file, because an
installed package does not contain the folder `jobs/` with one script per job.
"""

import sys
from importlib import import_module
from pathlib import Path

if __name__ == "__main__":
    # Remove the folder of this file from the import path. Python puts the folder of a script first, so that modules in
    # the folder could hide others of the same name.
    if sys.path[:1] == [str(Path(__file__).resolve().parent)]:
        del sys.path[0]
    from lake_schema import command
    from truesky.running.submitted_job import main

    command.exit_with_status(main, import_module(sys.argv[1]).JOB, sys.argv[2:])
