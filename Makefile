# make demo   set up .venv, stylise a mesh on the CPU, print where the result is
# make test   set up .venv, run every test
# make test-quick   the tests of geometry, files, losses and fields alone, which run no command: under
#             two minutes on two cores
# make test-cuda   the tests of CUDA alone, on a GPU or, with a torch without CUDA, a simulated one
# make test-simulated   every test with the simulated GPU as its device (what fails: docs/benchmarks.md)
# make lint   ruff and mypy
# make docs   the documentation, to site/index.html; warnings are errors
# make blender   pack the Blender extension: dist/styleexp-blender-VERSION.zip
# make blender-test   its tests in Blender without a window, which is a 374 MB package in an
#             environment of its own (.venv-bpy)
# make conformance   write docs/conformance.md from the checks of every renderer
# make stress   all slow tests: kill runners and workers of sweeps ten times each, with every
#               local launcher; start two sweeps at once twenty times each way; random meshes,
#               files, overrides and renders, STRESS_FUZZ times as many as in CI; every fault of
#               benchmarks/faults.py; benchmarks/long_haul.py. Each of the last three gets
#               STRESS_SECONDS. (make stress-sweeps stress-folders stress-fuzz stress-faults
#               stress-long: one of them)
# make matrix   install and run as wheel, editable, with the oldest and the newest dependencies, on
#               every available Python (noxfile.py)
# make sbom   the contents of .venv, as CycloneDX, in build/sbom.json (tools in .venv-security)
# make audit  known vulnerabilities in .venv (queries pypi.org)
# make bench-guard   compare the speed of this tree with a commit (BASE=...), interleaved on this machine
# make ray-test   a sweep on a local Ray cluster, in a separate environment (.venv-ray)
# Override: PYTHON (which interpreter), CONSTRAINTS (pinned versions; empty for none), PIP_FLAGS.

PYTHON ?= python3
CONSTRAINTS ?= constraints.txt
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check \
	$(if $(CONSTRAINTS),--constraint $(CONSTRAINTS)) $(PIP_FLAGS)

# Factor on CI's number of random examples, and time limit in seconds for each long part.
STRESS_FUZZ ?= 50
STRESS_SECONDS ?= 3600

# Tests of functions, in the tests' own process; those of them that are marked as slow are left out.
QUICK := $(addprefix tests/,encoders system \
	$(addprefix inputs/test_,gltf.py images.py meshes.py ply_obj.py refining.py shapes.py welding.py) \
	$(addprefix method/test_,fields.py height_maps.py losses.py masks.py relief.py remembered.py \
	styles.py views.py) experiments/test_collect.py experiments/test_reports_study.py)

# On busy cores, spinning OpenMP threads make everything many times slower.
export OMP_WAIT_POLICY ?= PASSIVE
# Named meshes and images, if there are any next to the checkout.
export STYLEEXP_ASSETS ?= $(wildcard $(abspath ../shared))

.PHONY: demo test test-quick test-cuda test-simulated lint docs blender blender-test conformance stress stress-sweeps stress-folders stress-fuzz stress-faults \
	stress-long matrix sbom audit bench-guard ray-test clean
.DELETE_ON_ERROR:

demo: $(VENV)/.installed
	$(BIN)/styleexp critter scales hydra.run.dir=outputs/demo

test: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal

test-quick: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal -m 'not slow' $(QUICK)

test-cuda: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal tests/cuda

test-simulated: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m pytest -n auto --dist worksteal -p tests.helpers.simulated_cuda

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python -m pip check

docs: $(VENV)/.installed-dev
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict
	@echo site/index.html

blender:
	$(PYTHON) blender/build.py

# bpy is GPL, and for Python 3.11 alone: never beside the package.
blender-test: $(VENV)/.installed $(VENV)-bpy/.installed
	STYLEEXP_COMMAND=$(abspath $(BIN)/styleexp) OMP_NUM_THREADS=1 \
		$(VENV)-bpy/bin/python -m pytest --noconftest tests/blender/test_extension.py

$(VENV)-bpy/.installed: Makefile
	test -x $(VENV)-bpy/bin/python || python3.11 -m venv $(VENV)-bpy
	$(VENV)-bpy/bin/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) \
		'bpy==5.0.1' 'pytest>=8'
	@touch $@

conformance: $(VENV)/.installed-dev
	$(BIN)/python -m styleexp.testing > docs/conformance.md

stress: stress-sweeps stress-folders stress-fuzz stress-faults stress-long

stress-sweeps: $(VENV)/.installed-dev
	STYLEEXP_KILLS=10 OMP_NUM_THREADS=1 $(BIN)/python -m pytest tests/experiments/test_sweeps.py -k kill_9

stress-folders: $(VENV)/.installed-dev
	STYLEEXP_PAIRS=20 OMP_NUM_THREADS=1 $(BIN)/python -m pytest tests/runs/test_folders.py -k two_sweeps

stress-faults: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python -m benchmarks.faults --seconds $(STRESS_SECONDS)

stress-long: $(VENV)/.installed-dev
	OMP_NUM_THREADS=1 $(BIN)/python benchmarks/long_haul.py --seconds $(STRESS_SECONDS)

stress-fuzz: $(VENV)/.installed-dev
	STYLEEXP_FUZZ=$(STRESS_FUZZ) OMP_NUM_THREADS=1 timeout $(STRESS_SECONDS) \
		$(BIN)/python -m pytest tests/inputs/test_fuzz.py

sbom: $(VENV)-security/.installed $(VENV)/.installed-dev
	mkdir -p build
	$(VENV)-security/bin/cyclonedx-py environment $(BIN)/python --pyproject pyproject.toml \
		--output-reproducible --of JSON -o build/sbom.json
	@echo build/sbom.json

audit: $(VENV)-security/.installed $(VENV)/.installed-dev
	$(BIN)/python -m pip freeze --exclude-editable > $(VENV)-security/frozen.txt
	$(VENV)-security/bin/pip-audit --strict --disable-pip --no-deps -r $(VENV)-security/frozen.txt

$(VENV)-security/.installed: Makefile
	test -x $(VENV)-security/bin/python || $(PYTHON) -m venv $(VENV)-security
	$(VENV)-security/bin/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) \
		'cyclonedx-bom==7.5.0' 'pip-audit==2.10.1'
	@touch $@

bench-guard: $(VENV)/.installed-dev
	$(BIN)/python benchmarks/guard.py $(BASE)

matrix: $(VENV)-nox/.installed
	PATH="$(abspath $(VENV)-nox/bin):$$PATH" nox

$(VENV)-nox/.installed: Makefile
	test -x $(VENV)-nox/bin/python || $(PYTHON) -m venv $(VENV)-nox
	$(VENV)-nox/bin/python -m pip install --quiet --disable-pip-version-check $(PIP_FLAGS) \
		'nox>=2025.2' 'uv>=0.8'
	@touch $@

# The Ray launcher pins cloudpickle below the tested version.
ray-test: pyproject.toml constraints.txt
	test -x $(VENV)-ray/bin/python || $(PYTHON) -m venv $(VENV)-ray
	grep -v -i '^cloudpickle==' constraints.txt > $(VENV)-ray/constraints.txt
	$(VENV)-ray/bin/python -m pip install --quiet --disable-pip-version-check \
		--constraint $(VENV)-ray/constraints.txt $(PIP_FLAGS) --editable '.[ray]' pytest
	OMP_NUM_THREADS=1 $(VENV)-ray/bin/python -m pytest tests/experiments/test_ray.py

clean:
	rm -rf $(VENV) $(VENV)-ray $(VENV)-security $(VENV)-nox $(VENV)-bpy .nox build dist src/*.egg-info

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "styleexp needs Python 3.11 or newer: make PYTHON=python3.12 ..."; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml $(wildcard constraints.txt) | $(BIN)/python
	$(PIP) --editable .
	@touch $@

$(VENV)/.installed-dev: pyproject.toml $(wildcard constraints.txt) | $(BIN)/python
	$(PIP) --editable '.[dev,docs,all]'
	@touch $@ $(VENV)/.installed
