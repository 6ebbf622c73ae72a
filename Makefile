# `make demo` and `make test` are all that a fresh machine needs: Python 3.11 or newer and make.
PYTHON ?= python3
VENV   ?= .venv
BIN    := $(VENV)/bin
OUT    ?= demo-output
CASES  ?= 400
NULLS  ?= 400
PROOF  ?= proof
N      ?= 100000
SEED   ?= 1
JOBS   ?= $(shell nproc 2>/dev/null || echo 2)
# Tests start many processes: keep compiled modules, also where the environment asks for none.
export PYTHONDONTWRITEBYTECODE =
# One file of tests stays on one worker, with what its tests share; files start in their order.
PYTEST := -m pytest -n auto --dist loadfile --no-loadscope-reorder

.PHONY: demo docs test test-slow test-install test-full test-minimum fuzz lint bench prove prove-quick real-recordings interop baseline clean help

help:  ## list the targets
	@grep -E '^[a-z-]+:.*##' Makefile | sed 's/:.*## /\t/' | expand -t 18

# Modules are compiled when they are first imported, as most of an installation is never used.
PIP := $(BIN)/pip install --quiet --disable-pip-version-check --no-compile

$(BIN)/python:
	$(PYTHON) -m venv $(VENV)

$(VENV)/.installed: pyproject.toml | $(BIN)/python
	$(PIP) -e .
	touch $@

$(VENV)/.installed-test: pyproject.toml | $(BIN)/python
	$(PIP) -e ".[test]"
	touch $(VENV)/.installed $@

$(VENV)/.installed-lint: pyproject.toml | $(BIN)/python
	$(PIP) -e ".[test,lint]"
	touch $(VENV)/.installed $(VENV)/.installed-test $@

demo: $(VENV)/.installed  ## install, and run the main job on the shipped log, a simulated day
	$(BIN)/gyrostab demo -o $(OUT) --overwrite

test: $(VENV)/.installed-test  ## install, and run the tests
	$(BIN)/python $(PYTEST)

test-slow: $(VENV)/.installed-test  ## the tests marked slow, which make test leaves out: whole records, statistics, killed processes, reports in Chromium
	$(BIN)/python $(PYTEST) -m "slow and not full" tests

test-install: $(VENV)/.installed-test  ## the README in a fresh checkout, and the wheel in a bare environment
	$(BIN)/python -m pytest -n0 -m install tests/packaging $(if $(ONLY),-k $(ONLY))

test-full: $(VENV)/.installed-test  ## all tests: also whole diagnoses and calibrations, and more random examples
	$(BIN)/python $(PYTEST) -m "" --hypothesis-profile full

$(VENV)-minimum/.installed: pyproject.toml tests/support/minimum_versions.py
	test -x $(VENV)-minimum/bin/python || $(PYTHON) -m venv $(VENV)-minimum
	$(PYTHON) -m tests.support.minimum_versions > $(VENV)-minimum/constraints.txt
	$(VENV)-minimum/bin/pip install --quiet --disable-pip-version-check --prefer-binary -c $(VENV)-minimum/constraints.txt -e ".[test]"
	touch $@

test-minimum: $(VENV)-minimum/.installed  ## the tests with the lowest versions of the dependencies that pyproject.toml allows
	$(VENV)-minimum/bin/python $(PYTEST)

fuzz: $(VENV)/.installed-test  ## try damaged inputs and write docs/fuzzing.md (N=100000 SEED=1 JOBS=2); can be stopped and repeated
	$(BIN)/python -W ignore -m tests.fuzz --count $(N) --seed $(SEED) --jobs $(JOBS) --output docs/fuzzing.md

# With the tools of the tests, so that a machine that builds and tests installs once.
$(VENV)/.installed-docs: pyproject.toml | $(BIN)/python
	$(PIP) -e ".[test,docs]"
	touch $(VENV)/.installed $(VENV)/.installed-test $@

docs: $(VENV)/.installed-docs  ## build the site in docs/_build/html, with executed tutorials: stops at a cell that fails
	$(BIN)/python -m sphinx -W --keep-going -b html docs docs/_build/html

lint: $(VENV)/.installed-lint  ## style, types, imports and wording
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m tests.language

bench: $(VENV)/.installed-test  ## measure docs/performance.md and docs/scaling.md again, on an idle machine
	$(BIN)/python benchmarks/kernels.py --output docs/performance.md
	$(BIN)/python benchmarks/fit.py --output docs/performance.md
	$(BIN)/python benchmarks/end_to_end.py --output docs/performance.md
	$(BIN)/python benchmarks/scaling.py --output docs/scaling.md

prove: $(VENV)/.installed-test  ## the published blind test (CASES=400 NULLS=400 PROOF=proof; injections from GYROSTAB_RECORDINGS); takes hours, can be stopped and repeated
	$(BIN)/gyrostab prove --resume -o $(PROOF) $(if $(wildcard $(PROOF)/benchmark.json),,--cases $(CASES) --nulls $(NULLS) --counterparts 1)
	$(BIN)/python benchmarks/publish_proof.py $(PROOF)

prove-quick: $(VENV)/.installed  ## a short blind test with a fresh seed, which is printed
	$(BIN)/gyrostab prove --cases 10 --nulls 200 --overwrite -o proof-quick

real-recordings: $(VENV)/.installed  ## write docs/real-recordings.md from the recordings (environment variable GYROSTAB_RECORDINGS)
	$(BIN)/python docs/generate/real_recordings.py

interop: $(VENV)/.installed-test  ## open the files in other installed programs (Debian: octave octave-netcdf netcdf-bin)
	$(BIN)/python -m pytest -n0 -v tests/interop

baseline: $(VENV)/.installed-test  ## write the reference pictures of the figures again; inspect them afterwards
	$(BIN)/python -m tests.plot.test_figures

clean:  ## delete what the targets made
	find gyrostab -name '*.nb[ic]' -delete
	rm -rf $(VENV) $(VENV)-minimum $(OUT)
