# One command each; every one makes .venv itself when it has to.
PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --quiet --quiet --disable-pip-version-check
LOCK := $(BIN)/uv pip compile pyproject.toml requirements/beside.in --override requirements/without-torch.txt --upgrade \
	--no-emit-package torch --universal --python-version 3.11 --generate-hashes --no-header --quiet
# of the tests: one more than the cores that this process may use, since many tests wait; at most four
WORKERS ?= $(shell n=$$(nproc 2>/dev/null || echo 2); echo $$((n > 3 ? 4 : n + 1)))
STAMP := $(VENV)/.installed
KERNELS := $(VENV)/.compiled
MINUTES ?=
ACTORS ?= 2
RUN ?=
POLICY ?=
VIDEO ?=
OUT ?=

.PHONY: help install train play pictures report test test-fast check fix bench bench-guard docs lock audit release clean

help:                     ## this list
	@grep -E '^[a-z-]+:.*##' $(MAKEFILE_LIST) | sed -E 's/:.*## / - /'

install: $(KERNELS)       ## make .venv with everything in it, and compile the kernels

# the lock names every package but torch, which the second line brings
$(STAMP): pyproject.toml requirements/dev.lock
	$(PYTHON) -m venv $(VENV)
	$(PIP) install --require-hashes --no-deps --requirement requirements/dev.lock
	$(PIP) install --no-build-isolation --editable '.[dev]'
	@touch $(STAMP)

$(KERNELS): $(STAMP)
	$(BIN)/python -m topspin.compile_kernels
	@touch $(KERNELS)

train: $(KERNELS)         ## train a robot: make train [MINUTES=10] [ACTORS=4] [RUN=name]
	$(BIN)/topspin train --actors $(ACTORS) $(if $(MINUTES),--minutes $(MINUTES)) $(if $(RUN),--run $(RUN))

play: $(KERNELS)          ## measure a policy and film it: make play [POLICY=folder] [VIDEO=runs/play.mp4]
	$(BIN)/topspin play $(if $(POLICY),--policy $(POLICY)) $(if $(VIDEO),--video $(VIDEO))

pictures: $(KERNELS)      ## draw the README's pictures: make pictures [POLICY=folder] [OUT=docs/pictures]
	$(BIN)/topspin pictures $(if $(POLICY),--policy $(POLICY)) $(if $(OUT),--out $(OUT))

report: $(KERNELS)        ## compare runs: make report RUN="night other" [OUT=runs/report]
	$(BIN)/topspin report $(RUN) $(if $(OUT),--out $(OUT))

test: $(KERNELS)          ## all tests
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

test-fast: $(KERNELS)     ## unit and contract tests
	$(BIN)/python -m pytest tests/unit tests/contract -n $(WORKERS) --dist worksteal

check: $(STAMP)           ## format, lint, types, layers
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

fix: $(STAMP)             ## format, and mend what ruff can
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

bench: $(KERNELS)         ## the quick benchmarks
	$(BIN)/python -m benchmarks.startup --json
	$(BIN)/python -m benchmarks.generator --json
	$(BIN)/python -m benchmarks.env --json
	$(BIN)/python -m benchmarks.camera_filter --json
	$(BIN)/python -m benchmarks.flight_filter --json
	$(BIN)/python -m benchmarks.actor --json
	$(BIN)/python -m benchmarks.learner --json
	$(BIN)/python -m benchmarks.learners --json
	$(BIN)/python -m benchmarks.system --json
	$(BIN)/python -m benchmarks.scaling --costs benchmarks/results/scaling_costs.json --json

bench-guard: $(KERNELS)   ## fail where a part is much slower against its limit than recorded
	$(BIN)/python -m benchmarks.guard

docs: $(STAMP)            ## the documentation as pages: build/site/index.html
	$(BIN)/mkdocs build --strict --quiet

lock:                     ## lock the newest allowed releases of all dependencies (after make install)
	$(LOCK) --extra dev --output-file requirements/dev.lock
	$(LOCK) --constraint requirements/dev.lock --output-file requirements/services.lock

audit: $(STAMP)           ## ask for known vulnerabilities of the locked dependencies
	$(BIN)/pip-audit --disable-pip --require-hashes --requirement requirements/dev.lock

release: $(STAMP)         ## sdist, wheel, bill of materials and checksums: build/release
	rm -rf build/release
	$(BIN)/python -m build --no-isolation --outdir build/release .
	(cat requirements/services.lock; sed -n 's/.*"\(torch==.*\)".*/\1/p' pyproject.toml) | $(BIN)/cyclonedx-py requirements - \
		--pyproject pyproject.toml --output-reproducible --of JSON --output-file build/release/topspin.cdx.json
	cd build/release && sha256sum * > SHA256SUMS

clean:                    ## remove the environment and caches, not the runs
	rm -rf $(VENV) .numba_cache .pytest_cache .mypy_cache .ruff_cache .hypothesis build *.egg-info
