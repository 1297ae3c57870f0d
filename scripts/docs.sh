#!/usr/bin/env bash
# Builds the documentation's site in site/ with the active environment (extra "docs"). A warning, such as a link that
# leads nowhere, is an error. Arguments go to mkdocs; `mkdocs serve` shows the pages while they are edited.
set -euo pipefail
cd "$(dirname "$0")/.."
# The theme announces that MkDocs 2 will not be supported.
export NO_MKDOCS_2_WARNING=1
mkdocs build --strict "$@"
