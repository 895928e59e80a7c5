PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
FUZZ_SECONDS ?= 60
WORKERS := --numprocesses 2 --dist loadfile

.PHONY: help venv demo test lint format bench explore fuzz judges clean

help:  ## Show what there is to make.
	@grep -E '^[a-z]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

venv: $(VENV)/.installed  ## Set up .venv with everything but the judges.

$(VENV)/.installed: pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit("edoras-tools needs Python 3.11 or newer, this is " + sys.version.split()[0] + "; try: make PYTHON=python3.12" if sys.version_info < (3, 11) else 0)'
	@$(PYTHON) -m venv $(VENV) || { echo "python3-venv is missing; on Debian: apt install python3-venv" >&2; exit 1; }
	$(BIN)/pip install --quiet --disable-pip-version-check -e '.[dev]'
	$(BIN)/python -m compileall -q edoras_tools dissectors
	@touch $@

demo: venv  ## Tour the main job on loopback.
	@$(BIN)/edoras demo

judges:  ## Install tshark, Chromium and a C compiler, the tests' judges, where they are missing.
	@.ci/install-judges

test: venv judges lint  ## Run every check and test.
	$(BIN)/python .ci/with_raw_sockets.py $(BIN)/pytest $(WORKERS)

lint: venv  ## Style, types, and which way imports point.
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

format: venv  ## Lay the code out.
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

bench: venv judges  ## Measure speed beside tshark, in one run.
	$(BIN)/python benchmarks/run.py

explore: venv  ## Run the tests with new random examples.
	HYPOTHESIS_PROFILE=explore $(BIN)/python .ci/with_raw_sockets.py $(BIN)/pytest $(WORKERS)

fuzz: venv  ## Feed garbage to every decoder for FUZZ_SECONDS.
	$(BIN)/python tests/fuzz/fuzz.py --seconds $(FUZZ_SECONDS)

clean:  ## Remove what make made.
	rm -rf $(VENV) build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache benchmarks/out
