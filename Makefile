# play, test, check and bench set up .venv by themselves, and again only when pyproject.toml or constraints.txt change.
VENV := .venv
BIN := $(VENV)/bin
PIP = $(BIN)/python -m pip install --disable-pip-version-check $(PIP_FLAGS) -c constraints.txt
# The first Python between 3.11 and 3.13 that runs; choose another with `make PYTHON=/path/to/python3.12 ...`.
PYTHON ?= $(shell for python in python3 python3.13 python3.12 python3.11; do \
	$$python -c 'import sys; sys.exit(not (3, 11) <= sys.version_info[:2] < (3, 14))' 2>/dev/null \
	&& { echo $$python; break; }; done)

# Compiled once, not in each of the processes that the tests start.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help play test test-all test-portable test-lerobot test-splats judge judge-cube check check-types check-style format bench bench-gpu clean
help:
	@echo "make play    open a page of worlds and places to step into: prints its address"
	@echo "make test    run the tests, in a real browser too"
	@echo "make test-all  the same with the slow sweeps (damaged files, many seeds)"
	@echo "make test-portable  run the numeric tests as a plain processor would: no wide vectors, one thread"
	@echo "make test-lerobot  run the tests against the real lerobot package, in an environment of its own"
	@echo "make test-splats  try our files of Gaussians in Spark, three.js and PlayCanvas, and theirs in ours (npm; into ~/.cache/terrella)"
	@echo "make judge   let stable-worldmodel's own harness judge our planners, in an environment of its own (it trains for some six minutes of one core first)"
	@echo "make judge-cube   the same for OGBench's cube-single: our recordings of its scripted arm, its own five tasks"
	@echo "make check   format, lint, types, the directions of imports and the house rules"
	@echo "make format  put the code into the form that make check asks for"
	@echo "make bench   time the whole path of a frame (ARGS='--help' for its options)"
	@echo "make bench-gpu  on a CUDA card: steps and training beside their bars, right or not, and what is slow (ARGS=--cpu rehearses)"
	@echo "make clean   remove .venv and caches"

play: $(VENV)/.ready-play
	$(BIN)/terrella play $(ARGS)

# Two at a time, whole files, so that what a file's tests share is made once; the long ones first (tests/conftest.py).
PYTEST = $(BIN)/python -m pytest
RUN_TESTS = $(PYTEST) -n 2 --dist loadfile --no-loadscope-reorder

test: $(VENV)/.ready-dev
	@sh tests/browser_setup.sh $(BIN)/python
	$(RUN_TESTS) -m "not slow" $(ARGS)

test-all: $(VENV)/.ready-dev
	@sh tests/browser_setup.sh $(BIN)/python
	$(RUN_TESTS) $(ARGS)

# Files whose results depend on how a processor rounds: kernels beside their slow twins, networks drawn in two ways or in batches
# and alone, trainings held to a bar. Texts, files, commands, and statistics come out the same on any processor; what of them takes
# seconds in these files is marked `exact`.
NUMERIC = $(addprefix tests/core/test_,chance.py deferred.py rollout.py) \
	$(addprefix tests/space/test_,align.py billboards.py enclosure.py estimator.py fitting.py fusing.py ground.py growing.py \
	kernels.py layout.py lifting.py memory.py mesh.py mosaic.py panorama.py raster.py remembering.py space.py walkable.py) \
	$(addprefix tests/worlds/test_,carried_frames.py dispatch.py doom_corridor.py doom_maze.py drift.py fast.py flow.py \
	islet.py latent.py learned.py localisation.py merge.py objects.py parts.py splat.py step_program.py) \
	$(addprefix tests/learn/test_,adapt.py drift.py flow_frames.py goals.py imitation.py latent_actions.py motion.py moves.py \
	muon.py objects.py outcome.py post_training.py ppo.py practice.py scroll.py train_latent.py uncertainty.py waypoints.py) \
	$(addprefix tests/measure/test_,drift.py fidelity.py frechet.py turning.py) tests/physics/test_guarded.py
test-portable: $(VENV)/.ready-dev
	ATEN_CPU_CAPABILITY=default DNNL_MAX_CPU_ISA=SSE41 NUMBA_CPU_NAME=generic NUMBA_CPU_FEATURES= OMP_NUM_THREADS=1 \
	$(RUN_TESTS) -q -m "not browser and not slow and not exact" $(NUMERIC) $(ARGS)

test-lerobot: $(VENV)/.ready-dev
	@python=$$(sh tests/lerobot_setup.sh .venv-lerobot); \
	TERRELLA_LEROBOT_PYTHON=$$python $(BIN)/python -m pytest -rs tests/data/test_lerobot.py

test-splats: $(VENV)/.ready-dev
	@sh tests/browser_setup.sh $(BIN)/python
	@folder=$$(sh tests/splat_tools_setup.sh "$${XDG_CACHE_HOME:-$$HOME/.cache}/terrella/splats" $(BIN)/python); \
	TERRELLA_SPLAT_TOOLS=$$folder $(PYTEST) -rs tests/space/test_other_tools.py

judge:
	@python=$$(sh benchmarks/judge_setup.sh .venv-judge) && OMP_NUM_THREADS=1 $$python -W ignore benchmarks/judge.py $(ARGS)

judge-cube:
	@python=$$(sh benchmarks/judge_setup.sh .venv-judge) && OMP_NUM_THREADS=1 $$python -W ignore benchmarks/cube.py $(ARGS)

check: $(VENV)/.ready-dev
	@$(MAKE) --no-print-directory -j2 check-types check-style

check-types:
	$(BIN)/pyright

check-style:
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports
	$(BIN)/python lints/house.py

format: $(VENV)/.ready-dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(VENV)/.ready-dev
	$(BIN)/python benchmarks/play.py $(ARGS)

# On a bare machine with PyTorch, too: then with the python that is there.
bench-gpu:
	PYTHONPATH=src $$(test -x $(BIN)/python && echo $(BIN)/python || echo python3) benchmarks/gpu.py $(ARGS)

clean:
	rm -rf $(VENV) .venv-lerobot .venv-judge .pytest_cache .ruff_cache .import_linter_cache .hypothesis build dist

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "Terrella needs Python 3.11, 3.12 or 3.13: install one, or run make PYTHON=/path/to/it." >&2; exit 1; }
	@$(PYTHON) -m venv --clear $(VENV) || { rm -rf $(VENV); \
		echo "$(PYTHON) cannot make a virtual environment; on Debian and Ubuntu: apt-get install python3-venv." >&2; exit 1; }

# Torch comes first and alone: its version is what the rest must live with. A CPU build of it that is already in .venv stays.
$(VENV)/.ready-play: pyproject.toml constraints.txt | $(BIN)/python
	@echo "setting up $(VENV) (once; again when pyproject.toml or constraints.txt change)"
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || $(BIN)/python -m ensurepip --upgrade
	@$(PIP) -q torch
	@$(PIP) -q -e '.[sim]'
	@echo "compiling what draws the worlds, so that the first play need not"
	@$(BIN)/python -c "import terrella as t; r = t.make_rng(0); [w.imagine(w.start(1, r), w.spec.sample_action(1, r), r) for w in map(t.load, ('doom-maze', 'doom-corridor', 'islet'))]"
	@touch $@

$(VENV)/.ready-dev: $(VENV)/.ready-play
	@$(PIP) -q -e '.[dev]'
	@echo "compiling the kernels that the tests call, so that the first run need not"
	@$(RUN_TESTS) -q -m "not slow" $(addprefix tests/space/test_,kernels.py mosaic.py raster.py walkable.py) >/dev/null || true
	@touch $@
