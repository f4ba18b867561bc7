# make study   environment, embedded data, the quick study, report
# make test    environment, whole test suite
# make check   environment, lint and format
# make data    environment, embedded data only

PYTHON ?= python3.11
VENV := .venv
STUDY ?= experiments/quick.toml
RUN ?= runs/$(basename $(notdir $(STUDY)))
DATA := runs/data/taylor_green_2d

.PHONY: study test check data clean

study: $(VENV)/.installed $(DATA)/metadata.json
	$(VENV)/bin/cconv study run $(STUDY) --data $(DATA) --out $(RUN) --overwrite

test: $(VENV)/.installed
	$(VENV)/bin/pytest

check: $(VENV)/.installed
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .

data: $(DATA)/metadata.json

$(DATA)/metadata.json: $(VENV)/.installed
	$(VENV)/bin/cconv data generate taylor_green_2d --out $(DATA) --trajectories 20 --frames 12 --overwrite

$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(VENV)/bin/python || $(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --quiet --constraint constraints.txt --editable '.[dev]'
	touch $@

clean:
	rm -rf $(VENV) runs
