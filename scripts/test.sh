#!/usr/bin/env bash
# Sets up the environment and runs the tests. Arguments go to pytest.
set -euo pipefail
cd "$(dirname "$0")/.."
source scripts/environment.sh test
python -m pytest "$@"
