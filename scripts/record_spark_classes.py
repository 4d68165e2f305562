"""Record the classes that Spark loads, so that later starts cost Java half the time.

    python scripts/record_spark_classes.py [--environment .venv]

A job with nothing to do runs once, and Java writes what it loaded to .venv/java/spark.jsa (class data sharing,
150 MB).  Java itself passes over an archive that does not fit; for another Java or another Spark a new one is
made.  Where none can be made, Spark starts as slowly as it did.  prepare_spark.py has to have run before.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import subprocess
import sys
import tempfile
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
        base, top, job = (Path(folder) / name for name in ("java.jsa", "spark.jsa", "job.py"))
        job.write_text(JOB)
        dump = [java.home / "bin" / "java", "-Xshare:dump", *OPTIONS.split(), f"-XX:SharedArchiveFile={base}"]
        if not (_runs(dump) and base.is_file()):
            return False
        # The archive on top remembers where the one below lies.
        base = base.replace(store / base.name)
        options = f"{OPTIONS} -XX:SharedArchiveFile={base} -XX:ArchiveClassesAtExit={top}"
        submit = [environment / "bin" / "spark-submit", "--conf", f"spark.driver.extraJavaOptions={options}", job]
        if not (_runs(submit, SPARK_CONF_DIR=str(environment / "spark-conf")) and top.is_file()):
            return False
        top.replace(store / top.name)
    return True


def _runs(command: list[str | Path], **variables: str) -> bool:
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
