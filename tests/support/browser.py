"""A browser without a window, for pages; tests that need one are skipped where there is none."""

import os
import shutil
from contextlib import contextmanager

import pytest

#: Draw without a graphics card; without a sandbox, as root must.
OPTIONS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
PROGRAMS = ("chromium", "chromium-browser", "google-chrome", "chrome")


def program():
    """Where a browser is; None if there is none. The variable CHROMIUM names another one."""
    named = os.environ.get("CHROMIUM")
    return named or next((found for found in map(shutil.which, PROGRAMS) if found), None)


@contextmanager
def browser():
    """A browser, driven by Playwright."""
    pytest.importorskip("websockets", reason="the page needs websockets")
    playwright = pytest.importorskip("playwright.sync_api", reason="a browser is driven by playwright")
    found = program()
    if found is None:
        pytest.skip("there is no chromium to open the page in")
    with playwright.sync_playwright() as driver:
        opened = driver.chromium.launch(executable_path=found, args=OPTIONS)
        try:
            yield opened
        finally:
            opened.close()
