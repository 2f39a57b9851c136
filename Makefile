# `make demo` and `make test` do all the set-up on a fresh machine: uv if it is there, else venv and pip.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
EXTRAS ?= dev,oracle
DOCS = dev,oracle,docs

.PHONY: demo test full core recordings studies slow fuzz mutants replay lint lock docs
demo: $(VENV)/installed
	$(BIN)/jaxnav demo

# `loadfile`: the tests of a module share compiled functions, so that each module stays in one process
test: $(VENV)/ready
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow and not full"

# those that take longer than a few seconds each
full: $(VENV)/ready
	$(BIN)/python -m pytest -n 2 --dist loadfile -m "full and not slow"

# a part of the house by itself, see docs/architecture.md
ALONE = $(BIN)/python -m pytest -n 2 --dist loadfile -m "not slow and not full"
core: $(VENV)/ready
	$(ALONE) $(addprefix tests/,maths states strapdown measurements filters initialization test_layout.py \
	  test_contract.py test_contract_rows.py test_stream.py test_now.py test_live.py)

recordings: $(VENV)/ready
	$(ALONE) $(addprefix tests/,gnss io checkup)

studies: $(VENV)/ready
	$(ALONE) $(addprefix tests/,simulate analysis tuning app faults benchmarks replay) tests/test_*.py

slow: $(VENV)/ready
	$(BIN)/python -m pytest -m slow

fuzz: $(VENV)/ready
	JAXNAV_FUZZ=20 $(BIN)/python -m pytest tests/faults/test_fuzz.py

mutants: $(VENV)/ready
	$(BIN)/python -m tests.mutants

replay: $(VENV)/ready
	$(BIN)/python -m tests.replay.test_replay && git diff --stat tests/replay

lint: $(VENV)/ready
	$(BIN)/ruff check . && $(BIN)/ruff format --check . && $(BIN)/mypy

# the pages of docs/ as a site in out/site; a broken link is an error
docs: $(VENV)/documented
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --site-dir out/site

$(VENV)/documented: pyproject.toml requirements.lock.txt
	$(call install,[$(DOCS)])

# what `jaxnav` itself needs, and what its tests need on top
define install
	@if command -v uv >/dev/null 2>&1; then \
	  uv venv -q --allow-existing --python $(PYTHON) $(VENV) && \
	  uv pip install -q --python $(BIN)/python -c requirements.lock.txt -e '.$(1)'; \
	else \
	  $(PYTHON) -m venv $(VENV) && $(BIN)/python -m pip install -q -c requirements.lock.txt -e '.$(1)'; \
	fi
	@touch $@
endef

$(VENV)/installed: pyproject.toml requirements.lock.txt
	$(call install,)

$(VENV)/ready: pyproject.toml requirements.lock.txt
	$(call install,[$(EXTRAS)])

lock:
	uv pip compile -q --universal --python-version 3.11 --extra dev --extra oracle pyproject.toml \
	  --no-header --no-annotate --no-emit-index-url -o requirements.lock.txt
