# make demo   set up .venv, stylise a mesh on the CPU, say where the result is
# make test   set up .venv, run every test
# make lint   ruff and mypy
# make conformance   write docs/conformance.md from the checks of every renderer
# Override: PYTHON (which interpreter), CONSTRAINTS (pinned versions; empty for none), PIP_FLAGS.

PYTHON ?= python3
CONSTRAINTS ?= constraints.txt
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check \
	$(if $(CONSTRAINTS),--constraint $(CONSTRAINTS)) $(PIP_FLAGS)

# Two busy cores and spinning OpenMP threads make everything many times slower.
export OMP_WAIT_POLICY ?= PASSIVE
# Named meshes and images, where there are some beside the checkout.
export STYLEEXP_ASSETS ?= $(wildcard $(abspath ../shared))

.PHONY: demo test lint conformance clean
.DELETE_ON_ERROR:

demo: $(VENV)/.installed
	$(BIN)/styleexp source=critter style=bubble hydra.run.dir=outputs/demo

test: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pip check

conformance: $(VENV)/.installed-dev
	$(BIN)/python -m styleexp.testing > docs/conformance.md

clean:
	rm -rf $(VENV) build dist src/*.egg-info

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "styleexp needs Python 3.11 or newer: make PYTHON=python3.12 ..."; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml $(wildcard constraints.txt) | $(BIN)/python
	$(PIP) --editable .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml $(wildcard constraints.txt) | $(BIN)/python
	$(PIP) --editable '.[dev,all]'
	@touch $@ $(VENV)/.installed
