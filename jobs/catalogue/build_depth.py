"""Build the table `depth`: depth and masks of the planned exposures of a request (TOML file), on the sky.

spark-submit jobs/catalogue/build_depth.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.running.submitted_job import main
from truesky.survey_maps.build_depth import JOB

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
