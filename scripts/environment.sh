# Sourced by the other scripts: makes the virtual environment .venv at the project's root, with the project and the
# extras named in $1 installed, and activates it.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
if [ ! -d .venv ]; then
  python="${PYTHON:-python3}"
  if ! "$python" -c "import sys; sys.exit(not (3, 10) <= sys.version_info < (3, 13))"; then
    echo "Error: $("$python" --version) cannot be used; name a Python 3.10, 3.11 or 3.12 as PYTHON=..." >&2
    exit 1
  fi
  "$python" -m venv .venv
fi
# shellcheck disable=SC1091
source .venv/bin/activate
# Each set of extras is installed once, and again whenever pyproject.toml changes.
wanted="$1 $(cksum pyproject.toml)"
if ! grep -qxF "$wanted" .venv/installed 2>/dev/null; then
  echo "Installing (a few minutes and several GB the first time) ..."
  python -m pip install --quiet --upgrade pip
  python -m pip install --quiet --editable ".[$1]"
  echo "$wanted" >> .venv/installed
fi
# PyTorch's threads wait for each other on small machines that do something else as well; see docs/nerfstudio.md.
if [ "$(nproc 2>/dev/null || echo 2)" -le 4 ]; then
  export OMP_NUM_THREADS="${OMP_NUM_THREADS:-1}"
fi
