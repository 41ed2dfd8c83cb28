# `make demo` and `make test` are all a fresh machine needs: Python 3.11 or newer and make.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# one thread a process: the tests' matrices are small, and three parts run side by side, each in its fixed order
TEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest

# the longest first
PARTS := test-packages test-service test-lipcore test-learning test-cluster test-browser test-docs test-shared

.PHONY: demo test warm-lip warm-chain bytecode test-lipcore test-service test-packages test-learning test-cluster test-shared test-docs \
	test-browser test-all screenshots lint install serve image clean

demo: install
	$(BIN)/lipserve demo

# a part that fails keeps no other from running; make still fails in the end
test: install
	failed=0; \
	$(MAKE) -j2 --keep-going warm-lip warm-chain bytecode || failed=1; \
	$(MAKE) -j3 --keep-going $(PARTS) || failed=1; \
	exit $$failed

# compiles what the parts below would else compile once each, side by side: a minute of one core
warm-lip: install
	$(BIN)/python -m lipcore.warm_up lip rigid-body

warm-chain: install
	$(BIN)/python -m lipcore.warm_up lip-chain

# of ours: where Python is told to write none, each of the many processes that tests start would else compile it again
bytecode: install
	$(BIN)/python -m compileall -q lipcore service

test-lipcore: install
	$(TEST) -m "not slow" tests/lipcore

test-service: install
	$(TEST) -m "not slow" $(wildcard tests/service/test_*.py)

test-packages: install
	$(TEST) -m "not slow" $(filter-out %/learning/ %/__pycache__/,$(wildcard tests/service/*/))

test-learning: install
	$(TEST) -m "not slow" tests/service/learning

# several services with a real PostgreSQL server, S3 endpoint and Dask cluster, which the tests start
test-cluster: install
	$(TEST) -m "not slow" tests/cluster

# the API once more, as the other parts test it with SQLite and local files: now on PostgreSQL and S3
SHARED := models/test_aliases.py models/test_deletion.py access/test_keys.py test_job_requests.py test_predicting.py \
	test_health_and_errors.py
MORE_SHARED := models/test_alias_answers.py access/test_scopes.py access/test_commands.py test_dataset_listing.py \
	test_training.py test_cancelling.py test_evaluating.py test_robots.py test_upload_transport.py bad_requests \
	client/test_idempotency.py archives/test_round_trip.py observability/test_metrics_of_service.py \
	learning/test_observations.py learning/test_learning_routes.py learning/test_rollback.py learning/test_unlearning.py \
	learning/test_inspection.py learning/test_alarm_routes.py learning/test_log.py

# (pytest's own tracebacks run into a limit of Python's parser on rewritten assertions of this depth)
test-shared: install
	$(TEST) --backend shared --tb=native -m "not slow" $(addprefix tests/service/,$(SHARED))

# what the documentation says, run
test-docs: install
	$(TEST) -m "not slow" tests/docs

# skipped where there is no Chromium
test-browser: install
	$(TEST) -m "not slow" tests/browser

test-all: install
	failed=0; \
	$(TEST) --hypothesis-profile thorough || failed=1; \
	$(TEST) --backend shared --tb=native $(addprefix tests/service/,$(SHARED) $(MORE_SHARED)) || failed=1; \
	exit $$failed

# pictures of the dashboard for the README, made by its tests
screenshots: install
	LIPSERVE_SCREENSHOTS=docs/screenshots $(TEST) tests/browser/test_journey.py tests/browser/test_states.py

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

serve: install
	$(BIN)/lipserve serve

image:
	docker build -t lipserve .

install: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml .ci/install-torch
	@echo "installing into $(VENV): about 3 GB, two to four minutes"
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed, this is " + sys.version)'
	$(PYTHON) -m venv $(VENV)
	.ci/install-torch $(BIN)/python
	$(BIN)/python -m pip install --disable-pip-version-check -e '.[sim,plot,cluster,dev]'
	@touch $@

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis dist build
	find lipcore service tests -name __pycache__ -type d -prune -exec rm -rf {} +
