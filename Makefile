# Everything runs from .venv: made from requirements.lock, for tests added to from requirements-dev.lock.
PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
READY  := $(VENV)/.ready
TOOLS  := $(VENV)/.tools
KERNELS := $(VENV)/.kernels
# Most of what is installed is never imported: Python compiles at the first import, which takes half the time. Some
# containers forbid Python to keep what it compiled: each process would then take 6 s more for its imports.
unexport PYTHONDONTWRITEBYTECODE
PIP    := $(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile
# A lock names all that is needed. With --no-deps pip asks no index what else there is: a release of tomorrow changes nothing.
LOCKED := $(PIP) --require-hashes --no-deps

.PHONY: demo test slow ros2 bench campaign mutants busy coverage docs lint weight lock wheel clean
.DEFAULT_GOAL := demo

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Sightline needs Python 3.11 or newer; try: make PYTHON=python3.12")'
	$(PYTHON) -m venv $(VENV)
	$(LOCKED) -r requirements.lock
	$(PIP) --no-deps --no-build-isolation -e .
	@touch $@

# The first demo compiles the kernels and keeps them; those that label a block or register a bone are not among them.
# Tests in several processes would wait for one that compiles.
$(KERNELS): $(TOOLS)
	-@$(BIN)/sightline demo --quiet --out $(VENV)/first-run
	-@$(BIN)/python -m pytest -q tests/detection/test_cloud.py tests/registration -k "hundred or three_views" >$(VENV)/first-run/kernels.txt
	@touch $@

$(TOOLS): $(READY) requirements-dev.lock
	$(LOCKED) -r requirements-dev.lock
	@touch $@

demo: $(READY)  ## two images of a twin, calibrated, planned, reported: out/demo/report.html
	@test -f $(KERNELS) || echo "the first demo also compiles the kernels: about a minute"
	$(BIN)/sightline demo
	@touch $(KERNELS)

# A process more than cores, since robots are waited for in real time; a file of tests on one of them: files share
# fixtures; in their order, that the longest (app) do not come last. Matrices are small: a thread each will do.
PROCESSES = -n $$($(BIN)/python -c 'import os; print(os.cpu_count() + 1)') --dist loadfile --no-loadscope-reorder

test: $(TOOLS) $(KERNELS)  ## the whole suite: about five minutes on two cores
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest $(PROCESSES) --durations=10

slow: $(TOOLS) $(KERNELS)  ## what is too slow for `make test`; on Linux with ROS 2
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -m slow $(PROCESSES) --durations=10
	test "$$(uname)" != Linux || $(MAKE) ros2

# ROS 2 restarts each Python that it is installed for, so it has an environment of its own, which sees the other.
ros2: $(VENV)/.ros2  ## the tests against ROS 2 (262 MB, Linux with gcc)
	OPENBLAS_NUM_THREADS=1 $(VENV)/ros2/bin/python -m pytest -m slow tests/robot/test_ros2.py

$(VENV)/.ros2: $(TOOLS) requirements-ros2.lock tools/build_tf2_msgs.py
	$(PYTHON) -m venv $(VENV)/ros2
	$(VENV)/ros2/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes --no-deps -r requirements-ros2.lock
	$(VENV)/ros2/bin/python tools/build_tf2_msgs.py
	cd $(VENV)/ros2/lib/python*/site-packages && realpath $(CURDIR)/src ../../../../lib/python*/site-packages > sightline.pth
	@touch $@

coverage: $(TOOLS) $(KERNELS)  ## the suite, and which lines of the source it runs
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest $(PROCESSES) \
	  --cov=sightline --cov-report=term:skip-covered

# The peer's OpenCV stands beside ours, since Python can import only one of them; it takes NumPy from .venv.
out/opencv4: $(TOOLS) requirements-opencv4.lock
	$(LOCKED) --upgrade --target $@ -r requirements-opencv4.lock
	@touch $@

bench: $(TOOLS) out/opencv4  ## the figures of docs/benchmarks.md, each beside its peer
	$(BIN)/python -m benchmarks

TRIES ?= 200
campaign: $(TOOLS)  ## inputs spoilt by seeds: refused, NO-GO, right, wrong, crash; TRIES=10000 takes hours
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m campaigns --tries $(TRIES)

CHANGES ?= 300
mutants: $(TOOLS)  ## one-token changes of the source, and whether a test notices: hours
	$(BIN)/python -m campaigns.mutants --changes $(CHANGES)

busy: $(TOOLS)  ## the tests, again and again, while all cores are busy: hours
	$(BIN)/python -m campaigns.busy

lint: $(TOOLS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/basedpyright
	$(BIN)/lint-imports

weight: $(READY)  ## how much there is to maintain, beside its limits in pyproject.toml
	$(BIN)/python tools/weight.py

docs: $(VENV)/.docs  ## the site: out/docs/index.html; three notebooks are executed
	OPENBLAS_NUM_THREADS=1 $(BIN)/sphinx-build --fail-on-warning --jobs auto --quiet -d out/doctrees docs out/docs

$(VENV)/.docs: $(READY) requirements-docs.lock
	$(LOCKED) -r requirements-docs.lock
	@touch $@

wheel: $(TOOLS)
	$(BIN)/python -m build --no-isolation --wheel --outdir dist

COMPILE = uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-emit-index-url --no-annotate \
  --custom-compile-command 'make lock'

lock:  ## compile the locks again (needs uv)
	$(COMPILE) --extra robot --extra app --extra studies --extra xreg --group build pyproject.toml -o requirements.lock
	$(COMPILE) --group dev --group bench -c requirements.lock -o requirements-dev.lock
	$(COMPILE) --group docs -c requirements.lock -c requirements-dev.lock -o requirements-docs.lock
	$(COMPILE) --group ros2 -c requirements.lock -c requirements-dev.lock -o requirements-ros2.lock
	$(COMPILE) --group opencv4 --no-deps -o requirements-opencv4.lock

clean:
	rm -rf out dist build .pytest_cache .ruff_cache .coverage
