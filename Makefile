# Every target sets up what it needs: a Python >= 3.11 and make are enough. A second call is quick.
PYTHON ?= python3
VENV := .venv
PY := $(VENV)/bin/python
PIP := $(PY) -m pip install --quiet --disable-pip-version-check -c constraints.txt

# Meshes and images of other people, where they are at hand; what needs them is skipped elsewhere.
ifneq ($(wildcard ../shared/assets/.),)
export TORCHPT_ASSETS ?= $(abspath ../shared/assets)
endif

# Bytecode is kept: every worker would rewrite the asserts of all tests else, and every process compile the package.
unexport PYTHONDONTWRITEBYTECODE

SCENE ?= cornell_box
OUT ?= $(notdir $(basename $(SCENE))).png
ARGS ?=

.PHONY: help render test test-quick test-all stress check format docs clean
.DEFAULT_GOAL := help

help:
	@echo "make render      render configs/scene/$(SCENE).yaml to $(OUT)   (SCENE=name OUT=file ARGS='render.spp=256')"
	@echo "make test        the fast tests"
	@echo "make test-quick  contracts alone: every model, light, shape, texture, camera, sampler, filter and integrator"
	@echo "make test-all    slow tests too, and the comparison with Mitsuba"
	@echo "make stress      stiff and extreme cases, whole sweeps by every backend, to stress/; a thousand million rays; damaged files"
	@echo "make check       ruff, pyright, import layers"
	@echo "make format      let ruff rewrite the files"
	@echo "make docs        the docs as a site, to site/: open site/index.html"
	@echo "make clean       remove the virtual environment and caches"

render: $(VENV)/run.stamp
	@$(PY) -m torchpt render "scene=$(SCENE)" "out=$(OUT)" $(ARGS)
	@echo "The picture is $(abspath .)/$(OUT)"

# Tests of ranks fork the process that they run in, so that it must not have worked for other tests before: one of their own, beside
# the others, since it mostly waits.
test: $(VENV)/dev.stamp
	@log=$$(mktemp); $(PY) -m pytest -q -m "not slow and not long and not gpu" tests/ranks > $$log 2>&1 & ranks=$$!; \
	$(PY) -m pytest -m "not slow and not long and not gpu" -n 2 --dist loadfile --ignore=tests/ranks $(ARGS); others=$$?; \
	wait $$ranks; ranks=$$?; cat $$log; rm -f $$log; exit $$((others + ranks))

test-quick: $(VENV)/dev.stamp
	$(PY) -m pytest -q -m "not slow and not long and not gpu" -n 2 $(wildcard tests/*/test_contract.py) $(ARGS)

test-all: $(VENV)/bench.stamp
	$(PY) -m pytest -m "not long" --hypothesis-profile=random tests/ranks
	$(PY) -m pytest -m "not long" --hypothesis-profile=random -n 2 --dist loadfile --ignore=tests/ranks $(ARGS)

stress: $(VENV)/dev.stamp
	$(PY) -m torchpt stress "accel=[numba,torch,brute]" "compile=[on,off]" out=stress $(ARGS)
	$(PY) -m pytest -m long -n 2

check: $(VENV)/dev.stamp
	$(PY) -m ruff check .
	$(PY) -m ruff format --check .
	$(PY) -m pyright --pythonpath $(PY)
	$(VENV)/bin/lint-imports --no-logo

format: $(VENV)/dev.stamp
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

docs: $(VENV)/docs.stamp
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/mkdocs build --strict --quiet
	@echo "The site is $(abspath .)/site/index.html"

clean:
	rm -rf $(VENV) site .pytest_cache .ruff_cache .hypothesis .import_linter_cache

$(PY):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "torchpt needs Python >= 3.11; name one with PYTHON=...")'
	$(PYTHON) -m venv $(VENV)

$(VENV)/run.stamp: pyproject.toml constraints.txt | $(PY)
	@echo "Installing into $(VENV) (a few minutes the first time)"
	$(PIP) -e .
	@touch $@

$(VENV)/dev.stamp: $(VENV)/run.stamp
	$(PIP) -e ".[dev,formats,video,compare,denoise,sweep]"
	@touch $@

$(VENV)/docs.stamp: $(VENV)/run.stamp
	$(PIP) -e ".[docs]"
	@touch $@

$(VENV)/bench.stamp: $(VENV)/dev.stamp
	$(PIP) -e ".[dev,formats,video,compare,denoise,sweep,bench,cuda-dev,docs]"
	@touch $@
