#!/usr/bin/env bash
# Fetches and verifies the weights of the profiles quality and fast. SuperPoint's licence allows non-commercial research only, so its weights
# (profile paper) are fetched when THEGRA_ACCEPT_SUPERPOINT_LICENCE=1 says that you accept it, or in CI (CI=true), where they are tested only.
# Needs BIN, the folder of the command thegra.
set -euo pipefail

for profile in quality fast; do
    "$BIN/thegra" weights fetch --profile "$profile"
done
if [[ ${CI:-} == true ]]; then
    "$BIN/thegra" weights fetch aliked-n16rot
fi
if [[ ${THEGRA_ACCEPT_SUPERPOINT_LICENCE:-} == 1 || ${CI:-} == true ]]; then
    "$BIN/thegra" weights fetch --profile paper --accept-licence
else
    echo "Profile paper needs SuperPoint's weights (non-commercial research only). To fetch them: $BIN/thegra weights fetch --profile paper --accept-licence"
fi
