PYTHON ?= $(shell for python in python3.11 python3; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	&& echo $$python && break; done)
BIN := .venv/bin
# What the demonstration needs, and on top of it, in the same environment, what development does.
INSTALLED := .venv/.installed
DEVELOPED := .venv/.developed
WALKING := .venv/.walking
# Where `make bench` stores its table.
BENCH ?= runs/bench.json

.DEFAULT_GOAL := help
.PHONY: help demo walking test lint bench docs clean

help: ## Show these targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-7s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(INSTALLED) ## Train on 300 episodes, evaluate, and throw balls at the robot
	$(BIN)/drake-safety train laikago_balancing --episodes 300 --out runs/demo --resume
	$(BIN)/drake-safety evaluate laikago_balancing --assessment runs/demo \
		--episodes 128 --calibration-episodes 60 --throws 30 --no-baselines
	$(BIN)/drake-safety run laikago_balancing --assessment runs/demo --push ball

walking: $(WALKING) ## Install what the walking scenarios need: robots, ONNX, policies

test: $(DEVELOPED) ## Run the tests, a process a core, eight at most
	$(BIN)/python -m pytest --numprocesses logical --maxprocesses 8 \
		--dist loadfile --no-loadscope-reorder

lint: $(DEVELOPED) ## Check style, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy drake_safety studies

bench: $(DEVELOPED) ## Measure costs beside limits and other libraries: a table, and runs/bench.json
	mkdir -p $(dir $(BENCH))
	$(BIN)/python -m pytest benchmarks --benchmark-only --benchmark-quiet --benchmark-json=$(BENCH)

docs: $(DEVELOPED) ## Build the pages and the reference into build/site; a warning is an error
	$(BIN)/mkdocs build --strict

clean: ## Remove the environment, the tools' caches and what was built (runs/ stays)
	rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .benchmarks

$(INSTALLED): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed: make PYTHON=/path/to/it" >&2; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --constraint constraints.txt --editable ".[live]"
	touch $@

$(DEVELOPED): $(INSTALLED) $(WALKING)
	$(BIN)/python -m pip install --constraint constraints.txt --editable ".[dev]"
	touch $@

$(WALKING): $(INSTALLED) policies.txt
	$(BIN)/python -m pip install --constraint constraints.txt --editable ".[robots,walking]"
	$(BIN)/python -m pip install --no-deps --require-hashes --requirement policies.txt
	touch $@
