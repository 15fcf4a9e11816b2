# Everything that a fresh clone needs: python3 with venv, and make.

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
# Written when something is done: base, extras of the demo and packages of the tests are installed, the kernels of the
# demo are compiled, and the tests are collected.
BASE := $(VENV)/.base
DEMO := $(VENV)/.demo
SETUP := $(VENV)/.set-up
KERNELS := $(VENV)/.kernels
COLLECTED := $(VENV)/.collected
# Many tests wait for another process: one worker more than cores.
WORKERS ?= $(shell expr $$(getconf _NPROCESSORS_ONLN 2>/dev/null || echo 2) + 1)
# More of them for pytest, such as --no-skips.
OPTIONS ?=
PYTEST := $(BIN)/python -m pytest --numprocesses $(WORKERS) --dist worksteal $(OPTIONS)
# Two at once: the kernels are compiled, and then mypy runs, beside what waits for the network and the disk.
MAKEFLAGS += --jobs=2
# Without files of byte code each worker and each process of the tests compiles every module again.
unexport PYTHONDONTWRITEBYTECODE
# Most of the modules that are installed are never imported: pip need not compile them all.
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --constraint constraints.txt
# uv takes an eighth of the time. Where there is none pip installs it beside, and where it fails, as behind a mirror that
# only pip knows, pip does its work.
UV = $(firstword $(shell command -v uv 2>/dev/null) $(BIN)/uv)
install = { test -x $(UV) && $(UV) pip install --quiet --python $(BIN)/python --constraint constraints.txt $(1); } \
	|| $(PIP) $(1)

.PHONY: demo demo-sma demo-muscles demo-hybrid test-quick test test-all preflight check lint types
.PHONY: kernels tests all-tests benchmark busy busy-study kill-safe interlock-times fault-matrix journal-faults
.PHONY: journal-kills
.PHONY: docs mutants studies resume-trials twin-trials clean

# The emulated VO2 laboratory: characterization, identification, validation and tracking, on the virtual clock.
demo: $(DEMO) $(KERNELS)
	$(BIN)/bench study vo2 --out recordings

# The other laboratories likewise.
demo-sma demo-muscles demo-hybrid: demo-%: $(DEMO)
	$(BIN)/bench study $* --out recordings

# Under a minute: numbers, contracts and drivers.
test-quick: lint
	$(PYTEST) --hypothesis-profile=brief -m 'not benchmark and not seeds and not slow' \
		tests/unit/models tests/unit/identification tests/unit/control tests/contract tests/wire/drivers

# Everything, with a short run of each study.
test: preflight tests check

# Everything, all seeds.
test-all: preflight all-tests check

# What the tests cannot install themselves, said before anything else.
preflight:
	@$(PYTHON) tests/support/programs.py

check: lint types

lint: $(SETUP)
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/lint-imports

types: lint
	$(BIN)/mypy

# Compiled once, before the workers of the tests would each do it.
kernels: $(BASE)
	$(BIN)/python -P tests/support/kernels.py

# So are the modules of the tests, with what pytest makes of their assertions; what is wrong with one of them is said
# when the tests run.
$(COLLECTED): $(shell find tests -name '*.py') | lint
	-$(BIN)/python -m pytest --collect-only -qq > /dev/null
	touch $@

# A quarter of the examples of each property.
tests: kernels $(COLLECTED)
	$(PYTEST) --hypothesis-profile=brief

all-tests: kernels $(COLLECTED)
	$(PYTEST) -m 'not benchmark'

# Side-by-side speed comparisons; run them on an idle machine.
benchmark: $(SETUP)
	$(BIN)/python -m pytest -m benchmark -s tools/benchmarks

# The documents as a site, in docs/_build/html: reference from the code, links checked; no network is needed.
docs: $(SETUP)
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html
	@echo docs/_build/html/index.html

# Changes of controllers, engine, journal and drivers, one at a time: do the tests notice? A sample of 300.
# coverage is installed for these alone: numba loads it where it finds it, 75 ms for each command.
mutants: $(SETUP)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt coverage
	$(BIN)/python tools/mutants.py --sample 300

# 50 virtual runs beside 16 busy processes, compared to the last bit, and a run at x100 beside them.
busy: $(SETUP)
	$(BIN)/python tools/busy_machine.py --trial runs clock --runs 50 --busy 16

# A study of the lowest priority beside four busy processes, without compiled kernels, compared with the same alone.
busy-study: $(SETUP)
	$(BIN)/python tools/busy_machine.py --trial study --study hybrid

# The studies with the seeds 0 to 9: median, worst and spread of each number.
studies: $(SETUP)
	$(BIN)/bench study examples/campaign-studies.toml --out recordings/studies

# Each fault of each rig with five seeds, and a table of what passed. The TEC controller of vo2 keeps a higher limit in
# its flash memory than the rig file sets: a restart must not bring it back.
fault-matrix: $(SETUP)
	$(BIN)/bench rig torture vo2 --override devices.tec.current_limit=1.0
	$(BIN)/bench rig torture sma
	$(BIN)/bench rig torture hybrid

# Disks that are full, fail or are slow, journals that are locked, removed or overwritten, on each rig.
journal-faults: $(SETUP)
	$(BIN)/python tools/journal_faults.py

# Benches killed at random moments on each rig: no step that was acknowledged is lost.
journal-kills: $(SETUP)
	$(BIN)/python tools/journal_kills.py --times 200

# Benches and guardians killed, stopped or hanging, and lines cut, on each rig: when every output is off, read in the
# instruments.
kill-safe: $(SETUP)
	$(BIN)/python tools/kill_safe.py --times 10

# The time from when each interlock of each rig has to act until every output is off, likewise.
interlock-times: $(SETUP)
	$(BIN)/python tools/interlock_times.py --times 5

# A run killed ten times and 40 runs killed once, by SIGKILL at random moments, resumed and compared with uninterrupted
# ones.
resume-trials: $(SETUP)
	$(BIN)/python tools/resume_trials.py

# Tracking runs on twins, beside those on the plants that they were identified from: durations and errors.
twin-trials: $(SETUP)
	$(BIN)/python tools/twin_trials.py

# The dashboard of every protocol on every emulated rig, dark and light, with those of README.md; fails on an empty view.
# Then the figures of the tutorials, by their own commands.
pictures: $(SETUP)
	$(BIN)/python -P tools/pictures.py --out recordings/pictures --docs
	$(BIN)/python docs/renew_figures.py

clean:
	rm -rf $(VENV) .mypy_cache .pytest_cache .ruff_cache .hypothesis .import_linter_cache

$(BASE): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	test -x $(UV) || $(PIP) uv || true
	$(call install,setuptools)
	$(call install,--no-build-isolation --editable .)
	touch $@

# The project itself is installed by now: these add what its extras need. A comma would end an argument of `call`.
OF_DEMO := dashboard,report
$(DEMO): $(BASE)
	$(call install,'actuator-bench[$(OF_DEMO)]')
	touch $@

$(SETUP): $(DEMO)
	$(call install,'actuator-bench[dev]')
	touch $@

# Once, beside the second half of the installation; afterwards `bench study` compiles what has changed.
$(KERNELS): $(BASE)
	@$(BIN)/python -P -c "from rich.console import Console; from bench.batch import prepare; prepare('vo2', Console())"
	touch $@
