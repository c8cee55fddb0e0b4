# Sourced by demo and test: a virtual environment of the checkout's own, and where it may, the GL library.
# Usage: . scripts/setup.sh EXTRAS    (EXTRAS is what to install, as in ".[test]")
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=""
for candidate in python3 python3.14 python3.13 python3.12 python3.11; do
  if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
    python=$candidate
    break
  fi
done
if [ -z "$python" ]; then
  echo "hyrl_mj needs Python 3.11 or newer, and there is none on the PATH." >&2
  exit 2
fi

# Rendering without a screen takes a GL library that pip does not bring. Without root there is no video,
# and everything else runs.
if [ "$(uname)" = Linux ] && ! ldconfig -p 2>/dev/null | grep -q 'libEGL\.so\.1'; then
  as_root=""
  [ "$(id -u)" = 0 ] || as_root="sudo -n"
  if command -v apt-get >/dev/null && $as_root true 2>/dev/null; then
    echo "Installing libegl1 and libgl1-mesa-dri for off-screen rendering ..."
    { $as_root apt-get update -qq && $as_root apt-get install -y -qq libegl1 libgl1-mesa-dri; } \
      >/dev/null 2>&1 || echo "That failed: there will be no videos."
  else
    echo "There will be no videos: for them, apt-get install libegl1 libgl1-mesa-dri as root."
  fi
fi

venv="${HYRL_MJ_VENV:-.venv}"
if ! [ -x "$venv/bin/python" ]; then
  echo "Making a virtual environment in $venv ..."
  if ! "$python" -m venv "$venv" 2>/dev/null; then
    # Debian ships venv without pip's installer unless python3-venv is there.
    rm -rf "$venv"
    echo "Python's venv module is incomplete: apt-get install python3-venv, and run this again." >&2
    exit 2
  fi
fi
echo "Installing hyrl_mj into $venv (a minute or two the first time) ..."
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable "$1"
PATH="$(cd "$venv/bin" && pwd):$PATH"
