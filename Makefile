# make benchmark   a venv with the library, then the official s3 test: on DexYCB with DATA=folder in HandoverSim's
#                  layout, else on the synthetic scenes
# make test        a venv with everything, then all tests; the quick ones alone: .venv/bin/python -m pytest -m "not slow"
# make check       style and types
# make loops       a venv with other libraries' training loops, then the tests of what trains with them
# make newer       a venv with what plays without PyBullet, then its tests: for Python 3.12 and later
# make docs        the site, into build/site, with the tutorial run; a warning is an error
# make smoke       wheel and sdist in clean environments, an episode from each
# make release     the same with every supported Python; what is not fit to be published is refused
# make lowest      the lowest versions that setup.cfg claims

PYTHON ?= python3
VENV ?= .venv
LOOPS ?= .venv-loops
NEWER ?= .venv-newer
EXTRAS ?= assets,demonstrations,dev,docs,import,mujoco,planning,plot,ray,render,replay,torchrl,train,vision
SETUP ?= s3
DATA ?= $(HANDOVER_MARL_DATA)
DATASET := $(if $(DATA),dexycb,synthetic)
OUT ?= results/$(DATASET)-$(SETUP)-yang2021

BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: test benchmark check loops newer docs smoke release lowest clean

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

# On pins of their own, see constraints-loops.txt. Learning is bound to one thread, as elsewhere.
loops: $(LOOPS)/.installed
	OMP_NUM_THREADS=1 $(LOOPS)/bin/python -m pytest tests/training/test_loops.py tests/envs/test_homogeneous.py

$(LOOPS)/.installed: setup.cfg constraints-loops.txt
	$(PYTHON) -m venv $(LOOPS)
	$(LOOPS)/bin/python -m pip --disable-pip-version-check install --progress-bar on -c constraints-loops.txt \
		-e ".[benchmarl,mujoco,plot,rllib,supersuit,tianshou]" hypothesis pytest pytest-timeout
	touch $@

# Not on the pins, which are for Pythons that PyBullet has wheels for.
newer: $(NEWER)/.installed
	$(NEWER)/bin/python -m pytest tests/test_without_pybullet.py

$(NEWER)/.installed: setup.cfg
	$(PYTHON) -m venv $(NEWER)
	$(NEWER)/bin/python -m pip --disable-pip-version-check install --progress-bar on \
		-e ".[mujoco,planning,vision]" hypothesis pytest pytest-timeout
	touch $@

# Learning in the tutorial is bound to one thread, as elsewhere.
docs: $(VENV)/.tested-with
	OMP_NUM_THREADS=1 $(BIN)/python -m sphinx -W --keep-going -q docs build/site

$(VENV)/.installed: setup.cfg constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --progress-bar on -c constraints.txt -e .
	touch $@

$(VENV)/.tested-with: $(VENV)/.installed
	$(PIP) install --progress-bar on -c constraints.txt -e ".[$(EXTRAS)]"
	touch $@

# What users install: wheel and sdist, each in a clean environment, and one episode played from each.
smoke: $(VENV)/.tested-with
	$(BIN)/python -m tests.packages

# The same with every supported Python at hand; refuses what is not fit to be published.
release: $(VENV)/.tested-with
	$(BIN)/python -m tests.packages --every --final

# The lowest versions that setup.cfg claims, with the same episode.
lowest: $(VENV)/.tested-with
	$(PYTHON) -m venv --clear build/lowest
	$(BIN)/python -m tests.lowest_versions > build/lowest.txt
	build/lowest/bin/python -m pip install --disable-pip-version-check --quiet -r build/lowest.txt
	build/lowest/bin/python -m pip install --disable-pip-version-check --quiet --no-deps .
	cd build/lowest && bin/handover-marl benchmark --dataset synthetic --split val --scenes 9 --physics fast
	cd build/lowest && bin/handover-marl benchmark --dataset synthetic --split val --scenes 9

clean:
	rm -rf $(VENV) $(LOOPS) $(NEWER) build dist *.egg-info
