# make benchmark   a venv with the library, then the s3 test: with DATA=folder in HandoverSim's layout on DexYCB in
#                  exact physics, which is the official evaluation, else on the synthetic scenes in fast physics
# make test        a venv with everything, then all tests
# make quick       lint, types and the fast tests
# make check       lint and types
# make loops       a venv with other RL libraries over that of the tests, then the tests of their training loops
# make lerobot     a venv with LeRobot and vla-eval, then the tests that need them
# make newer       a venv with everything, then the tests without PyBullet: for Python 3.14, which it has no wheels for
# make docs        the site in build/site, with the notebook executed; a warning is an error
# make smoke       the wheel in a clean environment with the lowest versions that setup.cfg claims, and episodes with it
# make release     the same with every supported Python and pinned versions; and checks before publishing
# make resolve     checks that constraints.txt holds for every Python that setup.cfg names; needs the network

PYTHON ?= python3
VENV ?= .venv
LOOPS ?= .venv-loops
LEROBOT ?= .venv-lerobot
EXTRAS ?= assets,dev,docs,import,minari,planning,plot,ray,render,replay,torchrl,train,vision,warp
SETUP ?= s3
DATA ?= $(HANDOVER_MARL_DATA)
DATASET := $(if $(DATA),dexycb,synthetic)
# Exact physics reproduces published results, which exist for DexYCB only. Evaluations with it take eight times as long.
# PyBullet, which has both, has no wheels for Python 3.14.
FASTEST = $(shell $(PYTHON) -c "import sys; print('fast' if sys.version_info < (3, 14) else 'mujoco')")
PHYSICS ?= $(if $(DATA),exact,$(FASTEST))
OUT ?= results/$(DATASET)-$(SETUP)-yang2021-$(PHYSICS)

BIN := $(VENV)/bin
INSTALL := PYTHON="$(PYTHON)" .ci/install

# The tests of a file run in one process, which makes its fixtures once; tests/conftest.py sorts the files.
SIDE_BY_SIDE := -n auto --dist loadfile --no-loadscope-reorder

.PHONY: test benchmark quick fast types lint check loops lerobot newer docs smoke play release resolve clean

test: $(VENV)/.tested-with
	$(BIN)/python -m pytest $(SIDE_BY_SIDE)

benchmark: $(VENV)/.installed
	$(BIN)/handover-marl benchmark --setup $(SETUP) --receiver yang2021 --dataset $(DATASET) --physics $(PHYSICS) \
		$(if $(DATA),--data-dir "$(DATA)") --out "$(OUT)"

# The inner loop: lint first, then types and fast tests at the same time.
quick: $(VENV)/.tested-with lint
	$(MAKE) --no-print-directory -j2 types fast

fast: $(VENV)/.tested-with
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) -q -m "not slow"

lint: $(VENV)/.tested-with
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python .ci/line_budgets.py

# Scripts are modules without a package, which import each other by their names.
SCRIPTS = $(shell find experiments -name '*.py')
types: $(VENV)/.tested-with
	MYPYPATH=$$(echo $(sort $(dir $(SCRIPTS))) | tr ' ' :) $(BIN)/mypy --cache-dir build/mypy \
		-p handover_marl $(patsubst %,-m %,$(basename $(notdir $(SCRIPTS))))

check: lint types

# These libraries have their own pins, see constraints-loops.txt. Learning uses one thread. Ray starts a cluster of its
# own, so that other tests may run at the same time.
loops: $(LOOPS)/.installed
	RAY_ADDRESS=local OMP_NUM_THREADS=1 $(LOOPS)/bin/python -m pytest -p no:xdist -k "loops or supersuit or rl_libraries" \
		tests/learning/training/test_loops.py tests/envs/test_wrappers.py tests/docs/test_blocks.py

$(LOOPS)/.installed: setup.cfg constraints-loops.txt
	$(INSTALL) $(LOOPS) -c constraints-loops.txt \
		-e ".[benchmarl,plot,rllib,supersuit,tianshou]" hypothesis pytest pytest-timeout
	touch $@

# LeRobot writes and reads data sets. torchcodec needs FFmpeg's libraries, which are in PyAV's package under other names.
lerobot: $(LEROBOT)/.installed
	LD_LIBRARY_PATH="$(abspath $(LEROBOT))/ffmpeg" HF_HUB_OFFLINE=1 HF_HOME="$(abspath $(LEROBOT))/cache" \
		$(LEROBOT)/bin/python -m pytest tests/evaluation/demonstrations/test_to_lerobot.py tests/experiments/test_harnesses.py

# LeRobot 0.4 asks for PyTorch before 2.11 and for packages that only robots need, hence --no-deps. Its data sets,
# training and evaluation work with these. For Python 3.11.
LEROBOT_PACKAGES := accelerate==1.15.0 av==15.1.0 datasets==4.8.5 deepdiff==8.6.1 diffusers==0.35.2 draccus==0.10.0 \
	einops==0.8.2 numpy==2.2.6 packaging==25.0 pyserial==3.5 termcolor==3.3.0 torch==2.13.0 torchcodec==0.13.0 \
	torchvision==0.28.0 vla-eval==0.8.0
$(LEROBOT)/.installed: setup.cfg Makefile
	$(INSTALL) $(LEROBOT) -e ".[vision]" $(LEROBOT_PACKAGES) hypothesis pytest pytest-timeout
	$(INSTALL) $(LEROBOT) --no-deps lerobot==0.4.4
	mkdir -p $(LEROBOT)/ffmpeg
	for file in $(abspath $(LEROBOT))/lib/python3*/site-packages/av.libs/lib[as][vw]*.so.*; do \
		ln -sf "$$file" $(LEROBOT)/ffmpeg/"$$(basename "$$file" | sed -E 's/-[0-9a-f]+(\.so\.[0-9]+).*/\1/')"; \
	done
	touch $@

newer: $(VENV)/.tested-with
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) tests/test_without_pybullet.py

# Learning in the notebook uses one thread.
docs: $(VENV)/.tested-with
	OMP_NUM_THREADS=1 $(BIN)/python -m sphinx -W --keep-going -q docs build/site

$(VENV)/.installed: setup.cfg constraints.txt
	$(INSTALL) $(VENV) -c constraints.txt -e .
	touch $@

$(VENV)/.tested-with: $(VENV)/.installed
	$(INSTALL) $(VENV) -c constraints.txt -e ".[$(EXTRAS)]"
	touch $@

# The wheel is built from the sdist.
smoke: $(VENV)/.tested-with
	rm -rf dist
	$(BIN)/python -m build
	$(BIN)/python -m twine check --strict dist/*
	test $$(cat dist/*.whl | wc -c) -lt 14000000
	! $(BIN)/python -m zipfile --list dist/*.whl | sed 1d | grep -v '^handover_marl'
	mkdir -p build
	sed -n '/^install_requires/,/^$$/{s/>=/==/;s/^    \([a-z]\)/\1/p}' setup.cfg > build/lowest.txt
	test $$(grep -c == build/lowest.txt) -ge 10
	$(MAKE) --no-print-directory play CONSTRAINTS=build/lowest.txt

# Episodes with the wheel in a clean environment. The page with the report needs templates, which are data files.
play:
	rm -rf build/smoke
	$(INSTALL) build/smoke --quiet -c $(CONSTRAINTS) dist/*.whl
	cd build/smoke && for physics in $$(bin/python -c \
		"from handover_marl.simulation.engines import list_available_physics; print(*list_available_physics()[-2:])"); do \
		bin/handover-marl benchmark --dataset synthetic --split val --scenes 9 --physics $$physics --overwrite --out results | \
			grep "Report: results/report.html" || exit 1; \
	done

release: smoke
	test -z "$$(git status --porcelain)"
	version=$$($(BIN)/python -c "import handover_marl; print(handover_marl.__version__)"); \
		grep "^## $$version$$" CHANGELOG.md && test -z "$$(git tag --list "v$$version")"
	for version in $$(sed -n 's/.*Python :: \(3\.[0-9]*\)$$/\1/p' setup.cfg); do \
		if python$$version --version; then \
			$(MAKE) --no-print-directory play PYTHON=python$$version CONSTRAINTS=constraints.txt || exit 1; \
		else echo "not tried, for there is no such Python here: $$version"; fi; \
	done

# pip resolves for the Python that it runs in; uv for any, here for patch 9, since packages leave out early ones.
resolve: $(VENV)/.installed
	rm -rf build/resolve
	$(BIN)/python -m pip wheel --quiet --no-deps --wheel-dir build/resolve .
	for version in $$(sed -n 's/.*Python :: \(3\.[0-9]*\)$$/\1/p' setup.cfg); do \
		echo "handover-marl[$(EXTRAS)] @ file://$$(echo $(CURDIR)/build/resolve/*.whl)" | $(BIN)/uv pip compile \
			--quiet --no-header --no-annotate --python-version $$version.9 --only-binary :all: -c constraints.txt \
			-o build/resolve/$$version.txt - && echo "Python $$version: build/resolve/$$version.txt" || exit 1; \
	done

clean:
	rm -rf $(VENV) $(LOOPS) $(LEROBOT) build dist *.egg-info
