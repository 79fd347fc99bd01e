# make run | test | lint | bench | clean. Each sets up .venv by itself, and is quiet when it is there.
SHELL := /bin/bash
PYTHON ?= python3
BIN := .venv/bin
PORT ?= 8000

.PHONY: run test lint bench lock clean browser

.venv/ready: requirements.lock pyproject.toml
	@echo "Setting up .venv (a minute, once)"
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "Diffuscope needs Python 3.11 or newer; set PYTHON=..."; exit 1; }
	@$(PYTHON) -m venv .venv || { echo "Install the venv module first, on Debian: apt-get install python3-venv"; exit 1; }
	@$(BIN)/pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	@$(BIN)/pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

run: .venv/ready
	@$(BIN)/diffuscope run --port $(PORT)

test: .venv/ready browser
	@$(BIN)/python -m pytest -m "not bench and not rig"

browser:
	@tests/browser/install

lint: .venv/ready
	@$(BIN)/ruff check .
	@$(BIN)/ruff format --check .
	@$(BIN)/mypy
	@$(BIN)/lint-imports

bench: .venv/ready
	@$(BIN)/python -m tests.bench

# Hashes for every platform in one file (x86-64 and aarch64), newest versions that pyproject.toml allows.
lock: .venv/ready
	@$(BIN)/pip install --quiet uv
	@$(BIN)/uv pip compile --quiet --universal --python-version 3.11 --generate-hashes --no-header \
		--extra test --group lock pyproject.toml -o requirements.lock

clean:
	@rm -rf .venv .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis out
	@find . -name __pycache__ -type d -prune -exec rm -rf {} +
