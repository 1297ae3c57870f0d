#!/usr/bin/env bash
# Lint and type-check. The type checker sees the package as it is laid out when installed.
set -euo pipefail
cd "$(dirname "$0")/.."
ruff check .
ruff format --check .
layout=$(mktemp -d)
trap 'rm -rf "$layout"' EXIT
mkdir "$layout/aenerf_ns"
for entry in aenerf_ns/* dataparsers method_configs; do
  ln -s "$PWD/$entry" "$layout/aenerf_ns/$(basename "$entry")"
done
ln -s "$PWD/benchmarks" "$layout/benchmarks"
(cd "$layout" && mypy --config-file "$OLDPWD/pyproject.toml" --cache-dir "$OLDPWD/.mypy_cache" -p aenerf_ns -p benchmarks.paper)
