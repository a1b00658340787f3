PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready

.PHONY: demo test fuzz bench numerics lint clean

$(READY): pyproject.toml
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --upgrade pip
	$(BIN)/pip install --quiet --editable '.[cpu,dev]'
	touch $(READY)

demo: $(READY)
	$(BIN)/splatart demo --output-dir demo

# Files of tests go to two processes, so that fixtures of a file are made once.
test: $(READY)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pytest --numprocesses 2 --dist loadfile

fuzz: $(READY)
	SPLATART_FUZZ_EXAMPLES=2000 $(BIN)/pytest tests/*/test_fuzz*.py

# BENCH=--quick for minutes instead of hours; captures with ground truth may follow.
bench: $(READY)
	$(BIN)/python benchmarks/bench.py $(BENCH)

numerics: $(READY)
	$(BIN)/python benchmarks/numerics.py

lint: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

clean:
	rm -rf $(VENV) demo
