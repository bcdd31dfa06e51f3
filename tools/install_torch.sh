#!/usr/bin/env bash
# Installs torch: the CUDA build where an NVIDIA GPU answers, else the CPU build, which is a tenth of the size. And kornia on Python 3.10.
# Needs PIP (a command), TORCH (empty: choose), TORCH_CPU_INDEX, TORCH_FALLBACK.
set -euo pipefail

python=${PIP%% *}
answers='import sys, urllib.request; urllib.request.urlopen(sys.argv[1] + "/torch/", timeout=5)'

if [[ -n ${TORCH:-} ]]; then
    $PIP install --quiet "$TORCH"
elif nvidia-smi -L >/dev/null 2>&1; then
    echo "NVIDIA GPU found: installing torch with CUDA"
    $PIP install --quiet "torch>=2.4"
elif [[ $(uname -s) != Linux || $(uname -m) != x86_64 ]]; then
    $PIP install --quiet "torch>=2.4"
elif "$python" -c "$answers" "$TORCH_CPU_INDEX" 2>/dev/null; then
    echo "No NVIDIA GPU: installing torch for the CPU from $TORCH_CPU_INDEX"
    $PIP install --quiet --index-url "$TORCH_CPU_INDEX" "torch>=2.4"
else
    echo "$TORCH_CPU_INDEX does not answer: installing $TORCH_FALLBACK from pip's index"
    $PIP install --quiet "$TORCH_FALLBACK"
fi

# kornia 0.9 refuses 3.10, but works: see thegra_core/features/python310.py
if "$python" -c 'import sys; sys.exit(sys.version_info >= (3, 11))'; then
    $PIP install --quiet --no-deps --ignore-requires-python "kornia>=0.9,<0.10" kornia_rs
fi
