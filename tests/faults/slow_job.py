"""A job for spark-submit whose parts take a while, so that it can be interrupted: --lake LAKE --request SEED_FILE."""

import sys
import time
from pathlib import Path

if __name__ == "__main__":
    sys.path[0] = str(Path(__file__).resolve().parents[2])
    # Limits numpy, before it is imported below.
    import lake_schema  # noqa: F401


from tests.universe import plain_plan, plain_work
from truesky.running.submitted_job import Job, Step, main

# Parts, and s a part: a driver that is to be stopped must still be at work.
PARTS, SLOW = 12, 1.5


def steps(lake, request):
    return [Step(plain_plan(request.seed, parts=PARTS), work)]


def work(root, facts):
    if (root / "slow").exists():
        time.sleep(SLOW)
    return plain_work(root, facts)


JOB = Job("slow_job", "Toy rows, slowly.", steps)

if __name__ == "__main__":
    sys.exit(main(JOB))
