# make benchmark   a venv with the library, then the official s3 test: on DexYCB with DATA=folder in HandoverSim's
#                  layout, else on the synthetic scenes
# make test        a venv with everything, then all tests; the quick ones alone: .venv/bin/python -m pytest -m "not slow"
# make check       style and types
# make smoke       wheel and sdist in clean environments, an episode from each
# make lowest      the lowest versions that setup.cfg claims

PYTHON ?= python3
VENV ?= .venv
EXTRAS ?= assets,dev,import,planning,plot,render,torchrl,train,vision
SETUP ?= s3
DATA ?= $(HANDOVER_MARL_DATA)
DATASET := $(if $(DATA),dexycb,synthetic)
OUT ?= results/$(DATASET)-$(SETUP)-yang2021

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: test benchmark check smoke lowest clean

test: $(VENV)/.tested-with
	$(BIN)/python -m pytest -n auto --dist worksteal

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

# What users install: wheel and sdist, each in a clean environment, and one episode played from each.
smoke: $(VENV)/.tested-with
	rm -rf dist build/smoke
	$(BIN)/python -m build --outdir dist .
	for package in dist/*.whl dist/*.tar.gz; do \
		$(PYTHON) -m venv --clear build/smoke && \
		build/smoke/bin/python -m pip install --disable-pip-version-check --quiet -c constraints.txt $$package && \
		(cd build/smoke && bin/handover-marl benchmark --dataset synthetic --split val --scenes 9 --physics fast) || exit 1; \
	done

# The lowest versions that setup.cfg claims, with the same episode.
lowest: $(VENV)/.tested-with
	$(PYTHON) -m venv --clear build/lowest
	$(BIN)/python -m tests.lowest_versions > build/lowest.txt
	build/lowest/bin/python -m pip install --disable-pip-version-check --quiet -r build/lowest.txt
	build/lowest/bin/python -m pip install --disable-pip-version-check --quiet --no-deps .
	cd build/lowest && bin/handover-marl benchmark --dataset synthetic --split val --scenes 9 --physics fast
	cd build/lowest && bin/handover-marl benchmark --dataset synthetic --split val --scenes 9

clean:
	rm -rf $(VENV) build dist *.egg-info
