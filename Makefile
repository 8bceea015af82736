# make demo   set up, simulate a rig, calibrate it, scan a person, export the mesh
# make test   set up, run the tests
# make bench  speed and accuracy at full size, written to docs/results.md
# make check  format, lint and types

PYTHON ?= $(shell for p in python3.13 python3.12 python3.11 python3; do \
	"$$p" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))' 2>/dev/null \
	&& echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
OUT ?= demo

.PHONY: demo test check bench setup clean
.DELETE_ON_ERROR:

demo: setup
	rm -rf $(OUT)
	$(BIN)/bodyscan simulate rigs/three-pole-12.yaml --out $(OUT) --scale 0.5 \
		--subject data/subjects/woman_average.ply
	$(BIN)/bodyscan check $(OUT)/rig.yaml
	$(BIN)/bodyscan calibrate-rig $(OUT)/rig.yaml
	$(BIN)/bodyscan scan $(OUT)/captures/person --calibration $(OUT)/calibration --out $(OUT)/scan
	$(BIN)/bodyscan export $(OUT)/scan --out $(OUT)/export
	$(BIN)/bodyscan evaluate $(OUT)

test: setup
	$(BIN)/python -m pytest

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy

# The site, in build/site: a dead link or a reference to what is not there fails it.
.PHONY: docs
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

bench: setup
	$(BIN)/python -m benchmarks

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml data/set-up.sh
	sh data/set-up.sh "$(PYTHON)" $(VENV)
	touch $@

clean:
	rm -rf $(VENV) $(OUT)
