# make study   environment, data, the quick study, report
# make rollout the same for steps that are rolled out: data, a study of five minutes, a rollout of its best model
# make test-fast   environment, the tests that start no processes: laws and formats, a minute or two
# make test    environment, whole test suite, on all cores
# make test-slow   what takes hours: clusters, kills, cold compilation, a thousand inputs
# make check   environment, lint, format and types
# make docs    environment and the documentation site in site/
# make data    environment and the data of the quick study, made by the SPH solver

PYTHON ?= python3.11
VENV := .venv
STUDY ?= experiments/quick.toml
ON_ALL_CORES := -n logical --maxprocesses 8 --dist worksteal
RUN ?= runs/$(basename $(notdir $(STUDY)))
DATA := runs/data/dam_break_2d
VORTICES := runs/data/taylor_green_2d
ROLLED := runs/rollout

.PHONY: study rollout test test-fast test-slow check docs data clean

study: $(VENV)/.installed $(DATA)/metadata.json
	$(VENV)/bin/cconv study run $(STUDY) --data $(DATA) --out $(RUN) --overwrite

rollout: $(VENV)/.installed $(VORTICES)/metadata.json
	$(VENV)/bin/cconv study run experiments/rollout.toml --data $(VORTICES) --out $(ROLLED) --overwrite
	rm -rf $(ROLLED)/rolled
	$(VENV)/bin/cconv rollout $(ROLLED) --out $(ROLLED)/rolled

test: $(VENV)/.installed
	$(VENV)/bin/pytest $(ON_ALL_CORES)

test-fast: $(VENV)/.installed
	$(VENV)/bin/pytest $(ON_ALL_CORES) -m "not slow and not integration"

test-slow: $(VENV)/.installed
	$(VENV)/bin/pytest -m slow

check: $(VENV)/.installed
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy

docs: $(VENV)/.installed-docs
	rm -rf site
	$(VENV)/bin/sphinx-build -q --fail-on-warning --keep-going -c docs -d $(VENV)/doctrees . site

data: $(DATA)/metadata.json

$(DATA)/metadata.json: $(VENV)/.installed
	$(VENV)/bin/cconv data generate dam_break_2d --size small --trajectories 20 --frames 13 \
		--steps-per-frame 210 --out $(DATA) --overwrite

$(VORTICES)/metadata.json: $(VENV)/.installed
	$(VENV)/bin/cconv data generate taylor_green_2d --size small --trajectories 12 --frames 61 \
		--out $(VORTICES) --overwrite

$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

$(VENV)/.installed-docs: $(VENV)/.installed
	$(VENV)/bin/pip install --quiet --constraint constraints.txt --editable '.[docs]'
	touch $@

clean:
	rm -rf $(VENV) runs site
