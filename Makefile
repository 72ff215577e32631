# `make demo` and `make test` set up everything they need in .venv; PYTHON chooses the interpreter.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/installed
# bytecode is kept, whatever the environment says: without it each process of a test compiles torch for 3 s
export PYTHONDONTWRITEBYTECODE :=

.PHONY: demo test quick lint types docs install-check bench gpu clean

demo: $(INSTALLED)
	$(BIN)/python demos/examples/bunny.py

# a process a core; those of a file share its kernels. Threads of torch and NumPy would wait for those of other processes
PYTEST := OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest --numprocesses auto --dist loadfile --no-loadscope-reorder

test: $(INSTALLED)
	$(PYTEST)

# the inner loop: what is not marked slow
quick: $(INSTALLED)
	$(PYTEST) -m "not slow" --exitfirst

bench: $(INSTALLED)
	$(BIN)/python demos/benchmarks/benchmark.py

# on a machine with an NVIDIA GPU: correctness, speed and floors beside the CPU's, in out/gpu
gpu: $(INSTALLED)
	$(BIN)/python demos/benchmarks/gpu_report.py

lint: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports --no-logo

types: $(INSTALLED)
	$(BIN)/mypy

# the API reference, from the docstrings, in out/docs
docs: $(INSTALLED)
	$(BIN)/python demos/tools/api_reference.py

# what README tells others to do, in an environment of its own
install-check:
	PYTHON=$(PYTHON) .ci/install

# torch first: the pinned release has a CPU build where an index offers one, and nothing later replaces it. Python compiles
# what it imports when it does: most of these packages it never needs
$(INSTALLED): pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt torch
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile -c constraints.txt -e ".[dev]"
	touch $@

clean:
	rm -rf $(VENV) out
