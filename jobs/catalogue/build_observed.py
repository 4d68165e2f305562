"""Make the table `observed`: galaxies and stars as the planned images would show them, drawn from models.

spark-submit jobs/catalogue/build_observed.py --lake LAKE --request REQUEST --model MODEL [MODEL ..]
"""

from lake_schema import command
from truesky.emulator.build_observed import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
