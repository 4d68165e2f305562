"""Build the table `strong_lenses`, and images of the lensed arcs, in the area of a request (TOML file).

spark-submit jobs/catalogue/build_strong_lenses.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.catalogue.build_strong_lenses import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
