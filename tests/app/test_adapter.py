"""[filter] adapter: a learned part by its name, or by a file of its weights."""

import numpy as np
import pytest

from jaxnav.app import prepare
from jaxnav.app.config import read_params, resolve
from jaxnav.filters.catalogue import build
from jaxnav.io.weights import write_weights
from jaxnav.states.grades import GRADES
from jaxnav.types import ConfigError, DataError
from tests.filters.test_adapters import moved


def test_weights_of_a_tuned_toml_reach_the_filter(tmp_path):
    """The file is in the folder of tuned.toml, wherever the command is run."""
    weights = moved(build("ekf15", adapter="mlp_noise").params("consumer").adapter)
    write_weights(tmp_path / "net.npz", weights, "mlp_noise")
    (tmp_path / "tuned.toml").write_text('[filter]\nadapter = "net.npz"\n[noise]\ngyro_deg_per_sqrt_hour = 0.5\n')
    config = resolve([("tuned.toml", read_params(tmp_path / "tuned.toml"))])
    filt = prepare.filter_of(config, prepare.measurements_of(config))
    params = prepare.base_params(config, GRADES["consumer"], np.zeros(3))
    assert filt.spec.adapter == "mlp_noise"
    np.testing.assert_array_equal(params.adapter["out"]["weights"], weights["out"]["weights"])
    velocity = resolve([("", {"filter": {"adapter": str(tmp_path / "net.npz"), "measurements": ["position"]}})])
    with pytest.raises(DataError, match=r"hidden.weights is \(10, 16\), expected \(7, 16\)"):
        prepare.base_params(velocity, GRADES["consumer"], np.zeros(3))


@pytest.mark.parametrize(
    ("adapter", "error", "words"),
    [
        ("mlp_noice", ConfigError, "filter.adapter: no adapter 'mlp_noice': did you mean mlp_noise"),
        ("window_constraints", ConfigError, "filter.adapter: window_constraints needs the measurement nonholonomic"),
        ("absent.npz", DataError, "absent.npz: cannot be read"),
    ],
)
def test_an_adapter_that_is_none_is_refused(adapter, error, words):
    config = resolve([("", {"filter": {"adapter": adapter}})])
    with pytest.raises(error, match=words):
        prepare.filter_of(config, prepare.measurements_of(config))
