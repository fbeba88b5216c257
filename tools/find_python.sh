#!/bin/sh
# Print the newest Python from 3.11 on that PATH offers and that can make virtual environments.
# Each is tried out: version managers put shims on PATH that only say that their version is not active.
for name in python3.14 python3.13 python3.12 python3.11 python3 python; do
    IFS=:
    for folder in $PATH; do
        unset IFS
        if [ -x "$folder/$name" ] && "$folder/$name" -c '
import sys, ensurepip, venv
sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then
            echo "$folder/$name"
            exit 0
        fi
    done
done
echo "no Python 3.11 or newer with venv on PATH; install one (on Debian also python3-venv) or give PYTHON=..." >&2
exit 1
