"""Build the table `transients`: supernovae in the galaxies of a request (TOML file).

spark-submit jobs/catalogue/build_transients.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.catalogue.build_transients import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
