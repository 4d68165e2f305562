"""Test the container image and the recipes for Kubernetes and YARN without a cluster or Docker."""

import os
import re
import shlex
import shutil
import socket
import subprocess
import sys
import time
import zipfile
from importlib.util import find_spec
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
DEPLOY = ROOT / "deploy"
SPARK = Path(find_spec("pyspark").origin).parent
RECIPES = ("kubernetes", "yarn")
# Keys that Spark puts together, by the constant that it has of their begins and ends.
PREFIXES = {
    "spark.executorEnv.": ("",),
    "spark.kubernetes.authenticate.driver": (".serviceAccountName",),
    "spark.kubernetes.driver.volumes.": ("mount.path", "options."),
    "spark.kubernetes.executor.volumes.": ("mount.path", "options."),
}


def steps():
    """Return (instruction, arguments) of every step of the Dockerfile, in order."""
    text = re.sub(r"\\\n", " ", (DEPLOY / "Dockerfile").read_text())
    lines = [line.strip() for line in text.splitlines()]
    return [tuple(line.split(maxsplit=1)) for line in lines if line and not line.startswith("#")]


def told(recipe):
    """Key -> value of a recipe."""
    lines = (DEPLOY / f"{recipe}.conf").read_text().splitlines()
    return dict(line.split(maxsplit=1) for line in lines if line and not line.startswith("#"))


def test_the_image_copies_existing_files_and_has_an_unprivileged_user():
    found = steps()
    words = [word for word, _ in found]
    assert set(words) <= {"FROM", "RUN", "WORKDIR", "COPY", "ENV", "USER", "ENTRYPOINT", "CMD"}
    assert words[0] == "FROM"
    assert words.count("FROM") == 1
    # One version of it, not whatever is newest.
    assert re.fullmatch(r"python:3\.11\.\d+-slim-[a-z]+", found[0][1])
    for sources in (rest.split()[:-1] for word, rest in found if word == "COPY"):
        for source in sources:
            assert (ROOT / source).exists(), source
    (user,) = (rest for word, rest in found if word == "USER")
    assert int(user) > 0
    assert words.index("USER") > max(i for i, word in enumerate(words) if word == "RUN")
    for _, step in (one for one in found if one[0] == "RUN" and "--requirement" in one[1]):
        assert "--require-hashes" in step
    copied = {source for word, rest in found if word == "COPY" for source in rest.split()[:-1]}
    assert {"jobs", "lake_schema", "truesky", "requests"} <= copied


def test_entrypoint_supports_all_commands_of_spark():
    done = subprocess.run(["bash", "-n", DEPLOY / "entrypoint.sh"], check=False)
    assert done.returncode == 0
    assert os.access(DEPLOY / "entrypoint.sh", os.X_OK)
    text = (DEPLOY / "entrypoint.sh").read_text()
    known = constants("kubernetes")
    for name in set(re.findall(r"\$\{?(SPARK_[A-Z_]+?)(?:_\$i|[:}\W])", text)) - {
        "SPARK_HOME",
        "SPARK_CONF_DIR",
        "SPARK_LOCAL_IP",
    }:
        assert name.encode() in known, name
    for option in re.findall(r"--[a-z]+[A-Z]\w*|--(?:driver-url|executor-id|cores|app-id|hostname)\b", text):
        assert option.encode() in known or option.encode() in constants("core"), option


def constants(*parts):
    """Return the constants in the classes of the jars of Spark, including strings."""
    found = []
    for part in parts:
        (jar,) = SPARK.glob(f"jars/spark-{part}_*.jar")
        with zipfile.ZipFile(jar) as archive:
            wanted = [name for name in archive.namelist() if name.endswith(".class") and "Suite" not in name]
            found += [archive.read(name) for name in wanted]
    return b"\0".join(found)


def test_settings_of_recipes_exist_in_spark():
    known = constants("core", "kubernetes", "yarn")
    for recipe in RECIPES:
        for key in told(recipe):
            prefix = next((prefix for prefix in PREFIXES if key.startswith(prefix)), None)
            texts = [key] if prefix is None else [prefix, *(end for end in PREFIXES[prefix] if end in key)]
            assert all(text.encode() in known for text in texts), key
            assert prefix is None or len(texts) > 1 or PREFIXES[prefix] == ("",), key
    assert b"spark.executor.memoryOverhed" not in known


def test_files_named_in_the_docs_exist():
    text = (ROOT / "docs" / "cluster.md").read_text()
    for name in ("Dockerfile", "entrypoint.sh", "kubernetes.conf", "yarn.conf"):
        assert f"../deploy/{name}" in text


# ------------------------------------------------------------------------------------------------ nightly


def environment(**more):
    kept = {name: value for name, value in os.environ.items() if not name.startswith(("SPARK", "PYSPARK", "PYTHON"))}
    return {**kept, "SPARK_LOCAL_IP": "127.0.0.1", **more}


def submitted(*options, **more):
    """Return the output of a spark-submit that stops at the connection to its server."""
    command = [SPARK / "bin" / "spark-submit", "--verbose", *options]
    command += ["--lake", "/lake", "--request", "/lake/requests/demo.toml"]
    done = subprocess.run(
        list(map(str, command)), env=environment(PYSPARK_PYTHON=sys.executable, SPARK_HOME=str(SPARK), **more),
        capture_output=True, text=True, timeout=300,
    )  # fmt: skip
    assert done.returncode != 0
    return done.stdout + done.stderr


@pytest.mark.nightly
@pytest.mark.spark
def test_spark_submit_accepts_the_recipe_for_kubernetes():
    script = "local:///opt/truesky/jobs/render/render_exposures.py"
    said = submitted(
        "--properties-file", DEPLOY / "kubernetes.conf", "--master", "k8s://https://127.0.0.1:1", "--deploy-mode",
        "cluster", script,
    )  # fmt: skip
    assert "org.apache.spark.deploy.k8s.submit.KubernetesClientApplication" in said
    assert script in said
    assert "127.0.0.1:1" in said
    assert re.search("Connection refused|ConnectException", said)


@pytest.mark.nightly
@pytest.mark.spark
def test_spark_submit_accepts_the_recipe_for_yarn(tmp_path):
    values = {
        "yarn.resourcemanager.address": "127.0.0.1:1",
        "yarn.resourcemanager.connect.max-wait.ms": "2000",
        "yarn.resourcemanager.connect.retry-interval.ms": "500",
        "ipc.client.connect.max.retries": "1",
    }
    lines = [f"<property><name>{name}</name><value>{value}</value></property>" for name, value in values.items()]
    for name in ("yarn-site.xml", "core-site.xml"):
        (tmp_path / name).write_text("<configuration>" + "".join(lines) + "</configuration>")
    (tmp_path / "truesky.tar.gz").touch()
    recipe = tmp_path / "yarn.conf"
    recipe.write_text((DEPLOY / "yarn.conf").read_text().replace("truesky.tar.gz#", f"{tmp_path}/truesky.tar.gz#"))
    said = submitted(
        "--properties-file", recipe, "--master", "yarn", "--deploy-mode", "cluster",
        ROOT / "jobs" / "render" / "render_exposures.py", HADOOP_CONF_DIR=str(tmp_path),
    )  # fmt: skip
    assert "org.apache.spark.deploy.yarn.YarnClusterApplication" in said
    assert f"{tmp_path}/truesky.tar.gz#environment" in said
    assert re.search("Connection refused|ConnectException", said)


def in_a_folder(folder, step):
    """Return the command of a step for a given root folder, without the creation of users."""
    step = re.sub(r"(?<![\w/.])/(opt|var/cache)/truesky", rf"{folder}/\1/truesky", step)
    step = re.sub(r"^python ", f"{shlex.quote(getattr(sys, '_base_executable', sys.executable))} ", step)
    return "true" if step.startswith(("useradd", "chown")) else step


@pytest.fixture(scope="module")
def image(tmp_path_factory):
    """Return a folder after all steps of the Dockerfile, and the final environment."""
    folder = tmp_path_factory.mktemp("image")
    kept, where = environment(HOME=str(folder)), folder
    for word, rest in steps():
        if word == "WORKDIR":
            where = Path(f"{folder}{rest}")
            where.mkdir(parents=True)
        elif word == "COPY":
            *sources, target = rest.split()
            for source in sources:
                to = where / target / source if target == "./" else where / target
                to.parent.mkdir(parents=True, exist_ok=True)
                copy = shutil.copytree if (ROOT / source).is_dir() else shutil.copy2
                copy(ROOT / source, to)
        elif word == "RUN":
            subprocess.run(["bash", "-euc", in_a_folder(folder, rest)], cwd=where, env=kept, check=True, timeout=3000)
        elif word == "ENV":
            kept |= dict(pair.split("=", 1) for pair in shlex.split(in_a_folder(folder, f" {rest}")))
    return where, kept


@pytest.mark.nightly
@pytest.mark.spark
def test_the_image_checks_a_request_and_runs_a_job(image, tmp_path):
    where, kept = image
    entry = where / "deploy" / "entrypoint.sh"

    def run(*command, **more):
        return subprocess.run(
            list(map(str, (entry, *command))), cwd=tmp_path, env={**kept, **more}, capture_output=True, text=True,
            timeout=3000,
        )  # fmt: skip

    done = run("truesky", "check", where / "requests" / "demo.toml")
    assert done.returncode == 0, done.stderr
    # Start a driver like Kubernetes; the table of spectra is the smallest that a single job makes.
    request = tmp_path / "small.toml"
    text = (where / "requests" / "demo.toml").read_text()
    for key, value in (("galaxy_limit", 18.0), ("star_limit", 15.0), ("lensing_nside", 64)):
        text, found = re.subn(rf"^{key} = [^ \n]+", f"{key} = {value}", text, flags=re.MULTILINE)
        assert found == 1
    request.write_text(text)
    job = where / "jobs" / "catalogue" / "build_stars.py"
    done = run(
        "driver", "--master", "local[1]", job, "--lake", tmp_path / "lake", "--request", request,
        SPARK_DRIVER_BIND_ADDRESS="127.0.0.1",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert run("truesky", "verify", tmp_path / "lake", "--deep").returncode == 0


@pytest.mark.nightly
@pytest.mark.spark
def test_the_image_starts_an_executor_that_asks_for_its_driver(image):
    where, kept = image
    with socket.create_server(("127.0.0.1", 0)) as driver:
        driver.settimeout(200)
        told = {
            "SPARK_EXECUTOR_MEMORY": "512m", "SPARK_EXECUTOR_ID": "1", "SPARK_EXECUTOR_CORES": "1",
            "SPARK_APPLICATION_ID": "spark-1", "SPARK_EXECUTOR_POD_IP": "127.0.0.1", "SPARK_RESOURCE_PROFILE_ID": "0",
            "SPARK_EXECUTOR_POD_NAME": "pod-1", "SPARK_JAVA_OPT_0": "-Dspark.driver.port=1",
            "SPARK_JAVA_OPT_1": "--add-modules=jdk.incubator.vector",
            "SPARK_DRIVER_URL": f"spark://CoarseGrainedScheduler@127.0.0.1:{driver.getsockname()[1]}",
        }  # fmt: skip
        with subprocess.Popen([str(where / "deploy" / "entrypoint.sh"), "executor"], env={**kept, **told}) as process:
            try:
                began = time.monotonic()
                connection, _ = driver.accept()
                with connection:
                    connection.settimeout(60)
                    # Spark's frames: what the first one asks for is the driver's endpoint.
                    assert b"CoarseGrainedScheduler" in connection.recv(65536) or time.monotonic() - began < 200
            finally:
                process.kill()


@pytest.mark.nightly
def test_a_packed_environment_runs_from_another_folder(tmp_path):
    """YARN unpacks it in this way: truesky is installed from a wheel, without the clone."""
    import tarfile

    made, packed, there = tmp_path / "made", tmp_path / "truesky.tar.gz", tmp_path / "container" / "environment"
    base = getattr(sys, "_base_executable", sys.executable)
    subprocess.run([base, "-m", "venv", made], check=True)
    install = [made / "bin" / "python", "-m", "pip", "install", "--quiet", "--no-deps"]
    for name in ("build", "run"):
        more = ["--require-hashes", "--no-build-isolation"] if name == "run" else ["--require-hashes"]
        subprocess.run([*install, *more, "-r", ROOT / "requirements" / f"{name}.txt"], check=True, timeout=3000)
    source = tmp_path / "source"
    for name in ("jobs", "lake_schema", "truesky", "requests", "notebooks"):
        shutil.copytree(ROOT / name, source / name)
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy2(ROOT / name, source / name)
    subprocess.run([*install, "--no-build-isolation", source], check=True, timeout=600)
    pack = [sys.executable, "-m", "venv_pack", "--prefix", made, "--output", packed]
    subprocess.run(pack, check=True, timeout=1200, stdout=subprocess.DEVNULL)
    shutil.rmtree(made)
    shutil.rmtree(source)
    with tarfile.open(packed) as archive:
        archive.extractall(there, filter="tar")
    ask = "import lake_schema, pyarrow; from truesky.render import render_exposures; print(lake_schema.__file__)"
    done = subprocess.run(
        [there / "bin" / "python", "-c", ask],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        env=environment(),
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(str(there))
