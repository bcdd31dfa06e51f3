#!/usr/bin/env bash
# Prints a Python interpreter that Thegra supports (3.10 to 3.13) and that can make virtual environments.
# Usage: find_python.sh [INTERPRETER]
set -euo pipefail

supported='import sys; sys.exit(not (3, 10) <= sys.version_info[:2] <= (3, 13))'
wanted=${1:-}
for candidate in ${wanted:-python3 python3.12 python3.13 python3.11 python3.10}; do
    "$candidate" -c "$supported" 2>/dev/null || continue
    if ! "$candidate" -c 'import ensurepip, venv' 2>/dev/null; then
        version=$("$candidate" -c 'import sys; print("python%d.%d" % sys.version_info[:2])')
        echo "$candidate cannot make virtual environments. Install the missing part with:  sudo apt install $version-venv" >&2
        exit 1
    fi
    command -v "$candidate"
    exit 0
done
echo "No Python 3.10 to 3.13 found${wanted:+ at $wanted}. Install one with:  sudo apt install python3 python3-venv  (or name yours: make setup PYTHON=/path/to/python3)" >&2
exit 1
