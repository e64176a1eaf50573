# The system's Python alone is enough: it makes .venv, and uv installs the pinned packages there.
PYTHON ?= python3
UV_VERSION := 0.13.8
VENV := .venv
BIN := $(VENV)/bin
UV := $(BIN)/uv
INSTALLED := $(VENV)/.installed
BENCHMARKS := $(sort $(wildcard benchmarks/*.py))

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

demo: $(INSTALLED) ## have a first look, in minutes: runs/demo/report.html
	$(BIN)/sliplens demo runs/demo

test: $(INSTALLED) ## run the tests on all cores; the last line says how long they took
	$(BIN)/pytest --durations 10

fuzz: $(INSTALLED) ## read 10,000 hostile inputs, half an hour or more; given again it goes on
	$(BIN)/python tests/fuzz/run_fuzz.py --inputs 10000 --keep runs/fuzz.jsonl

kills: $(INSTALLED) ## disturb the commands that write 200 times, an hour or less; given again it goes on
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

docs: $(INSTALLED) ## build the documentation, run its gallery and try every page: docs/_build/index.html
	$(BIN)/python .ci/docs.py

weights: $(INSTALLED) ## train the networks that come with the package: some seven hours on two cores
	$(BIN)/sliplens simulate runs/weights/varied --preset varied
	$(BIN)/sliplens train runs/weights/varied -o runs/weights/small-difference --input difference \
		--image-size 112 --epochs 7
	$(BIN)/sliplens train runs/weights/varied -o runs/weights/large-difference --input difference \
		--start-from runs/weights/small-difference --epochs 2 --learning-rate 1e-3
# trials of other days and objects, for the network that is to read sensors it never saw
	$(BIN)/sliplens simulate runs/weights/more --preset varied --dry-trials 3060 --days 1020 --seed 1
	$(BIN)/sliplens train runs/weights/more -o runs/weights/more-difference --input difference \
		--start-from runs/weights/large-difference --epochs 5 --learning-rate 1e-3
# a second answer, F_t / F_n, for where friction is told: its margins stay as they are
	$(BIN)/sliplens simulate runs/weights/other --preset varied --dry-trials 1230 --days 410 --seed 2
	$(BIN)/sliplens train runs/weights/other -o runs/weights/told-difference --recipe ratio \
		--start-from runs/weights/more-difference
# a head beside it that reads several frames, on pulls of which no two are alike; what it says of one frame stays
	$(BIN)/sliplens simulate runs/weights/pulled --preset varied --pulls varied --dry-trials 1020 --days 340 \
		--test-days 10 --wet-trials 30 --frames-per-trial 60 --seed 4
	$(BIN)/sliplens train runs/weights/pulled -o runs/weights/sequence-difference --recipe sequence \
		--start-from runs/weights/told-difference
# the reference beside the frame: begun at 224 px, then many fresh trials at 112 px, where six times as many are seen in the time
	$(BIN)/sliplens simulate runs/weights/fresh --preset varied --dry-trials 1230 --days 410 --seed 3
	$(BIN)/sliplens train runs/weights/fresh -o runs/weights/begun-pair --input pair \
		--start-from runs/weights/told-difference --epochs 5 --learning-rate 1e-3
	$(BIN)/sliplens simulate runs/weights/many --preset varied --dry-trials 5100 --days 1700 --test-days 10 \
		--wet-trials 10 --seed 5
	$(BIN)/sliplens train runs/weights/many -o runs/weights/told-pair --input pair \
		--start-from runs/weights/begun-pair --image-size 112 --epochs 7 --learning-rate 2e-3
# trained further twice, on other trials, and averaged: wet is read better, and an answer costs what it did
	$(BIN)/sliplens simulate runs/weights/again --preset varied --dry-trials 5100 --days 1700 --test-days 10 \
		--wet-trials 10 --seed 6
	$(BIN)/sliplens train runs/weights/again -o runs/weights/again-pair --input pair \
		--start-from runs/weights/told-pair --image-size 112 --epochs 3 --learning-rate 1e-3
	$(BIN)/sliplens train runs/weights/other -o runs/weights/other-pair --input pair \
		--start-from runs/weights/told-pair --image-size 112 --epochs 1 --learning-rate 5e-4
	$(BIN)/python .ci/average.py runs/weights/again runs/weights/again-pair runs/weights/other-pair \
		-o runs/weights/average-pair
	$(BIN)/sliplens simulate runs/weights/pulled-again --preset varied --pulls varied --dry-trials 2040 --days 680 \
		--test-days 10 --wet-trials 30 --frames-per-trial 60 --seed 7
	$(BIN)/sliplens train runs/weights/pulled-again -o runs/weights/before-pair --recipe sequence \
		--start-from runs/weights/average-pair
# pulls in every direction; .ci/networks/pair-turned is runs/weights/further-pair, to go on from: wet objects lose by it, so that
# it does not ship yet
	$(BIN)/sliplens simulate runs/weights/turned --preset varied --dry-trials 3600 --days 1200 --test-days 10 \
		--wet-trials 10 --seed 11
	$(BIN)/sliplens train runs/weights/turned -o runs/weights/turned-pair --start-from runs/weights/before-pair \
		--augmentation all-directions --image-size 112 --epochs 5 --learning-rate 1.5e-3 --seed 11
	$(BIN)/sliplens train runs/weights/turned -o runs/weights/further-pair --start-from runs/weights/turned-pair \
		--augmentation all-directions --image-size 112 --epochs 3 --learning-rate 1e-3 --seed 13
	$(BIN)/sliplens simulate runs/weights/pulled-turned --preset varied --pulls varied --dry-trials 720 --days 240 \
		--test-days 10 --wet-trials 30 --frames-per-trial 60 --seed 12
	$(BIN)/sliplens train runs/weights/pulled-turned -o runs/weights/sequence-pair --recipe sequence \
		--start-from runs/weights/further-pair
# the networks of the thesis: its days and trials on one sensor, its recipe, as far as two cores reach
	$(BIN)/sliplens simulate runs/weights/thesis --preset thesis --frames-per-trial 200
	@set -e; for input in difference raw; do \
		$(BIN)/sliplens train runs/weights/thesis -o runs/weights/thesis-$$input --input $$input \
			--recipe thesis --image-size 112 --epochs 4; \
	done
# rounded, so that the package stays under 15 MB; answers move by less than 0.001
	@set -e; for kept in sequence-difference:chromatouch:10 sequence-pair:chromatouch:10 thesis-difference:thesis:14 thesis-raw:thesis:14; do \
		set -- $$(echo $$kept | tr : ' '); \
		$(BIN)/python .ci/ship.py runs/weights/$$1 src/sliplens/weights/$$2-$${1##*-} --bits $$3; \
	done

dist: $(INSTALLED) ## build wheel and source archive, and try the wheel on every Python at hand; needs a package index
	$(BIN)/python .ci/dist.py

lock: $(UV) ## pin the newest packages that fit, for every supported Python
	$(UV) pip compile --quiet --upgrade --universal --python-version 3.11 --extra dev --extra docs \
		--generate-hashes --custom-compile-command "make lock" --output-file requirements.txt pyproject.toml

audit: $(INSTALLED) ## compare what is installed with requirements.txt, file by file; asks nobody
	$(BIN)/python .ci/audit.py

clean: ## remove .venv and what the tools cache
	rm -rf $(VENV) .pytest_cache .ruff_cache .hypothesis .import_linter_cache docs/_build docs/gallery dist

$(UV):
	@$(PYTHON) -c 'import sys; v = sys.version_info[:2]; sys.exit(None if (3, 11) <= v <= (3, 13) else \
		f"sliplens needs Python 3.11 to 3.13 and found {v[0]}.{v[1]}; name one with make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv==$(UV_VERSION)

$(INSTALLED): $(UV) requirements.txt pyproject.toml
	$(UV) pip install --quiet --compile-bytecode --python $(BIN)/python --require-hashes -r requirements.txt
	$(UV) pip install --quiet --python $(BIN)/python --no-build-isolation --no-deps -e .
	@touch $@
