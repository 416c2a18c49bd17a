# make setup | demo | test | lint | bench | viewer | validator | dist | clean
VENV ?= .venv
NICE ?=
WORKERS ?= 2
SUITES ?= multiview flash duplicates collection

.PHONY: setup demo test lint bench viewer validator dist clean
.DEFAULT_GOAL := setup

# virtual environment, wheels, libLLVM; returns at once when nothing has changed
setup:
	@VENV=$(VENV) tools/setup.sh

# its own object and light, rendered, reconstructed, scored: a GLB and a report in under 5 minutes on 2 cores
demo: setup
	$(NICE) $(VENV)/bin/python -m relit demo -o runs/demo

# files of tests side by side, one thread each
test: setup validator viewer
	$(NICE) $(VENV)/bin/python -m pytest -q -n $(WORKERS) --dist loadfile

lint: setup
	$(VENV)/bin/python -m ruff check src tests benchmarks

bench: setup
	for suite in $(SUITES); do $(NICE) $(VENV)/bin/python -m relit benchmark $$suite || exit $$?; done

# the Khronos glTF validator for the tests; without node they skip with a reason
validator:
	@if [ -f tools/validator/package.json ] && command -v npm >/dev/null && [ ! -e tools/validator/node_modules/.package-lock.json ]; then \
	  (cd tools/validator && npm ci --silent --no-audit --no-fund) || echo "npm could not install the glTF validator; its tests are skipped" >&2; fi

# the page of `relit view`, built into the package; without node the page and its tests are left out with a reason
VIEWER := $(shell find viewer -path viewer/node_modules -prune -o -type f -print 2>/dev/null)
viewer: src/relit/viewer/static/index.html
src/relit/viewer/static/index.html: $(VIEWER)
	@if command -v npm >/dev/null; then \
	  (cd viewer && { [ node_modules/.package-lock.json -nt package-lock.json ] || npm ci --silent --no-audit --no-fund; } && npm run --silent build -- --logLevel warn) \
	  || echo "npm could not build the page; relit view says so" >&2; \
	else echo "no npm: the page of relit view is not built" >&2; fi

# what is published: a source archive and a wheel with the page in it, which is installed into an empty environment and passes the demo there
dist: setup viewer
	@test -f src/relit/viewer/static/index.html || { echo "error: the page is not built; a wheel needs it" >&2; exit 5; }
	rm -rf dist build
	$(VENV)/bin/python -m build --outdir dist .
	$(NICE) $(VENV)/bin/python tools/check_release.py dist/*.whl --demo

clean:
	rm -rf $(VENV) build dist .pytest_cache .ruff_cache tools/validator/node_modules viewer/node_modules src/relit/viewer/static src/relit.egg-info
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +
