"""Hidden windows: what drift is measured on."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.analysis.windows import drift, hidden_windows
from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import build
from jaxnav.filters.lanes import RECEIVER_ERROR
from jaxnav.filters.run import prepare, run_jit
from jaxnav.initialization.initialize import initialize
from jaxnav.maths import earth
from jaxnav.measurements import GNSS
from jaxnav.simulate.scenarios import URBAN_SHORT
from jaxnav.simulate.simulation import simulate_jit, to_recording


@pytest.mark.parametrize("states", [(), (RECEIVER_ERROR,)], ids=["plain", "receiver error"])
def test_drift_is_that_of_the_predicted_fix(states):
    """Antenna of the reported position and attitude, and the receiver's slow error where there is one, less the fix."""
    what = URBAN_SHORT._replace(imu_rate_hz=10.0, gnss=URBAN_SHORT.gnss._replace(outages_s=()))
    rec = to_recording(simulate_jit(jax.random.key(1), what), what)
    filt = build("ekf15", states=states, cov_stride=5)
    begin = initialize(rec, filt.params("consumer"))
    params = begin.apply_to(filt.params("consumer"))
    params = params._replace(mounting=params.mounting._replace(lever_arm=jnp.zeros(3)))
    nav = jax.tree.map(lambda a: a[0], begin.navs)
    packed = ep.pack_recording(rec, GNSS, begin.t)
    windows = hidden_windows(packed, 5.0, 15.0, settle=10.0)
    found, record = drift(filt, params, nav, packed.epochs, windows, GNSS)
    (hidden,) = windows.hidden
    info = run_jit(filt, params, nav, prepare(filt, ep.hide(packed.epochs, hidden, GNSS)))
    lla = np.asarray(info.nav.pos)[windows.end]
    fix = np.asarray(packed.epochs.fix.value)[windows.end, :3]
    off = np.array([earth.enu_difference(a, b) for a, b in zip(lla, fix)])
    slow = np.asarray(info.nav.errors[RECEIVER_ERROR])[windows.end] if states else np.zeros_like(off)
    np.testing.assert_allclose(found, off + slow, atol=1e-5)
    assert np.abs(slow).max() > 0.05 or not states  # else nothing is tested
