#!/usr/bin/env bash
# Checks style, spelling and types with the tools of the active environment (extra "dev").
set -euo pipefail
cd "$(dirname "$0")/.."
ruff check .
ruff format --check .
codespell
# mypy sees the package as it is laid out when installed.
layout=$(mktemp -d)
trap 'rm -rf "$layout"' EXIT
mkdir "$layout/aenerf_ns"
for entry in aenerf_ns/* dataparsers method_configs; do
  ln -sfn "$PWD/$entry" "$layout/aenerf_ns/$(basename "$entry")"
done
ln -s "$PWD/benchmarks" "$layout/benchmarks"
(cd "$layout" && mypy --config-file "$OLDPWD/pyproject.toml" --cache-dir "$OLDPWD/.mypy_cache" -p aenerf_ns -p benchmarks)
