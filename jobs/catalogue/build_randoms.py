"""Build the table `randoms`: random points in the area that a band covers, with depth and masks.

spark-submit jobs/catalogue/build_randoms.py --lake LAKE --request REQUEST --density 30 --band euclid_vis
"""

from lake_schema import command
from truesky.emulator.build_randoms import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
