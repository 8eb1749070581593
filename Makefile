# Each target makes its own .venv and installs what it needs; only make and a Python 3.11 to 3.13
# with venv must be there. Choose one with `make PYTHON=python3.12 …`.

# The newest one on the path, of pyenv or of uv. Each is run: a shim of pyenv may lead nowhere.
PYTHON ?= $(shell for v in 3.13 3.12 3.11; do \
	for p in python$$v "$${PYENV_ROOT:-$$HOME/.pyenv}"/versions/$$v*/bin/python$$v \
	$$(uv python find --system $$v 2>/dev/null) python3 python; do \
	"$$p" -c "import sys, venv, ensurepip; sys.exit('%d.%d' % sys.version_info[:2] != '$$v')" \
	2>/dev/null && echo "$$p" && exit; done; done)
VENV ?= .venv
BIN := $(VENV)/bin
ARGS ?=
export PIP_DISABLE_PIP_VERSION_CHECK := 1
# JAX spreads work over the cores itself; threads of the BLAS under its LAPACK calls only get in the way.
export OPENBLAS_NUM_THREADS ?= 1
# Bytecode is kept: without it each process of the suite compiles four hundred modules again.
unexport PYTHONDONTWRITEBYTECODE
# Where jemalloc is installed (Debian: libjemalloc2) compiling takes an eighth less of the processor.
JEMALLOC := $(firstword $(wildcard /usr/lib/*/libjemalloc.so.2 /usr/lib64/libjemalloc.so.2))

.DELETE_ON_ERROR:
.PHONY: consistency test test-all test-oldest check bench docs api links clean

## The main job: is EKF-SLAM honest? 100 simulated runs; results in out/.
consistency: $(VENV)/.run
	$(BIN)/jaxslam consistency $(ARGS)

## The tests, on every core: large files first, compiled programs kept in .cache/ for the next run. Of each kind
## of case one is tested; `test-all` takes every variant, scenario and precision.
test: SELECTED := -m "not sweep"
test test-all: $(VENV)/.dev
	LD_PRELOAD=$(JEMALLOC) $(BIN)/python -m pytest -n auto --dist loadscope --no-loadscope-reorder $(SELECTED) $(ARGS)

## The tests that ARGS names on the lowest versions that pyproject.toml allows:
## make test-oldest PYTHON=python3.11 VENV=.venv-oldest ARGS="tests/core".
test-oldest: $(VENV)/.oldest
	$(BIN)/python -m pytest -n auto --dist loadscope --no-loadscope-reorder $(ARGS)

## Format, lint and types.
check: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

## Published figures, real data and speed; prints tables, see benchmarks/README.md.
bench: $(VENV)/.dev
	$(BIN)/python -m benchmarks $(ARGS)

## The documentation, in docs/_build/html; its code and commands are run, what they gave kept in .cache/. Warnings are errors.
docs: $(VENV)/.dev
	$(BIN)/sphinx-build --builder html --jobs auto --fail-on-warning --keep-going --quiet docs docs/_build/html $(ARGS)

## The reference and the text of all pages, in docs/_build/api: none of their code is run.
api: $(VENV)/.docs
	$(BIN)/sphinx-build --builder html --tag api --jobs auto --quiet docs docs/_build/api $(ARGS)

## Whether the documentation's links to other sites are alive; needs the network.
links: $(VENV)/.dev
	$(BIN)/sphinx-build --builder linkcheck --jobs auto --quiet docs docs/_build/links $(ARGS)

$(VENV)/bin/python:
	@python="$(PYTHON)"; \
	test -n "$$python" || { echo "jaxslam needs Python 3.11 to 3.13 with the venv module"; exit 1; }; \
	echo "$(VENV): $$("$$python" --version) ($$python)"; "$$python" -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip

$(VENV)/.run: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable .
	@touch $@

$(VENV)/.dev: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable . --group dev
	@touch $@

$(VENV)/.docs: pyproject.toml | $(VENV)/bin/python
	$(BIN)/python -m pip install --quiet --editable . --group docs
	@touch $@

$(VENV)/.oldest: pyproject.toml | $(VENV)/bin/python
	grep -v '^requires = ' pyproject.toml | grep -oE '"[a-z0-9-]+>=[0-9.]+"' | tr -d '"' | sed 's/>=/==/' | sort -u > $(VENV)/oldest.txt
	$(BIN)/python -m pip install --quiet --editable . --group test --constraint $(VENV)/oldest.txt
	@touch $@

clean:
	rm -rf $(VENV) out docs/_build docs/reference/api
