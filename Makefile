# The system's Python alone is enough: it makes .venv, and uv installs the pinned packages there.
PYTHON ?= python3
UV_VERSION := 0.13.8
VENV := .venv
BIN := $(VENV)/bin
UV := $(BIN)/uv
INSTALLED := $(VENV)/.installed
# those left out need trained networks, or are no benchmark
BENCHMARKS := $(filter-out %/replica.py %/claims.py %/contact_events.py,$(sort $(wildcard benchmarks/*.py)))

# idle threads that spin take the cores from those that work
export OMP_WAIT_POLICY := passive
# what is imported is compiled once: torch alone takes every process six seconds anew
unexport PYTHONDONTWRITEBYTECODE
# the real recordings, where they are at hand; tests and the demo do without them where they are not
export SLIPLENS_REFERENCE ?= ../shared/reference

.DEFAULT_GOAL := help
.PHONY: help install demo test fuzz kills check format bench docs weights dist lock audit clean

help: ## list these targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / {printf "  make %-8s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

install: $(INSTALLED) ## set up .venv with the pinned packages and sliplens itself

demo: $(INSTALLED) ## write a first result, in minutes: runs/demo/report.html
	$(BIN)/sliplens demo runs/demo

test: $(INSTALLED) ## run the tests on all cores; the last line has their time
	$(BIN)/pytest --durations 10

fuzz: $(INSTALLED) ## open 10,000 hostile inputs, half an hour or more; repeat to continue
	$(BIN)/python tests/fuzz/run_fuzz.py --inputs 10000 --keep runs/fuzz.jsonl

kills: $(INSTALLED) ## interrupt writing commands 200 times, an hour or less; repeat to continue
	$(BIN)/python tests/fuzz/run_kills.py --faults 200 --keep runs/kills.jsonl

check: $(INSTALLED) ## lint, format, types, floors
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/pyright
	$(BIN)/lint-imports

format: $(INSTALLED) ## format the code and sort its imports
	$(BIN)/ruff check --fix
	$(BIN)/ruff format

bench: $(INSTALLED) ## run every benchmark
	@set -e; for script in $(BENCHMARKS); do echo "== $$script"; $(BIN)/python $$script --json; done

docs: $(INSTALLED) ## build the documentation, run its gallery and check every page: docs/_build/index.html
	$(BIN)/python .ci/docs.py

weights: $(INSTALLED) ## train the networks that come with the package: some seven hours on two cores
	bash .ci/weights.sh

dist: $(INSTALLED) ## build wheel and source archive, and test the wheel on every installed Python; needs a package index
	$(BIN)/python .ci/dist.py

lock: $(UV) ## pin the newest packages that fit, for every supported Python
	$(UV) pip compile --quiet --upgrade --universal --python-version 3.11 --extra dev --extra docs \
		--generate-hashes --custom-compile-command "make lock" --output-file .ci/requirements.txt pyproject.toml

audit: $(INSTALLED) ## compare installed files with .ci/requirements.txt, offline
	$(BIN)/python .ci/audit.py

clean: ## remove .venv and the caches of the tools
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis .import_linter_cache docs/_build docs/gallery dist

$(UV):
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(None if (3, 11) <= v <= (3, 13) else \
		f"sliplens needs Python 3.11 to 3.13 and found {v[0]}.{v[1]}; name one with make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv==$(UV_VERSION)

$(INSTALLED): $(UV) .ci/requirements.txt pyproject.toml
	$(UV) pip install --quiet --compile-bytecode --python $(BIN)/python --require-hashes -r .ci/requirements.txt
	$(UV) pip install --quiet --python $(BIN)/python --no-build-isolation --no-deps -e .
	@touch $@
