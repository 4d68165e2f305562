"""Build the catalogue of simulated stars, table `stars`, in the area of a request (TOML file).

spark-submit jobs/catalogue/build_stars.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.catalogue.build_stars import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
