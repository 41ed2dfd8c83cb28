# A fresh machine needs Python 3.11 or newer and make, then `make demo` or `make test`.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# with that variable every process compiles all modules again
unexport PYTHONDONTWRITEBYTECODE
# one thread a process: the tests' matrices are small, and several processes run at a time
TEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest
# parallel test processes; tests that share a service run in the same process: tests/conftest.py
WORKERS ?= 3
SHARE := -n $(WORKERS) --dist loadfile --no-loadscope-reorder

.PHONY: demo test warm-lip warm-chain bytecode test-all nightly year screenshots fuzz fuzz-long cpp lint install install-all serve image image-serve docs dist sbom clean

demo: $(VENV)/.running
	$(BIN)/lipserve demo

# all tests that are not slow, and one journey each of real services, browsers and compilers: three minutes on two cores
test: install
	$(MAKE) -j2 warm-lip warm-chain bytecode
	$(TEST) $(SHARE) -m "not slow" $(TESTS)

# compiles kernels once, which all test processes would compile again: a minute of one core
warm-lip: install
	$(BIN)/python -m lipcore.warm_up lip rigid-body

warm-chain: install
	$(BIN)/python -m lipcore.warm_up lip-chain

# bytecode of the packages and of the tests as rewritten by pytest, which all processes would compile again
# (errors of the collection are ignored here; `make test` shows them)
bytecode: install
	$(BIN)/python -m compileall -q lipcore service clients/python/lipserve benchmarks
	$(TEST) --collect-only -q -m "not slow" $(TESTS) > /dev/null || true

# tests of the API that also run on PostgreSQL and S3
SHARED := $(addprefix tests/service/, \
	models/test_aliases.py models/test_deletion.py models/test_alias_answers.py models/archives/test_round_trip.py \
	api/access/test_keys.py api/access/test_scopes.py api/access/test_commands.py api/bad_requests \
	api/test_metrics_of_service.py telemetry/test_readiness.py inference/test_predicting.py inference/test_evaluating.py \
	training/test_job_requests.py training/test_training.py training/test_cancelling.py robots/test_robots.py \
	datasets/test_uploads.py datasets/test_reading_again.py learning/test_observations.py learning/test_learning_routes.py learning/test_undoing.py \
	learning/test_inspection.py learning/test_log.py) tests/clients/python/test_idempotency.py

# seconds of recorded histories (tests/system/histories): half on SQLite, half on three services
HISTORY_S ?= 3600

# all tests; pytest's own tracebacks exceed a limit of Python's parser on these rewritten assertions
test-all: install-all
	failed=0; \
	LIPSERVE_HISTORY_S=$$(( $(HISTORY_S) / 2 )) $(TEST) $(SHARE) --hypothesis-profile thorough || failed=1; \
	$(TEST) --backend shared --tb=native $(SHARED) || failed=1; \
	exit $$failed

# all tests, with histories of ten minutes
nightly:
	$(MAKE) test-all HISTORY_S=600

# a simulated year of twenty robots, about four hours; `make test-all` runs a month of three
YEAR_DAYS ?= 365
YEAR_ROBOTS ?= 20
year: install-all
	LIPSERVE_YEAR_DAYS=$(YEAR_DAYS) LIPSERVE_YEAR_ROBOTS=$(YEAR_ROBOTS) $(TEST) -s tests/year/test_year.py

# screenshots of the dashboard for README and guide; `pytest tests/system/browser/test_pages.py --pictures FOLDER` takes one of
# every page
screenshots: install-all
	LIPSERVE_SCREENSHOTS=docs/screenshots $(TEST) tests/system/browser/test_journey.py tests/system/browser/test_arm.py tests/system/browser/test_payload.py

# fuzzes the readers of uploads with Atheris, each for SECONDS; findings go to build/fuzz
FUZZ ?= csv json json_lines npz parquet feather hdf5 npy xlsx gzip yaml rosbag1 rosbag2 mcap zip urdf archive manifest tensors
SECONDS ?= 60
fuzz: install-all
	$(BIN)/python -m pip install --disable-pip-version-check --quiet -e '.[fuzz]'
	failed=0; for each in $(FUZZ); do $(BIN)/python -m tests.fuzz $$each $(SECONDS) || failed=1; done; exit $$failed

fuzz-long:
	$(MAKE) fuzz SECONDS=1800

# builds example and test of the C++ client; needs CMake and a C++17 compiler
cpp:
	cmake -S clients/cpp -B build/cpp
	cmake --build build/cpp
	ctest --test-dir build/cpp --output-on-failure

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/codespell lipcore service clients benchmarks tests docs *.md Makefile

serve: $(VENV)/.running
	$(BIN)/lipserve serve

# the full image, and one that serves and learns only
image:
	docker build -t lipserve .

image-serve:
	docker build --target serve -t lipserve:serve .

# the documentation as a site, service/api/guide/site, which the service shows at /guide
docs: install-all
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

# wheels and sdists of both distributions in dist/; with TAG=v1.2.3, fails for another version
dist: install-all
	rm -rf dist
	$(BIN)/python -m build --outdir dist clients/python
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*
	@test -z "$(TAG)" || ls $(patsubst v%,dist/lipserve-%-py3-none-any.whl,$(TAG)) $(patsubst v%,dist/lipserve_client-%-py3-none-any.whl,$(TAG))

# packages of the image's environment: build/sbom.json (CycloneDX) and build/licences.md. Fails if a licence is
# incompatible with Apache-2.0. Exceptions: psycopg is LGPL and linked at run time; Qhull declares no licence, its own is
# permissive.
IMAGE := build/image
LICENCES := $(BIN)/pip-licenses --python $(IMAGE)/bin/python --from mixed
sbom: install-all
	rm -rf $(IMAGE) && $(PYTHON) -m venv $(IMAGE)
	.ci/install-torch $(IMAGE)/bin/python
	$(IMAGE)/bin/python -m pip install --quiet $$(grep -o "\./clients/python '[^']*'" Dockerfile | tail -1 | tr -d "'")
	$(IMAGE)/bin/python -m pip uninstall --yes --quiet setuptools pip
	$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --output-file build/sbom.json $(IMAGE)/bin/python
	$(LICENCES) --format markdown --output-file build/licences.md
	$(LICENCES) --partial-match --fail-on "GPL;General Public;Affero;SSPL;UNKNOWN" \
		--ignore-packages psycopg psycopg-binary cmeel-qhull > /dev/null

install: $(VENV)/.installed

install-all: $(VENV)/.installed-all

# pip compiles no bytecode: most of it is never imported. The value 0 means that, 1 does not
export PIP_NO_COMPILE := 0

# with the newest pip: that of Python 3.11 takes twice as long
$(VENV)/.created:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is required; this is " + sys.version)'
	$(PYTHON) -m venv --upgrade-deps $(VENV)
	@touch $@

INSTALL := $(BIN)/python -m pip install --disable-pip-version-check -e clients/python -e
PROJECT := $(VENV)/.created pyproject.toml clients/python/pyproject.toml hatch_build.py

# an environment that can run the service
$(VENV)/.running: $(PROJECT)
	@echo "installing into $(VENV): one to two minutes"
	$(INSTALL) '.[sim,ingest]'
	@touch $@

# the same with the dependencies of `make test` and `make lint`
$(VENV)/.installed: $(PROJECT) .ci/install-torch
	@echo "installing into $(VENV): two minutes"
	.ci/install-torch $(BIN)/python
	$(INSTALL) '.[all,test,lint]'
	@touch $@ $(VENV)/.running

# the same with the dependencies of everything else
$(VENV)/.installed-all: $(VENV)/.installed
	$(INSTALL) '.[dev]'
	@touch $@

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis dist build
	find lipcore service clients tests -name __pycache__ -type d -prune -exec rm -rf {} +
