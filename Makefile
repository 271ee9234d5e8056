# make demo: the main job on the embedded abdomen.  make test: everything that must hold.  make quick: most of it, in under a minute on two idle cores.
# make mutants: which faults in the plain modules and kernels the tests notice (a quarter of an hour).

# The newest that is tried, is here and can make an environment, or the one that is named: make test PYTHON=python3.11
ifndef PYTHON
PYTHON := $(shell for p in python3.13 python3.12 python3.11; do $$p -c 'import ensurepip, venv' 2>/dev/null && echo $$p && break; done)
endif
VENV := .venv
BIN := $(VENV)/bin
OUT ?= out/demo
RUNS ?= 100000
FIRST ?= 0
DRAWS ?= 1000
SEED ?= 0
KILLS ?= 10

# Python keeps what it compiles, whatever the shell says: to read every module anew takes each process seconds.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: FORCE demo test versions simulator browser quick durations slips fuzz kill kill-batch lint mutants install links reinstall kernels wheel release docs pictures meshes clean

demo: install simulator
	$(BIN)/python run_twin.py demo --out $(OUT)

# In CI, where nothing is compiled yet, the kernels are beside lint and versions: they use one core alone.
test: export LATER := $(if $(CI),kernels)
test: install simulator browser
	@$(MAKE) --no-print-directory --jobs 2 --output-sync=target $(LATER) lint $(if $(CI),versions)
	$(BIN)/pytest -q -n auto --dist loadfile

# Beside this environment: the newest Python, and the lowest version of every part (two minutes; in CI a part of make test).
versions: install
	$(BIN)/python -m tools.versions

# While one works: what takes under 0.07 s a test, without real data.
quick: install
	$(BIN)/pytest -q -n auto --dist loadfile -m "not slow and not real"

# Which tests are slow is measured, not guessed: writes tests/slow_tests.txt again (as long as make test).
durations: install
	mkdir -p out
	rm -f out/durations.txt
	DURATIONS=$(CURDIR)/out/durations.txt $(BIN)/pytest -q -n auto --dist loadfile
	$(BIN)/python tests/slow_tests.py out/durations.txt

# Two hundred SIGKILLs of a cohort's workers and main process (half an hour); then the merged files are those of an undisturbed one.
kill-batch: install
	BATCH_KILLS=200 BATCH_CASES=40 $(BIN)/python -m pytest -q -s tests/batch/test_kill_batch.py

kill: install
	KILLS=$(KILLS) $(BIN)/python -m pytest -q -s tests/jobs/test_kill.py

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# Slips of each kind, each beside a true input: what is said of them; DRAWS=100 SEED=1 for fewer, and other, ones.
slips: install
	cd tests && PYTHONPATH=..:. ../$(BIN)/python -m slips --draws $(DRAWS) --seed $(SEED)

# Mutated files and command lines; RUNS=1000 FIRST=500000 for fewer, and other, ones.
fuzz: install
	cd tests && PYTHONPATH=..:. ../$(BIN)/python -m fuzz --runs $(RUNS) --first $(FIRST) --keep ../out/fuzz

mutants: install
	$(BIN)/python -m tools.mutants --out out/mutants.json

install: links $(VENV)/installed

# Beside the package's own files: mypy, the site's pages and editors look there for its parts. Python needs none of them.
LINKS := $(addprefix puncture_twin/,planning twin meshes run_twin.py)
links: $(LINKS)
$(LINKS):
	@ln -sfn ../$(@F) $@

# The stamp holds what was installed: files that are only newer, as after a checkout, install nothing again.
WHICH := -c 'import sys; print("Python %d.%d" % sys.version_info[:2])'
STAMP := { cat pyproject.toml constraints.txt; $(PYTHON) $(WHICH); }
$(VENV)/installed: FORCE
	@[ -n "$(PYTHON)" ] || { echo "no Python 3.11, 3.12 or 3.13 with venv is here; Debian 12 and later, Ubuntu 24.04: apt install python3-venv"; exit 2; }
	@$(STAMP) 2>/dev/null | cmp -s - $@ || $(MAKE) --no-print-directory reinstall PYTHON=$(PYTHON)

reinstall:
	@[ "$$($(BIN)/python $(WHICH) 2>&1)" = "$$($(PYTHON) $(WHICH))" ] || rm -rf $(VENV)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[twin,test]'
	@$(MAKE) --no-print-directory simulator
	$(if $(LATER),,$(MAKE) --no-print-directory kernels)
	$(STAMP) > $(VENV)/installed

# PyBullet has no wheel after Python 3.11. Where it could not be built, the next make demo or make test tries again.
simulator:
	@$(BIN)/python -c "import pybullet" 2>/dev/null || { command -v g++ >/dev/null && \
	  echo "building the simulator: PyBullet has no wheel for this Python (8 minutes; needs g++ and python3-dev)" && \
	  $(BIN)/pip install --quiet --constraint constraints.txt pybullet; } || \
	  echo "NO SIMULATOR: demo plans only; rehearse, servo, selfcal, reproduce and their tests need it; all else works. apt install g++ python3-dev, or PYTHON=python3.11"

# The page is tested in one: Debian's where it may be installed, else Playwright's own.
browser:
	@{ command -v chromium || command -v chromium-browser || command -v google-chrome; } >/dev/null || { [ "$$(id -u)" = 0 ] && command -v apt-get >/dev/null && \
	  apt-get update -qq && apt-get install -y -qq --no-install-recommends -o Acquire::Retries=3 chromium; } >/dev/null 2>&1 || \
	  $(BIN)/playwright install chromium >/dev/null 2>&1 || \
	  echo "NO BROWSER IS HERE: the page's tests in one are skipped, and fail where CI is set; apt install chromium"

# Compiled here, not while a person waits for a first answer. What is not compiled here is where it is first used.
kernels:
	@echo "compiling the kernels (a minute)"
	@out=$$(mktemp -d) && export PUNCTURE_TWIN_CACHE=$$out/cache && \
	  { $(BIN)/python run_twin.py demo --out $$out/demo && \
	    $(BIN)/python run_twin.py check meshes/abdomen --theta 64 --beta 98 && \
	    $(BIN)/python -c "from puncture_twin.twin.jobs.live import planner as live; import puncture_twin as pt; live.Planner(pt.prepare('meshes/abdomen'))"; \
	  } > $$out/log 2>&1 || \
	  { tail -n 1 $$out/log; echo "kernels will be compiled where they are first used"; }; rm -rf $$out

# In out/wheels: for every machine.
wheel: install
	$(BIN)/pip wheel --quiet --no-deps --wheel-dir out/wheels .

# A commit and a tag, after linters, quick tests and the wheel in an empty environment: make release VERSION=0.2.0
VERSION ?=
release: install
	$(BIN)/python -m tools.release $(VERSION)

# The pages and the API reference, as a site in out/site.
docs: install
	$(BIN)/pip install --quiet --constraint constraints.txt --editable '.[twin,docs]'
	$(BIN)/python docs/command_line.py
	$(BIN)/python docs/default_roles.py
	$(BIN)/python docs/sentences.py
	$(BIN)/mkdocs build --quiet

pictures: demo
	$(BIN)/python docs/architecture_picture.py
	$(BIN)/python docs/frames_picture.py
	$(BIN)/python run_twin.py place meshes/abdomen --out out/place
	$(BIN)/python run_twin.py selfcal --seeds 1 --out out/selfcal
	$(BIN)/python run_twin.py servo meshes/head --out out/servo
	mkdir -p out/budget
	$(BIN)/python run_twin.py register meshes/abdomen --picture out/budget/budget.png
	PYTHONPATH=. $(BIN)/python docs/concept_pictures.py $(OUT)/plan.json
	$(BIN)/python docs/reliability_picture.py
	$(BIN)/python docs/copy_pictures.py $(OUT) out/place out/selfcal out/servo out/budget

meshes: install
	$(BIN)/python -m tools.phantoms --out meshes

clean:
	rm -rf $(VENV) build out $(LINKS)
