# Everything runs in .venv, made on demand from the lock file. Needs: Python >= 3.11, make.
PYTHON  ?= python3
VENV    := .venv
BIN     := $(VENV)/bin
READY   := $(VENV)/.ready
OUT     ?= runs/demo
WORKERS ?= 2
COUNT   ?= 2000
TIME    ?= 60
LOWEST  := .cache/lowest
NEWEST  := .cache/newest
MORE    := .cache/more
TRIAL   := .cache/release
PYTHONS ?= $(PYTHON)
# Compiled modules are kept, also where the environment says otherwise: the tests start hundreds of processes, and each
# begins in a third of the time with them.
export PYTHONDONTWRITEBYTECODE :=
CORE    := tests/bundle/test_packing.py tests/bundle/test_solve.py tests/bundle/test_properties.py tests/report/test_page.py tests/geometry/test_point_cloud.py \
	tests/figures/test_plots.py tests/cli/test_settings_file.py

.PHONY: help venv demo test test-long test-slow test-lowest test-newest test-more fuzz docs audit sbom release lint types format lock clean

help:  ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

venv: $(READY)  ## make the environment: locked dependencies and the package, editable

$(READY): pyproject.toml setup.py requirements.lock
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; v < (3, 11) and sys.exit("Python %d.%d found, 3.11 or later needed: call make PYTHON=python3.12, say" % v)'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --require-hashes --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	@touch $@

demo: $(READY)  ## run the system in a synthetic office; OUT=runs/demo
	$(BIN)/vggtgeo demo -o $(OUT)

test: $(READY)  ## run the tests (a few minutes); ARGS="-k name" for some
	$(BIN)/python -m pytest -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

test-long: $(READY)  ## run the tests that compile for long: derivatives, whole runs
	$(BIN)/python -m pytest -m "long and not slow" -n $(WORKERS) --dist loadfile --no-loadscope-reorder $(ARGS)

test-slow: $(READY)  ## run the slow tests: real clips, long sequences
	$(BIN)/python -m pytest -m slow $(ARGS)

fuzz: $(READY)  ## try COUNT=2000 random problems and geometries, others than the tests do
	VGGTGEO_FUZZ=$(COUNT) $(BIN)/python -m pytest -m "not slow" $(or $(ARGS),tests/bundle/test_properties.py \
		tests/geometry/test_geometry_properties.py)

# Newer packages below ours warn of what older ones of ours do: those warnings are not what is asked here.
test-lowest: $(READY)  ## test the core with the lowest versions that pyproject.toml allows, in an environment of its own
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv venv --quiet --clear --python $(PYTHON) $(LOWEST)
	$(BIN)/uv pip install --quiet --python $(LOWEST)/bin/python --resolution lowest-direct --editable ".[dev]"
	$(LOWEST)/bin/python -m pytest -o filterwarnings=ignore $(or $(ARGS),$(CORE))

# What came out since the lock was written, pre-releases left out; warnings of what will go are errors here, as in `make test`.
test-newest: $(READY)  ## test the core with the newest versions that are out, in an environment of its own
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv venv --quiet --clear --python $(PYTHON) $(NEWEST)
	$(BIN)/uv pip install --quiet --python $(NEWEST)/bin/python --upgrade --editable ".[dev]"
	$(NEWEST)/bin/python -m pytest $(or $(ARGS),$(CORE))

# Ray, Open3D and grain are large, and not in the lock: the tests that need them skip elsewhere. All markers: kills, too.
test-more: $(READY)  ## run the tests that need Ray, Open3D or grain (a cluster, an oracle, a loader), in an environment of its own
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv venv --quiet --clear --python $(PYTHON) $(MORE)
	$(BIN)/uv pip install --quiet --python $(MORE)/bin/python --constraint requirements.lock --editable ".[dev,cluster]" open3d grain
	$(MORE)/bin/python -m pytest -m "" -o filterwarnings=ignore $(or $(ARGS),tests/benchmark/test_bench_cluster.py \
		tests/evaluation/test_map_metrics.py tests/learning/test_window_dataset.py)

# The reference is read from an installed copy, where `vggtgeo.solvers` and `vggtgeo.models` are in place.
docs: $(READY)  ## build the documentation site into site/ (open site/index.html); broken links are errors
	$(BIN)/python -m pip install --quiet --require-hashes --requirement requirements-docs.lock
	rm -rf build
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --target build/docs .
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --quiet

audit: $(READY)  ## ask a public database for known vulnerabilities of what requirements.lock holds (network)
	$(BIN)/python -m pip install --quiet "pip-audit>=2.7"
	$(BIN)/pip-audit --requirement requirements.lock --require-hashes --disable-pip

sbom: $(READY)  ## write sbom.json, a bill of materials (CycloneDX) of requirements.lock; asks nobody
	$(BIN)/python -m pip install --quiet "cyclonedx-bom>=5"
	$(BIN)/cyclonedx-py requirements --output-file sbom.json requirements.lock

# The trial runs in a folder of its own, so that nothing of the source tree is imported.
release: $(READY)  ## build wheel and source archive into dist/, check them, try the wheel in empty environments; PYTHONS="3.11 3.12"
	$(BIN)/python -m pip install --quiet "build>=1.2" "twine>=6.1" uv
	rm -rf build dist $(TRIAL)
	$(BIN)/python -m build --quiet --outdir dist .
	$(BIN)/python -m twine check --strict dist/*
	$(BIN)/python .ci/check_release.py dist
	set -e; for version in $(PYTHONS); do \
		$(BIN)/uv venv --quiet --clear --python $$version $(TRIAL)/venv; \
		$(BIN)/uv pip install --quiet --python $(TRIAL)/venv/bin/python dist/*.whl; \
		(cd $(TRIAL) && venv/bin/vggtgeo --version && venv/bin/vggtgeo demo --frames 12 -o demo --quiet); \
		$(BIN)/uv pip install --quiet --python $(TRIAL)/venv/bin/python pytest hypothesis beartype; \
		(cd $(TRIAL) && venv/bin/python -m pytest -q -p no:cacheprovider ../../tests/geometry/test_lie.py); \
	done

lint: $(READY)  ## check format, style and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	@$(MAKE) --no-print-directory types

# mypy cannot follow the mapping of solvers/ and models/ in an editable install, so it reads an installed copy.
types: $(READY)  ## check types
	rm -rf build
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --target build/types .
	MYPYPATH=build/types $(BIN)/mypy --package vggtgeo

format: $(READY)  ## format the code and apply the safe fixes
	$(BIN)/ruff check --fix-only --quiet .
	$(BIN)/ruff format .

lock: $(READY)  ## renew requirements.lock for all supported Pythons and platforms
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile --quiet --universal --upgrade --python-version 3.11 --fork-strategy fewest --extra dev \
		--generate-hashes --no-annotate --no-header --no-emit-index-url --no-emit-find-links \
		--output-file requirements.lock pyproject.toml
	$(BIN)/uv pip compile --quiet --universal --upgrade --python-version 3.11 --fork-strategy fewest --extra docs \
		--constraint requirements.lock --generate-hashes --no-annotate --no-header --no-emit-index-url \
		--no-emit-find-links --output-file requirements-docs.lock pyproject.toml

clean:  ## remove what was built, keep .venv and runs
	rm -rf build dist site .cache .mypy_cache .pytest_cache .ruff_cache *.egg-info
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +
