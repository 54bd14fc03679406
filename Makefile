# skope: set-up, the demonstration, checks, and the pipeline from data to report.
#
#   make help        these lines
#   make setup       .venv with everything; each of the others does that first
#   make demo        set up, then what skope does in minutes: runs/demo/index.html shows it
#   make chain       the whole chain from random weights: generate, train a little, evaluate
#   make test        set up, run the tests (make test-slow: those that take minutes)
#   make lint        ruff and mypy
#   make paper       the paper's experiment: preset paper, recipe paper, its table beside ours; hours on a GPU
#   make real        score a detector on hand-labelled photographs: REAL=folder, CHECKPOINT=file, run or (default) road33,
#                    SCORED=folder to write to
#   make reference   road33, the detector that comes with skope, from nothing: hours on GPUS=0,1
#   make lite        road33-lite, the light one, from nothing with road33 as its teacher: an hour on GPUS=0,1,2,3
#   make report      the pipeline by files: data -> model -> report; redoes only what is out of date
#   make docs        the pages of docs/ as a website under site/
#   make bench       benchmarks
#   make clean       remove what the targets made, but not data/ and runs/
#
# PIP_ARGS reaches pip, e.g. PIP_ARGS="--index-url ...".

VENV    := .venv
SKOPE   := $(VENV)/bin/skope
STAMP   := $(VENV)/.ready
DATA    ?= data/skope
RUN     ?= runs/skope
EPOCHS  ?= 10
RECIPE  ?= paper
CHECKPOINT ?= road33
GPUS    ?= 0
SCORED  ?= runs/real
# One more than there are processors, and at most four: tests also wait, for processes and browsers.
TESTERS ?= $(shell n=$$(getconf _NPROCESSORS_ONLN); echo $$((n < 3 ? n + 1 : 4)))
FOOTAGE ?= runs/bench_footage

.PHONY: help setup demo chain paper reference lite real test test-slow lint data model report docs bench clean

help:
	@sed -n 's/^#   //p' Makefile

setup: $(STAMP)

$(STAMP): pyproject.toml constraints.txt scripts/setup.sh
	VENV=$(VENV) PIP_ARGS="$(PIP_ARGS)" bash scripts/setup.sh
	touch $@

demo: $(STAMP)
	SKOPE=$(SKOPE) PYTHON=$(VENV)/bin/python bash scripts/demo.sh

chain: $(STAMP)
	SKOPE=$(SKOPE) bash scripts/chain.sh

# A crashed worker ends the run: pytest-xdist may wait forever for its replacement if files are kept together.
test: $(STAMP)
	$(VENV)/bin/python -m pytest -n $(TESTERS) --dist loadfile --no-loadscope-reorder --max-worker-restart 0

test-slow: $(STAMP)
	$(VENV)/bin/python -m pytest -m slow

lint: $(STAMP)
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy

# mkdocs advertises another program at every build.
docs: $(STAMP)
	NO_MKDOCS_2_WARNING=1 $(VENV)/bin/python -m mkdocs build

data: $(DATA)/dataset.json
model: $(RUN)/.trained
report: $(RUN)/eval/metrics.json

$(DATA)/dataset.json: | $(STAMP)
	$(SKOPE) gen --out $(DATA)

# A run that is younger than its data is gone on with; one on older data makes room for a new one.
$(RUN)/.trained: $(DATA)/dataset.json | $(STAMP)
	if [ $(RUN)/resume.pt -nt $(DATA)/dataset.json ]; then $(SKOPE) train --out $(RUN) --resume; \
	else rm -rf $(RUN) && $(SKOPE) train --data $(DATA) --out $(RUN) --epochs $(EPOCHS); fi
	touch $@

# What is evaluated is newer than what lies there: a folder of other work would be refused.
$(RUN)/eval/metrics.json: $(RUN)/.trained | $(STAMP)
	rm -rf $(RUN)/eval
	$(SKOPE) eval --data $(DATA) --checkpoint $(RUN)

# The paper's experiment: 13 500 images, 10 epochs, three test splits and the sites apart. Training starts from weights
# trained on COCO, which torchvision downloads: road33 has been trained on such images. Finished steps are not repeated,
# and interrupted ones resume.
paper: $(STAMP)
	$(SKOPE) gen --preset paper --out data/paper
	$(SKOPE) gen --preset extra --out data/extra
	$(SKOPE) train --data data/paper --recipe $(RECIPE) --init coco --out runs/paper
	$(SKOPE) eval --data data/paper --checkpoint runs/paper --compare paper
	$(SKOPE) eval --data data/extra --checkpoint runs/paper --split extra --out runs/paper/extra

# What is finished is not done again here either; docs/results.md has the machine and the times.
reference: $(STAMP)
	$(VENV)/bin/python scripts/reference_run.py varied --gpus $(GPUS)
	$(VENV)/bin/python scripts/reference_run.py world --gpus $(GPUS)
	$(VENV)/bin/python scripts/reference_run.py road33 --gpus $(GPUS)

# Two legs of 25 minutes, what they measure, calibration and packing.
lite: $(STAMP)
	$(VENV)/bin/python scripts/reference_run.py lite --gpus $(GPUS)

# Without REAL nothing is set up first, so that what is missing is told at once.
real: $(if $(REAL),$(STAMP))
	$(if $(REAL),,$(error REAL is not set: make real REAL=folder names a folder of labelled photographs))
	$(VENV)/bin/python scripts/score_photographs.py "$(REAL)" --checkpoint "$(CHECKPOINT)" --out "$(SCORED)"

bench: $(STAMP) $(DATA)/dataset.json
	$(VENV)/bin/python scripts/bench_detector.py backbones
	$(VENV)/bin/python scripts/bench_detector.py metrics
	$(VENV)/bin/python scripts/bench_gen.py frames
	$(VENV)/bin/python scripts/bench_gen.py dataset
	$(VENV)/bin/python scripts/bench_gen.py world
	$(SKOPE) gen video t06_plaza_opening --fps 10 --seconds 4 --out $(FOOTAGE) --quiet
	$(VENV)/bin/python scripts/bench_footage.py ways $(FOOTAGE) --frames 10
	$(VENV)/bin/python scripts/bench_train.py --data $(DATA)

clean:
	rm -rf $(VENV) build dist site *.egg-info .mypy_cache .pytest_cache .ruff_cache
