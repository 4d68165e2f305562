"""Render the raw detector images of all exposures that `plan_exposures.py` has planned for a request (TOML file).

spark-submit jobs/render/render_exposures.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.render.render_exposures import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
