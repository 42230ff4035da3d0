# make run: the default experiment; make test: all tests; make dashboard: pages on which runs can be watched.
# All make the environment first.
PYTHON ?= python3
VENV ?= .venv
EXTRAS ?= test
BIN := $(VENV)/bin

.PHONY: run test check dashboard clean

run: $(VENV)/ready
	$(BIN)/python -m flows.run

test: $(VENV)/ready
	$(BIN)/python -m pytest

dashboard: $(VENV)/ready
	$(BIN)/python -m flows.dashboard

check: $(VENV)/ready
	$(BIN)/ruff check . && $(BIN)/ruff format --check .

$(VENV)/ready: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[$(EXTRAS)]'
	touch $@

clean:
	rm -rf $(VENV) store
