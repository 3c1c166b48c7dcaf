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
# What the images are built on instead of what the Dockerfile names, for example BASE_IMAGE=debian:bookworm-slim
BASE_IMAGE ?=
# Where the repository can be read, for the links in a release
REPOSITORY ?=
# The tag of a release that `make release-check` is to hold in order
RELEASE ?=
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

$(VENV)/.docs $(VENV)/.release: $(VENV)/.dev
	@scripts/venv.sh $(VENV) dev,uvloop,operator,docs,release
	@touch $(VENV)/.docs $(VENV)/.release

.PHONY: help
help: ## list the targets
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-13s %s\n", $$1, $$2}' Makefile

.PHONY: demo
demo: $(VENV)/.runtime ## messages of ROS 1 and ROS 2 through the proxy, both ways, in 15 seconds; needs neither ROS nor Docker nor root
	@$(BIN)/python -m examples.demo

.PHONY: test
test: $(VENV)/.dev ## unit and integration tests; and a smoke test with real ROS and Docker, which it installs, as root on Debian or Ubuntu
	@$(BIN)/python -m scripts.test_layers --smoke

.PHONY: test-all
test-all: $(VENV)/.dev ## every test of every layer that this machine can run; builds a Kubernetes cluster's programs, too
	@$(BIN)/python -m scripts.test_layers $(LAYERS)

.PHONY: bench
bench: $(VENV)/.bench ## speed and memory next to a direct connection, socat, HAProxy and nginx, in an hour (BENCH="--quick"); as root on Debian or Ubuntu, installs those and ROS
	@scripts/install-bench.sh
	@$(BIN)/python -m tests.bench $(BENCH)

.PHONY: screenshot
screenshot: $(VENV)/.dev ## paint docs/live-page.png and docs/live-page anew: the live page with real nodes and a broken link, and with made-up robots; as root on Debian, installs ROS, Docker and Chromium
	@scripts/install-ros.sh
	@scripts/install-browser.sh
	@scripts/install-docker.sh
	@$(BIN)/python -m tests.browser.screenshot docs/live-page.png
	@$(BIN)/python -m tests.browser.screenshot --containers docs/live-page
	@$(BIN)/python -m tests.browser.screenshot --made-up docs/live-page

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

.PHONY: docs
docs: $(VENV)/.docs ## the documentation as a site, in build/site
	@$(BIN)/python scripts/docs_site.py
	@$(BIN)/mkdocs build --strict

.PHONY: release-check
release-check: $(VENV)/.release ## build and try all that a release has: packages, SBOM, chart, images; publishes nothing (RELEASE=v1.2.3)
	@$(BIN)/python scripts/release_check.py $(RELEASE:%=--tag %) $(BASE_IMAGE:%=--base-image %) $(REGISTRY:%=--registry %) $(REPOSITORY:%=--repository %)

.PHONY: image
image: ## build the images rosproxy and rosproxy-operator, tagged with the version and latest (REGISTRY, TAG)
	docker build $(BASE_IMAGE:%=--build-arg BASE_IMAGE=%) --target proxy --tag $(IMAGE):$(TAG) --tag $(IMAGE):latest .
	docker build $(BASE_IMAGE:%=--build-arg BASE_IMAGE=%) --target operator --tag $(OPERATOR_IMAGE):$(TAG) --tag $(OPERATOR_IMAGE):latest .

.PHONY: push
push: ## push both to REGISTRY, with the version as tag
	docker push $(IMAGE):$(TAG)
	docker push $(OPERATOR_IMAGE):$(TAG)

.PHONY: clean
clean: ## remove what the other targets made
	rm -rf $(VENV) build dist .grimp_cache .hypothesis .import_linter_cache .mypy_cache .pytest_cache .ruff_cache
	find $(SOURCES) -name __pycache__ -type d -prune -exec rm -rf {} +
