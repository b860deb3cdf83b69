# One command each, from a bare checkout: needs Python 3.11 with venv, and make.
#   make train    set up if needed, then run the main job (ARGS="--seed 1" adds options)
#   make test     set up if needed, then run the tests
#   make view     set up if needed, then open the live view (ARGS="--robot panda")
#   make paper    set up if needed, then run the paper's experiments (PRESET=smoke)
# The rest: lint type format faults mutants bench bench-peers bench-gate deploy-demo docs
#   wheel sbom audit test-latest clean.

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
SHELL := /bin/bash

# A version manager may put a shim called python3.11 on the path without a Python 3.11
# behind it, so one counts only if it runs and says so.
find = $(shell for p in python$(1) python3; do $$p -c 'import sys; \
  v = "%d.%d" % sys.version_info[:2]; sys.exit(v != "$(1)" or print(sys.executable))' \
  2>/dev/null && break; done)
PYTHON ?= $(call find,3.11)
PYTHON312 ?= $(call find,3.12)
JOBS ?= 2
ARGS ?=
PRESET ?= cpu

VENV := .venv
LATEST := .venv-latest
PY := $(VENV)/bin/python
STAMP := $(VENV)/.installed
LATEST_STAMP := $(LATEST)/.installed
TOOLS := build/tools
PIP := -m pip --disable-pip-version-check install --quiet

.PHONY: help setup train view paper test test-slow test-latest faults mutants lint format \
  type bench bench-peers bench-gate deploy-demo docs wheel sbom audit clean

help:
	@sed -n '1,7s/^#  *//p' Makefile

setup: $(STAMP)

$(STAMP): requirements.lock pyproject.toml
	@test -x $(PY) || test -n "$(PYTHON)" || { \
	  echo "Python 3.11 not found (the locked set-up is for it): install it, or say"; \
	  echo "make PYTHON=/path/to/python3.11; for 3.12 see make test-latest"; exit 1; }
	test -x $(PY) || $(PYTHON) -m venv $(VENV) || { rm -rf $(VENV); exit 1; }
	$(PY) $(PIP) --require-hashes -r requirements.lock
	$(PY) $(PIP) --no-deps --no-build-isolation -e .
	@touch $@

train: $(STAMP)
	$(PY) train.py $(ARGS)

view: $(STAMP)
	$(PY) -m rmp_mjx.viewer $(ARGS)

paper: $(STAMP)
	$(PY) -m benchmarks.paper --preset $(PRESET) $(ARGS)

test: $(STAMP)
	$(PY) -m pytest -n $(JOBS) --dist loadfile $(ARGS)

test-slow: $(STAMP)
	$(PY) -m pytest -m slow $(ARGS)

# Hostile input in numbers; prints the figures of docs/reliability.md.
faults: $(STAMP)
	$(PY) -m pytest -m faults $(ARGS)
	$(PY) -m benchmarks.faults
	$(PY) -m benchmarks.soak

# Do the tests see small changes of the code? A random sample of them: half an hour for
# --sample 60. Goes on where it was interrupted.
mutants: $(STAMP) $(TOOLS)
	$(PY) -m benchmarks.mutants $(ARGS)

lint: $(STAMP)
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .

format: $(STAMP)
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

type: $(STAMP)
	$(PY) -m pyright

bench: $(STAMP)
	@mkdir -p runs/bench
	$(PY) -m benchmarks.bench_controller --json runs/bench/controller.json $(ARGS)
	$(PY) -m benchmarks.bench_env --json runs/bench/env.json $(ARGS)

# Ours against its peers, each in an environment of its own under ~/.cache/rmp_mjx.
bench-peers: $(STAMP)
	@mkdir -p runs/bench
	$(PY) -m benchmarks.peers --json runs/bench/peers.json $(ARGS)

# Fails where speed is lost against benchmarks/results/gate_baseline.json.
bench-gate: $(STAMP)
	$(PY) -m benchmarks.gate $(ARGS)

docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict

# Wheel and sdist, byte for byte the same twice, each installed into a fresh environment
# and tried from another folder.
wheel: $(STAMP)
	rm -rf dist build/again build/installed
	$(PY) -m hatchling build
	$(PY) -m hatchling build -d build/again
	diff -r dist build/again
	$(PY) -m venv build/installed
	sed -n 's/ .*//; /==/p' requirements.lock > build/constraints.txt
	build/installed/bin/python $(PIP) -c build/constraints.txt dist/*.whl
	cd build && installed/bin/python -P ../tests/installed.py
	build/installed/bin/python $(PIP) --force-reinstall --no-deps dist/*.tar.gz
	cd build && installed/bin/python -P ../tests/installed.py

# A pretrained policy on an FR3 through the robot's own bindings, against a server that
# speaks the robot's protocol. Both in places of their own: they pin old packages.
deploy-demo: $(STAMP) build/franka-sim/.installed
	PYTHONPATH=$(CURDIR):build/pylibfranka $(PY) -m benchmarks.deploy_demo $(ARGS)

build/franka-sim/.installed:
	$(PY) -m venv build/franka-sim
	build/franka-sim/bin/python $(PIP) franka-sim==1.1.7
	$(PY) $(PIP) --no-deps --target build/pylibfranka pylibfranka==0.21.3
	@touch $@

# What is installed, and under which licences: build/sbom.json (CycloneDX), licences.md.
sbom: $(STAMP) $(TOOLS)
	$(TOOLS)/bin/cyclonedx-py environment --output-file build/sbom.json $(PY)
	$(TOOLS)/bin/pip-licenses --python $(PY) --format markdown --with-urls \
	  --output-file build/licences.md

# Known vulnerabilities of what is locked; asks a database on the internet.
audit: $(TOOLS)
	$(TOOLS)/bin/pip-audit --require-hashes --disable-pip -r requirements.lock

$(TOOLS): $(STAMP)
	$(PY) -m venv $@
	$@/bin/python $(PIP) cosmic-ray cyclonedx-bom pip-audit pip-licenses

# Python 3.12 and the newest release of everything.
test-latest:
	@test -n "$(PYTHON312)" || \
	  echo "no Python 3.12 here: name one with make test-latest PYTHON312=..."
	@test -z "$(PYTHON312)" || $(MAKE) --no-print-directory $(LATEST_STAMP)
	@test -z "$(PYTHON312)" || \
	  $(LATEST)/bin/python -m pytest -n $(JOBS) --dist loadfile $(ARGS)

$(LATEST_STAMP): pyproject.toml
	test -x $(LATEST)/bin/python || $(PYTHON312) -m venv $(LATEST)
	$(LATEST)/bin/python $(PIP) --upgrade --upgrade-strategy eager -e '.[dev]'
	@touch $@

clean:
	rm -rf $(VENV) $(LATEST) build dist site .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
