# Two commands, each doing all of its set-up on a fresh machine:
#   make run    the main job; RECORDINGS=DIR ROBOT=NAME take your own data, FORMAT=NAME imports it
#               first (csv, mcap, darwin-hardware, ...), ARGS=... passes options on
#   make test   linters, types, import rules and the tests
# and `make install` for the set-up of the first alone: `pup` and `pup-agent` in .venv/bin.
PYTHON ?= python3.11
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out
ROBOT ?= darwin_op2

.PHONY: install run test slow lint docs clean

$(VENV)/.installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[service,learn]'
	touch $@

# Tests need their tools, and the engine on JAX too.
$(VENV)/.tested: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[all,brax]'
	touch $@

install: $(VENV)/.installed

IMPORTED := $(if $(FORMAT),$(OUT)/recordings,$(RECORDINGS))

run: $(VENV)/.installed
	$(if $(FORMAT),$(BIN)/pup import $(FORMAT) $(RECORDINGS) --robot $(ROBOT) --out $(IMPORTED))
	$(BIN)/pup run --out $(OUT) --robot $(ROBOT) $(if $(RECORDINGS),--recordings $(IMPORTED)) $(ARGS)

lint: $(VENV)/.tested
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# Two processes: fixtures of a file are made once, and no test runs in the one whose exit counts.
# Files go out in the order of tests/conftest.py: the longest first, not those with the most tests.
test: lint
	$(BIN)/python -m pytest -n 2 --dist loadfile --no-loadscope-reorder --durations 20

slow: $(VENV)/.tested
	$(BIN)/python -m pytest -m slow

docs: $(VENV)/.tested
	$(BIN)/mkdocs build --strict

clean:
	rm -rf $(VENV) out build site *.egg-info
