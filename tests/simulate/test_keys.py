import itertools

import jax
import numpy as np

from jaxnav.simulate.keys import Purpose, run_key, run_keys


def test_no_two_purposes_share_a_stream():
    """Nor does a run's own sub-key (`simulate` folds small numbers into it) equal the key of any other run."""
    keys = {(p.name, i): run_key(7, p, i) for p, i in itertools.product(Purpose, range(8))}
    subs = {(*name, j): jax.random.fold_in(key, j) for name, key in keys.items() for j in range(5)}
    data = [tuple(np.asarray(jax.random.key_data(key))) for key in (*keys.values(), *subs.values())]
    assert len(set(data)) == len(data) == len(Purpose) * 8 * 6


def test_keys_side_by_side_are_those_of_the_runs():
    several = jax.random.key_data(run_keys(3, Purpose.TEST, np.arange(5, 8)))
    alone = [jax.random.key_data(run_key(3, Purpose.TEST, i)) for i in (5, 6, 7)]
    np.testing.assert_array_equal(several, np.stack(alone))
