# Everything starts here: `make demo`, `make test`, `make serve`. Needs Python 3.11 or newer, and make.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
DOCS_READY := $(VENV)/.docs
COLLECTED := $(VENV)/.collected
FAST   := not slow and not ray and not postgres and not browser and not data
TEST_PROCESSES ?= 3
# One cache for all checkouts of a user: mypy looks at the content of files, not at their place.
export MYPY_CACHE_DIR ?= $(or $(XDG_CACHE_HOME),$(HOME)/.cache)/lagid/mypy

.DEFAULT_GOAL := help
.PHONY: help demo paper serve test suite warm check check-code check-unit check-laws format docs site openapi bench bench-full mutants night real-data clean

help:
	@echo "make demo        set up, run the paper's Example 1 through the service, print the table"
	@echo "make paper       set up, reproduce the paper's tables and figures with real jobs: paper.html"
	@echo "make serve       set up, keep the service up on http://127.0.0.1:8000"
	@echo "make test        set up, run the whole test suite"
	@echo "make check       lint, types, import contracts, fast tests (before each commit)"
	@echo "make bench       quick benchmarks; make bench-full for all; make real-data for measured records"
	@echo "make docs        run the tutorials, write their outputs and pictures, build the documentation in build/docs"
	@echo "make openapi     write docs/openapi.json and the client's types after a change of the interface"
	@echo "make mutants     the gate's tests against faults made by hand, about an hour"
	@echo "make night       all long tests with new seeds, mutants, robustness, torture: hours, one table"

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "lagid needs Python 3.11 or newer; $(PYTHON) is $$($(PYTHON) -V). Try: make PYTHON=python3.12 $(MAKECMDGOALS)"; exit 1; }
	@echo "setting up $(VENV) (once, a minute or two)"
	@$(PYTHON) -m venv $(VENV)
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --config-settings editable_mode=compat -e .
	@git config core.hooksPath .ci/hooks 2>/dev/null || true  # subjects of at most 72 characters
	@touch $@

$(DOCS_READY): $(READY) docs/site/requirements.txt
	@$(BIN)/python -m pip install --quiet --disable-pip-version-check -r docs/site/requirements.txt
	@touch $@

demo: $(READY)
	@$(BIN)/lagid demo

paper: warm
	@$(BIN)/python -m examples.paper

serve: warm
	@exec $(BIN)/lagid serve

# Bytecode is kept for the next run, also where the shell says otherwise: modules of tests are
# compiled twice, and every process that a test starts compiles its modules again.
test suite check: export PYTHONDONTWRITEBYTECODE =

# Linters beside the compilation of the search and of bytecode, which processes of tests side by
# side would each do. Tests of services begin, as they wait more than they compute.
test: $(READY)
	@$(MAKE) --no-print-directory -j2 check-code suite

suite: warm $(COLLECTED)
	$(BIN)/python -m pytest -n $(TEST_PROCESSES) --dist loadscope --no-loadscope-reorder

# Once: bytecode of all tests, which each process of the suite would otherwise make.
$(COLLECTED): $(READY)
	@$(BIN)/python -m pytest --collect-only --quiet >/dev/null || true  # the suite tells the reason
	@touch $@

warm: $(READY)
	@$(BIN)/python -c 'from sysid.identification.warmup import compile_search; compile_search()'

# Side by side, or as -j says; each with its output in one piece where this make can do that. The
# part that failed may have ended before the others, which go on.
check: $(READY) warm
	@$(MAKE) --no-print-directory --keep-going $(if $(filter -j% --jobserver%,$(MAKEFLAGS)),,-j3) \
	  $(if $(filter output-sync,$(.FEATURES)),--output-sync) check-code check-unit check-laws || \
	  { echo "make check failed: see '***' above; each part: make check-code, check-unit, check-laws"; exit 1; }

check-code: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

check-unit: $(READY)
	$(BIN)/python -m pytest -q -m "$(FAST)" tests/unit

check-laws: $(READY)
	$(BIN)/python -m pytest -q -m "$(FAST)" tests/property tests/contract

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(DOCS_READY) warm
	$(BIN)/python -m tests.documents.settings
	$(BIN)/python -m tests.documents.job
	$(BIN)/python -m tests.documents.tutorials
	$(BIN)/python -m tests.documents.photographs
	@$(MAKE) --no-print-directory site

# The site alone, from the pages as they are; a link that leads nowhere is an error.
site: $(DOCS_READY)
	$(BIN)/python -m sphinx -q -W --keep-going -c docs/site -b html docs build/docs

BENCHES := kernels search peers latency silverbox noise_sweep memory mcap
FULL    := $(BENCHES) robustness efficiency scaling
RESULTS := benchmarks/results

bench: $(READY)
	@mkdir -p $(RESULTS)
	@for name in $(BENCHES); do rm -f $(RESULTS)/$$name.*; $(BIN)/python -m benchmarks.$$name --quick --json $(RESULTS)/$$name.json; done
	@$(BIN)/python -m benchmarks.collect $(RESULTS) $(BENCHES)

bench-full: $(READY)
	@mkdir -p $(RESULTS)
	@for name in $(FULL); do rm -f $(RESULTS)/$$name.*; $(BIN)/python -m benchmarks.$$name --json $(RESULTS)/$$name.json; done
	@$(BIN)/python -m benchmarks.collect $(RESULTS) $(FULL)

# The contract of the interface, after a change of it: OpenAPI document and types of the client.
openapi: $(READY)
	$(BIN)/python -m service.api.contract.write_contract .

mutants: $(READY)
	$(BIN)/python -m tests.mutants -j 2

night: $(READY)
	$(BIN)/python -m benchmarks.night

real-data: $(READY)
	@mkdir -p benchmarks/results
	$(BIN)/python -m benchmarks.real_data.all --json benchmarks/results/real_data.json

clean:
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis .import_linter_cache build ./*.egg-info
