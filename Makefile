# make train | test | lint | bench | benchmark: each sets up .venv first. PYTHON=... chooses the interpreter; PIP_ARGS=... goes to pip.
SHELL := /bin/bash
PYTHONS := $(PYTHON) python3.11 python3.12 python3
BASE := $(shell for p in $(PYTHONS); do $$p -c 'import sys, venv, ensurepip; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' 2>/dev/null && echo $$p && break; done)
BIN := .venv/bin
STAMP := .venv/.installed

.PHONY: venv train test lint format bench benchmark

venv: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@test -n "$(BASE)" || { echo "error: no Python 3.11 or 3.12 found (tried: $(PYTHONS)). Install one, or: make PYTHON=/path/to/python3.11"; exit 1; }
	test -x $(BIN)/python || $(BASE) -m venv .venv
	$(BIN)/python -m pip install -q --disable-pip-version-check $(PIP_ARGS) -c constraints.txt "$$(grep -m1 '^torch==' constraints.txt)"
	$(BIN)/python -m pip install -q --disable-pip-version-check $(PIP_ARGS) -c constraints.txt -e '.[dev]'
	@touch $(STAMP)

train: venv
	$(BIN)/python train.py $(ARGS)

test: venv
	OMP_NUM_THREADS=1 MKL_NUM_THREADS=1 $(BIN)/python -m pytest -q -n 2 --dist loadgroup $(ARGS)

lint: venv
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

format: venv
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: venv
	@for name in qp filter env_step update; do $(BIN)/python tests/benchmarks/bench_$$name.py --seconds 5 $(ARGS) || exit 1; done

# The whole table, or a part: make benchmark ENVS=default SEEDS='range(3)' METHODS=certified,ddpg DEVICE=device=cpu. Goes on where it
# was stopped, on another machine too: runs of ARCHIVE count as done (ARCHIVE= : none), and $(FOLDER)/report/runs.tar.xz is the next one.
ENVS ?= default,five_robots,random_density,moving_density
SEEDS ?= range(10)
CONTROLLERS ?= coverage_cbf,lloyd,charge_when_low,random
FOLDER ?= runs/benchmark
ARCHIVE ?= docs/benchmark/runs.tar.xz
SET = env=$(ENVS) 'seed=$(SEEDS)' num_envs=256 pictures=false resume=auto folder=$(FOLDER)/controllers $(DEVICE)
benchmark: venv
	$(if $(wildcard $(ARCHIVE)),$(BIN)/python report.py sweep=$(FOLDER) unpack=$(ARCHIVE))
	$(BIN)/python train.py -m experiment=benchmark env=$(ENVS) 'seed=$(SEEDS)' $(if $(METHODS),method=$(METHODS)) hydra.sweep.dir=$(FOLDER) $(DEVICE) $(ARGS)
	$(BIN)/python evaluate.py -m controller=$(CONTROLLERS) $(SET)
	$(BIN)/python evaluate.py -m controller=coverage_cbf_literal safety=paper env.on_violation=continue $(SET)
	$(BIN)/python report.py sweep=$(FOLDER) incomplete=true pack=$(FOLDER)/report/runs.tar.xz
