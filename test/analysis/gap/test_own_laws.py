"""A linear nominal model: the simulator's own laws are asked first (own_laws.py)."""

import dataclasses

import numpy as np
import pytest
from test_gap import TEXTBOOK, recorded

from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.inference.bounded_least_squares import least_step
from asi_analysis.gap.model.simulator import has_linear_laws


@pytest.mark.parametrize(('changed', 'effect'), [
    ({'valve_hysteresis__model': 'full', 'valve_hysteresis__radius': 4.0,
      'valve_hysteresis__lag_time': 0.0, 'valve_hysteresis__rounding': 0.5,
      'valve_hysteresis__saturation': 1e6}, 'valve_hysteresis'),
    ({'fluid_dynamics__air_time': 3e-4, 'fluid_dynamics__air_force': 200.0}, 'entrained_air'),
])
def test_small_effect_is_found_beside_parameters_that_are_off(changed, effect):
    run = recorded(**changed)
    assert diagnose([run], TEXTBOOK).verdict == (effect,)
    # Block by block, half a per cent of the signal counts as model error.
    assert diagnose([run], TEXTBOOK, simulate=False).verdict == ()


def test_what_no_law_explains_is_unknown():
    run = recorded()
    ripple = 6.0 * np.sin(2.0 * np.pi * run.position_m / 3e-4)
    assert diagnose([dataclasses.replace(run, force_n=run.force_n + ripple)],
                    TEXTBOOK).verdict == ('unknown',)


def test_only_a_wholly_linear_model_has_one_formulation():
    assert has_linear_laws(TEXTBOOK)
    assert not has_linear_laws({**TEXTBOOK, 'friction.model': 'full'})
    assert not has_linear_laws({})


def test_step_of_a_parameter_without_influence_stays_within_its_bounds():
    step, _ = least_step(np.diag([1.0, 0.0]), np.array([-0.5, 0.0]), np.full(2, -0.3),
                         np.full(2, 0.3))
    assert (np.abs(step) <= 0.3).all()
