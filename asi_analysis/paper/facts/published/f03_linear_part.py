"""F3: a linear part of 10th order with two delays; fluid of about 1,000 Hz."""

from asi_analysis.loop.linear_model import fluid_phase_deg, linear_model
from asi_analysis.paper.facts.fact import Fact, Measured, Role, Row, Setup, around


def measure(setup: Setup) -> Measured:
    model = linear_model(setup.actuator)
    return {'linear_order': float(model.denominator.size - 1),
            'linear_delays': float(sum(delay > 0.0 for delay in model.delays_s)),
            'fluid_corner_hz': float(setup.record()['fluid_dynamics_frequency']),
            'fluid_phase_deg': fluid_phase_deg(setup.actuator, 400.0)}


FACT = Fact(
    'F3',
    (Row('linear_order', 'order of the linear part', '2.2', 10.0, '', 10.0, 10.0, Role.GIVEN),
     Row('linear_delays', 'delays of the linear part', '2.2', 2.0, '', 2.0, 2.0, Role.GIVEN),
     around('fluid_corner_hz', 'bandwidth of the fluid dynamics', '4.1', 1000.0, 'Hz', 0.1,
            Role.GIVEN),
     Row('fluid_phase_deg', 'phase lag of the fluid at 400 Hz', '4.1', 0.0, 'deg', 0.0, 25.0,
         Role.GIVEN)),
    measure,
    lambda _: 'piston locked, small motion about rest, hysteresis as a gain',
    'poles and zeros of the linearised model')
