# `make demo` and `make test` work from a fresh clone. Everything they write stays in this folder:
# the environment in .venv, caches in .cache.

PYTHON ?= python3
OUT ?= results/speed.md
EXTRAS ?= recipes,offline,docs,dev
SHELL := bash
.DEFAULT_GOAL := help

VENV := .venv/bin/python
INSTALLED := .venv/.installed-$(EXTRAS)
CACHE := $(CURDIR)/.cache

export XDG_CACHE_HOME := $(CACHE)
export PIP_CACHE_DIR := $(CACHE)/pip
export MPLCONFIGDIR := $(CACHE)/matplotlib
export TORCHINDUCTOR_CACHE_DIR := $(CACHE)/inductor
export TRITON_CACHE_DIR := $(CACHE)/triton
export WANDB_CACHE_DIR := $(CACHE)/wandb-cache
export WANDB_CONFIG_DIR := $(CACHE)/wandb-config
export WANDB_DATA_DIR := $(CACHE)/wandb-data

# Worker processes and wandb open sockets below TMPDIR, and a socket's path may have 107 characters:
# a folder in a deep checkout is too long, so a run gets a short one that goes when the run ends.
# A run that is told to stop keeps it until its checkpoint is written, hence the second trap.
WITH_TMPDIR = tmp=$$(mktemp -d) && trap 'rm -rf "$$tmp"' EXIT && trap : TERM && export TMPDIR="$$tmp" &&

.PHONY: help install demo test docs lint format bench gpu clean

help:  ## list the targets
	@sed -nE 's/^([a-z]+):.*## (.*)/\1\t\2/p' $(MAKEFILE_LIST) | expand -t 10

install: $(INSTALLED)  ## create .venv and install the tested versions (PYTHON=python3.12, EXTRAS=all)

$(INSTALLED): pyproject.toml constraints.txt
	@$(VENV) -m pip --version > /dev/null 2>&1 || { \
	  $(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { \
	    echo "constraints.txt needs Python >= 3.11, and '$(PYTHON)' is not that: try make PYTHON=python3.11 ..."; exit 1; }; \
	  $(PYTHON) -m venv .venv; }
	@echo "Installing torchrl-aca[$(EXTRAS)] into .venv (a few minutes the first time) ..."
	@$(WITH_TMPDIR) $(VENV) -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[$(EXTRAS)]"
	@touch $@

demo: $(INSTALLED)  ## train ACA on a small MuJoCo task and draw its learning curve
	@$(WITH_TMPDIR) $(VENV) recipes/online_mujoco.py --config-name quickstart

test: $(INSTALLED)  ## run all tests on up to four cores (ARGS="-m 'not slow'" for the quick ones)
	@$(WITH_TMPDIR) $(VENV) -m pytest -n auto --maxprocesses 4 --dist worksteal $(ARGS)

docs: $(INSTALLED)  ## build the documentation into docs/_build/html, warnings are errors
	@$(WITH_TMPDIR) $(VENV) -m sphinx -q -W --keep-going -b html -d .cache/doctrees $(ARGS) docs docs/_build/html
	@echo "Documentation: docs/_build/html/index.html"

lint: $(INSTALLED)  ## check style, format and types
	$(VENV) -m ruff check .
	$(VENV) -m ruff format --check .
	$(VENV) -m mypy

format: $(INSTALLED)  ## repair style and format
	$(VENV) -m ruff check --fix .
	$(VENV) -m ruff format .

bench: $(INSTALLED)  ## measure speed and write results/speed.md (THREADS=2, OUT=another.md)
	@$(WITH_TMPDIR) $(VENV) -m pytest benchmarks -q --benchmark-only --benchmark-json="$(CACHE)/speed.json" $(ARGS)
	@$(VENV) benchmarks/report.py "$(CACHE)/speed.json" "$(OUT)"

gpu:  ## on a machine with CUDA, with the torch of PYTHON: tests, speed, a short training -> results/gpu
	PYTHONPATH="$(CURDIR):recipes:benchmarks$${PYTHONPATH:+:$$PYTHONPATH}" $(PYTHON) benchmarks/gpu.py $(ARGS)

clean:  ## remove caches and builds, keep .venv and outputs
	rm -rf .cache docs/_build build dist *.egg-info
