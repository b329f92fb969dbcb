PYTHON ?= $(shell for python in python3.11 python3; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	&& echo $$python && break; done)
BIN := .venv/bin
INSTALLED := .venv/.installed

.DEFAULT_GOAL := help
.PHONY: help demo test lint bench docs clean

help: ## Show these targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-6s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(INSTALLED) ## Train on 1024 episodes, evaluate, and throw balls at the robot
	$(BIN)/drake-safety train laikago_balancing --episodes 1024 --out runs/demo --resume
	$(BIN)/drake-safety evaluate laikago_balancing --assessment runs/demo \
		--episodes 200 --calibration-episodes 60 --throws 60 --calibration-throws 40
	$(BIN)/drake-safety run laikago_balancing --assessment runs/demo --push ball

test: $(INSTALLED) ## Run the tests, a process a core
	$(BIN)/python -m pytest --numprocesses logical --maxprocesses 8 \
		--dist loadfile --no-loadscope-reorder

lint: $(INSTALLED) ## Check style, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy drake_safety

bench: $(INSTALLED) ## Measure the costs of rollouts, training and one assessment
	$(BIN)/python -m pytest benchmarks --benchmark-only

docs: $(INSTALLED) ## Build the reference into build/site; a warning is an error
	$(BIN)/mkdocs build --strict

clean: ## Remove the environment, the caches and what was built (runs/ stays)
	rm -rf .venv build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .benchmarks

$(INSTALLED): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed: make PYTHON=/path/to/it" >&2; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --constraint constraints.txt --editable ".[dev]"
	touch $@
