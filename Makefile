# `make demo` and `make test` need nothing but Python 3.11 or newer; PYTHON=... names one, else the newest on PATH.

VENV := .venv
BIN := $(VENV)/bin

.PHONY: help demo test slow lint clean llvm

help:
	@echo "make demo   render the letters scene and refocus it; pictures in demo/ (a few minutes)"
	@echo "make test   run the tests"
	@echo "make slow   run the tests that take minutes"
	@echo "make lint   check format, style and types"
	@echo "make clean  remove what make made"

demo: $(VENV)/.ready llvm
	@mkdir -p demo
	$(BIN)/mitsuba-plenoptic render letters -o demo/raw.exr --spp 4
	$(BIN)/python tools/capture_picture.py demo/raw.exr demo/raw.png
	$(BIN)/mitsuba-plenoptic reconstruct demo/raw.exr -o demo/refocused.png \
		--distance 210 --distance 240 --distance 280
	@echo
	@echo "Look at demo/raw.png, the field of micro-images on the detector (demo/raw.exr in full), and at"
	@echo "demo/refocused_210.png, demo/refocused_240.png and demo/refocused_280.png, refocused from it."

test: $(VENV)/.ready llvm
	$(BIN)/python -m pytest -n 2

slow: $(VENV)/.ready llvm
	$(BIN)/python -m pytest -m slow

lint: $(VENV)/.ready
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

# The stamp comes last, so that an interrupted installation is taken up again. An environment of the user's own is
# used as it is, but one whose Python is broken or was never finished is made anew.
$(VENV)/.ready: pyproject.toml
	@$(BIN)/python -m pip --version >/dev/null 2>&1 || { \
		python="$${PYTHON:-$$(tools/find_python.sh)}" && [ -n "$$python" ] && \
		echo "Making $(VENV) with $$python" && \
		"$$python" -m venv --clear $(VENV) && touch $(VENV)/.made-by-make; }
	$(BIN)/python -m pip install --disable-pip-version-check --quiet --editable '.[test]'
	@touch $@

llvm: $(VENV)/.ready
	@$(BIN)/python tools/ensure_llvm.py

clean:
	rm -rf build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -not -path './$(VENV)/*' -prune -exec rm -rf {} +
	rm -f demo/raw.exr demo/raw.png demo/refocused_210.png demo/refocused_240.png demo/refocused_280.png
	if [ -d demo ]; then rmdir --ignore-fail-on-non-empty demo; fi
	if [ -f $(VENV)/.made-by-make ]; then rm -rf $(VENV); fi
