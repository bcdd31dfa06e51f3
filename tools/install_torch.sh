#!/usr/bin/env bash
# Installs torch: the CUDA build where an NVIDIA GPU answers, else the CPU build, which is a tenth of the size.
# Needs PIP, TORCH (empty: choose), TORCH_CPU_INDEX, TORCH_FALLBACK.
set -euo pipefail

if [[ -n ${TORCH:-} ]]; then
    $PIP install --quiet "$TORCH"
elif nvidia-smi -L >/dev/null 2>&1; then
    echo "NVIDIA GPU found: installing torch with CUDA"
    $PIP install --quiet "torch>=2.2"
elif [[ $(uname -s) != Linux || $(uname -m) != x86_64 ]]; then
    $PIP install --quiet "torch>=2.2"
elif ${PIP%% *} -c 'import sys, urllib.request; urllib.request.urlopen(sys.argv[1] + "/torch/", timeout=5)' "$TORCH_CPU_INDEX" 2>/dev/null; then
    echo "No NVIDIA GPU: installing torch for the CPU from $TORCH_CPU_INDEX"
    $PIP install --quiet --index-url "$TORCH_CPU_INDEX" "torch>=2.2"
else
    echo "$TORCH_CPU_INDEX does not answer: installing $TORCH_FALLBACK from pip's index"
    $PIP install --quiet "$TORCH_FALLBACK"
fi
