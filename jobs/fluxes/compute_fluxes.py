"""Compute the fluxes of all galaxies and stars of a request (TOML file) in its passbands.

The passbands and the spectral templates that were used are stored, too.

spark-submit jobs/fluxes/compute_fluxes.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.fluxes.compute_fluxes import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
