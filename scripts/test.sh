#!/usr/bin/env bash
# Sets up the environment if need be and runs the tests; arguments go to pytest (for instance: -k packaging -n 0).
set -euo pipefail
. "$(dirname "${BASH_SOURCE[0]}")/setup_env.sh"
cd "$ROOT"
exec python -m pytest --numprocesses 2 --dist loadfile --timeout 900 "$@"
