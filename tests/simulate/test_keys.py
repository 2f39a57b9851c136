import itertools

import jax
import numpy as np

from jaxnav.simulate.keys import Purpose, run_key


def test_no_two_purposes_share_a_stream():
    """Nor does a run's own sub-key (`simulate` folds small numbers into it) equal the key of any other run."""
    keys = {(p.name, i): run_key(7, p, i) for p, i in itertools.product(Purpose, range(8))}
    subs = {(*name, j): jax.random.fold_in(key, j) for name, key in keys.items() for j in range(5)}
    data = [tuple(np.asarray(jax.random.key_data(key))) for key in (*keys.values(), *subs.values())]
    assert len(set(data)) == len(data) == 48 * 6
