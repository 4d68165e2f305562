"""Build the table `light_curves`: fluxes of the sources that change in the planned exposures of a request (TOML file).

spark-submit jobs/catalogue/build_light_curves.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.light_curve_tables.build_light_curves import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
