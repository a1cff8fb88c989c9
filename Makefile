# upright. `make help` lists what there is to make; every target sees to its own set-up.

PYTHON ?= python3
export PYTHON
PATH := $(PATH):/usr/sbin:/sbin
export PATH

BIN := .venv/bin
READY := .venv/.ready
GUEST := tests/guest/vcan-guest
# In a guest with a time of its own, a process that never waits stops every timeout: this one is the host's.
OWN_TIME = timeout --foreground 40m $(GUEST) --own-time
GUEST_NEEDS := linux.uml:user-mode-linux insmod:kmod ip:iproute2 taskset:util-linux poweroff:systemd-sysv
ifneq ($(shell grep -cw amx_tile /proc/cpuinfo 2>/dev/null),0)
GUEST_NEEDS += cc:build-essential # for tests/guest/whole_xstate.c
endif
# Where UPRIGHT_REQUIRE_ALL=1 (as in .ci/run), what cannot run here is a failure; elsewhere it is left out, and said.
OPTIONAL := [ "$${UPRIGHT_REQUIRE_ALL:-}" != 1 ]
NO_GUEST := { [ $$? = 125 ] && $(OPTIONAL) && echo "make: left out: these tests need SocketCAN or a guest" >&2; }

.DEFAULT_GOAL := help
.NOTPARALLEL:
.PHONY: help demo test docs lint native-test hurried-test patient-test thorough-test viewer-test vcan-test faults fuzz benchmark soak wheels deb install uninstall lock audit clean

help: ## this list
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 16

demo: $(READY) ## the whole story on a virtual bus, no hardware needed; ARGS="--dashboard" shows it in a browser
	$(BIN)/upright demo $(ARGS)

test: lint hurried-test ## lint and the tests, those on real SocketCAN and under a real systemd included
	tests/setup/beside "$(MAKE) --no-print-directory patient-test" "$(MAKE) --no-print-directory vcan-test"

docs: $(READY) ## the manual as a site, to be read from disk, with search: dist/docs/index.html
	rm -rf dist/docs
	OPENBLAS_NUM_THREADS=1 $(BIN)/python docs/site/build.py dist/docs

lint: $(READY) ## ruff, mypy --strict, import contract
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

native-test: hurried-test patient-test ## the tests that need neither SocketCAN nor systemd

hurried-test: $(READY)
	@tests/setup/apt-needs mosquitto:mosquitto chromium:chromium openssl:openssl || $(OPTIONAL)
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder --durations=20 -m "not (vcan or systemd or browser or viewer or patient or thorough)"
	$(BIN)/pytest -m browser

# These compute on one CPU and ask no clock, so that they go beside the guest, which is one CPU, too. A slow machine may
# take its time.
patient-test: $(READY)
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest --durations=20 --timeout 900 -m "patient and not thorough"

thorough-test: $(READY) ## what `make test` leaves out: the same asked of further effects and records, for an hour or two
	OPENBLAS_NUM_THREADS=1 $(BIN)/pytest -n 2 --dist loadfile --no-loadscope-reorder --durations=20 --timeout 900 -m "thorough and not (vcan or systemd)"
	$(OWN_TIME) $(BIN)/pytest -m "own_time and thorough" --basetemp=/dev/shm/upright-pytest || $(NO_GUEST)
	$(MAKE) deb && $(OWN_TIME) --systemd $(BIN)/pytest -m "systemd and thorough" || $(NO_GUEST)

viewer-test: $(READY) ## the live server in Foxglove Studio and by the libraries of Lichtblick, from the npm registry
	@tests/setup/apt-needs node:nodejs npm:npm chromium:chromium
	npm ci --prefix tests/support/viewers --ignore-scripts --no-audit --no-fund
	$(BIN)/pytest -m viewer

vcan-test: $(READY) ## the tests on real SocketCAN and under a real systemd, in a user-mode Linux guest where needed
	@tests/setup/apt-needs $(GUEST_NEEDS) || $(OPTIONAL)
	$(GUEST) $(BIN)/pytest --durations=20 -m "vcan and not (own_time or thorough)" --basetemp=/dev/shm/upright-pytest || $(NO_GUEST)
	$(OWN_TIME) $(BIN)/pytest -m "own_time and not thorough" --basetemp=/dev/shm/upright-pytest || $(NO_GUEST)
	$(OWN_TIME) --systemd $(BIN)/pytest -m "systemd and not thorough" --durations=20 || $(NO_GUEST)

faults: $(READY) ## every fault in every part of a run, for every vehicle, as one table; ARGS="--phase rise --markdown"
	OPENBLAS_NUM_THREADS=1 PYTHONPATH=tests $(BIN)/python -m faults.table $(ARGS)

fuzz: $(READY) ## rubbish into everything that reads what others wrote, as one table; ARGS="--minutes 10 --only sdo"
	OPENBLAS_NUM_THREADS=1 PYTHONPATH=tests:tests/support $(BIN)/python -m fuzz.table $(ARGS)

benchmark: $(READY) ## roll filter beside VQF, fits beside SciPy and CasADi, diagnosis beside a search, import beside numpy, page beside an empty one, bus turnaround beside bare echoes and hostile clients
	@tests/setup/apt-needs $(GUEST_NEEDS) cc:gcc mosquitto:mosquitto chromium:chromium
	$(BIN)/python benchmarks/broad.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/fitting.py
	OPENBLAS_NUM_THREADS=1 $(BIN)/python benchmarks/diagnosing.py
	$(BIN)/python benchmarks/importing.py
	$(BIN)/python benchmarks/dashboard.py
	$(GUEST) $(BIN)/python benchmarks/turnaround.py --rate 500 --seconds 60 \
	  --source "$(BIN)/python benchmarks/vehicle_at.py {rate} simulate" \
	  --responder upright "$(BIN)/python benchmarks/vehicle_at.py 500 serve"
	$(GUEST) $(BIN)/python benchmarks/clients.py

soak: $(READY) ## an hour of experiments in turn on SocketCAN: nothing may grow; ARGS="--minutes 5"
	@tests/setup/apt-needs $(GUEST_NEEDS)
	$(GUEST) $(BIN)/python benchmarks/soak.py $(ARGS)

# What is installed is what requirements.lock says, for the Python of this computer's Debian.
wheels:
	deploy/wheels dist/wheels

deb: wheels ## a Debian package of upright and all that it needs beside Python, in dist/
	rm -f dist/upright_*.deb
	deploy/deb dist/wheels dist

install: ## install command and service on this computer, as root: sudo make wheels install
	deploy/install dist/wheels

uninstall: ## remove them again; recordings and configuration stay
	deploy/install --remove

lock: $(READY) ## write requirements.lock anew where pyproject.toml has changed; ARGS=--upgrade takes the newest of all
	$(BIN)/pip install --quiet "uv>=0.9"
	deploy/lock $(ARGS)

audit: $(READY) ## known vulnerabilities of what requirements.lock names
	$(BIN)/pip install --quiet "pip-audit>=2.9"
	$(BIN)/python deploy/audit

clean: ## remove the environment and everything that was made
	rm -rf .venv .mypy_cache .ruff_cache .pytest_cache .import_linter_cache .hypothesis .fuzz dist build .guest.* tests/support/viewers/node_modules

$(READY): pyproject.toml requirements.lock
	tests/setup/environment
	@touch $@
