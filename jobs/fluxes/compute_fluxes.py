"""Compute the band fluxes of all sources of a lake, and store the passbands and templates used.

spark-submit jobs/fluxes/compute_fluxes.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.fluxes.compute_fluxes import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
