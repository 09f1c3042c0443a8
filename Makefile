# The default target lists the others.
PYTHON ?= python3.11
BIN := .venv/bin

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | awk -F ':.*## ' '{printf "%-10s %s\n", $$1, $$2}'

install: ## make .venv with the suite, its tests and the hooks
	$(PYTHON) -m venv .venv && $(BIN)/pip install -e '.[dev]' && $(BIN)/pre-commit install

check: ## formatting, lint, types and the contract between the rooms
	$(BIN)/ruff format --check . && $(BIN)/ruff check . && $(BIN)/mypy && $(BIN)/lint-imports

test: ## the tests a change must pass (minutes)
	$(BIN)/pytest

test-long: ## the long tests as well
	$(BIN)/pytest -m 'long or not long'

all: check test ## what CI runs

.PHONY: help install check test test-long all
