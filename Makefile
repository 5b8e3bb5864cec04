# Targets of the project; each needs nothing but Python 3.11 or newer, pip, make and gcc.
PYTHON ?= python3
BIN := .venv/bin

.PHONY: install demo test test-fast test-thorough test-long test-docs test-kill test-browser lint types docs pictures api-diff lowest bench bench-smoke verify dist clean-cache

install: .venv/installed

.venv/installed: pyproject.toml constraints.txt Makefile
	test -x $(BIN)/python || $(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --upgrade 'pip>=25.1'
	$(BIN)/python -m pip install --quiet -c constraints.txt -e ".[all]" --group dev && touch $@

demo: install
	$(BIN)/shiftsim demo

test: install
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not browser and not thorough and not long"

test-fast: install
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow and not browser and not thorough and not long"

test-thorough: install
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "thorough and not browser and not long"

test-long: install
	$(BIN)/python -m pytest -n 2 --dist loadfile -m long

test-docs: install
	$(BIN)/python -m pytest -n 2 --dist loadfile tests/docs

test-kill: install
	KILL_ROUNDS=24 KILL_SECONDS=60 $(BIN)/python -m pytest -n 4 tests/runs/test_kills.py

test-browser: install
	$(BIN)/python -m pytest tests/browser -rs

lint: install
	$(BIN)/ruff format --check . && $(BIN)/ruff check .

types: install
	$(BIN)/mypy

# the pictures of the documentation, made anew; needs a browser
pictures: install
	PICTURES=docs/images $(BIN)/python -m pytest tests/browser/test_pictures.py -k made

docs: install
	$(BIN)/python tools/build_site.py build/docs

# changes of the public API since a revision, which CHANGELOG.md has to name
REVISION ?= main

api-diff: install
	$(BIN)/python tools/api_diff.py $(REVISION)

# the oldest packages that pyproject.toml allows, in place of those of constraints.txt
lowest: install
	mkdir -p build
	$(BIN)/python tools/lowest.py > build/lowest.txt
	$(BIN)/python -m pip install --quiet -r build/lowest.txt

bench: install
	$(BIN)/python -m pytest shiftsim/benchmarks/speed -s -p no:cacheprovider --benchmark-disable-gc --benchmark-columns=median,iqr

bench-smoke: install
	$(BIN)/python -m pytest shiftsim/benchmarks/speed -q -p no:cacheprovider --benchmark-disable

# outputs of official code beside the repository; the last line of the output sums up
REFERENCE ?= ../shared/reference

verify: install
	$(BIN)/python -m pytest -n 2 --dist loadfile tests/parity --reference $(REFERENCE)

dist: install
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir dist .

clean-cache:
	rm -rf .numba-cache .pytest_cache .mypy_cache .ruff_cache .hypothesis
