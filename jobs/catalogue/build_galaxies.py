"""Build the tables `halos`, `halo_limits`, `galaxies` and `quarantine` of a request.

spark-submit jobs/catalogue/build_galaxies.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.catalogue.build_galaxies import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
