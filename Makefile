# Set-up and checks from a clean clone; everything goes into .venv. PYTHON must be 3.11 or newer.
PYTHON ?= $(firstword $(foreach p,python3 python3.13 python3.12 python3.11,$(shell $(p) -c "import sys; print(sys.executable if sys.version_info >= (3, 11) else '')" 2>/dev/null)))
VENV ?= .venv
# what is installed is what was tested: every file of every package is known by its hash. "make LOCK=" takes what fits pyproject.toml
LOCK ?= requirements.lock
EXTRAS ?= fast,test
# what checks and the site need beyond it, so that nobody else pays: campaigns (Dask, pyarrow), mkdocs, rerun
CHECK_LOCK ?= requirements-check.lock
CHECK_EXTRAS ?= campaign,docs,rerun
BIN := $(VENV)/bin
WORKERS ?= 2
DEMO_OUT ?= out/demo
PURE_TESTS := tests/common tests/compare_node
# one thread each: the test workers share the cores
ONE_THREAD := OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1

.PHONY: demo docs test test-slow check static coverage bench lock blind-test colcon clean

demo: $(VENV)/installed ## the main job on the shipped experiment: report in out/demo
	$(BIN)/livedeform demo --out $(DEMO_OUT) --force

test: $(VENV)/installed ## the tests (a few minutes)
	$(ONE_THREAD) $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile -m "not slow and not statistical" $(PYTEST_OPTIONS)

test-slow: $(VENV)/installed ## the tests that take minutes, and those over many seeds
	$(ONE_THREAD) $(BIN)/python -m pytest -n $(WORKERS) --dist loadfile -m "slow or statistical"

check: ## what CI runs: the pinned packages, style, types, tests with the site, coverage of the pure layers
	$(MAKE) --no-print-directory -j 2 static coverage
	$(MAKE) --no-print-directory test

# in a fresh clone kernels compile while the rest is installed and these begin
static: $(VENV)/check-installed ## what runs nothing: the pinned packages, style, types
ifneq ($(LOCK),)
	$(BIN)/python .ci/packages.py check
endif
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

coverage: $(VENV)/installed $(VENV)/check-installed ## the coverage of the pure layers by their own tests: cheap, unlike a trace of the whole suite
	$(ONE_THREAD) $(BIN)/python -m pytest -q -m "not slow and not statistical" $(PURE_TESTS) --cov --cov-report=
	@echo "coverage of common and compare_node by their own tests: $$($(BIN)/coverage report --format=total) %"

docs: $(VENV)/check-installed ## the documentation as a site in out/site, without a network; fails on a dead link
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "out/site/index.html"

$(VENV)/check-installed: $(VENV)/packages $(CHECK_LOCK)
ifeq ($(LOCK),)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[$(EXTRAS),$(CHECK_EXTRAS)]'
else
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r $(CHECK_LOCK)
endif
	@touch $@

bench: $(VENV)/installed ## the benchmark table
	$(BIN)/python -m benchmarks

# the source tree is what is tested, so the package is installed in place; a changed pyproject or lock installs again
$(VENV)/packages: pyproject.toml setup.py $(LOCK)
	@test -n "$(PYTHON)" || { echo "no Python 3.11 or newer found; name one: make PYTHON=/path/to/python3.11" >&2; exit 2; }
	$(PYTHON) -m venv $(VENV)
ifeq ($(LOCK),)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -e '.[$(EXTRAS)]'
else
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --require-hashes -r $(LOCK) || \
	  { echo "the tested packages do not fit this machine; 'make LOCK=' takes others, within pyproject.toml's bounds" >&2; exit 2; }
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	$(BIN)/python -m pip --disable-pip-version-check check
endif
	@touch $@

$(VENV)/installed: $(VENV)/packages
	@echo "compiling kernels, once: about a minute"
	$(BIN)/python -c "from livedeform.kernels import compile_kernels; compile_kernels()"
	@touch $@

lock: ## pins the newest packages within pyproject.toml's bounds
	$(BIN)/python -m pip install --quiet --disable-pip-version-check uv
	PATH="$(abspath $(BIN)):$$PATH" $(BIN)/python .ci/packages.py lock
	$(BIN)/python docs/make_licences.py

blind-test: $(VENV)/installed ## the large set of undeclared effects: a day's work in the background, resumable
	$(BIN)/python -m benchmarks.blind run --out out/blind

colcon: ## builds the tree as a ROS 2 package into build/ and install/ (colcon must be there)
	colcon build --packages-select livedeform

clean:
	rm -rf $(VENV) build dist install log out src/*.egg-info
