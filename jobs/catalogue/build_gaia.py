"""Build the table `gaia`: the simulated stars of a lake (folder of tables) as Gaia DR2 would list them.

spark-submit jobs/catalogue/build_gaia.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.catalogue.build_gaia import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
