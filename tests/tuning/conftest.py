"""A recording in town, a filter and a job that tests of tuning share."""

import jax
import pytest

from jaxnav.filters import epochs as ep
from jaxnav.filters.catalogue import build
from jaxnav.filters.lanes import padded_shape, ready
from jaxnav.initialization.initialize import initialize
from jaxnav.measurements import GNSS
from jaxnav.simulate.scenarios import URBAN_SHORT
from jaxnav.simulate.simulation import simulate_jit, to_recording
from tuning.recordings import priors
from tuning.recordings.evidence import Evidence
from tuning.recordings.parts import Used, parts_of, plan, window_of, windows_of


@pytest.fixture(scope="module")
def rec():
    """Two minutes in town; the receiver states a third of its sd."""
    gnss = URBAN_SHORT.gnss._replace(outages_s=(), position_sd_m=(0.5, 0.5, 1.0), velocity_sd_mps=(0.05, 0.05, 0.08))
    what = URBAN_SHORT._replace(duration_s=130.0, imu_rate_hz=20.0, gnss_rate_hz=1.0, gnss=gnss)
    made = to_recording(simulate_jit(jax.random.key(4), what), what)
    return made._replace(aiding={name: s._replace(sd=s.sd / 3) for name, s in made.aiding.items()})


@pytest.fixture(scope="module")
def ekf():
    return build("ekf15", cov_stride=5, history=9)  # what `tune` takes for this recording: one program for both


@pytest.fixture(scope="module")
def job(rec, ekf):
    begin = initialize(rec, ekf.params("adis16465"))
    datasheet = begin.apply_to(ekf.params("adis16465"))
    packed = ep.pack_recording(rec, GNSS, begin.t)
    layout = plan(packed, window_of([packed]))
    windows = windows_of(packed, layout, padded_shape(packed.epochs)[0])
    nav = jax.tree.map(lambda a: a[0], begin.navs)
    spec, parts = priors.spec_of(ekf, datasheet, ("noise", "fixes")), parts_of(layout, windows)

    def use(packed=packed):
        epochs = ready(ekf, datasheet, nav, packed.epochs)
        return Used("town", begin, datasheet, nav, packed, epochs, layout, windows, parts, rec.truth)

    def make(packed=packed):
        return Evidence(ekf, spec, [use(packed)])

    make.use, make.spec = use, spec
    return make, packed, layout
