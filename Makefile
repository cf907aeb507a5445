# make benchmark   a venv with the library, then the official s3 test: on DexYCB with DATA=folder in HandoverSim's
#                  layout, else on the synthetic scenes
# make test        a venv with everything, then all tests
# make check       style and types

PYTHON ?= python3
VENV ?= .venv
EXTRAS ?= assets,dev,planning,plot,render,train
SETUP ?= s3
DATA ?= $(HANDOVER_MARL_DATA)
DATASET := $(if $(DATA),dexycb,synthetic)
OUT ?= results/$(DATASET)-$(SETUP)-yang2021

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: test benchmark check clean

test: $(VENV)/.tested-with
	$(BIN)/python -m pytest

benchmark: $(VENV)/.installed
	$(BIN)/handover-marl benchmark --setup $(SETUP) --receiver yang2021 --dataset $(DATASET) \
		$(if $(DATA),--data-dir "$(DATA)") --out "$(OUT)"

# Style and types. Types are checked on an installed copy, where givers/, receivers/ and assets/ have their names.
check: $(VENV)/.tested-with
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	rm -rf build
	$(PIP) install --quiet --no-deps --target build/typed .
	MYPYPATH=build/typed $(BIN)/mypy --cache-dir build/mypy -p handover_marl

$(VENV)/.installed: setup.cfg constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --progress-bar on -c constraints.txt -e .
	touch $@

$(VENV)/.tested-with: $(VENV)/.installed
	$(PIP) install --progress-bar on -c constraints.txt -e ".[$(EXTRAS)]"
	touch $@

clean:
	rm -rf $(VENV) build dist *.egg-info
