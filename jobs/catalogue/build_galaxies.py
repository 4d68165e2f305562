"""Build the catalogues of dark-matter halos and galaxies that a request (TOML file) asks for.

The tables are `halos`, `halo_limits`, `galaxies` and `quarantine`.

spark-submit jobs/catalogue/build_galaxies.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.catalogue.build_galaxies import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
