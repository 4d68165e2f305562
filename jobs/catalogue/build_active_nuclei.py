"""Build the table `active_nuclei` of quasars and active galaxies in the area of a request (TOML file).

spark-submit jobs/catalogue/build_active_nuclei.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.catalogue.build_active_nuclei import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
