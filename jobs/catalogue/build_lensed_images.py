"""Build the table `lensed_images`: images of transients and quasars behind strong lenses, for a request (TOML file).

spark-submit jobs/catalogue/build_lensed_images.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.catalogue.build_lensed_images import JOB
from truesky.running.submitted_job import main

if __name__ == "__main__":
    command.exit_with_status(main, JOB)
