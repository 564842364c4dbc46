# make quick   style, types, imports, the losses against their oracles, one short run: after every change, two minutes
# make demo    train PPO and SND-VIC on MountainCar, and draw both learning curves
# make test    the test suite
# make test-all       every cell of the grid on every kind of input too (an hour)
# make test-survival  fifty kills, thousands of bad inputs, half an hour of load (an hour)
# make bench   the benchmark of six algorithms against the committed figures (a quarter of an hour)
# make gpu-suite      what can be learned on a GPU in MINUTES minutes (10); called again, it resumes
# make docs    the manual: build/site/index.html, without a network
# make check   formatter, linter and type checker
# make style   how the code is documented, in numbers
# make .venv          the environment; PYTHON=python3.12 picks another Python
# make .venv/.sweeps    launchers for clusters, and trackers, which the tests use too
# make .venv/.jax-envs  environments that live in JAX (gymnax, Craftax, XLand-MiniGrid), which they use too
# make .venv/.docs      what builds the manual
PYTHON ?= python3
MINUTES ?= 10
RUN := .venv/bin/python

.PHONY: .venv quick style demo test test-all test-survival bench gpu-suite check format docs
.venv: .venv/.complete

.venv/.complete: requirements.txt pyproject.toml bootstrap.py
	@command -v $(PYTHON) >/dev/null || { echo "sndjax: no $(PYTHON) here; install Python 3.11 or newer, or run make PYTHON=..." >&2; exit 2; }
	@$(PYTHON) bootstrap.py

.venv/.sweeps .venv/.jax-envs .venv/.docs: .venv/.%: .venv/.complete requirements-%.txt
	@$(PYTHON) bootstrap.py $*

QUICK := tests/objectives tests/signals tests/test_returns.py tests/test_ppo.py tests/test_statistics.py \
	tests/test_scaling.py tests/test_hashing.py tests/test_style.py tests/experiments/test_imports.py

quick: check
	@$(RUN) -m pytest -q -n 2 --dist worksteal $(QUICK)
	@rm -rf build/quick
	@$(RUN) -m experiments.cli env=MountainCar algo=snd_vic total_steps=16_384 run_dir=build/quick

style: .venv/.complete
	@$(RUN) tests/measure_style.py

demo: .venv/.complete
	@$(RUN) -m experiments.cli demo

test: .venv/.sweeps .venv/.jax-envs
	@$(RUN) -m pytest -n 2 --dist worksteal

test-all: .venv/.sweeps .venv/.jax-envs
	@$(RUN) -m pytest -n 2 --dist worksteal -m "not survival"

test-survival: .venv/.sweeps .venv/.jax-envs
	@$(RUN) -m pytest -m survival -s

bench: .venv/.complete
	@$(RUN) -m experiments.cli bench_suite

gpu-suite: .venv/.complete
	@$(RUN) -m experiments.cli gpu_suite minutes=$(MINUTES)

docs: .venv/.docs
	@NO_MKDOCS_2_WARNING=1 PYTHONPATH=. $(RUN) -m mkdocs build
	@echo "the manual: build/site/index.html (with search: $(RUN) -m http.server -d build/site)"

check: .venv/.complete
	@$(RUN) -m ruff check .
	@$(RUN) -m ruff format --check .
	@$(RUN) -m mypy

format: .venv/.complete
	@$(RUN) -m ruff check --fix .
	@$(RUN) -m ruff format .
