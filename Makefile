# `make demo` and `make test` are all a fresh machine needs: Python 3.11 or newer and make.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# one thread a process: the tests' matrices are small, and several processes run side by side
TEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest
# as many as run side by side, here and in `make test-all`; tests that share a service stay together: tests/conftest.py
WORKERS ?= 3
SHARE := -n $(WORKERS) --dist loadfile --no-loadscope-reorder

.PHONY: demo test warm-lip warm-chain bytecode test-all nightly screenshots fuzz cpp lint install serve image image-serve docs dist sbom clean

demo: $(VENV)/.running
	$(BIN)/lipserve demo

# five to six minutes on two cores; some tests of each kind, the others are slow
test: install
	$(MAKE) -j2 warm-lip warm-chain bytecode
	$(TEST) $(SHARE) -m "not slow" $(TESTS)

# compiles what the tests' processes would else compile once each, side by side: a minute of one core
warm-lip: install
	$(BIN)/python -m lipcore.warm_up lip rigid-body

warm-chain: install
	$(BIN)/python -m lipcore.warm_up lip-chain

# of ours, and of tests as pytest rewrites them: each of the processes that tests start would else compile it again
# (what cannot be collected is said by the tests themselves, in sight)
bytecode: install
	$(BIN)/python -m compileall -q lipcore service clients/python/lipserve benchmarks
	PYTHONDONTWRITEBYTECODE= $(TEST) --collect-only -q -m "not slow" $(TESTS) > /dev/null || true

# the API as all tests know it with SQLite and local files, once more on PostgreSQL and S3
SHARED := models/test_aliases.py models/test_deletion.py access/test_keys.py test_job_requests.py test_predicting.py \
	observability/test_readiness.py models/test_alias_answers.py access/test_scopes.py access/test_commands.py \
	test_training.py test_cancelling.py test_evaluating.py test_robots.py \
	test_uploads.py bad_requests client/test_idempotency.py archives/test_round_trip.py \
	observability/test_metrics_of_service.py learning/test_observations.py learning/test_learning_routes.py \
	learning/test_undoing.py learning/test_inspection.py learning/test_log.py

# seconds of recorded histories (tests/histories): half on SQLite, half on three services
HISTORY_S ?= 3600

# (pytest's own tracebacks run into a limit of Python's parser on rewritten assertions of this depth)
test-all: install
	failed=0; \
	LIPSERVE_HISTORY_S=$$(( $(HISTORY_S) / 2 )) $(TEST) $(SHARE) --hypothesis-profile thorough || failed=1; \
	$(TEST) --backend shared --tb=native $(addprefix tests/service/,$(SHARED)) || failed=1; \
	exit $$failed

# the same with histories of ten minutes
nightly:
	$(MAKE) test-all HISTORY_S=600

# pictures of the dashboard for README and guide, made by its tests; `pytest tests/browser/test_pages.py --pictures FOLDER`
# makes one of every page
screenshots: install
	LIPSERVE_SCREENSHOTS=docs/screenshots $(TEST) tests/browser/test_journey.py tests/browser/test_arm.py tests/browser/test_payload.py

# readers of uploads, fuzzed with Atheris, one after the other for so many seconds: findings go to build/fuzz
FUZZ := csv json json_lines npz parquet rosbag1 rosbag2 mcap zip urdf archive manifest tensors
SECONDS ?= 60
fuzz: install
	$(BIN)/python -m pip install --disable-pip-version-check --quiet -e '.[fuzz]'
	failed=0; for each in $(FUZZ); do $(BIN)/python -m tests.fuzz $$each $(SECONDS) || failed=1; done; exit $$failed

# the C++ client: its example and its test; needs CMake and a compiler of C++17, and nothing else here does
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

# the image of all that runs in a container, and one that serves, streams and learns only
image:
	docker build -t lipserve .

image-serve:
	docker build --target serve -t lipserve:serve .

# the documentation as a site, service/api/guide/site: what the service shows below /guide
docs: install
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build

# wheels and sdists of both distributions, dist/; with TAG=v1.2.3 they have to be of that version
dist: install
	rm -rf dist
	$(BIN)/python -m build --outdir dist clients/python
	$(BIN)/python -m build --outdir dist .
	$(BIN)/twine check --strict dist/*
	@test -z "$(TAG)" || ls $(patsubst v%,dist/lipserve-%-py3-none-any.whl,$(TAG)) $(patsubst v%,dist/lipserve_client-%-py3-none-any.whl,$(TAG))

# what the image's environment holds: build/sbom.json (CycloneDX) and build/licences.md; the release writes one of the
# image as a whole. Fails at a licence that does not go with Apache-2.0. Known: psycopg is LGPL and linked at run time;
# Qhull, which names no licence, has a permissive one of its own.
IMAGE := build/image
LICENCES := $(BIN)/pip-licenses --python $(IMAGE)/bin/python --from mixed
sbom: install
	rm -rf $(IMAGE) && $(PYTHON) -m venv $(IMAGE)
	.ci/install-torch $(IMAGE)/bin/python
	$(IMAGE)/bin/python -m pip install --quiet $$(grep -o "\./clients/python '[^']*'" Dockerfile | tail -1 | tr -d "'")
	$(IMAGE)/bin/python -m pip uninstall --yes --quiet setuptools pip
	$(BIN)/cyclonedx-py environment --pyproject pyproject.toml --output-file build/sbom.json $(IMAGE)/bin/python
	$(LICENCES) --format markdown --output-file build/licences.md
	$(LICENCES) --partial-match --fail-on "GPL;General Public;Affero;SSPL;UNKNOWN" \
		--ignore-packages psycopg psycopg-binary cmeel-qhull > /dev/null

install: $(VENV)/.installed

# what the main job needs
$(VENV)/.running: pyproject.toml clients/python/pyproject.toml hatch_build.py
	@echo "installing into $(VENV): one to two minutes"
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, this is " + sys.version)'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --disable-pip-version-check --no-compile -e clients/python -e '.[sim,ingest]'
	@touch $@

# and what tests it
$(VENV)/.installed: $(VENV)/.running .ci/install-torch
	@echo "installing what the tests need into $(VENV): 2 GB, one to two minutes"
	.ci/install-torch $(BIN)/python
	$(BIN)/python -m pip install --disable-pip-version-check -e clients/python -e '.[all,dev,docs,publish]'
	@touch $@

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis dist build
	find lipcore service clients tests -name __pycache__ -type d -prune -exec rm -rf {} +
