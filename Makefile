# Every target sets up what it needs; nothing else is to be typed on a fresh machine.
PYTHON ?= python3
BIN := .venv/bin
DEMO := data/demo
RELEASED := inverted-pendulum-v4-ppo-v1
# The released models that the demo and the README show.
TIPL := tipl-inverted-pendulum-v4
GATE := tipl-gate
# The processes that tests start share compiled code: without it each compiles both packages again.
PYTEST := PYTHONDONTWRITEBYTECODE= OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist worksteal

.PHONY: demo readme test test-long lint docs bench results stress setup clean-demo

setup: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q -c constraints.txt -e '.[dev]'
	touch $@

demo: setup ## collect a run, train TIPL for a moment, evaluate released models: about four minutes
	$(BIN)/weighttraj show $(RELEASED)
	$(BIN)/weighttraj collect datasets/demo/recipe.toml --out $(DEMO)/live
	$(BIN)/weighttraj returns $(DEMO)/live --every 25 --episodes 5
	$(BIN)/weighttraj report $(DEMO)/live --out $(DEMO)/live.html
	$(BIN)/tipl train tipl --data $(RELEASED) --out $(DEMO)/tipl --n-batches 200 --warmup 50 --save-every 25
	@echo "These are the first 200 batches of a new TIPL. The table below shows the released one, after 100,000."
	$(BIN)/tipl evaluate $(TIPL) $(GATE) --data $(RELEASED) --out $(DEMO)/report --quick --horizons 1 10 50 --return-horizons 10 50 --starts 100 --workers 2

readme: demo ## write the numbers of the demo, the tables and the picture into the pages
	cp $(DEMO)/report/results.json datasets/demo/results.json
	$(BIN)/tipl report datasets/demo/results.json --into README.md
	$(BIN)/tipl report datasets/demo/results.json --into docs/quickstart.md
	$(BIN)/python docs/results/make_results.py
	$(BIN)/tipl report docs/studies/live/test/results.json --into README.md
	$(BIN)/tipl report docs/studies/live/test/results.json --into docs/live.md
	for study in guarded suite stretched; do \
		$(BIN)/tipl report docs/studies/$$study/test/results.json --into docs/live.md || exit 1; \
	done
	for study in live confirm guarded suite stretched; do for stage in test tuning; do \
		$(BIN)/tipl report docs/studies/$$study/$$stage/results.json --into docs/live-tables.md || exit 1; \
	done; done
	$(BIN)/tipl zoo --into README.md
	$(BIN)/python datasets/pages.py
	$(BIN)/python examples/plot_path_and_returns.py docs/path-and-returns.png
	$(BIN)/jupyter-execute --inplace examples/quickstart.ipynb

test: setup ## run the tests
	$(PYTEST)

test-long: setup ## run the tests and their long versions, on a disk, with the types of every call checked
	PYTEST_DEBUG_TEMPROOT=$${TMPDIR:-/tmp} WEIGHTTRAJ_CHECK_ALL_TYPES=1 $(PYTEST) -m "long or not long"

lint: setup ## check style and types
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

docs: setup ## build the pages as one site, docs/_build/index.html
	$(BIN)/sphinx-build -q -W --keep-going -b html -c docs . docs/_build

bench: setup ## measure on two real runs (an hour to collect them), keep the numbers, write them into docs/benchmarks.md
	$(BIN)/weighttraj collect tests/benchmarks/inverted-pendulum.toml --out data/bench/inverted-pendulum
	$(BIN)/weighttraj collect tests/benchmarks/half-cheetah.toml --out data/bench/half-cheetah
	$(BIN)/python -W ignore tests/benchmarks/bench_format.py data/bench/*/runs/*.zarr.zip --save
	WEIGHTTRAJ_CACHE=data/bench/cache $(BIN)/python -W ignore tests/benchmarks/bench_load.py data/bench/*/runs/*.zarr.zip --save
	$(BIN)/python -W ignore tests/benchmarks/bench_svd.py --real data/bench/half-cheetah/runs/seed0000.zarr.zip --save
	$(BIN)/python -W ignore tests/benchmarks/bench_remote.py --save
	$(BIN)/python -W ignore tests/benchmarks/bench_callback.py --save
	$(BIN)/python -W ignore tests/benchmarks/bench_returns.py data/bench/inverted-pendulum data/bench/half-cheetah --save
	$(BIN)/python -W ignore tests/benchmarks/bench_population.py --save
	$(BIN)/python -W ignore tests/benchmarks/bench_population.py --processes --save
	$(BIN)/python -W ignore tests/benchmarks/bench_tipl_train.py --save
	$(BIN)/python -W ignore tests/benchmarks/bench_gate.py --save
	$(BIN)/python -W ignore tests/benchmarks/bench_learning.py --save
	$(BIN)/python -W ignore tests/benchmarks/bench_recipes.py --save
	$(BIN)/python tests/benchmarks/results.py

results: setup ## say what it costs, then train and evaluate every forecaster, and write docs/results.md
	$(BIN)/python docs/results/make_results.py --run

stress: setup ## kill, flip, delete, fuzz: about an hour
	$(BIN)/python -W ignore tests/benchmarks/stress_format.py

clean-demo: ## forget the demo's data
	rm -rf $(DEMO)
