# make demo runs the main job, make test passes the tests; each target is a line or two one could type by hand.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# one more than processors, since tests that drive a browser wait for it
WORKERS ?= $(shell $(PYTHON) -c 'import os; print(len(getattr(os, "sched_getaffinity", lambda _: range(os.cpu_count()))(0)) + 1)')
# threads that wait do not spin, compiled modules are kept, and a worker runs files as a whole for as long as others do
PYTEST := OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest --dist worksteal

.PHONY: setup demo test test-slow test-all test-gpu lint clean

# of other packages only what is imported is compiled, when it is: all of them would take half a minute
setup: $(VENV)/.installed

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -q --no-compile -c constraints.txt -e ".[dev]"
	$(BIN)/python -m compileall -q -j 0 ngff_cli stages
	touch $@

demo: setup
	$(MAKE) -C examples/falling_toys NGFF=$(abspath $(BIN))/ngff

test: setup
	$(PYTEST) -n $(WORKERS) -m "not slow"

test-slow: setup
	$(PYTEST) -n auto -m slow

test-all: test test-slow

test-gpu:
	$(PYTHON) -m pytest -m gpu

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

clean:
	$(MAKE) -C examples/falling_toys clean
