#!/bin/sh
# Makes .venv with the pinned dependencies. Installs an OpenGL that works without a screen, if there is none.
# Usage: sh deploy/setup.sh [python3]
set -eu
python=${1:-python3}

if ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
    echo "saccade: Python 3.11 or newer is needed, '$python' is not: install it, or call make PYTHON=python3.11" >&2
    exit 2
fi
if [ ! -x .venv/bin/python ] && ! "$python" -m venv .venv; then
    echo "saccade: '$python -m venv' failed: install it (Debian, Ubuntu: apt-get install python3-venv)" >&2
    exit 2
fi
.venv/bin/python -m pip install --quiet --editable '.[all]'

has_opengl() { .venv/bin/python -c 'from saccade.shared.render.opengl import choose_backend; choose_backend()' 2>/dev/null; }

if ! has_opengl; then
    if [ "$(id -u)" = 0 ] && command -v apt-get >/dev/null; then
        echo "saccade: installing software OpenGL (libosmesa6)"
        apt-get update -q >/dev/null && apt-get install -y -q libosmesa6 >/dev/null || true
    fi
    has_opengl || echo "saccade: no OpenGL without a screen: install libosmesa6 (Debian, Ubuntu: sudo apt-get install libosmesa6)" >&2
fi
