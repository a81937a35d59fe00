"""What each row of the table says about how it was measured: conditions and method, in words."""

from asi_actuator.parameters import as_record
from asi_analysis.loop.bench import RATE_HZ, Values
from asi_analysis.paper.facts.conditions import Conditions, StepTest
from asi_controller.compensator import design


def _spring(actuator: Values) -> str:
    p = as_record(actuator)
    return (f'spring {p["load_stiffness"]:.3g} N/m, {p["load_mass"]:.3g} kg, '
            f'{p["load_damping"]:.3g} N s/m')


def _controller(test: StepTest, feedforward: float) -> str:
    gain = design({**test.controller}).gain
    others = ', '.join(f'{name} {value:.4g}' for name, value in test.controller.items()
                       if name not in ('compensator', 'gain') and isinstance(value, float))
    return (f'{test.controller["compensator"]}, gain {gain:.4g}'
            + (f', {others}' if others else '') + f', feed-forward {feedforward:g}')


def stated(actuator: Values, conditions: Conditions) -> dict[str, tuple[str, str]]:
    """Return conditions and method by the id of the fact."""
    loop = f'piston locked, P with feed-forward {conditions.feedforward:g}, {RATE_HZ:g} Hz'
    step = 'stepinfo measures of asi analyze on the force'
    cycle = (f'{loop}; step of {conditions.cycle_step_n:g} N, {conditions.cycle_gain:g} times '
             'the onset gain')
    prediction = 'harmonic balance, 1 + Kp H S N = 0, with the describing function of the ' \
                 'hysteresis alone; valve, static gain and sensor linear, fluid a gain'
    texts = {
        'F1': ('piston locked, friction off; slow ramp of the valve command',
               'force against valve position; straight line fitted below 97 % of the opening'),
        'F2': ('valve closed; piston moved at a prescribed speed',
               'stiction: largest force of a slow motion; Coulomb: force when sliding, '
               'less that without friction'),
        'F3': ('piston locked, small motion about rest, hysteresis as a gain',
               'poles and zeros of the linearised model'),
        'F4': (f'piston locked, open loop, sines of {conditions.open_loop_amplitude_n:g} N',
               'gain of the fundamental, 3 dB below that at 2 Hz'),
        'F5': (f'{loop}; Kp = 3, sines of {conditions.small_amplitude_n:g} and '
               f'{conditions.large_amplitude_n:g} N',
               'gain of the fundamental, 3 dB below that at 5 Hz'),
        'F6': (cycle, 'fundamental and harmonics 2 to 9 over whole periods'),
        'F7': (f'{cycle}; pushes of +-400 and 800 N for 30 ms, starts from +-600 N',
               'fundamental over whole periods'),
        'F8': (f'{loop}; steps from rest; to 0 N, a step back from {conditions.start_n:g} N',
               f'least gain with a sustained cycle, by bisection to '
               f'{100.0 * conditions.onset_accuracy:g} %'),
        'F9': ('as section 4.1', prediction),
        'F10': ('as section 4.1, gains up to 15', prediction),
        'F11': (f'{loop}; step of {conditions.cycle_step_n:g} N, gains up to 15',
                'that prediction against simulated cycles; without: damping and friction off'),
        'F12': (f'{loop}; hysteresis and static characteristic as gains, step of '
                f'{conditions.cycle_step_n:g} N', 'least gain with a sustained cycle, up to 3 '
                'times'),
        'F13': (f'{loop}; hysteresis off, step of {conditions.cycle_step_n:g} N',
                'least gain with a sustained cycle, up to 3 times'),
        'F17': ('piston moved at prescribed speeds up to 1 m/s at five valve positions, '
                'friction off', 'force lost against that at rest'),
        'F18': (f'piston locked, open loop, slow triangle of '
                f'{conditions.open_loop_amplitude_n:g} N',
                'half width of the loop over 1 + Kp G at Kp = 3'),
    }
    for id_, name in (('F14', 'proportional'), ('F15', 'lead_lag'), ('F16', 'lead4')):
        test: StepTest = getattr(conditions, name)
        load = ('piston locked' if test.load['load.type'] == 'locked'
                else _spring({**actuator, **test.load}))
        texts[id_] = (f'{load}; {_controller(test, conditions.feedforward)}, '
                      f'{RATE_HZ:g} Hz; step of {test.amplitude_n:g} N', step)
    return texts
