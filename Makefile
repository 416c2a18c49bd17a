# make setup | demo | test | lint | bench | validator | clean
VENV ?= .venv
NICE ?=

.PHONY: setup demo test lint bench validator clean
.DEFAULT_GOAL := setup

# virtual environment, wheels, libLLVM; returns at once when nothing has changed
setup:
	@VENV=$(VENV) tools/setup.sh

# its own object and light, rendered, reconstructed, scored: a GLB and a report in under 5 minutes on 2 cores
demo: setup
	$(NICE) $(VENV)/bin/python -m relit demo -o runs/demo

test: setup validator
	$(NICE) $(VENV)/bin/python -m pytest -q

lint: setup
	$(VENV)/bin/python -m ruff check src tests benchmarks

bench: setup
	$(NICE) $(VENV)/bin/python -m relit benchmark multiview

# the Khronos glTF validator for the tests; without node they skip with a reason
validator:
	@if [ -f tools/validator/package.json ] && command -v npm >/dev/null && [ ! -e tools/validator/node_modules/.package-lock.json ]; then \
	  (cd tools/validator && npm ci --silent --no-audit --no-fund) || echo "npm could not install the glTF validator; its tests are skipped" >&2; fi

clean:
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache tools/validator/node_modules src/relit.egg-info
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +
