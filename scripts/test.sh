#!/usr/bin/env bash
# Sets up the environment and runs the tests, a file of tests on a core. Arguments go to pytest.
set -euo pipefail
cd "$(dirname "$0")/.."
source scripts/environment.sh test
# A process of tests on each core: more threads in each would only wait for one another.
export OMP_NUM_THREADS=${OMP_NUM_THREADS:-1}
python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile "$@"
