# Every target sets up what it needs; nothing else is to be typed on a fresh machine.
PYTHON ?= python3
BIN := .venv/bin
DEMO := data/demo

.PHONY: demo test lint bench setup clean-demo

setup: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q -c constraints.txt -e '.[dev]'
	touch $@

demo: setup ## collect four runs, train TIPL on three, judge it on the fourth: about five minutes
	$(BIN)/weighttraj collect datasets/demo/recipe.toml --out $(DEMO)/dataset --workers 2
	$(BIN)/tipl train --data $(DEMO)/dataset --out $(DEMO)/tipl --n-batches 500 --warmup 100 --save-every 100
	$(BIN)/tipl evaluate $(DEMO)/tipl --data $(DEMO)/dataset --out $(DEMO)/report --return-starts 5 --episodes 5

test: setup ## run the tests
	$(BIN)/python -m pytest -q -n 2

lint: setup ## check style and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

bench: setup ## run every benchmark by hand; each prints one JSON line
	for f in tests/benchmarks/bench_*.py; do $(BIN)/python -W ignore $$f; done

clean-demo: ## forget the demo's data
	rm -rf $(DEMO)
