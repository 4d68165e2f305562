# make demo | pilot | test | test-oldest | check | bench | bench-compare | docs | clean -- each installs what it is missing into
# .venv, and nothing a second time. test-oldest has an environment of its own, .venv-oldest.

SHELL := bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
.NOTPARALLEL:
.PHONY: help demo pilot test test-oldest check bench bench-compare docs clean spark FORCE

export OMP_NUM_THREADS := 1
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# The last one: without bytecode each of the tests' processes would parse all sources again.
unexport PYTHONHOME PYTHONPATH PIP_CONSTRAINT PIP_BUILD_CONSTRAINT PYTHONDONTWRITEBYTECODE

ifneq ($(words $(CURDIR)),1)
$(error truesky: Spark cannot be started from a folder with a space in its name ($(CURDIR)): move the clone)
endif

RUN := . .venv/bin/activate &&
# Nothing is installed whose sha256 is not known; what comes as source (pyspark among others) is built by what is
# known, too.
# The target's folder is the environment.
INSTALL = $(@D)/bin/python -m pip install --no-deps --no-build-isolation
KNOWN = $(INSTALL) --require-hashes --requirement

help:
	@echo 'make demo         simulate a field: five Spark jobs, a lake of tables and two images in out/demo'
	@echo 'make pilot        one observation of Euclid in full, ground cameras, calibrations: says hours and disc first;'
	@echo '                  goes on where it was stopped'
	@echo 'make test         all tests'
	@echo 'make test-oldest  fast tests with the lowest versions that pyproject.toml allows'
	@echo 'make check        style, spelling, types, who may import whom, plain English'
	@echo 'make bench        all benchmarks'
	@echo 'make bench-compare BASE=COMMIT   CPU times of this working copy relative to a commit'
	@echo 'make docs         the documentation as a site in out/site, its notebooks run on the lake of make demo'
	@echo 'make clean        remove what was computed (.venv, .venv-oldest and the cache stay)'

demo: spark
	@$(RUN) python -m truesky.commands.demo

pilot: spark
	@$(RUN) python -m truesky.commands.demo --request requests/pilot_one_observation.toml --out out/pilot

test: .venv/installed-test spark
	@$(RUN) python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder

# Tests of the packages that call numpy, scipy, numba, astropy, pyarrow, hats, duckdb and boto3 most directly.
test-oldest: .venv-oldest/installed
	@. .venv-oldest/bin/activate && python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder \
	    -m 'not nightly and not spark' tests/lake_schema $(addprefix tests/truesky/,explore fluxes numerics randomness request)

check: .venv/installed-test
	@$(RUN) ruff check . && ruff format --check . && codespell && mypy && lint-imports --no-cache && python -m scripts.plain_words --check

bench: .venv/installed-bench spark
	@$(RUN) for file in benchmarks/[a-z]*.py; do name=$${file##*/}; name=$${name%.py}; \
	    published="benchmarks/results/$$name.json"; \
	    [ "$$name" = compare ] || python -m "benchmarks.$$name" $$([ ! -e "$$published" ] || echo --json "$$published"); done

# For example, make bench-compare BASE=origin/main SUBJECTS="vis lsst"
bench-compare: .venv/installed-bench spark
	@$(RUN) python -m benchmarks.compare $(or $(BASE),$(error give a commit: make bench-compare BASE=origin/main)) \
	    $(if $(SUBJECTS),--subjects $(SUBJECTS))

docs: .venv/installed-test demo
	@$(RUN) python -m scripts.make_docs --notebooks

clean:
	rm -rf out build dist *.egg-info spark-warehouse
	rm -rf .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find . -path './.venv*' -prune -o -name __pycache__ -prune -exec rm -rf {} +

# ---------------------------------------------------------------------------- the environment

# Java is looked at every time (0.1 s): it may have come, gone or changed since.
spark: .venv/installed
	@.venv/bin/python truesky/commands/prepare_spark.py

.venv/installed: .venv/bin/python pyproject.toml requirements/build.txt requirements/run.txt
	$(KNOWN) requirements/build.txt
	$(KNOWN) requirements/run.txt
	$(INSTALL) --editable .
	@touch $@

# truesky is built first, since the lowest galsim needs a setuptools that is too old to build it.
.venv-oldest/installed: .venv-oldest/bin/python pyproject.toml requirements/build.txt requirements/oldest.txt
	$(KNOWN) requirements/build.txt
	$(INSTALL) --editable .
	$(KNOWN) requirements/oldest.txt
	@touch $@

.venv/installed-test: requirements/java.txt
.venv/installed-%: .venv/installed requirements/%.txt
	$(KNOWN) requirements/$*.txt
	@touch $@

# The first Python that really runs, is neither too old nor too new, and can make an environment.
PYTHONS := $(or $(PYTHON),python3.13 python3.12 python3.11 python3)
SERVES := import sys, ensurepip, venv; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))
# An environment that does not run, or was made for another folder, is made anew.
stale = $(shell test "$$(cat $1/.place 2>/dev/null || pwd)" = "$$(pwd)" && $1/bin/python -c 'import pip' 2>/dev/null || echo FORCE)

.venv/bin/python: $(call stale,.venv)
.venv-oldest/bin/python: $(call stale,.venv-oldest)
.venv/bin/python .venv-oldest/bin/python: environment = $(@D:/bin=)
.venv/bin/python .venv-oldest/bin/python:
	@for python in $(PYTHONS); do \
	    if $$python -c '$(SERVES)' >/dev/null 2>&1; then \
	        echo "$$($$python --version) makes $(environment)"; \
	        $$python -m venv --clear $(environment); \
	        pwd > $(environment)/.place; \
	        exit; \
	    fi; \
	done; \
	echo 'truesky: no Python 3.11, 3.12 or 3.13 with venv among: $(PYTHONS);' \
	    'install one (e.g. apt install python3 python3-venv) or name it: make PYTHON=/path/to/python' >&2; \
	exit 2
