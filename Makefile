# `make help` lists the targets. `export:` has no space before its colon: `export :` is a directive.
PYTHON ?= $(shell python3.11 -c '' 2>/dev/null && echo python3.11 || echo python3)
VENV := .venv
BIN := $(VENV)/bin
PIP_INSTALL := $(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt
option = $(if $(filter-out 0,$($(1))),$(2))

.DEFAULT_GOAL := help
.PHONY: help install demo test soak check format train export bench board clean

help: ## list the targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-9s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

install: $(VENV)/.all ## put everything, torch included, into .venv

demo: $(VENV)/.demo ## teach once and repeat in simulation (SEED=n SCENE=dir OBSTACLE=1 FAST=1)
	$(BIN)/python -m cbe_bench.demo \
	  $(if $(SEED),--seed $(SEED)) $(if $(SCENE),--scene "$(SCENE)") \
	  $(call option,OBSTACLE,--obstacle) $(call option,FAST,--fast)

test: $(VENV)/.all ## run the tests (ARGS="-k name" narrows)
	$(BIN)/python -m pytest -n 2 --dist loadgroup $(ARGS)

soak: $(VENV)/.all ## drive 15 min, feed 200000 hostile inputs of a kind, kill 200 teachers (MINUTES=n INPUTS=n SEED=n)
	$(BIN)/cbe-bench soak --minutes $(or $(MINUTES),15)
	CBE_FUZZ_INPUTS=$(or $(INPUTS),200000) CBE_FUZZ_SEED=$(or $(SEED),0) $(BIN)/python -m pytest tests/fuzz -n 2 --timeout 14400 $(ARGS)
	CBE_KILLS=200 CBE_KILL_SEED=$(or $(SEED),0) $(BIN)/python -m pytest tests/runtime/test_teach_crashes.py

check: $(VENV)/.all ## lint, format check, types and the rooms' import rules
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(VENV)/.all ## apply ruff's format and safe fixes
	$(BIN)/ruff format
	$(BIN)/ruff check --fix

train: $(VENV)/.all ## train, resuming where the last run ended (ARGS="--help" lists options)
	$(BIN)/cbe-train $(ARGS)

export: $(VENV)/.all ## turn the checkpoint into the shipped ONNX files, past the parity gate
	$(BIN)/cbe-export $(ARGS)

bench: $(VENV)/.all ## measure the speed of renderer, scanner and networks
	$(BIN)/cbe-bench speed $(ARGS)

board: $(VENV)/bin/python ## fetch the base install's wheels for 64-bit ARM, Python 3.11 to 3.13, into dist/
	@mkdir -p dist
	@$(BIN)/python -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["dependencies"], sep="\n")' > dist/board.txt
	@for version in 3.11 3.12 3.13; do \
	  $(BIN)/python -m pip download --quiet --disable-pip-version-check -c constraints.txt -r dist/board.txt -d dist/board-$$version \
	    --only-binary :all: --python-version $$version --platform manylinux_2_17_aarch64 --platform manylinux_2_28_aarch64 || exit 1; \
	  $(BIN)/python -c 'import sys, zipfile; sizes = [sum(i.file_size for i in zipfile.ZipFile(p).infolist()) for p in sys.argv[2:]]; print("Python", sys.argv[1] + ":", len(sizes), "wheels, installed", sum(sizes) >> 20, "MiB")' $$version dist/board-$$version/*.whl || exit 1; \
	done

clean: ## remove .venv and what tools cached
	rm -rf $(VENV) dist .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis

# Stamps: an install runs again only when what it reads has changed.
$(VENV)/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' || \
	  { echo "Python 3.11 to 3.13 is needed, $$($(PYTHON) -V 2>&1) was found; name one: make PYTHON=python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/.demo: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP_INSTALL) -e '.[sim]'
	@touch $@

$(VENV)/.all: pyproject.toml constraints.txt | $(VENV)/bin/python
	$(PIP_INSTALL) -e '.[train,bench,view,dev]'
	@touch $(VENV)/.demo $@
