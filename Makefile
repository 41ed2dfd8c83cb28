# `make demo` and `make test` are all a fresh machine needs: Python 3.11 or newer and make.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# one thread a process: the tests' matrices are small, and three parts run side by side, each in its fixed order
TEST := OMP_NUM_THREADS=1 $(BIN)/python -m pytest

.PHONY: demo test warm-lip warm-chain test-lipcore test-service test-packages test-updates test-docs test-browser test-kills \
	test-all screenshots lint install serve image clean

demo: install
	$(BIN)/lipserve demo

test: install
	$(MAKE) -j2 warm-lip warm-chain
	$(MAKE) -j3 test-service test-updates test-lipcore test-packages test-docs test-browser test-kills

# compiles what the parts below would else compile once each, side by side: a minute of one core
warm-lip: install
	$(BIN)/python -m lipcore.warm_up lip baselines

warm-chain: install
	$(BIN)/python -m lipcore.warm_up lip-chain

test-lipcore: install
	$(TEST) -m "not slow" tests/lipcore

test-service: install
	$(TEST) -m "not slow" $(wildcard tests/service/test_*.py)

test-packages: install
	$(TEST) -m "not slow" $(filter-out %/updates/ %/__pycache__/,$(wildcard tests/service/*/))

test-updates: install
	$(TEST) -m "not slow" tests/service/updates --ignore tests/service/updates/test_kill_trials.py

# what the documentation says, run
test-docs: install
	$(TEST) -m "not slow" tests/docs

# skipped where there is no Chromium
test-browser: install
	$(TEST) -m "not slow" tests/browser

# by itself, because a minute of it is waiting for services to start: when one of the others has ended
test-kills: install
	$(TEST) tests/service/updates/test_kill_trials.py

test-all: install
	$(TEST) --hypothesis-profile thorough

# pictures of the dashboard for the README, made by its tests
screenshots: install
	LIPSERVE_SCREENSHOTS=docs/screenshots $(TEST) tests/browser/test_journey.py tests/browser/test_states.py

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

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
