# Two commands do all the set-up: `make demo` renders the bundled shot, `make test` runs every test.
PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin
PIP = $(BIN)/python -m pip install --disable-pip-version-check --quiet --constraint constraints.txt

.PHONY: demo test lint clean

demo: $(VENV)/core.stamp
	$(BIN)/neumat demo --out out/demo
	@echo "open out/demo/report.html"

test: $(VENV)/full.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/python -m pytest $(PYTEST_FLAGS)

lint: $(VENV)/full.stamp
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

$(VENV)/pip.stamp:
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/core.stamp: $(VENV)/pip.stamp pyproject.toml constraints.txt
	$(PIP) --editable '.[video,report]'
	@touch $@

$(VENV)/full.stamp: $(VENV)/core.stamp
	$(PIP) --editable '.[fit,video,report,test,bench]'
	@touch $@

clean:
	rm -rf $(VENV) out
