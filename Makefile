# `make run`: set up and run one episode.  `make up`: the same in containers.  `make test`: set up and run all tests.
PYTHON ?= python3
SACCADE = .venv/bin/saccade

.PHONY: run up test test-compose test-package lint docs bench fixtures clean

run: .venv/.installed
	$(SACCADE) run --view

# Two files at a time: many tests wait for processes. The viewer's page comes alone: a viewer gets only what the other
# processes leave of the processors, and beside a second file of tests that may be nothing.
PAGE = tests/test_viewer_page.py
test: .venv/.installed-dev lint
	.venv/bin/python -m pytest -q --numprocesses 2 --dist loadfile --ignore=$(PAGE)
	.venv/bin/python -m pytest -q $(PAGE)

# As the user who calls it; root has the containers run as user 1000.
up:
	[ "$$(id -u)" = 0 ] || export SACCADE_UID=$$(id -u) SACCADE_GID=$$(id -g); \
	SACCADE_COMMIT=$$(git rev-parse HEAD) docker compose up --build

test-compose: .venv/.installed-dev
	.venv/bin/python -m pytest -q tests/compose

# mypy does not follow an editable installation: it finds `saccade` through a link.
lint: .venv/.installed-dev
	.venv/bin/ruff check .
	.venv/bin/lint-imports
	mkdir -p .venv/names && ln -sfn ../.. .venv/names/saccade
	.venv/bin/mypy

# Builds a wheel, installs it into an empty environment and uses it there.
test-package: .venv/.installed-dev
	.venv/bin/python -m pytest -q tests/package

# Writes the reference pages anew and builds the guide into site/.
docs: .venv/.installed-dev
	.venv/bin/python -m saccade.app.reference docs
	EXECUTE_TUTORIAL=true .venv/bin/mkdocs build --strict

fixtures: .venv/.installed-dev
	.venv/bin/python -m saccade.tests.fixtures.make

bench: .venv/.installed
	$(SACCADE) bench --objects pantry --jobs 2 --json bench/pantry.json

.venv/.installed: pyproject.toml setup.py deploy/setup.sh
	sh deploy/setup.sh $(PYTHON)
	touch $@

.venv/.installed-dev: .venv/.installed
	.venv/bin/python -m pip install --quiet --editable '.[dev]'
	touch $@

clean:
	rm -rf .venv build dist site *.egg-info .pytest_cache .ruff_cache
