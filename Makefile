# make demo         set up, simulate a rig, calibrate it, scan a person, export the mesh
# make station      set up, simulate and calibrate a rig, open its page: people are simulated as they come
# make test         set up, run all tests on all cores
# make test-quick   those that answer within seconds, for the loop of everyday work
# make coverage     all tests again, with the lines of the package that they run
# make wheel        build both wheels into dist, install each into an empty environment, scan something small
# make check        format, lint, types, the directions of imports, words and the size of the house
# make lock         the versions that CI installs, data/constraints.txt, made anew from the newest that fit
# make bench        speed and accuracy at full size, written to docs/results.md, old sections marked

PYTHON ?= $(shell for p in python3.13 python3.14 python3.12 python3.11 python3; do \
	"$$p" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' 2>/dev/null \
	&& echo $$p && break; done)
VENV := .venv
BIN := $(VENV)/bin
OUT ?= demo
# Containers forbid Python to keep what it compiled, and every process that tests start compiles again.
export PYTHONDONTWRITEBYTECODE :=
# A file's tests stay in one worker, which makes what they share once; the longest come first.
PARALLEL := -n auto --dist loadfile --no-loadscope-reorder

.PHONY: demo test test-quick coverage wheel check bench setup clean
.DELETE_ON_ERROR:

demo: setup
	@test ! -e $(OUT) || test -d $(OUT)/truth || { echo "$(OUT) holds no demo: remove it, or give another OUT=" >&2; exit 1; }
	rm -rf $(OUT)
	$(BIN)/bodyscan simulate rigs/three-pole-12.yaml --out $(OUT) --scale 0.5 --board-shots 24 \
		--subject data/subjects/woman_average.ply --set optics.samples=2 --set person.subdivisions=1
	$(BIN)/bodyscan check $(OUT)/rig.yaml
	$(BIN)/bodyscan calibrate-rig $(OUT)/rig.yaml
	$(BIN)/bodyscan scan $(OUT)/captures/person --calibration $(OUT)/calibration --out $(OUT)/scan
	$(BIN)/bodyscan export $(OUT)/scan --out $(OUT)/export
	$(BIN)/bodyscan evaluate $(OUT)

.PHONY: station
SHOWN := build/station
station: $(SHOWN)/calibration/calibration.json
	mkdir -p $(SHOWN)/inbox
	$(BIN)/bodyscan station --calibration $(SHOWN)/calibration --rig $(SHOWN)/rig.yaml \
		--inbox $(SHOWN)/inbox --out $(SHOWN)/models

$(SHOWN)/calibration/calibration.json: | setup
	rm -rf $(SHOWN)
	$(BIN)/bodyscan simulate rigs/three-pole-12.yaml --out $(SHOWN) --scale 0.5
	printf 'capture:\n  camera: {kind: simulated, subject: %s, samples: 2}\n' \
		$(CURDIR)/data/subjects/woman_average.ply >> $(SHOWN)/rig.yaml
	$(BIN)/bodyscan calibrate-rig $(SHOWN)/rig.yaml

test: setup
	$(BIN)/python -m pytest $(PARALLEL)

test-quick: setup
	$(BIN)/python -m pytest $(PARALLEL) -m "not slow" --hypothesis-profile=quick

coverage: setup
	$(BIN)/python -m pytest $(PARALLEL) --cov --cov-report=term:skip-covered

wheel: setup
	sh tests/wheel/try-wheel.sh "$(BIN)/python" dist

check: setup
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python tests/support/check_words.py

# The site, in build/site: a dead link or a reference to what is not there fails it.
.PHONY: docs
docs: setup
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

# docs/reproduction.md and its figures: the chapter's experiments, ideal and with real light.
.PHONY: reproduction
REPRODUCED := build/reproduction
reproduction: setup
	$(BIN)/bodyscan reproduce --out $(REPRODUCED)
	$(BIN)/bodyscan reproduce --out $(REPRODUCED) --real-light
	cp $(REPRODUCED)/*.png docs/
	{ echo '<!-- Made by `make reproduction`: do not edit, run it again. -->'; echo; \
		cat $(REPRODUCED)/reproduction.md; echo; \
		sed '1s/.*/# The same with real light/' $(REPRODUCED)/reproduction-real-light.md; } \
		> docs/reproduction.md

bench: setup
	$(BIN)/python -m benchmarks

# Deliberate faults that the tests should see; those that survive are listed. Takes an hour or two.
.PHONY: mutants
mutants: setup
	$(BIN)/python -m pip install --quiet --disable-pip-version-check 'cosmic-ray>=8.4'
	$(BIN)/python -m benchmarks mutants

# Users get the newest libraries that pyproject.toml allows; CI those of the day it was last looked at.
# To be made with the oldest Python there is: what it can have, all can.
.PHONY: lock
lock:
	rm -rf build/lock
	"$(PYTHON)" -m venv build/lock
	build/lock/bin/python -m pip install --quiet --disable-pip-version-check '.[dev,docs,cluster,e57,station,capture-pylon]'
	build/lock/bin/python -m pip freeze --exclude bodyscan > data/constraints.txt
	rm -rf build/lock

setup: $(VENV)/.ready

$(VENV)/.ready: pyproject.toml data/set-up.sh
	sh data/set-up.sh "$(PYTHON)" $(VENV)
	touch $@

clean:
	rm -rf $(VENV) $(OUT)
