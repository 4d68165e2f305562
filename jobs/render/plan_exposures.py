"""Plan the exposures of a request (TOML file): pointings, and one rendering task per detector image.

spark-submit jobs/render/plan_exposures.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.commands.plan import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
