"""Effects in another form than the diagnosis': a machine of its own equations, in 20 us steps."""

import math

import numba
import numpy as np
import pytest

from asi_analysis.bags.run import Run
from asi_analysis.gap.diagnose import diagnose
from asi_analysis.gap.document import document

PERIOD_S, SUB_STEPS = 1e-3, 50
MASS, STIFFNESS, DAMPER = 2.0, 1e5, 150.0       # kg, N/m, N s/m: of the load
FULL_OPENING, THRUST = 2e-5, 1000.0             # m, N
NOMINAL = {'load.type': 'spring', 'load.mass': 1.1 * MASS, 'load.stiffness': 0.93 * STIFFNESS,
           'load.damping': 1.1 * DAMPER, 'force_sensor.model': 'off',
           'fluid_dynamics.model': 'off', 'force_sensor.mass_share': 0.0,
           'friction.model': 'off',
           'hydraulic_damping.model': 'linear', 'hydraulic_damping.linear_gain': 370.0,
           'valve_characteristic.model': 'off',
           'valve_characteristic.full_opening': FULL_OPENING,
           'valve_characteristic.maximum_force': 1.08 * THRUST}


@numba.njit(cache=True)
def _machine(opening, bias, viscous, exponent, oil, gap, out):
    """Put force, position and velocity of a machine whose valve opens so far into out (3 x n)."""
    step = PERIOD_S / SUB_STEPS
    before = MASS if gap == 0.0 else 0.4 * MASS
    x, v, y, w, felt = 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(opening.size):
        out[0, k], out[1, k], out[2, k] = felt, x, v
        for j in range(SUB_STEPS):
            after = opening[min(k + 1, opening.size - 1)]
            z = opening[k] + (j + 1.0) / SUB_STEPS * (after - opening[k]) + bias
            felt = (THRUST * z / FULL_OPENING - 400.0 * v - oil * math.tanh(v / 0.1)
                    - math.copysign(viscous * abs(v) ** exponent, v))
            if gap == 0.0:
                v += step / before * (felt - STIFFNESS * x - DAMPER * v)
            else:
                touch = min(max(x - y, -gap), gap)
                push = 4e6 * (x - y - touch) + (600.0 * (v - w) if touch != x - y else 0.0)
                v += step / before * (felt - push)
                w += step / (MASS - before) * (push - STIFFNESS * y - DAMPER * w)
                y += step * w
            x += step * v


def recorded(bias: float = 0.0, viscous: float = 0.0, exponent: float = 1.0, oil: float = 0.0,
             gap: float = 0.0) -> Run:
    """Return 6 s of the machine under steps and sines, with noise."""
    rng = np.random.default_rng(4)
    time = PERIOD_S * np.arange(6000)
    steps = np.convolve(np.repeat(rng.uniform(-0.3, 0.3, 30), 200), np.ones(20) / 20, 'same')
    sines = sum(np.sin(2.0 * np.pi * f * time) for f in (2.3, 11.0, 31.0))
    opening = FULL_OPENING * (steps + 0.06 * sines)
    out = np.empty((3, time.size))
    _machine(opening, bias, viscous, exponent, oil, gap, out)
    noise = rng.normal(size=(4, time.size))
    return Run(time, force_n=out[0] + noise[0], valve_position_m=opening + 2e-8 * noise[1],
               position_m=out[1] + 1e-6 * noise[2], velocity_m_s=out[2] + 5e-4 * noise[3],
               source='machine')


@pytest.mark.parametrize(('changed', 'effect', 'sizes'), [
    ({'viscous': 700.0, 'exponent': 1.2}, 'viscous_friction', {'viscous_exponent': 1.2}),
    pytest.param({'oil': 500.0}, 'hydraulic_damping', {}, marks=pytest.mark.slow),
    ({'bias': 0.1 * FULL_OPENING}, 'valve_bias', {'orifice_bias': 0.1 * FULL_OPENING}),
    ({'gap': 1e-4}, 'backlash', {'backlash': 1e-4, 'piston_share': 0.4})])
@pytest.mark.filterwarnings('ignore:without command')
def test_form_of_another_machine_is_named(changed, effect, sizes):
    answer = document(diagnose([recorded(**changed)], NOMINAL))
    assert answer['verdict'] == effect, answer['ambiguity_set']
    found = answer['which'][0]['parameters']
    assert {name: found[name] for name in sizes} == pytest.approx(sizes, rel=0.08)
