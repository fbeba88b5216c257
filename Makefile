# `make demo` and `make test` need nothing but Python 3.11 or newer; PYTHON=... names one, else the newest on PATH.

VENV := .venv
BIN := $(VENV)/bin

.PHONY: help demo test test-tensors hunt coverage slow in-turn examples pictures package release docs lint clean llvm

help:
	@echo "make demo   capture and refocus the letters by rays and by waves; demo/report.html (a few minutes)"
	@echo "make test   run the tests"
	@echo "make test-tensors   run the tests of PyTorch and JAX in an environment of their own, .venv-tensors (GBs)"
	@echo "make hunt   try what every camera obeys on random ones; SECONDS=3600 SEED=1, or AGAIN=... as a failure prints it"
	@echo "make coverage   run them and see what they reach: build/coverage/html"
	@echo "make slow   run the tests that take minutes"
	@echo "make in-turn   run the part of them, or the coverage, whose turn it is; PART=1 the first"
	@echo "make examples   render the captures of mp.example from the built-in scenes (20 s)"
	@echo "make pictures   make the pictures of the site (some minutes; needs Chromium, and the notebooks of 'make docs')"
	@echo "make package   build wheel and sdist from a fresh clone, and try the wheel in an empty environment"
	@echo "make release   do that, try every Python that is on PATH, and check what an index asks for: dist/, ready to upload"
	@echo "make docs   build the site with its notebooks executed: build/docs/index.html (some minutes)"
	@echo "make lint   check format, style, types and directions of imports"
	@echo "make clean  remove what make made"

demo: $(VENV)/.installed
	@$(BIN)/python tools/ensure_llvm.py
	$(BIN)/mitsuba-plenoptic reproduce --preset quick -o demo

# Each process takes half of the tests in their order, so that those of a file share captures and compiled kernels, and
# at the end some of the other's. A process that dies ends the run at once, and so does a test that hangs. Tests
# start many processes: compiled modules are kept, as a third of the time would go into compiling them again.
PYTEST := PYTHONDONTWRITEBYTECODE= $(BIN)/python -m pytest -n 2 --dist worksteal --max-worker-restart=0
test: $(VENV)/.ready llvm
	$(PYTEST) --timeout=300

hunt: $(VENV)/.ready
	@$(BIN)/python tests/relations/hunt.py $(or $(AGAIN),$(or $(SECONDS),3600) $(or $(SEED),1))

# PyTorch's default wheel brings CUDA, several GB: an environment apart, and no part of 'make test'.
TENSORS := .venv-tensors
test-tensors: $(TENSORS)/.ready llvm
	$(TENSORS)/bin/python -m pytest tests/extensions/inverse/test_torch.py tests/extensions/inverse/test_jax.py tests/docs/test_reference.py \
		tests/extensions/inverse/test_refocus_derivatives.py tests/extensions/data/test_dataset.py

$(TENSORS)/.ready: pyproject.toml $(VENV)/.ready
	$(BIN)/python -m venv --clear $(TENSORS)
	$(TENSORS)/bin/python -m pip install --disable-pip-version-check --quiet --editable '.[test,torch,jax]'
	@touch $@

# Measuring takes a sixth more of the processor, so 'make test' leaves it out; pyproject.toml sets the floor.
coverage: $(VENV)/.ready llvm
	rm -rf build/coverage && mkdir -p build/coverage
	$(PYTEST) --timeout=300 --cov --cov-report=html --cov-report=term

# Parts take like times by tests/slow_seconds.json, which 'make slow MEASURE=yes' writes.
SLOW_PARTS := 6
slow: $(VENV)/.ready llvm
	$(PYTEST) -m slow --timeout=1200 --durations-path tests/slow_seconds.json \
		$(if $(PART),--splits $(SLOW_PARTS) --group $(PART)) $(if $(MEASURE),--store-durations --clean-durations)

# The slow tests and the coverage, of which a workflow runs one at a time: PART=1 and so on, or by the hour.
PART_BY_TIME = $(shell expr $$(date +%s) / 10800 % \( $(SLOW_PARTS) + 1 \) + 1)
in-turn:
	@echo "In turn: part $(or $(PART),$(PART_BY_TIME)) of $$(($(SLOW_PARTS) + 1)), where the last is the coverage"
	@part=$(or $(PART),$(PART_BY_TIME)); \
	if [ $$part -gt $(SLOW_PARTS) ]; then $(MAKE) coverage; else $(MAKE) slow PART=$$part; fi

examples: $(VENV)/.ready llvm
	$(BIN)/python tools/make_examples.py

pictures: $(VENV)/.ready llvm
	$(BIN)/python tools/make_pictures.py

package: $(VENV)/.ready llvm
	$(BIN)/python tools/check_release.py

# All of a release but the upload.
release: $(VENV)/.ready llvm
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --editable '.[release]'
	rm -rf dist
	$(BIN)/python tools/check_release.py --keep dist --everywhere
	$(BIN)/python -m twine check --strict dist/*

# EXECUTE=off leaves the notebooks' cells and the pages' blocks unexecuted, as .ci/run has it.
docs: $(VENV)/.docs-ready
	@$(BIN)/python tools/ensure_llvm.py
	$(BIN)/python -m sphinx -W --keep-going -j 2 -b html docs build/docs
	$(BIN)/python tools/check_site.py build/docs
	$(if $(filter off,$(EXECUTE)),,$(BIN)/python tools/paste_pages.py)

lint: $(VENV)/.ready
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports --no-cache

# The stamp comes last, so that an interrupted installation is taken up again. An environment of the user's own is
# used as it is, but one whose Python is broken or was never finished is made anew.
define MAKE_ENVIRONMENT
$(BIN)/python -m pip --version >/dev/null 2>&1 || { \
	python="$${PYTHON:-$$(tools/find_python.sh)}" && [ -n "$$python" ] && \
	echo "Making $(VENV) with $$python" && \
	"$$python" -m venv --clear $(VENV) && touch $(VENV)/.made-by-make; }
endef

# The demo needs nothing of the extra "test", which takes a third of the time of an installation. Python compiles what
# it imports, which is a small part of what compiling at the installation would take half of its time for.
$(VENV)/.installed: pyproject.toml
	@$(MAKE_ENVIRONMENT)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-compile --editable .
	@touch $@

$(VENV)/.ready: pyproject.toml
	@$(MAKE_ENVIRONMENT)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-compile --editable '.[test]'
	@touch $@ $(VENV)/.installed

$(VENV)/.docs-ready: pyproject.toml
	@$(MAKE_ENVIRONMENT)
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --no-compile --editable '.[docs]'
	@touch $@

llvm: $(VENV)/.ready
	@$(BIN)/python tools/ensure_llvm.py

clean:
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
	rm -rf demo/data
	rm -f demo/report.html demo/results.json $(foreach name,answer first fig1 fig2 fig3 fig4 methods interference captures,\
		demo/$(name).png demo/$(name).pdf)
	if [ -d demo ]; then rmdir --ignore-fail-on-non-empty demo; fi
	if [ -f $(VENV)/.made-by-make ]; then rm -rf $(VENV); fi
	rm -rf $(TENSORS)
