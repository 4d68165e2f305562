"""Build the table `gaia` of a lake's stars.

spark-submit jobs/catalogue/build_gaia.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.catalogue.build_gaia import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
