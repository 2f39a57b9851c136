"""FilterSpec: equal by value, one filter of equal specs, and what a rule of one's own is applied to."""

import json

import pytest

from jaxnav.filters.catalogue import FILTERS, build, changed, with_history, with_states
from jaxnav.filters.core import make_filter
from jaxnav.filters.feedback import observer
from jaxnav.filters.papers.gpid import gpid
from jaxnav.filters.rules.kalman import kalman
from jaxnav.filters.rules.robust import gate, gate_params
from jaxnav.filters.run import require_params
from jaxnav.filters.spec import FilterSpec
from jaxnav.measurements import GNSS, MEASUREMENTS
from jaxnav.states.table import STATES

NAMES = ("position", "velocity", "nonholonomic")


def test_equal_fields_are_one_filter():
    filt = build("ekf15", list(NAMES), states=["gyro_scale"])
    assert build("ekf15", tuple(MEASUREMENTS[n] for n in NAMES), states=("gyro_scale",), frame="local_level") is filt
    assert build(filt.spec) is filt and changed(filt) is filt
    assert filt.spec == FilterSpec("ekf15", NAMES, ("gyro_scale",), frame="local_level")
    assert len({filt.spec, build(filt.spec).spec, FilterSpec("ekf15")}) == 2
    assert repr(FilterSpec("ekf9").replace(history=3)) == "FilterSpec(name='ekf9', history=3)"


@pytest.mark.parametrize("name", FILTERS)
def test_every_filter_has_a_spec_that_makes_it(name):
    filt = build(name)
    assert build(filt.spec) is filt and filt.name == name and filt.spec.frame == FILTERS[name].frame
    longer = changed(filt, history=9)
    assert changed(longer, history=2) is filt and longer.model is filt.model


def test_a_filter_that_is_composed_by_hand_has_any_history():
    made = build("ekf9").made
    filt = make_filter(*made)._replace(params=build("ekf9").params)
    longer = with_history(filt, 9)
    assert filt.spec is None and filt.name == "" and longer.made == made._replace(history=9)
    assert longer.params is filt.params and longer.step is build("ekf9", history=9).step


def test_further_states_and_those_that_a_measurement_needs():
    ranges = build("ekf15", ("position", "pseudorange", "range_rate"))
    assert set(ranges.spec.states) == set(ranges.model.states) - set(FILTERS["ekf15"].states) <= set(STATES)
    assert with_states(ranges, *ranges.model.states) is ranges
    assert with_states(ranges, "gyro_scale").model.states[-1] == "gyro_scale"


def test_a_rule_in_place_of_the_filters():
    """Kalman's is the filter itself; a gate is for the receiver's fixes alone, and its leaves are no catalogue's."""
    assert build("ekf15", NAMES, rule=kalman()).step is build("ekf15", NAMES).step
    gated = build("ekf15", rule=gate(kalman()))
    assert gated.step is build("ekf15_gate").step and gated.name == "" and gated.spec.name == "ekf15"
    assert build("ekf15_gate", rule=kalman()).step is build("ekf15").step
    assert build("ekf15_gate", rule=kalman()).params("consumer").rule == ()
    require_params(gated, gated.params("consumer", rule=gate_params()))
    assert build("ekf15", NAMES, rule=gpid()).step is not build("ekf15", rule=gpid()).step


def test_a_spec_is_text_for_json():
    spec = FilterSpec("ekf15", (GNSS[0], "velocity"), rule=kalman(), feedback=observer)
    known = spec.as_dict()
    assert json.loads(json.dumps(known)) == known
    assert known["measurements"] == ["position", "velocity"] and known["feedback"] == "observer"


def test_a_spec_and_further_arguments_are_refused():
    with pytest.raises(TypeError, match=r"spec\.replace"):
        build(FilterSpec("ekf15"), cov_stride=5)
    with pytest.raises(TypeError, match="stride"):
        FilterSpec("ekf15").replace(stride=5)
