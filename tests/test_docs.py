"""The library user's page runs as it is printed."""

import re
from pathlib import Path

import numpy as np

PAGE = Path(__file__).parents[1] / "docs" / "library.md"


def test_library_page_runs_and_does_what_it_says(capsys):
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.S)
    assert len(blocks) == 7
    assert sum(bool(line.strip()) for line in blocks[1].splitlines()) <= 15
    assert len(blocks[2].splitlines()) <= 30
    space: dict = {}
    for block in blocks:
        exec(block, space)
    truth = space["drive"].truth
    error = np.abs(space["solution"].lla[-1] - truth.lla[-1]) * 6.4e6
    assert error[:2].max() < 10.0 and bool(space["info"].ok.all())
    history = space["tuned"].history
    assert history[-1]["loss"] < history[0]["loss"]
    # the rule's knee at infinity is the Kalman filter
    jax, np_ = space["jax"], space["jnp"]
    params = space["params"]._replace(rule=space["Huber"](np_.array(1e9)))
    wide = jax.jit(space["jaxnav"].run, static_argnums=0)(space["robust"], params, space["nav"], space["packed"].epochs)
    np.testing.assert_allclose(wide.nav.pos, space["info"].nav.pos, rtol=1e-14, atol=1e-14)
    assert space["gated_params"].rule.rule.kd == 0.1
    assert space["about"]["runs"] == 8 and space["band"].shape == space["found"].course.t.shape
