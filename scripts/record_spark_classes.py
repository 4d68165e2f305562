"""Record the classes that Spark loads, so that later starts cost Java half the time.

    python scripts/record_spark_classes.py [--environment .venv]

A job with nothing to do runs once, and Java writes what it loaded to .venv/java/spark.jsa (class data
sharing, 150 MB).  Java passes over an archive that does not fit; for another Java or another Spark a new one
is made.  Where none can be made, Spark starts as slowly as it did.  prepare_spark.py has to have run before.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path

from prepare_spark import Java, choose

# Long enough for any machine that could run the jobs.
TIMEOUT_S = 300
OPTIONS = "-XX:+UseSerialGC -XX:TieredStopAtLevel=1 -Xlog:disable -Xlog:all=off"
# What a job of ours does, without the work.
JOB = """
import pyarrow as pa
from pyspark.sql import SparkSession

def receipts(batches):
    for batch in batches:
        yield pa.RecordBatch.from_pydict({"part": [""] * batch.num_rows})

spark = SparkSession.builder.getOrCreate()
spark.range(0, 2, 1, numPartitions=2).mapInArrow(receipts, "part string").collect()
"""


def fingerprint(java: Java) -> str:
    """What an archive depends on: which Java, in which version, and which Spark."""
    release = java.home / "release"
    facts = (str(java.home), release.read_text() if release.is_file() else "", version("pyspark"))
    return hashlib.sha256(repr(facts).encode()).hexdigest()


def record(environment: Path, java: Java) -> bool:
    """Make both archives, Java's own and Spark's on top of it; whether that worked."""
    store = environment / "java"
    (store / "spark.jsa").unlink(missing_ok=True)
    with tempfile.TemporaryDirectory(dir=store) as folder:
        names = ("java.jsa", "spark.jsa", "job.py", "nothing.py")
        base, top, job, nothing = (Path(folder) / name for name in names)
        job.write_text(JOB)
        nothing.touch()
        dump = ["-Xshare:dump", *OPTIONS.split(), f"-XX:SharedArchiveFile={base}"]
        if not (_runs([java.home / "bin" / "java", *dump]) and base.is_file()):
            return False
        # The archive on top remembers where the one below lies.
        base = base.replace(store / base.name)
        if not _submits(environment, job, f"-XX:SharedArchiveFile={base} -XX:ArchiveClassesAtExit={top}"):
            return False
        # Made to use both or fail, Java uses them.
        forced = f"-XX:SharedArchiveFile={base}:{top} -Xshare:on"
        if not (top.is_file() and _submits(environment, nothing, forced)):
            return False
        # Java trusts what an archive says: none may be there that a crash of the machine cut short.
        for archive in (base, top):
            with archive.open("rb") as stream:
                os.fsync(stream.fileno())
        top.replace(store / top.name)
    return True


def _submits(environment: Path, script: Path, options: str) -> bool:
    options = f"spark.driver.extraJavaOptions={OPTIONS} {options}"
    command = [environment / "bin" / "spark-submit", "--conf", options, script]
    return _runs(command, SPARK_CONF_DIR=str(environment / "spark-conf"))


def _runs(command: Sequence[str | Path], **variables: str) -> bool:
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ.get('PATH', '')}"
    environ = {**os.environ, "PATH": path, **variables}
    environ.pop("SPARK_HOME", None)
    try:
        done = subprocess.run(command, env=environ, capture_output=True, timeout=TIMEOUT_S)
    except (OSError, subprocess.SubprocessError):
        return False
    return done.returncode == 0


def main() -> int:
    """Exit status 0: an archive is a convenience."""
    parser = argparse.ArgumentParser(description="Record the classes that Spark loads, for quicker starts.")
    parser.add_argument("--environment", type=Path, default=Path(sys.prefix), help="virtual environment")
    environment = parser.parse_args().environment.resolve()
    java, recorded = choose(install=False), environment / "java" / "recorded"
    if java is None or (recorded.is_file() and recorded.read_text() == fingerprint(java)):
        return 0
    print("truesky: recording Spark's classes for quicker starts (once, half a minute)", flush=True)
    if not record(environment, java):
        print("truesky: that did not work; everything else does, each start takes some seconds longer")
    recorded.write_text(fingerprint(java))
    return 0


if __name__ == "__main__":
    sys.exit(main())
