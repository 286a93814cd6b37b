# Two commands set everything up: `make demo` runs the main job, `make test` runs the tests.
PYTHON ?= $(shell python3.11 -c 'import venv' 2>/dev/null && echo python3.11 || echo python3)
WORKERS ?= 2
DEVICE ?= cpu
BIN := .venv/bin
RUN := .venv/.installed
DEV := .venv/.installed-dev
# In this checkout, what its golden files and results were made with.
TORCH ?= "torch<2.14"

export PIP_DISABLE_PIP_VERSION_CHECK = 1

.PHONY: help demo test coverage test-slow test-browser test-gpu test-oldest test-newest bench lint types docs format wheel clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 12

demo: $(RUN) ## the main job: imitation of 40 demonstrations, self-examination, and a report (TASK=pick, ARGS="seed=1")
	$(BIN)/ifo-grounding demo $(if $(TASK),task=$(TASK)) $(ARGS)

test: $(DEV) ## all fast tests, doctests and examples of the docs
	OMP_NUM_THREADS=1 $(BIN)/pytest -n $(WORKERS) --dist worksteal $(ARGS)

coverage: ## the same, and that they run at least 90% of the lines, in half as long again
	$(MAKE) test ARGS="--cov $(ARGS)"

test-slow: $(DEV) ## tests that train for minutes
	OMP_NUM_THREADS=1 $(BIN)/pytest -n $(WORKERS) -m slow --timeout 3600 $(ARGS)

test-browser: $(DEV) ## tests that open pages in headless Chromium: the system's, or Playwright's own
	command -v chromium chromium-browser >/dev/null || $(BIN)/playwright install chromium
	OMP_NUM_THREADS=1 $(BIN)/pytest -m "browser and not slow" tests/browser $(ARGS)

test-gpu: $(DEV) ## tests that need a GPU, and those that pretend one where there is none
	OMP_NUM_THREADS=1 $(BIN)/pytest -m gpu $(ARGS)
	OMP_NUM_THREADS=1 $(BIN)/pytest tests/test_devices.py tests/recipes/test_two_phase.py -k gpu $(ARGS)

test-oldest: ## a quick try of every extra, each dependency at its lower bound (in .venv-oldest)
	$(PYTHON) tests/environments.py oldest $(ARGS)

test-newest: ## the same with the newest versions, upper bounds left out (in .venv-newest)
	$(PYTHON) tests/environments.py newest $(ARGS)

bench: $(DEV) ## speed of every part beside peers, in under ten minutes (ARGS="pixels step")
	for peer in navix minigrid imitation; do \
	  test -e .venv-peers/$$peer/.installed || { \
	    $(PYTHON) -m venv .venv-peers/$$peer && \
	    .venv-peers/$$peer/bin/pip install --quiet -r benchmarks/peers/$$peer.txt && \
	    touch .venv-peers/$$peer/.installed; } || echo "$$peer cannot be installed here"; \
	done
	$(BIN)/python benchmarks/run.py --device $(DEVICE) --out results/bench/$(DEVICE).json $(ARGS)

lint: $(DEV) ## style
	$(BIN)/ruff check
	$(BIN)/ruff format --check

types: $(DEV) ## type check
	$(BIN)/mypy

docs: $(DEV) ## build the documentation into site/, warnings are errors
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

format: $(DEV) ## format and fix what can be fixed
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

wheel: $(DEV) ## build dist/*.whl
	$(BIN)/pip wheel --quiet --no-deps --no-build-isolation --wheel-dir dist .

clean: ## remove the environment and all that was built
	rm -rf .venv .venv-oldest .venv-newest build dist site htmlcov .coverage .coverage.* .pytest_cache .mypy_cache .ruff_cache

$(RUN): pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable . $(TORCH)
	@touch $@

$(DEV): pyproject.toml
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --editable ".[dev,docs]" $(TORCH)
	@touch $(RUN) $@
