"""The table of facts: what the paper says, within which limits, and what measures it."""

import math
from collections.abc import Callable, Mapping
from typing import Final, NamedTuple

from asi_analysis.loop.bench import Runner, Values, in_process
from asi_analysis.paper.facts import measures
from asi_analysis.paper.facts.conditions import Conditions
from asi_analysis.paper.facts.measures import Measured, onset_name
from asi_analysis.terminal import Progress, silent

GIVEN, FITTED, HELD_OUT = 'given', 'fitted', 'held out'


class Fact(NamedTuple):
    """
    One published fact: met if low <= simulated <= high.

    value: name of the measured value. role: 'given', the model is told it; 'fitted', the
    calibration aims at it; 'held out', it does not.
    """

    id: str
    value: str
    quantity: str
    section: str
    published: float
    unit: str
    low: float
    high: float
    role: str = FITTED

    @property
    def tolerance(self) -> str:
        """Say in words which values meet the fact."""
        if self.low == self.high:
            return f'exactly {self.low:g}'
        if math.isinf(self.high):
            return f'at least {self.low:.4g}'
        if math.isinf(self.low) or (self.low == 0.0 and self.high > self.low):
            return f'at most {self.high:.4g}'
        return f'{self.low:.4g} to {self.high:.4g}'

    def met(self, value: float) -> bool:
        return bool(self.low <= value <= self.high)


def _around(id_: str, value: str, quantity: str, section: str, published: float, unit: str,
            share: float, role: str = FITTED) -> Fact:
    return Fact(id_, value, quantity, section, published, unit,
                published * (1.0 - share), published * (1.0 + share), role)


def _onset(step: float) -> Fact:
    # Fig. 7, a straight line between the two frequencies that section 3.1 gives.
    published = 95.0 - 20.0 * step / 600.0
    return Fact('F8', onset_name(step, 'frequency_hz'),
                f'cycle frequency at onset, {step:.0f} N', '3.1, Fig. 7',
                published, 'Hz', published - 3.0, published + 3.0,
                HELD_OUT if step in (400.0, 500.0) else FITTED)


def _column(id_: str, name: str, words: str, rise: float, overshoot: tuple[float, float, float],
            settling: float, error: tuple[float, float, float]) -> tuple[Fact, ...]:
    """Return a column of Table 1: published values with 20 % each, or (published, low, high)."""
    return (
        _around(id_, f'{name}_rise_s', f'{words}: rise time 10 to 90 %', 'Table 1', rise, 's',
                0.2),
        Fact(id_, f'{name}_overshoot_percent', f'{words}: overshoot', 'Table 1', overshoot[0],
             '%', *overshoot[1:]),
        _around(id_, f'{name}_settling_s', f'{words}: settling time 2 %', 'Table 1', settling,
                's', 0.2),
        Fact(id_, f'{name}_error_n', f'{words}: steady-state error', 'Table 1', error[0], 'N',
             *error[1:]),
        Fact(id_, f'{name}_monotone', f'{words}: one rise: no spike, dip, creep or chatter',
             'Table 1',
             1.0, '', 1.0, 1.0),
    )


INFINITE: Final = math.inf

FACTS: Final[tuple[Fact, ...]] = (
    _around('F1', 'thrust_push_n', 'maximum thrust, pushing', '2.1, Fig. 4', 1000.0, 'N', 0.02,
            GIVEN),
    _around('F1', 'thrust_pull_n', 'maximum thrust, pulling', '2.1, Fig. 4', 1000.0, 'N', 0.02,
            GIVEN),
    Fact('F1', 'characteristic_bend_percent', 'bend of the characteristic before it saturates',
         '2.2, Fig. 4', 0.0, '% of thrust', 0.0, 1.0, GIVEN),
    _around('F2', 'coulomb_n', 'Coulomb friction', '2.2', 7.0, 'N', 0.03, GIVEN),
    _around('F2', 'stiction_push_n', 'stiction, pushing', '2.2', 27.0, 'N', 0.03, GIVEN),
    _around('F2', 'stiction_pull_n', 'stiction, pulling', '2.2', 15.0, 'N', 0.03, GIVEN),
    Fact('F3', 'linear_order', 'order of the linear part', '2.2', 10.0, '', 10.0, 10.0, GIVEN),
    Fact('F3', 'linear_delays', 'delays of the linear part', '2.2', 2.0, '', 2.0, 2.0,
         GIVEN),
    _around('F3', 'fluid_corner_hz', 'bandwidth of the fluid dynamics', '4.1', 1000.0, 'Hz', 0.1,
            GIVEN),
    Fact('F3', 'fluid_phase_deg', 'phase lag of the fluid at 400 Hz', '4.1', 0.0, 'deg',
         0.0, 25.0, GIVEN),
    Fact('F4', 'open_loop_bandwidth_hz', 'open-loop bandwidth', '2.2', 20.0, 'Hz', 18.0, 22.0),
    Fact('F5', 'closed_loop_bandwidth_hz', 'closed-loop bandwidth, small sine', '2.2', 100.0,
         'Hz', 90.0, 110.0),
    Fact('F5', 'closed_loop_bandwidth_fall_percent', 'its fall at the largest sine', '2.2', 10.0,
         '%', 10.0, INFINITE),
    Fact('F6', 'cycle_frequency_hz', 'frequency of the cycle at high gain', '3.1, Fig. 6', 90.0,
         'Hz', 86.0, 94.0),
    Fact('F6', 'cycle_thd_percent', 'its harmonic distortion', '3.1, Fig. 6', 0.0, '%', 0.0, 6.0),
    Fact('F7', 'cycle_frequency_spread_percent', 'same cycle after pushes and from other starts: '
         'frequency', '3.1', 0.0, '%', 0.0, 1.0, role=HELD_OUT),
    Fact('F7', 'cycle_amplitude_spread_percent', 'same cycle after pushes and from other starts: '
         'amplitude', '3.1', 0.0, '%', 0.0, 3.0, role=HELD_OUT),
    Fact('F7', 'cycle_peak_valve_percent', 'largest valve opening in the cycle', '4.2', 0.0,
         '% of full', 0.0, 90.0),
    *(_onset(step) for step in Conditions().onset_steps_n),
    Fact('F8', 'onset_least_rise_percent', 'least rise of the onset gain from step to step',
         '3.1, Fig. 7', 0.0, '%', 0.0, INFINITE),
    Fact('F8', 'onset_rise_percent', 'rise of the onset gain from 0 to 600 N', '3.1, Fig. 7', 8.0,
         '%', 8.0, INFINITE),
    _around('F9', 'predicted_onset_gain', 'first intersection of the Nyquist plot, gain',
            '4.1, Fig. 9', 8.0, 'N/N', 0.05),
    _around('F9', 'predicted_onset_frequency_hz', 'first intersection, frequency', '4.1, Fig. 9',
            130.0, 'Hz', 0.05),
    Fact('F10', 'predicted_frequency_fall_percent', 'fall of that frequency to Kp = 15', '4.1',
         10.0, '%', 10.0, INFINITE),
    Fact('F10', 'predicted_highest_gain', 'gain up to which a stable cycle is predicted', '4.1',
         15.0, 'N/N', 15.0, INFINITE),
    Fact('F10', 'predicted_monotone', 'frequency falls and amplitude rises all the way', '4.1',
         1.0, '', 1.0, 1.0),
    Fact('F11', 'prediction_frequency_ratio', 'predicted over simulated frequency, worst', '4.2',
         1.0, '', 0.0, 2.0),
    Fact('F11', 'prediction_amplitude_ratio', 'predicted over simulated amplitude, Kp = 15',
         '4.2', 1.0, '', 1.0, INFINITE),
    Fact('F11', 'undamped_amplitude_ratio', 'simulated amplitude without over with damping, '
         'Kp = 15', '4.2', 1.0, '', 1.0, INFINITE),
    Fact('F12', 'linear_onset_ratio', 'onset with friction and damping alone, over onset',
         '4.1, Fig. 8', 2.0, '', 2.0, INFINITE),
    Fact('F13', 'no_hysteresis_onset_ratio', 'onset without hysteresis, over onset', '4.2', 1.5,
         '', 1.5, INFINITE, role=HELD_OUT),
    *_column('F14', 'proportional', 'P, Kp = 3', 0.04, (20.0, 16.0, 24.0), 0.18, (6.0, 4.8, 7.2)),
    *_column('F15', 'lead_lag', 'lead-lag', 0.01, (14.0, 11.2, 16.8), 0.08, (2.0, 0.0, 2.0)),
    *_column('F16', 'lead4', 'fourth-order lead', 0.007, (0.0, 0.0, 2.0), 0.04, (0.0, 0.0, 0.5)),
    Fact('F17', 'damping_largest_n', 'largest damping force of the family', '4.1, Fig. 3',
         1200.0, 'N', 960.0, 1200.0, HELD_OUT),
    Fact('F17', 'damping_exponent', 'damping rises as this power of the velocity, valve closed',
         '2.2, Fig. 3', 1.0, '', 1.2, INFINITE),
    Fact('F17', 'damping_taper', 'slope at 1 m/s over the steepest', '2.2, Fig. 3', 0.0, '',
         0.0, 0.5, HELD_OUT),
    Fact('F17', 'damping_spread', 'velocity of half the damping, largest over least of the family',
         '2.2, Fig. 3', 1.0, '', 1.1, INFINITE, HELD_OUT),
    Fact('F18', 'error_within_loop_n', 'error at Kp = 3 that hysteresis and friction can hide',
         '2.2, Table 1', 6.0, 'N', 4.8, 12.0),
)



def closed_loop_groups(actuator: Values, conditions: Conditions, gains: Measured,
                       runner: Runner) -> dict[str, Callable[[], Measured]]:
    """
    Return the measurements that are single runs of the loop: the nodes can make them too.

    gains: holds the onset gains, by the time that a group is called.
    """
    def table_1() -> Measured:
        return {key: value for name in ('proportional', 'lead_lag', 'lead4')
                for key, value in measures.step_test(
                    actuator, conditions, getattr(conditions, name), name, runner).items()}

    return {
        'Table 1': table_1,
        'frequency at the onset': lambda: measures.onset_frequencies(
            actuator, conditions, gains, runner),
        'the cycle': lambda: measures.high_gain_cycle(
            actuator, conditions, gains[onset_name(conditions.cycle_step_n, 'gain')], runner),
    }


def measure(actuator: Values, conditions: Conditions | None = None,
            report: Progress = silent) -> Measured:
    """
    Return every value of the table, measured on the simulator.

    actuator: parameters by name, the rest at their defaults; report: told what is going on.
    """
    conditions = conditions or Conditions()
    measured: Measured = {}

    def gain() -> float:
        return measured[onset_name(conditions.cycle_step_n, 'gain')]

    groups: Mapping[str, Callable[[], Measured]] = {
        'slow tests': lambda: measures.static(actuator, conditions),
        'linear part': lambda: measures.linear(actuator),
        'damping': lambda: measures.damping(actuator),
        'describing function': lambda: measures.describing(actuator),
        'bandwidths': lambda: measures.bandwidths(actuator, conditions),
        'onset of the cycle': lambda: measures.onsets(actuator, conditions),
        'its rise': lambda: measures.onset_rise(measured, conditions),
        **closed_loop_groups(actuator, conditions, measured, in_process),
        'pushes and starts': lambda: measures.same_cycle(actuator, conditions, gain()),
        'without hysteresis': lambda: {
            'linear_onset_ratio': measures.free_onset(
                actuator, conditions, measures.HYSTERESIS_AS_GAIN, gain(), 3.0),
            'no_hysteresis_onset_ratio': measures.free_onset(
                actuator, conditions, measures.NO_HYSTERESIS, gain(), 3.0)},
        'prediction against simulation': lambda: measures.prediction_error(
            actuator, conditions, gain()),
    }
    for done, (name, group) in enumerate(groups.items()):
        report(name, done / len(groups))
        measured.update({key: float(value) for key, value in group().items()})
    return measured
