# The default target lists the others.
PYTHON ?= python3.11
BIN := .venv/bin

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "%-10s %s\n", $$1, $$2}'

install: ## make .venv with the suite, its tests and the hooks
	$(PYTHON) -m venv .venv && $(BIN)/pip install -e '.[dev]' && $(BIN)/pre-commit install

check: ## formatting, lint, types and the contract between the rooms
	$(BIN)/ruff format --check . && $(BIN)/ruff check . && $(BIN)/mypy && $(BIN)/lint-imports

test: ## the tests of everyday (a quarter of an hour)
	$(BIN)/pytest

test-slow: ## whole windows and real processes: what a change must pass as well before it lands
	$(BIN)/pytest -m slow

test-long: ## every test there is (an hour)
	$(BIN)/pytest -m ''

rules: ## how well the safety rules are tested: every line and branch, and every small change (a quarter of an hour)
	$(BIN)/coverage run --branch --include="milling/permission.py,milling/point.py,milling/limits.py,milling/supervisor.py" -m pytest -q tests/milling/test_rules.py tests/milling/supervising
	$(BIN)/coverage report -m --fail-under=100
	$(BIN)/python tests/mutants.py

fuzz: ## a million spoilt inputs into every parser (an hour or less)
	$(BIN)/python tests/drivers/fuzz.py --inputs 1000000

docs: ## the documentation as a site into site/; a warning is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

OUT ?= weights
weights: ## train all three networks from nothing into OUT, on two cores (25 minutes)
	printf '%s\n' landmarks completion tip | xargs -P 3 -I{} $(BIN)/mill train {} --out $(OUT)/{}.onnx

all: check test test-slow ## what CI runs

.PHONY: help install check test test-slow test-long rules fuzz docs weights all
