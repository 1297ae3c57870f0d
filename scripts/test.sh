#!/usr/bin/env bash
# Sets up the environment and runs the tests, a file of tests on a core. Arguments go to pytest.
set -euo pipefail
cd "$(dirname "$0")/.."
source scripts/environment.sh test
python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile "$@"
