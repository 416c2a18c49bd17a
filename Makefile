# make setup | demo | test | test-quick | lint | format | docs | bench | viewer | validator | dist | clean
VENV ?= .venv
NICE ?=
WORKERS ?= 2
SUITES ?= multiview flash duplicates collection

.PHONY: setup environment demo test test-quick lint format docs bench viewer validator dist clean
.DEFAULT_GOAL := setup

# the environment, and the page of `relit view` where npm is installed
setup: environment viewer

# virtual environment, wheels, libLLVM; returns at once when nothing has changed
environment:
	@VENV=$(VENV) tools/setup.sh

# renders, reconstructs and scores Relit's own object: a GLB and a report in 5 minutes on 2 cores
demo: setup
	$(NICE) $(VENV)/bin/python -m relit demo -o runs/demo

# all tests; files of tests run side by side, one thread each
PYTEST = $(NICE) $(VENV)/bin/python -m pytest -q -n $(WORKERS) --dist loadfile
test: setup validator
	$(PYTEST)

# the tests without the marker `slow`
test-quick: environment
	$(PYTEST) -m "not slow"

lint: environment
	$(VENV)/bin/python -m ruff check .
	$(VENV)/bin/python -m ruff format --check .
	$(VENV)/bin/python -m pyright --pythonpath $(VENV)/bin/python

format: environment
	$(VENV)/bin/python -m ruff check --fix .
	$(VENV)/bin/python -m ruff format .

# the guide and the API reference as one site in site/; builds without network once installed
docs: environment
	@$(VENV)/bin/python -c "import mkdocs, material, mkdocstrings" 2>/dev/null \
	  || $(VENV)/bin/python -m pip install -q --disable-pip-version-check -e '.[docs]'
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/python -m mkdocs build --strict

bench: setup
	for suite in $(SUITES); do $(NICE) $(VENV)/bin/python -m relit benchmark $$suite || exit $$?; done

# the Khronos glTF validator for the tests; without node its tests skip with a reason
validator:
	@if [ -f tools/validator/package.json ] && command -v npm >/dev/null \
	  && [ ! -e tools/validator/node_modules/.package-lock.json ]; then \
	  (cd tools/validator && npm ci --silent --no-audit --no-fund) \
	  || echo "npm could not install the glTF validator; its tests are skipped" >&2; fi

# the page of `relit view`, built into the package; without npm, `relit view` reports its absence
VIEWER := $(shell find viewer -path viewer/node_modules -prune -o -type f -print 2>/dev/null)
viewer: src/relit/viewer/static/index.html
src/relit/viewer/static/index.html: $(VIEWER)
	@if command -v npm >/dev/null; then \
	  (cd viewer \
	    && { [ node_modules/.package-lock.json -nt package-lock.json ] || npm ci --silent --no-audit --no-fund; } \
	    && npm run --silent build -- --logLevel warn) \
	  || echo "npm could not build the page of relit view; make viewer tries again" >&2; \
	else echo "npm is not installed: the page of relit view is not built (apt-get install npm, make viewer)" >&2; fi

# release: a source archive and a wheel with the page, installed into an empty environment and tested with the demo
dist: setup
	@test -f src/relit/viewer/static/index.html \
	  || { echo "error: the page is not built; a wheel needs it" >&2; exit 5; }
	rm -rf dist build
	$(VENV)/bin/python -m build --outdir dist .
	$(NICE) $(VENV)/bin/python tools/check_release.py dist/*.whl --demo

clean:
	rm -rf $(VENV) build dist site .pytest_cache .ruff_cache tools/validator/node_modules viewer/node_modules
	rm -rf src/relit/viewer/static src/relit.egg-info
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +
