# The two commands are `make demo` and `make test`; each does all the set-up that it needs.

VENV := .venv
BIN := $(VENV)/bin
export ROS_AUTOMATIC_DISCOVERY_RANGE ?= LOCALHOST
# Many images set this; then every process would compile all that it imports, 1 to 3 s.
unexport PYTHONDONTWRITEBYTECODE

PART := test/common test/controller test/actuator/test_model_blocks.py test/actuator/test_drivers.py \
  test/actuator/test_lockstep.py test/analysis/bags test/analysis/measures test/test_private_parts.py

# Without bytecode of all modules, which takes a quarter of the time: what is imported gets it then.
INSTALL := pip install -qq --disable-pip-version-check --no-compile

# One more than there are cores, as nodes are waited for; each takes tests of another at its end.
WORKERS := -n $(shell expr $$(nproc) + 1) --maxprocesses 4 --dist worksteal

.PHONY: help ready setup demo test test-slow test-python test-oldest torture soak bench lint docs clean

help:
	@echo 'make demo     run actuator and controller, record, analyse: runs/demo/report.html'
	@echo 'make test     run the tests'
	@echo 'make test-slow  run the tests that take longest, which make test leaves out'
	@echo 'make test-python PYTHON=python3.13   a part of the tests with another Python'
	@echo 'make test-oldest   the same with the oldest dependencies that setup.py allows'
	@echo 'make torture  break everything, ten thousand inputs or TORTURE_MINUTES; print what was lost'
	@echo 'make soak     an hour of lock-step, ten minutes of real time: memory, files, threads'
	@echo 'make bench    measure the speed of everything (doc/reference/performance.md); BENCH=NAME: one'
	@echo 'make lint     check style, types and imports'
	@echo 'make docs     build the documents, tutorials run: build/docs/index.html'
	@echo 'make clean    remove the virtual environment and all that was built'

demo: ready
	@$(BIN)/asi demo

test: setup
	@$(BIN)/python -m pytest -q $(WORKERS)

test-slow: setup
	@$(BIN)/python -m pytest -q $(WORKERS) -m slow

# A part of the tests with another Python, or the oldest dependencies, in a virtual environment of its
# own; too long for .ci/run. PART names other tests.
OTHER = build/$(@:test-%=%)
test-python: CHOSEN = $(or $(PYTHON),python3)
test-oldest: CHOSEN = $(or $(PYTHON),python3.11)
test-oldest: BOUNDS = -c $(OTHER)/oldest.txt
test-python test-oldest:
	@mkdir -p build && $(CHOSEN) -m venv --clear $(OTHER)
	@$(OTHER)/bin/$(INSTALL) setuptools
	@$(OTHER)/bin/python test/oldest.py > $(OTHER)/oldest.txt
	@$(OTHER)/bin/$(INSTALL) $(BOUNDS) . pytest pytest-timeout \
	  pytest-xdist hypothesis control colcon-common-extensions
	@$(OTHER)/bin/python -m pytest -q -p no:cacheprovider $(WORKERS) \
	  -W ignore::DeprecationWarning $(PART)   # those of others, as of an old matplotlib

torture: setup
	@$(BIN)/python -m torture

soak: setup
	@$(BIN)/python -m torture.soak

bench: setup $(VENV)/benchmarked
	@$(BIN)/python -m bench $(BENCH)

# Beside the compilation of the diagnosis, with make -j2.
lint: ready $(VENV)/tested
	@$(BIN)/ruff check .
	@$(BIN)/mypy asi_common asi_actuator asi_controller asi_analysis asi_examiner
	@$(BIN)/lint-imports

docs: setup $(VENV)/documented
	@$(BIN)/sphinx-build -q -W --keep-going -n -b html doc build/docs
	@echo build/docs/index.html

VERSION := -c 'import sys; print(sys.version_info[:2])'

# With what the tests, the checks and the benchmarks need.
setup: ready $(VENV)/tested $(VENV)/diagnosed

# A PYTHON that is named is the one that is used, or make stops.
ready: $(VENV)/compiled
	@test -z '$(PYTHON)' || test "$$($(PYTHON) $(VERSION))" = "$$($(BIN)/python $(VERSION))" || { \
	  echo 'make: $(VENV) was made with another version than $(PYTHON): run make clean first' >&2; \
	  exit 1; }

# LOCKED=1: the versions and hashes of requirements.lock; else the newest that setup.py allows.
# Python 3.11 to 3.13: the one that is named, else the first that can make virtual environments. An
# interpreter is tried, not only looked for: a pyenv shim exists for versions that it refuses to run.
$(VENV)/installed: setup.py setup.cfg pyproject.toml Makefile
	@for python in $(or $(PYTHON),python3 python3.13 python3.12 python3.11 /usr/bin/python3) no; do \
	  test $$python != no || { echo 'make: Python 3.11 to 3.13 with venv is needed' \
	    '(name it: make PYTHON=/path/to/python3.12)' >&2; exit 1; }; \
	  $$python -c 'import ensurepip, sys; sys.exit(not (3, 11) <= sys.version_info[:2] <= (3, 13))' \
	    2>/dev/null && break; \
	done; \
	echo "Setting up $(VENV) with $$($$python --version); about a minute" && \
	$$python -m venv --clear $(VENV)
	@test -z '$(LOCKED)' || $(BIN)/$(INSTALL) --require-hashes \
	  -r requirements.lock
	@$(BIN)/$(INSTALL) -e '.[live]'
	@touch $@

# Beside what follows, with make -j2.
$(VENV)/compiled: $(VENV)/installed
	@echo 'Compiling the model' && $(BIN)/python -m asi_analysis.loop.closed_loop
	@touch $@

# The diagnosis, too, once: each worker of the tests would.
$(VENV)/diagnosed: $(VENV)/compiled
	@echo 'Compiling the diagnosis: about a minute'
	@for world in joint textbook; do $(BIN)/asi gap check --world $$world --cases 1 --jobs 1 \
	  --out $(VENV)/world_$$world > /dev/null || exit 1; done
	@touch $@

# What a demo does not need: the first thing that a new user sees comes sooner.
$(VENV)/tested: $(VENV)/installed
	@$(BIN)/$(INSTALL) -e '.[test]'
	@touch $@

# The rivals that only the benchmark needs.
$(VENV)/benchmarked: $(VENV)/tested
	@$(BIN)/$(INSTALL) -e '.[bench]'
	@touch $@

$(VENV)/documented: $(VENV)/tested
	@$(BIN)/$(INSTALL) -e '.[docs]'
	@touch $@

clean:
	rm -rf $(VENV) build install log runs *.egg-info .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache
