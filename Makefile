# One command each, from a bare checkout: needs Python 3.11 with venv, and make.
#   make train    set up if needed, then run the main job (ARGS="--seed 1" adds options)
#   make test     set up if needed, then run the tests
# The rest: lint type format bench docs test-latest clean.

.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
SHELL := /bin/bash

PYTHON ?= $(shell command -v python3.11 || command -v python3)
# A version manager may put a shim called python3.12 on the path without a Python
# 3.12 behind it, so it counts only if it runs.
PYTHON312 ?= $(shell python3.12 -c 'import sys; print(sys.executable)' 2>/dev/null)
JOBS ?= 2
ARGS ?=

VENV := .venv
LATEST := .venv-latest
PY := $(VENV)/bin/python
STAMP := $(VENV)/.installed
LATEST_STAMP := $(LATEST)/.installed
PIP := -m pip --disable-pip-version-check install --quiet

.PHONY: help setup train test test-slow test-latest lint format type bench docs clean

help:
	@sed -n 's/^#  *//p' Makefile

setup: $(STAMP)

$(STAMP): requirements.lock pyproject.toml
	@test -n "$(PYTHON)" || { echo "no python3 found: install Python 3.11"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info[:2] != (3, 11))' || { \
	  echo "the locked set-up is for Python 3.11, found $$($(PYTHON) -V): say"; \
	  echo "make PYTHON=/path/to/python3.11, or see make test-latest for 3.12"; exit 1; }
	test -x $(PY) || $(PYTHON) -m venv $(VENV)
	$(PY) $(PIP) -r requirements.lock
	$(PY) $(PIP) --no-deps --no-build-isolation -e .
	@touch $@

train: $(STAMP)
	$(PY) train.py $(ARGS)

test: $(STAMP)
	$(PY) -m pytest -n $(JOBS) --dist loadfile $(ARGS)

test-slow: $(STAMP)
	$(PY) -m pytest -m slow $(ARGS)

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

docs: $(STAMP)
	$(PY) $(PIP) -c requirements.lock -e '.[docs]'
	$(PY) -m mkdocs build --strict

# Python 3.12 and the newest release of everything.
test-latest:
ifeq ($(PYTHON312),)
	@echo "test-latest: no Python 3.12 here (name one: make test-latest PYTHON312=...)"
else
	@$(MAKE) --no-print-directory $(LATEST_STAMP)
	$(LATEST)/bin/python -m pytest -n $(JOBS) --dist loadfile $(ARGS)
endif

$(LATEST_STAMP): pyproject.toml
	test -x $(LATEST)/bin/python || $(PYTHON312) -m venv $(LATEST)
	$(LATEST)/bin/python $(PIP) --upgrade --upgrade-strategy eager -e '.[dev]'
	@touch $@

clean:
	rm -rf $(VENV) $(LATEST) build dist site .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
