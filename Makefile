# make demo   train PPO and SND-VIC on MountainCar and draw both learning curves
# make test   the test suite
# make test-all  every cell of the grid on every kind of input too (an hour)
# make test-survival  fifty kills, thousands of bad inputs, half an hour of load (an hour)
# make bench  the benchmark of six algorithms against the committed figures (a quarter of an hour)
# make gpu-evidence  the thesis' hard games on a GPU for MINUTES minutes (60); again, and it goes on
# make check  formatter, linter and type checker
# make .venv/.sweeps  launchers for clusters, and trackers, which the tests use too
# make .venv  the environment alone; PYTHON=python3.12 picks another Python
PYTHON ?= python3
MINUTES ?= 60
RUN := .venv/bin/python

.PHONY: .venv demo test test-all test-survival bench gpu-evidence check format
.venv: .venv/.complete

.venv/.complete: requirements.txt pyproject.toml bootstrap.py
	@command -v $(PYTHON) >/dev/null || { echo "sndjax: no $(PYTHON) here; install Python 3.11 or newer, or say make PYTHON=..." >&2; exit 2; }
	@$(PYTHON) bootstrap.py

.venv/.sweeps: .venv/.complete requirements-sweeps.txt
	@$(PYTHON) bootstrap.py sweeps

demo: .venv/.complete
	@$(RUN) -m experiments.demo

test: .venv/.sweeps
	@$(RUN) -m pytest -n 2 --dist worksteal

test-all: .venv/.sweeps
	@$(RUN) -m pytest -n 2 --dist worksteal -m "not survival"

test-survival: .venv/.sweeps
	@$(RUN) -m pytest -m survival -s

bench: .venv/.complete
	@$(RUN) -m experiments.benches

gpu-evidence: .venv/.complete
	@$(RUN) -m experiments.evidence --minutes $(MINUTES)

check: .venv/.complete
	@$(RUN) -m ruff check .
	@$(RUN) -m ruff format --check .
	@$(RUN) -m mypy

format: .venv/.complete
	@$(RUN) -m ruff check --fix .
	@$(RUN) -m ruff format .
