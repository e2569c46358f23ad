#!/bin/sh
# Set everything up and run the demo or the tests, on a fresh Debian 11, 12 or 13 (or any machine with Python 3.9 to 3.13).
#   sh Testing/run.sh demo                   colour and render the built-in sample: results in ./demo
#   sh Testing/run.sh test                   all tests, fast and slow, on as many processes as there are cores, at most four
#   sh Testing/run.sh test -m 'not slow'     the fast ones; what follows `test` is pytest's
set -eu
cd "$(dirname "$0")/.."
task=${1:-}
case "$task" in
  demo|test) shift ;;
  *) echo "usage: sh Testing/run.sh demo|test [pytest arguments]" >&2; exit 2 ;;
esac

say() { echo "==> $*"; }

# System packages: OpenGL without a display (Mesa); what Qt needs to draw offscreen in the panel tests, and CMake to configure
# the extension.
packages="libegl1 libgl1 libgl1-mesa-dri"
[ "$task" = test ] && packages="$packages libxkbcommon0 libdbus-1-3 libfontconfig1 libglib2.0-0 fonts-dejavu-core cmake make g++"
if command -v dpkg-query >/dev/null 2>&1; then
  missing=""
  for package in $packages; do
    # From Debian 13 and Ubuntu 24.04 on some are named ...t64 (64-bit time); apt-get takes the old name for the new.
    dpkg-query -W -f='${Status}\n' "$package" "${package}t64" 2>/dev/null | grep -q "install ok installed" ||
      missing="$missing $package"
  done
  python3 -c "import ensurepip, venv" 2>/dev/null || missing="$missing python3-venv"
  if [ -n "$missing" ]; then
    if [ "$(id -u)" = 0 ]; then
      say "Installing system packages:$missing (half a minute)"
      apt-get update -qq
      # shellcheck disable=SC2086
      DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends $missing >/dev/null
    else
      say "These system packages are missing; ask an administrator for: apt-get install$missing" >&2
    fi
  fi
fi

# The first time pip tells on a terminal what it is doing; later there is little to do, and it is silent.
python=.venv/bin/python
mark=.venv/set-up-for-$task
quiet=--quiet
if [ -f "$mark" ]; then
  say "Python packages: looking whether .venv is up to date (seconds)"
else
  say "Installing Python packages in .venv: 3 GB on disk, or 7 GB where PyTorch comes with CUDA; minutes, by the speed of the network"
  if [ -t 1 ]; then quiet=; fi
fi
[ -x "$python" ] || python3 -m venv .venv
install() {
  # shellcheck disable=SC2086
  "$python" -m pip install $quiet --disable-pip-version-check -c Testing/constraints.txt "$@"
}
install 'pip>=21.3'  # older ones (Python 3.9's) make no editable installation without a setup.py
install torch
if [ "$task" = demo ]; then
  install --editable .
  touch "$mark"
  say "Colouring and rendering a head made by formula (under a minute)"
  exec .venv/bin/medcolor demo -o demo
fi
install --editable '.[test]'
touch "$mark"
export QT_QPA_PLATFORM=offscreen
say "Lint, then all tests, the slow ones, too; the fast ones alone: sh Testing/run.sh test -m 'not slow'"
say "On as many processes as there are cores, at most four: some ten minutes on two cores; in one: sh Testing/run.sh test -n 0"
"$python" -m ruff check MedColor MedColorLib Testing
# Else the processes compile the same files at the same time, where tests copy the folders.
"$python" -m compileall -q MedColor MedColorLib
exec "$python" -m pytest -m '' -n auto --dist loadfile "$@"
