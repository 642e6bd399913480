PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
INSTALL := $(PIP) install --require-hashes --requirement
OURSELVES := $(PIP) install --no-deps --build-constraint requirements/build.txt --editable .
SOAKED := $(shell grep -rl is_soak tests --include='test_*.py')
LOCK := $(BIN)/uv pip compile --quiet --universal --generate-hashes --python-version 3.11 --no-annotate \
	--custom-compile-command "make lock" $(LOCK_FLAGS)

.DEFAULT_GOAL := help
.PHONY: help setup run test soak check audit lock sbom openapi

help: ## Say what each command means
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /|/' | awk -F'|' '{printf "make %-10s %s\n", $$1, $$2}'

.venv/.service: pyproject.toml requirements/service.txt requirements/build.txt
	@echo "Setting up .venv for the service ..."
	@test -x $(BIN)/python || $(PYTHON) -m venv .venv
	@$(INSTALL) requirements/service.txt
	@$(OURSELVES)
	@touch $@

# torch has other builds, and so other hashes, on every platform: the version is pinned in pyproject.toml alone
.venv/.dev: .venv/.service requirements/dev.txt
	@echo "Adding what development and training need ..."
	@$(INSTALL) requirements/dev.txt
	@$(PIP) install "torch==2.13.0"
	@touch $@

setup: .venv/.dev ## Make .venv with the service, the development tools and torch

run: .venv/.service ## Start the service with the shipped model on http://127.0.0.1:8000
	$(BIN)/camind serve

test: setup ## Run the tests
	$(BIN)/pytest -n 2

soak: setup ## Run the long versions of the tests that kill, fill and load the service: an hour or two
	$(BIN)/pytest --soak -s $(SOAKED)

check: setup ## Lint, check types, the arrows between packages, and the dependencies for known vulnerabilities
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python requirements/audit.py

audit: setup ## Look the locked dependencies up among known vulnerabilities; fails where they cannot be looked up
	$(BIN)/python requirements/audit.py --strict

lock: setup ## Write requirements/ from pyproject.toml, pins kept; LOCK_FLAGS=--upgrade takes the newest
	@echo 'pip>=25.3' | $(LOCK) --output-file requirements/service.txt --extra postgres --extra otel pyproject.toml -
	@echo torch | $(LOCK) --output-file requirements/dev.txt --constraint requirements/service.txt --excludes /dev/stdin \
		--extra postgres --extra otel --extra heic --extra raw --extra train --group dev pyproject.toml
	@printf 'hatchling>=1.27,<2\neditables\n' | $(LOCK) --output-file requirements/build.txt -

sbom: setup ## Write dist/sbom.json: what the service is made of (CycloneDX)
	@mkdir -p dist
	$(BIN)/cyclonedx-py requirements --pyproject pyproject.toml --output-reproducible \
		--output-file dist/sbom.json requirements/service.txt

openapi: setup ## Write openapi.yaml from the app
	$(BIN)/camind openapi > openapi.yaml
