# warprrf: `make lobby` reconstructs the lobby from photos, fits its radio field and reports every error.
#
#   make lobby      install what is missing, then photos -> geometry -> radio -> evaluation into runs/lobby/ (resumable)
#   make test       lint, types, import rules, documentation, tests: what CI runs
#   make long       the tests of a minute and more, and more cases of the others
#   make quick      every public verb and the main laws once: two minutes on two cores with compiled kernels cached, on a
#                   fresh clone a few more while they compile (tests/quick.txt)
#   make lint       the first three alone
#   make docs       the documentation, into build/site: warnings are errors, links are checked
#   make gpu        tests and times on a CUDA device, within ten minutes; without one a dry run on the CPU
#   make data       regenerate data/lobby/ from nothing: scene, photos, spectra (hours; resumable)
#   make notebooks  run the notebooks and store their outputs
#   make clean      remove caches and build output (not .venv, data or runs)
#
#   PYTHON=...  which interpreter makes the environment     VENV=...  where it goes (default .venv)

SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
MAKEFLAGS += --no-builtin-rules

VENV ?= .venv
BIN := $(abspath $(VENV))/bin
RUN := $(BIN)/python
# Python compiles what is imported when it is: a small part of what is installed.
INSTALL := $(RUN) -m pip install -q --no-compile
# Two workers have a core each: threads of BLAS would wait for one another. A worker takes a whole file, the longest first
# (tests/conftest.py), so that both end together.
PYTEST := OPENBLAS_NUM_THREADS=1 OMP_NUM_THREADS=1 $(RUN) -m pytest -n 2 --dist loadfile --no-loadscope-reorder
ARGS ?=

# Compiled kernels are kept in the checkout, so that they survive from one command to the next.
export WARP_CACHE_PATH ?= $(CURDIR)/.cache/warp
export PIP_DISABLE_PIP_VERSION_CHECK := 1
export PYTHONHASHSEED ?= 0
export PYTHON
# What is imported is compiled once: where a container says otherwise, each of a hundred processes would do it again.
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help lobby test long quick lint docs gpu data notebooks clean setup setup-test

help:
	@sed -n '1,/^$$/s/^# \{0,1\}//p' Makefile

$(VENV)/.made:
	python=$$(bash tools/find_python.sh) && "$$python" -m venv $(VENV)
	touch $@

# One stamp for what the main job needs, one for everything (torch is only in the second).
$(VENV)/.lobby: $(VENV)/.made pyproject.toml constraints.txt
	bash tools/system_packages.sh
	$(INSTALL) -c constraints.txt -e '.[photos,plots,view]'
	touch $@

$(VENV)/.sionna: $(VENV)/.lobby
	bash tools/system_packages.sh llvm
	$(INSTALL) -c constraints.txt -e '.[photos,plots,view,sionna,exr]'
	touch $@

$(VENV)/.test: $(VENV)/.made pyproject.toml constraints.txt
	bash tools/system_packages.sh llvm browser
	$(INSTALL) -c constraints.txt -e '.[all,docs,test]'
	# Its wheel asks for an older NumPy than it needs, so it is no extra: only its scenario reader is tested against.
	$(INSTALL) --no-deps 'DeepMIMO==4.0.5' && $(INSTALL) requests
	touch $(VENV)/.lobby $(VENV)/.sionna $@

setup: $(VENV)/.lobby
setup-test: $(VENV)/.test

lobby: $(VENV)/.lobby
	@$(RUN) -m benchmarks lobby $(ARGS)

data: $(VENV)/.sionna
	@$(RUN) -m benchmarks data $(ARGS)

lint: $(VENV)/.test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	PYTHONPATH=. $(BIN)/lint-imports --no-cache

docs: $(VENV)/.test
	$(BIN)/sphinx-build -q -W --keep-going -b html -d build/doctrees docs build/site

test: $(VENV)/.test
	$(MAKE) --output-sync -j 2 lint docs
	$(PYTEST) --durations=30 $(ARGS)

long: $(VENV)/.test
	$(PYTEST) -m long $(ARGS)

quick: $(VENV)/.test
	$(PYTEST) @tests/quick.txt $(ARGS)

gpu: $(VENV)/.test
	@$(RUN) -m benchmarks gpu $(ARGS)

notebooks: $(VENV)/.test
	$(RUN) tools/run_notebooks.py

clean:
	rm -rf docs/reference docs/figures .cache build dist *.egg-info .mypy_cache .ruff_cache .pytest_cache .hypothesis .import_linter_cache
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
