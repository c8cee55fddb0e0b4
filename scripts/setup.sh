# Sourced by demo and test: a virtual environment of the checkout's own, and where it may, the GL library.
# Usage: . scripts/setup.sh EXTRAS [browser]    (EXTRAS is what to install, as in ".[test]")
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

# Installs Debian packages if we may: as root, or with a sudo that asks for no password.
apt_install() {
  local as_root=""
  [ "$(id -u)" = 0 ] || as_root="sudo -n"
  command -v apt-get >/dev/null && $as_root true 2>/dev/null || return 1
  echo "Installing $* ..."
  { $as_root apt-get update -qq && $as_root apt-get install -y -qq "$@"; } >/dev/null 2>&1
}

# Rendering without a screen takes GL libraries that pip does not bring: EGL, and OpenGL's own functions. Without
# them there is no video, and everything else runs. Debian's packages come while pip installs.
libraries=$(PATH="$PATH:/usr/sbin:/sbin" ldconfig -p 2>/dev/null || true)
gl="libegl1 libopengl0 libgl1-mesa-dri"
if [ "$(uname)" = Linux ]; then
  {
    [[ $libraries == *libEGL.so.1* && $libraries =~ lib(OpenGL.so.0|GL.so.1) ]] || apt_install $gl ||
      echo "There will be no videos: for them, apt-get install $gl as root."
    [ "${2:-}" != browser ] || command -v chromium >/dev/null || apt_install chromium ||
      echo "The report is not looked at in a browser: apt-get install chromium as root."
  } &
  trap wait EXIT # whatever goes wrong meanwhile
fi

venv="${HYRL_MJ_VENV:-.venv}"
if ! [ -x "$venv/bin/pip" ]; then
  if ! mkdir -p "$venv" 2>/dev/null; then
    echo "$PWD cannot be written to: set HYRL_MJ_VENV to a folder that can, and run this again." >&2
    exit 2
  fi
  echo "Making a virtual environment in $venv ..."
  # Debian ships Python without what venv needs to bring pip along.
  "$python" -m venv "$venv" >/dev/null 2>&1 ||
    { wait && apt_install python3-venv && "$python" -m venv --clear "$venv" >/dev/null; } || {
      echo "Python's venv is incomplete: apt-get install python3-venv as root, and run this again." >&2
      exit 2
    }
fi
# Python compiles what it imports, and most of what is installed is never imported. What it has compiled is kept,
# whatever the shell says: the libraries would be compiled anew by each process, which takes longer than most tests.
unset PYTHONDONTWRITEBYTECODE
echo "Installing hyrl_mj into $venv (a minute or two the first time) ..."
"$venv/bin/python" -m pip install --quiet --disable-pip-version-check --no-compile --editable "$1"
wait
trap - EXIT
PATH="$(cd "$venv/bin" && pwd):$PATH"
