"""A headless browser, and a mark for tests that need it: without one they are skipped, never in CI."""

import os
import shutil
import subprocess

import pytest

CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "google-chrome"))), None)

needs_chromium = pytest.mark.skipif(
    "CI" not in os.environ and CHROMIUM is None, reason="no chromium on this machine"
)


def chromium(page, profile, width=1280, height=6000, *arguments):
    """Open a page; what the browser wrote to its standard output."""
    assert CHROMIUM is not None, "apt-get install chromium"
    done = subprocess.run(
        [
            CHROMIUM, "--headless=new", "--no-sandbox", "--disable-gpu", "--hide-scrollbars",
            "--disable-dev-shm-usage", "--no-first-run", f"--user-data-dir={profile}",
            f"--window-size={width},{height}", *arguments, page.as_uri(),
        ],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout
