"""Plan the exposures of a request.

spark-submit jobs/render/plan_exposures.py --lake LAKE --request REQUEST
"""

from lake_schema import command
from truesky.commands.plan import JOB
from truesky.running.shell import main

if __name__ == "__main__":
    command.leave(main, JOB)
