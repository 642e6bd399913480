PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet

.DEFAULT_GOAL := help
.PHONY: help setup run test soak check openapi

help: ## Say what each command means
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /|/' | awk -F'|' '{printf "make %-10s %s\n", $$1, $$2}'

.venv/.service: pyproject.toml
	@echo "Setting up .venv for the service ..."
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(PIP) install --upgrade "pip>=25.1"
	@$(PIP) install --editable .
	@touch $@

.venv/.dev: .venv/.service
	@echo "Adding what development and training need ..."
	@$(PIP) install "torch==2.13.0"
	@$(PIP) install --editable ".[train,postgres]" --group dev
	@touch $@

setup: .venv/.dev ## Make .venv with the service, the development tools and torch

run: .venv/.service ## Start the service with the shipped model on http://127.0.0.1:8000
	$(BIN)/camind serve

test: setup ## Run the tests
	$(BIN)/pytest -n 2

soak: setup ## Run the long versions of the tests that kill and load the service: a quarter of an hour
	$(BIN)/pytest --soak -s tests/test_killed.py tests/test_soak.py tests/test_migrations.py tests/storage/test_backup.py

check: setup ## Lint, check types and the arrows between packages
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

openapi: setup ## Write openapi.yaml from the app
	$(BIN)/camind openapi > openapi.yaml
