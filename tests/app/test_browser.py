"""report.html in a real browser (slow): it draws, and its console holds no error."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import matplotlib.image
import numpy as np
import pytest

from jaxnav.app import cli

BROWSER = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome", "chrome-headless-shell"))), None
)


@pytest.mark.slow
@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
@pytest.mark.parametrize("verb", ["filter", "mc"])
def test_the_report_opens(tmp_path, verb):
    few = ["--runs", "4"] if verb == "mc" else []
    argv = [verb, "--data", "urban_short", "--out", str(tmp_path / "run"), "--quiet", "--set", "filter.cov_stride=25"]
    assert cli.main([*argv, *few]) == 0
    shot = Path(os.environ.get("JAXNAV_SHOTS", tmp_path)) / f"report_{verb}.png"
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--enable-logging=stderr", "--hide-scrollbars"]
    size = ["--window-size=1200,2400", "--virtual-time-budget=8000", f"--screenshot={shot}"]
    page = (tmp_path / "run" / "report.html").as_uri()
    said = subprocess.run([BROWSER, *flags, *size, page], capture_output=True, text=True, timeout=120)
    assert said.returncode == 0, said.stderr
    console = [
        line for line in said.stderr.splitlines() if "CONSOLE" in line
    ]  # bokeh greets, WebGL says how slow it is
    assert not [line for line in console if re.search("uncaught|error|fail|refused|not defined", line, re.IGNORECASE)]
    pixels = (255 * matplotlib.image.imread(shot)[..., :3]).astype(int)
    colours = len(np.unique(pixels.reshape(-1, 3), axis=0))
    assert pixels.shape[:2] == (2400, 1200) and colours > 100  # text alone has some dozen greys
    covered = (pixels.min(-1) < 250).any(1)
    assert covered.mean() > 0.3  # of the page's height
