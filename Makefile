# One command does all set-up: every target below makes its own .venv first.
#
#   make setup PYTHON=python3.12   use this interpreter
#   make setup TORCH="torch==2.9"  use this torch, from pip's index
#   make setup ROS=                leave ROS 2 out

SHELL := /bin/bash
.SHELLFLAGS := -eu -o pipefail -c
.DEFAULT_GOAL := help
.DELETE_ON_ERROR:
MAKEFLAGS += --no-builtin-rules

PYTHON ?=
TORCH ?=
TORCH_CPU_INDEX ?= https://download.pytorch.org/whl/cpu
TORCH_FALLBACK ?= torch==2.13.0
EXTRAS ?= dev
ROS ?= 1

VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check
DEMO_BAG := bags/demo
DEMO_OUT := runs/demo

.PHONY: help setup demo test test-slow lint clean

help: ## show this list
	@grep -E '^[a-z-]+:.*## ' $(firstword $(MAKEFILE_LIST)) | sed -E 's/^([a-z-]+):.*## /\1\t/' | expand -t 12

setup: $(VENV)/.weights ## make .venv with everything in it and fetch the networks' weights (does nothing when up to date)

demo: setup $(DEMO_BAG)/metadata.yaml ## track a small simulated recording and name the report
	$(BIN)/thegra run $(DEMO_BAG) --profile realtime --out $(DEMO_OUT)
	@echo "Report: $(DEMO_OUT)/report.html"

test: setup ## run the tests (no recordings needed)
	$(BIN)/python -m pytest

test-slow: setup ## run the tests that take minutes or need recordings
	$(BIN)/python -m pytest -m slow

lint: setup ## ruff, mypy, import-linter
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

clean: ## remove what make made (the weights' cache stays)
	rm -rf $(VENV) $(DEMO_BAG) $(DEMO_OUT) build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache .hypothesis

$(DEMO_BAG)/metadata.yaml: | $(VENV)/.installed
	rm -rf $(DEMO_BAG)
	$(BIN)/thegra simulate --scene room --duration 20 --rate 10 --size 320x256 --shutter freeze --out $(DEMO_BAG)

$(VENV)/.python:
	@tools/find_python.sh "$(PYTHON)" > /dev/null
	"$$(tools/find_python.sh "$(PYTHON)")" -m venv --clear $(VENV)
	touch $@

$(VENV)/.torch: $(VENV)/.python
	PIP="$(PIP)" TORCH="$(TORCH)" TORCH_CPU_INDEX="$(TORCH_CPU_INDEX)" TORCH_FALLBACK="$(TORCH_FALLBACK)" tools/install_torch.sh
	touch $@

$(VENV)/.installed: $(VENV)/.torch setup.py pyproject.toml package.xml
	$(PIP) install --quiet --editable ".[$(EXTRAS)]"
	[[ -z "$(ROS)" ]] || PIP="$(PIP)" BIN="$(BIN)" tools/install_ros.sh
	touch $@

$(VENV)/.weights: $(VENV)/.installed $(wildcard thegra_core/features/weights.py)
	BIN=$(BIN) tools/fetch_weights.sh
	touch $@
