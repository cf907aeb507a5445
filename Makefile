# make test        a venv with everything, then all checks
# make benchmark   a venv with the library, then the official s3 test (DATA=folder in HandoverSim's layout)

PYTHON ?= python3
VENV ?= .venv
EXTRAS ?= dev,train
SETUP ?= s3
DATA ?= $(HANDOVER_MARL_DATA)
OUT ?= results/$(SETUP)-yang2021

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: test benchmark check clean

test: $(VENV)/.tested-with
	$(BIN)/python -m pytest

benchmark: $(VENV)/.installed
	@test -n "$(DATA)" || { echo "make benchmark needs DexYCB in HandoverSim's layout: make benchmark DATA=/path/to/handover/data"; exit 2; }
	$(BIN)/handover-marl benchmark --setup $(SETUP) --receiver yang2021 --data-dir "$(DATA)" --out "$(OUT)"

# Style and types. Types are checked on an installed copy, where givers/, receivers/ and assets/ have their names.
check: $(VENV)/.tested-with
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	rm -rf build
	$(PIP) install --quiet --no-deps --target build/typed .
	MYPYPATH=build/typed $(BIN)/mypy -p handover_marl

$(VENV)/.installed: setup.cfg constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --quiet --progress-bar on -c constraints.txt -e .
	touch $@

$(VENV)/.tested-with: $(VENV)/.installed
	$(PIP) install --quiet --progress-bar on -c constraints.txt -e ".[$(EXTRAS)]"
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info
