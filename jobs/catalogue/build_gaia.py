"""Build the table `gaia` from the stars of a lake.

spark-submit jobs/catalogue/build_gaia.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.catalogue.build_gaia import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
