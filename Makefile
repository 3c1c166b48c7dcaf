# `make` lists the targets. Everything Python lives in .venv, made when needed.
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c
.DEFAULT_GOAL := help
MAKEFLAGS += --no-print-directory

VENV ?= .venv
BIN := $(VENV)/bin
# The project's version, from the one place that has it. The chart pulls images of this tag.
VERSION := $(shell sed -n 's/^__version__ = "\(.*\)"$$/\1/p' proxy/rosproxy/__init__.py)
TAG ?= $(VERSION)
# What stands before the images' names, for example: make image push REGISTRY=registry.example/ros
REGISTRY ?=
IMAGE := $(REGISTRY:%=%/)rosproxy
OPERATOR_IMAGE := $(REGISTRY:%=%/)rosproxy-operator
# Which layers `make test-all` runs, for example: make test-all LAYERS="unit ros"
LAYERS ?=
# Options of `make bench`, for example: make bench BENCH="--sections streams --rounds 3"
BENCH ?=
SOURCES := proxy operator examples tests scripts

$(VENV)/.runtime: pyproject.toml constraints.txt scripts/venv.sh scripts/pins.py
	@scripts/venv.sh $(VENV)
	@touch $@

$(VENV)/.dev: pyproject.toml constraints.txt scripts/venv.sh scripts/pins.py
	@scripts/venv.sh $(VENV) dev,uvloop,operator
	@touch $(VENV)/.runtime $@

$(VENV)/.bench: $(VENV)/.dev
	@scripts/venv.sh $(VENV) dev,uvloop,operator,bench
	@touch $@

.PHONY: help
help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-10s %s\n", $$1, $$2}' Makefile

.PHONY: demo
demo: $(VENV)/.runtime ## messages through the proxy, both ways, in 15 seconds; needs neither ROS nor Docker nor root
	@$(BIN)/python -m examples.demo

.PHONY: test
test: $(VENV)/.dev ## unit and integration tests; and a smoke test with real ROS and Docker, which it installs, as root on Debian or Ubuntu
	@$(BIN)/python scripts/test_layers.py --smoke

.PHONY: test-all
test-all: $(VENV)/.dev ## every test of every layer that this machine can run; builds a Kubernetes cluster's programs, too
	@$(BIN)/python scripts/test_layers.py $(LAYERS)

.PHONY: bench
bench: $(VENV)/.bench ## speed and memory next to a direct connection, socat, HAProxy and nginx, in twelve minutes (BENCH="--quick"); as root on Debian or Ubuntu, installs those and ROS
	@scripts/install-bench.sh
	@$(BIN)/python -m tests.bench $(BENCH)

.PHONY: check
check: $(VENV)/.dev ## format, lint, types, import rules, unit tests
	$(BIN)/ruff format --check $(SOURCES)
	$(BIN)/ruff check $(SOURCES)
	$(BIN)/mypy
	$(BIN)/lint-imports --no-logo
	$(BIN)/pytest -q -n 2 --hypothesis-profile=brief tests/unit

.PHONY: format
format: $(VENV)/.dev ## rewrite the sources in the house format
	$(BIN)/ruff format $(SOURCES)
	$(BIN)/ruff check --fix $(SOURCES)

.PHONY: venv
venv: $(VENV)/.dev ## make .venv with the development tools

.PHONY: lock
lock: ## pin what is installed anew, into constraints.txt
	@scripts/lock.sh constraints.txt

.PHONY: manifests
manifests: $(VENV)/.dev ## write manifests/install.yaml, the chart's README and the tables of the RosProxy's fields from the chart
	@PYTHON=$(BIN)/python scripts/manifests.sh

.PHONY: image
image: ## build the images rosproxy and rosproxy-operator, tagged with the version and latest (REGISTRY, TAG)
	docker build --target proxy --tag $(IMAGE):$(TAG) --tag $(IMAGE):latest .
	docker build --target operator --tag $(OPERATOR_IMAGE):$(TAG) --tag $(OPERATOR_IMAGE):latest .

.PHONY: push
push: ## push both to REGISTRY, with the version as tag
	docker push $(IMAGE):$(TAG)
	docker push $(OPERATOR_IMAGE):$(TAG)

.PHONY: clean
clean: ## remove what the other targets made
	rm -rf $(VENV) build dist .grimp_cache .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find $(SOURCES) -name __pycache__ -type d -prune -exec rm -rf {} +
