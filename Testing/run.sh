#!/bin/sh
# Set everything up and run the demo or the tests, on a fresh Debian 12 (or any machine with Python 3.10 or later).
#   sh Testing/run.sh demo   colour and render the built-in sample: results in ./demo
#   sh Testing/run.sh test   all tests, fast and slow
set -eu
cd "$(dirname "$0")/.."
task=${1:-}
case "$task" in
  demo|test) shift ;;
  *) echo "usage: sh Testing/run.sh demo|test [pytest arguments]" >&2; exit 2 ;;
esac

# System packages: OpenGL without a display (Mesa), and what Qt needs to draw offscreen in the panel tests.
packages="libegl1 libgl1 libgl1-mesa-dri"
[ "$task" = test ] && packages="$packages libxkbcommon0 libdbus-1-3 libfontconfig1 libglib2.0-0 fonts-dejavu-core cmake make"
if command -v dpkg-query >/dev/null 2>&1; then
  missing=""
  for package in $packages; do
    dpkg-query -W -f='${Status}' "$package" 2>/dev/null | grep -q "install ok installed" || missing="$missing $package"
  done
  python3 -c "import ensurepip, venv" 2>/dev/null || missing="$missing python3-venv"
  if [ -n "$missing" ]; then
    if [ "$(id -u)" = 0 ]; then
      apt-get update -qq
      # shellcheck disable=SC2086
      DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $missing >/dev/null
    else
      echo "These system packages are missing; ask an administrator for: apt-get install$missing" >&2
    fi
  fi
fi

python=.venv/bin/python
[ -x "$python" ] || python3 -m venv .venv
"$python" -m pip install --quiet --disable-pip-version-check torch -c Testing/constraints.txt
if [ "$task" = demo ]; then
  "$python" -m pip install --quiet --disable-pip-version-check --editable . -c Testing/constraints.txt
  exec .venv/bin/medcolor demo -o demo
fi
"$python" -m pip install --quiet --disable-pip-version-check --editable '.[test]' -c Testing/constraints.txt
export QT_QPA_PLATFORM=offscreen
"$python" -m ruff check MedColor MedColorLib Testing
exec "$python" -m pytest -m '' "$@"
