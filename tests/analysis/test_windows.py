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
def test_drift_is_that_of_the_written_position(states):
    """Antenna of the reported position and attitude less the fix, whether the filter estimates the receiver or not."""
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
    np.testing.assert_allclose(found, [earth.enu_difference(a, b) for a, b in zip(lla, fix)], atol=1e-6)
    if states:
        estimate = np.asarray(info.nav.errors[RECEIVER_ERROR])[windows.end]
        np.testing.assert_allclose(record.slow[windows.phase, windows.end], estimate, rtol=1e-4)
        assert np.abs(estimate).max() > 0.05  # else nothing is tested
