#!/usr/bin/env bash
# Fetches and verifies the weights of the profiles quality and fast. SuperPoint's licence allows research that is not commercial only, so
# its weights are fetched when THEGRA_ACCEPT_SUPERPOINT_LICENCE=1 says that you accept it, or CI=true (tests are research).
# Needs BIN.
set -euo pipefail

"$BIN/thegra" weights --help >/dev/null 2>&1 || exit 0

"$BIN/thegra" weights fetch --profile quality --profile fast
if [[ ${THEGRA_ACCEPT_SUPERPOINT_LICENCE:-} == 1 || ${CI:-} == true ]]; then
    "$BIN/thegra" weights fetch --profile paper --accept-licence
else
    echo "Profile paper needs SuperPoint's weights (research, not commercial). To fetch them: thegra weights fetch --profile paper --accept-licence"
fi
