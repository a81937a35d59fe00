"""The experiments of `asi demo`, and the measures of their limit cycle and hysteresis loop."""

from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from asi_analysis.bags.run import Run
from asi_analysis.experiments.experiment import Experiment
from asi_analysis.loop.bench import step_experiment
from asi_analysis.measures.sinusoids.sinusoid import fit
from asi_analysis.paper.facts.conditions import Conditions, StepTest


class Published(NamedTuple):
    """One figure of the paper's Table 1, as printed and as a number."""

    quantity: str
    key: str        # of `asi analyze`
    unit: str       # of both figures
    scale: float    # from the key's unit to this one
    words: str
    value: float


class DemoRun(NamedTuple):
    """One run of the demo."""

    name: str
    title: str
    experiment: Experiment
    published: tuple[Published, ...] = ()


class Recorded(NamedTuple):
    """A completed run: its experiment, its bag, the recording and its analysis."""

    plan: DemoRun
    experiment: Experiment   # with every parameter
    bag: Path
    run: Run
    analysis: dict[str, Any]


def _row(rise_ms: float, overshoot: float, settling_ms: float, error: tuple[str, float]
         ) -> tuple[Published, ...]:
    return (Published('rise time 10-90 %', 'rise_time_s', 'ms', 1e3, f'{rise_ms:g}', rise_ms),
            Published('overshoot', 'overshoot_percent', '%', 1.0, f'{overshoot:g}', overshoot),
            Published('settling time', 'settling_time_2_s', 'ms', 1e3, f'{settling_ms:g}',
                      settling_ms),
            Published('steady-state error', 'steady_state_error_n', 'N', 1.0, *error))


def _step(test: StepTest) -> Experiment:
    return step_experiment(test.load, test.controller, test.amplitude_n, 0.8)


# The paper does not say on which loads and with which steps Table 1 was measured; these are the
# conditions under which `asi reproduce` measures it.
TABLE_1: Final = Conditions()
PADDED: Final = 8   # times the samples: length of the transform of a spectrum
RUNS: Final = (
    DemoRun('proportional', 'Proportional, Kp = 3', _step(TABLE_1.proportional),
            _row(40, 20, 180, ('6', 6.0))),
    DemoRun('lead_lag', 'Lead-lag', _step(TABLE_1.lead_lag), _row(10, 14, 80, ('< 2', 2.0))),
    DemoRun('lead4', 'Fourth-order lead', _step(TABLE_1.lead4), _row(7, 0, 40, ('≪ 2', 2.0))),
    # Locked piston, as for the paper's Fig. 7; the step starts the cycle.
    DemoRun('limit_cycle', 'Limit cycle, Kp = 8', Experiment(
        {}, {'gain': 8.0, 'reference.shape': 'step', 'reference.amplitude': 100.0}, 1.0)),
    # Little feedback and a slow command: the response of the valve alone.
    DemoRun('hysteresis', 'Valve hysteresis, slow sine', Experiment(
        {}, {'gain': 1e-3, 'reference.shape': 'sine', 'reference.amplitude': 60.0,
             'reference.frequency': 0.5, 'reference.start': 0.0}, 4.0, rate_hz=500.0)),
)


class Cycle(NamedTuple):
    """A limit cycle in the steady part of a run."""

    frequency_hz: float
    amplitude_n: float
    distortion: float                       # of the force, share of the fundamental
    opening: float                          # of the valve, largest, share of the full one
    command_n: float                        # largest
    harmonics: list[tuple[float, float]]    # Hz, N
    spectrum: tuple[np.ndarray, np.ndarray]  # Hz, N
    steady: np.ndarray                      # n, whether the sample belongs to that part


def limit_cycle(recorded: Recorded, frequency_hz: float) -> Cycle:
    """Return frequency, amplitude and distortion of the cycle in a run's second half."""
    run = recorded.run
    steady = run.time_s >= 0.5 * run.time_s[-1]
    time, force = run.time_s[steady], run.signal('force')[steady]
    # All harmonics together: one by one, the fundamental would leak into the weak ones.
    found = fit(time, force, frequency_hz)
    assert found is not None   # the run has the samples of tens of cycles
    harmonics = [(k * found.frequency_hz, abs(size)) for k, size in enumerate(found.harmonics, 1)]
    window = np.hanning(time.size)
    count = PADDED * time.size   # so that a line between two bins has its height
    amplitude = 2.0 * np.abs(np.fft.rfft((force - force.mean()) * window, count)) / window.sum()
    full = float(recorded.experiment.actuator['valve_characteristic.full_opening'])
    return Cycle(frequency_hz, found.amplitude, found.thd,
                 float(np.abs(run.signal('valve_position')[steady]).max()) / full,
                 float(np.abs(run.signal('command')[steady]).max()), harmonics,
                 (np.fft.rfftfreq(count, run.period_s), amplitude), steady)


class Loop(NamedTuple):
    """The loop of valve position against command, over the last whole period of a slow sine."""

    command_n: np.ndarray
    valve_position_m: np.ndarray
    slope_m_n: float
    offset_m: float
    width_n: float     # distance of the branches at the middle
    lag_n: float       # the part of it due to the coil's lag at this frequency


def hysteresis_loop(recorded: Recorded) -> Loop:
    """Return the loop of a run with a sine reference."""
    run, values = recorded.run, recorded.experiment
    frequency = float(values.controller['reference.frequency'])
    period = round(run.rate_hz / frequency)
    command, valve = (run.signal(name)[-period:] for name in ('command', 'valve_position'))
    slope, offset = np.polyfit(command, valve, 1)
    # Command at which each branch crosses the middle.
    rising = np.gradient(command) > 0
    crossings = [np.interp(offset, np.sort(valve[branch]), np.sort(command[branch]))
                 for branch in (rising, ~rising)]
    lag_s = 1.0 / (2.0 * np.pi * float(values.actuator['valve_flexure.coil_frequency']))
    lag_s += float(values.actuator['valve_flexure.delay'])
    lag_n = 2.0 * np.ptp(command) / 2.0 * 2.0 * np.pi * frequency * lag_s
    return Loop(command, valve, float(slope), float(offset),
                float(crossings[0] - crossings[1]), float(lag_n))


def scaled(analysis: dict[str, Any], entry: Published) -> float | None:
    """Return the simulated figure in the unit of the published one."""
    value = analysis[entry.key]
    return None if value is None else value * entry.scale
