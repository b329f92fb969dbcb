PYTHON ?= $(shell for python in python3 python3.13 python3.12 python3.11; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null \
	&& echo $$python && break; done)
BIN := .venv/bin
PYTEST := -m pytest --numprocesses logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder
# The Pythons of this machine, on the PATH and pyenv's, one of each version: `3.12=/path/to/it`.
PYTHONS = $(shell { echo "$$PATH" | tr : '\n'; ls -d "$$(pyenv root)"/versions/*/bin; } 2>/dev/null \
	| while read -r at; do for python in "$$at"/python3.[0-9] "$$at"/python3.[0-9][0-9]; do \
	"$$python" -c 'import ensurepip, sys; print("%d.%d=%s" % (*sys.version_info[:2], sys.executable))'; \
	done; done 2>/dev/null | sort -t= -k1,1V -u | grep -E '^3\.(1[1-9]|[2-9][0-9])=')
# An environment of the light install, and one of the lowest versions.
LIGHT ?= .pythons/light
LOWEST := .pythons/lowest
# What the demonstration needs, and on top of it, in the same environment, what development does.
INSTALLED := .venv/.installed
DEVELOPED := .venv/.developed
WALKING := .venv/.walking
# Where `make bench` stores its table.
BENCH ?= runs/bench.json

.DEFAULT_GOAL := help
.PHONY: help demo walking test light pythons lowest lint bench tutorials docs clean

help: ## Show these targets
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "  make %-7s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

demo: $(INSTALLED) ## Train on 100 episodes, evaluate, and throw balls at the robot
	$(BIN)/drake-safety train laikago_balancing --motion 12.5 --episodes 100 --out runs/demo --resume
	$(BIN)/drake-safety evaluate laikago_balancing --assessment runs/demo \
		--episodes 64 --calibration-episodes 40 --throws 16
	$(BIN)/drake-safety run laikago_balancing --assessment runs/demo --push ball

walking: $(WALKING) ## Install what the walking scenarios need: robots, ONNX, policies

test: $(DEVELOPED) ## Run the tests, a process a core, eight at most
	$(BIN)/python $(PYTEST)

light: $(LIGHT)/.installed ## Test the light install: quick tests of all that does not learn
	$(LIGHT)/bin/python $(PYTEST) -m "not train and not slow"

pythons: ## Test the light install on each Python of this machine that `make test` does not use
	@own=$$($(BIN)/python -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null); \
	found="$(PYTHONS)"; echo "Pythons found: $${found:-none}; of .venv: $${own:-none}"; \
	for one in $$found; do version=$${one%%=*}; if [ "$$version" != "$$own" ]; then \
	$(MAKE) light PYTHON="$${one#*=}" LIGHT=".pythons/$$version" || exit 1; fi; done

# The plugin of anyio that is installed then warns of a newer pytest.
lowest: $(LOWEST)/.installed ## Test the lowest versions of all dependencies, on Python 3.11
	$(LOWEST)/bin/python $(PYTEST) -p no:anyio

lint: $(DEVELOPED) ## Check style, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy drake_safety studies
	$(BIN)/lint-imports

bench: $(DEVELOPED) ## Measure costs beside limits and other libraries: a table, and runs/bench.json
	mkdir -p $(dir $(BENCH))
	$(BIN)/python -m pytest benchmarks --benchmark-only --benchmark-quiet --benchmark-json=$(BENCH)

tutorials: $(DEVELOPED) ## Run the tutorials, half an hour, and keep the outputs that the site shows
	$(BIN)/python -m studies tutorials

docs: $(DEVELOPED) ## Build the pages and the reference into build/site; a warning is an error
	$(BIN)/mkdocs build --strict

clean: ## Remove the environments, the tools' caches and what was built (runs/ stays)
	rm -rf .venv .pythons build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .benchmarks .hypothesis

$(INSTALLED): pyproject.toml constraints.txt
	@test -n "$(PYTHON)" || { echo "Python 3.11 or newer is needed: make PYTHON=/path/to/it" >&2; exit 1; }
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --constraint constraints.txt --editable ".[live,train]"
	touch $@

$(DEVELOPED): $(INSTALLED) $(WALKING)
	$(BIN)/python -m pip install --constraint constraints.txt --editable ".[dev]"
	touch $@

$(WALKING): $(INSTALLED) policies.txt
	$(BIN)/python -m pip install --constraint constraints.txt --editable ".[robots,walking]"
	$(BIN)/python -m pip install --no-deps --ignore-requires-python --require-hashes \
		--requirement policies.txt
	touch $@

$(LIGHT)/.installed: pyproject.toml constraints.txt policies.txt
	$(PYTHON) -m venv $(LIGHT)
	$(LIGHT)/bin/python -m pip install --constraint constraints.txt --editable \
		".[c,live,mujoco,onnx,report,robots,test,walking]"
	$(LIGHT)/bin/python -m pip install --no-deps --ignore-requires-python --require-hashes \
		--requirement policies.txt
	touch $@

$(LOWEST)/.installed: pyproject.toml lowest.txt
	python3.11 -m venv $(LOWEST)
	$(LOWEST)/bin/python -m pip install --constraint lowest.txt --editable \
		".[c,cluster,live,logs,mujoco,onnx,report,robots,test,train,tutorials,walking]"
	$(LOWEST)/bin/python -m pip install --no-deps --require-hashes --requirement policies.txt
	touch $@
