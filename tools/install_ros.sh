#!/usr/bin/env bash
# Installs ROS 2 Jazzy's Python packages into the environment of $PIP and $BIN, for the nodes and their tests. There are wheels for Linux on x86-64 only; elsewhere, or
# where they cannot be had, Thegra works on recordings and the nodes' tests are skipped. A ROS that is sourced is used as it is.
set -euo pipefail

if [[ -n "${ROS_DISTRO:-}" ]]; then
    echo "ROS 2 $ROS_DISTRO is sourced: its packages are used"
    exit 0
fi
if [[ "$(uname -s)-$(uname -m)" != Linux-x86_64 ]]; then
    exit 0
fi
if ! $PIP install --quiet --editable ".[ros]"; then
    echo "ROS 2 could not be installed: 'thegra live', 'thegra play' and their tests are left out; all else works" >&2
    exit 0
fi
tools/build_tf2_msgs.sh
