"""
`python -m bench.limit_cycle_verdicts [--count 100 --seed 1]`: the verdicts on synthetic signals.

Sines for the accuracy, relative to the Cramér-Rao bound; families of signals for the verdicts.
Printed: a JSON document with `accuracy`, `verdicts` and `robustness`.
"""

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, Final

import numpy as np
from scipy import signal
from scipy.integrate import solve_ivp

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.limit_cycle.detection.agreement import judge_run
from asi_analysis.limit_cycle.detection.verdict import Segment
from asi_analysis.measures.sinusoids.sinusoid import fit

Random = np.random.Generator

# Least confidence of a verdict that must survive changes of the record, and for one of how many
# signals that is checked.
SURE: Final = 0.9
CHANGED: Final = 5


def cramer_rao(time_s: Array, frequency_hz: float, amplitude: float, phase: float,
               noise: float) -> tuple[float, float]:
    """Return the Cramér-Rao bounds of frequency (Hz) and amplitude in white noise on a drift."""
    t = time_s - time_s.mean()
    angle = 2.0 * np.pi * frequency_hz * t + phase
    jacobian = np.column_stack([-amplitude * 2.0 * np.pi * t * np.sin(angle),
                                -amplitude * np.sin(angle), np.cos(angle), np.ones(len(t)), t])
    bound = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian))) * noise
    return float(bound[0]), float(bound[2])


def check_accuracy(cycles: float, samples_a_cycle: float, snr_db: float, count: int,
                   seed: int) -> dict[str, float]:
    """
    Return rms errors over the Cramér-Rao bound, and coverage of the 95 % intervals.

    Sines of amplitude 1 on a drifting mean, a tenth of the samples missing.
    """
    random = np.random.default_rng(seed)
    errors, covered = [], []
    noise = np.sqrt(0.5 / 10.0 ** (snr_db / 10.0))
    for _ in range(count):
        frequency = 10.0 ** random.uniform(-1.0, 2.0)
        t = np.arange(int(cycles * samples_a_cycle)) / (frequency * samples_a_cycle)
        if len(t) > 20:
            t = t[random.random(len(t)) > 0.1]
        phase = random.uniform(0.0, 2.0 * np.pi)
        centred = t - t.mean()
        y = (np.cos(2.0 * np.pi * frequency * centred + phase) + 3.0
             + random.normal() * centred / np.ptp(t) + noise * random.standard_normal(len(t)))
        found = fit(t, y)
        assert found is not None
        bound = cramer_rao(t, frequency, 1.0, phase, noise)
        errors.append([(found.frequency_hz - frequency) / bound[0],
                       (found.amplitude - 1.0) / bound[1]])
        low, high = found.interval('frequency_hz')
        least, most = found.interval('amplitude')
        covered.append([low < frequency < high, least < 1.0 < most])
    rms, share = np.sqrt(np.mean(np.square(errors), axis=0)), np.mean(covered, axis=0)
    return {'cycles': cycles, 'samples_a_cycle': samples_a_cycle, 'snr_db': snr_db,
            'frequency_error_over_bound': float(rms[0]),
            'amplitude_error_over_bound': float(rms[1]),
            'frequency_coverage': float(share[0]), 'amplitude_coverage': float(share[1])}


def _noisy(y: Array, random: Random) -> Array:
    """Return the signal with 15 to 40 dB of white noise."""
    size = np.std(y) * 10.0 ** (-random.uniform(15.0, 40.0) / 20.0)
    return y + size * random.standard_normal(len(y))


def undriven(t: Array, force: Array, command: Array | None = None) -> Run:
    """Return a run of a loop whose reference rests."""
    return Run(t, np.zeros(len(t)), command, force)


def _oscillator(random: Random, mu: float, cubic: float, start: float, settle: float,
                fewest_cycles: float = 10.0) -> Run:
    """Return a run of x'' = mu (1 - x²) x' - x - cubic x³, up to 100 cycles, from x = `start`."""
    cycles = random.uniform(fewest_cycles, 100.0)
    t: Array = np.linspace(0.0, 2.0 * np.pi * cycles, int(cycles * random.uniform(12.0, 60.0)))
    solution = solve_ivp(
        lambda _, x: [x[1], mu * (1.0 - x[0] ** 2) * x[1] - x[0] - cubic * x[0] ** 3],
        (-settle, t[-1]), [start, 0.0], t_eval=t, rtol=1e-7, atol=1e-8)
    return undriven(t, _noisy(solution.y[0], random))


def van_der_pol(random: Random) -> Run:
    """Return a Van der Pol oscillator on its cycle."""
    mu = random.uniform(0.1, 3.0)
    return _oscillator(random, mu, 0.0, 2.0, 50.0 + 20.0 / mu)


def van_der_pol_approach(random: Random) -> Run:
    """Return a Van der Pol oscillator that approaches its cycle from inside or outside."""
    return _oscillator(random, random.uniform(0.2, 0.5), 0.0, random.choice([0.05, 6.0]), 0.0,
                       40.0)


def duffing(random: Random) -> Run:
    """Return a self-excited oscillator with a hardening spring on its cycle."""
    mu = random.uniform(0.1, 1.0)
    return _oscillator(random, mu, random.uniform(0.1, 2.0), 2.0, 50.0 + 20.0 / mu)


def duffing_decay(random: Random) -> Run:
    """Return a damped oscillator with a hardening spring: frequency falls with amplitude."""
    damping, cubic = 10.0 ** random.uniform(-2.3, -1.3), random.uniform(0.1, 2.0)
    cycles = random.uniform(10.0, 60.0)
    t: Array = np.linspace(0.0, 6.0 * cycles, int(cycles * random.uniform(12.0, 60.0)))
    solution = solve_ivp(lambda _, x: [x[1], -2 * damping * x[1] - x[0] - cubic * x[0] ** 3],
                         (0.0, t[-1]), [2.0, 0.0], t_eval=t, rtol=1e-7, atol=1e-8)
    return undriven(t, _noisy(solution.y[0], random))


def third_order_loop(random: Random, drive: Callable[[float, float], float], settle: int) -> Run:
    """Return 1/(s + 1)³ in feedback with `drive(error, last drive)`: 10 to 60 cycles of 3.6 s."""
    step, count = 0.01, int(random.uniform(10.0, 60.0) * 363)
    x = np.array([0.1, 0.0, 0.0])
    force, command = np.empty(count + settle), np.empty(count + settle)
    u = 1.0
    for k in range(count + settle):
        u = drive(-x[2], u)
        x = x + step * np.array([u - x[0], x[0] - x[1], x[1] - x[2]])
        force[k], command[k] = x[2], u
    every = int(random.integers(1, 20))
    t = np.arange(count, dtype=np.float64)[::every] * step
    return undriven(t, _noisy(force[settle:], random)[::every], command[settle:][::every])


def relay(random: Random) -> Run:
    """Return a loop with a relay, with or without hysteresis."""
    width = random.uniform(0.0, 0.1)
    return third_order_loop(
        random, lambda e, u: 1.0 if e > width else -1.0 if e < -width else u, 2000)


def saturated(random: Random) -> Run:
    """Return an unstable linear loop whose command saturates."""
    gain = random.uniform(9.0, 20.0)
    return third_order_loop(random, lambda e, _: float(np.clip(gain * e, -1.0, 1.0)), 10_000)


def linear_loop(random: Random, visible: bool) -> Run:
    """
    Return a linear loop just inside its stability limit.

    visible: its decay rate is 5 to 50 standard deviations of the estimate; otherwise 0 to 1.
    """
    cycles = random.uniform(5.0, 100.0)
    rate_hz = random.uniform(8.0, 60.0)
    t = np.arange(int(cycles * rate_hz)) / rate_hz
    snr = 10.0 ** random.uniform(1.5, 4.0)
    least = np.sqrt(12.0 / (len(t) * snr)) / t[-1]
    rate = least * (10.0 ** random.uniform(0.7, 1.7) if visible else random.uniform(0.0, 1.0))
    y = np.exp(-rate * (t - 0.5 * t[-1])) * np.cos(2 * np.pi * t + random.uniform(0.0, 6.0))
    return Run(t, force_n=y + np.sqrt(0.5 / snr) * random.standard_normal(len(t)))


def forced(random: Random) -> Run:
    """Return a linear loop that a sine drives."""
    t: Array = np.linspace(0.0, random.uniform(10.0, 100.0), int(random.uniform(800, 4000)))
    y = random.uniform(0.2, 3.0) * np.cos(2.0 * np.pi * t - 1.0)
    return Run(t, reference_n=10.0 + np.cos(2.0 * np.pi * t), force_n=_noisy(y, random))


def resonance(random: Random) -> Run:
    """Return noise through a resonance of quality 3 to 100."""
    quality, samples = random.uniform(3.0, 100.0), random.uniform(8.0, 40.0)
    count = int(random.uniform(20.0, 200.0) * samples)
    pulsation = 2.0 * np.pi / samples
    radius = np.exp(-0.5 * pulsation / quality)
    driven = random.standard_normal(count + int(20 * quality * samples))
    y = signal.lfilter([1.0], [1.0, -2.0 * radius * np.cos(pulsation), radius**2], driven)
    t = np.arange(count, dtype=np.float64) / samples
    return Run(t, force_n=_noisy(y[-count:] / np.std(y), random))


def white(random: Random) -> Run:
    """Return white noise."""
    n = int(random.uniform(100, 2000))
    return Run(np.arange(n, dtype=np.float64) * 0.01, force_n=random.standard_normal(n))


def with_rests(run: Run, before: float, after: float) -> Run:
    """Return a run with a rest, in shares of its length, before and after it."""
    count = len(run)
    first, last = round(before * count), round(after * count)
    t = np.arange(first + count + last) * run.period_s

    def padded(values: Array | None) -> Array | None:
        return None if values is None else np.concatenate([
            np.full(first, values[0]), values, np.full(last, values[-1])])

    return Run(t, padded(run.reference_n), padded(run.command_n), padded(run.force_n))


def rested_cycle(random: Random) -> Run:
    """Return a Van der Pol oscillator on its cycle, from 5 cycles on, with rests at the ends."""
    mu = random.uniform(0.3, 3.0)
    run = _oscillator(random, mu, 0.0, 2.0, 50.0 + 20.0 / mu, 5.0)
    return with_rests(run, random.uniform(0.0, 0.5), random.uniform(0.0, 0.5))


def _sine(random: Random, samples_a_cycle: float) -> tuple[Array, Array]:
    """Return a sine of 8 to 80 cycles of 1 s."""
    t = np.arange(int(random.uniform(8.0, 80.0) * samples_a_cycle)) / samples_a_cycle
    return t, np.cos(2.0 * np.pi * t + random.uniform(0.0, 6.0))


def rounded_sine(random: Random) -> Run:
    """Return a sine that is recorded with 4 to 60 levels, with or without noise before."""
    t, y = _sine(random, random.uniform(12.0, 60.0))
    step = 2.0 / random.uniform(4.0, 60.0)
    noise = random.choice([0.0, 0.3]) * step * random.standard_normal(len(t))
    return undriven(t, step * np.round((y + noise) / step))


def slow_sine(random: Random) -> Run:
    """Return a sine of a slow sensor, held or joined by straight lines at ten times its rate."""
    t, y = _sine(random, random.uniform(6.0, 20.0))
    fine = np.arange(10 * len(t) - 9) * (t[1] / 10.0)
    held = np.repeat(y, 10)[:len(fine)]
    return undriven(fine, held if random.random() < 0.5 else np.interp(fine, t, y))


def ringing(random: Random) -> Run:
    """Return a linear loop that rings, hardly damped, after a step of its reference."""
    rate, cycles = random.uniform(12.0, 60.0), random.uniform(10.0, 60.0)
    t = np.arange(int(cycles * rate)) / rate - random.uniform(0.1, 0.5) * cycles
    y = np.where(t > 0.0, 1.0 - np.exp(-random.choice([0.0, 1e-5]) * t) * np.cos(
        2.0 * np.pi * t), 0.0)
    return Run(t - t[0], np.where(t > 0.0, 1.0, 0.0), None, _noisy(y, random))


def open_loop(random: Random) -> Run:
    """Return a linear process that a square wave or a triangle drives; its reference rests."""
    t = np.arange(int(random.uniform(10.0, 60.0) * 100.0)) / 100.0
    wave = signal.square(2.0 * np.pi * t) if random.random() < 0.5 else signal.sawtooth(
        2.0 * np.pi * t, 0.5)
    pulsation = random.uniform(5.0, 40.0)
    process = signal.lti([pulsation ** 2], [1.0, pulsation, pulsation ** 2])
    y = signal.lsim(process, wave, t)[1]
    return undriven(t, _noisy(np.asarray(y), random), wave)


def strong_second(random: Random) -> Run:
    """Return a cycle whose second harmonic is larger than its fundamental."""
    t, _ = _sine(random, random.uniform(20.0, 60.0))
    y = sum(size * np.cos(2.0 * np.pi * order * t + random.uniform(0.0, 6.0))
            for order, size in ((1, random.uniform(0.3, 0.9)), (2, 1.0), (3, 0.2)))
    return undriven(t, _noisy(np.asarray(y), random))


FAMILIES: Final[dict[str, tuple[Callable[[Random], Run], str]]] = {
    'Van der Pol': (van_der_pol, 'limit_cycle'),
    'Van der Pol, approach': (van_der_pol_approach, 'limit_cycle'),
    'Duffing, self-excited': (duffing, 'limit_cycle'),
    'Duffing, damped': (duffing_decay, 'decaying'),
    'relay feedback': (relay, 'limit_cycle'),
    'saturated loop': (saturated, 'saturating'),
    'linear loop, decay visible': (lambda r: linear_loop(r, True), 'decaying'),
    'linear loop, decay hidden': (lambda r: linear_loop(r, False), 'unsteady'),
    'driven linear loop': (forced, 'forced'),
    'noise with a resonance': (resonance, 'noise'),
    'white noise': (white, 'noise'),
    'cycle between rests': (rested_cycle, 'limit_cycle'),
    'cycle, second harmonic larger': (strong_second, 'limit_cycle'),
    'rounded sine': (rounded_sine, 'unsteady'),
    'sine of a slow sensor': (slow_sine, 'unsteady'),
    'ringing after a step': (ringing, 'unsteady'),
    'square wave, open loop': (open_loop, 'unsteady'),
}


def _main_segment(segments: list[Segment]) -> Segment:
    """Return the longest segment that is not noise, which is right after a decayed oscillation."""
    moving = [s for s in segments if s.verdict != 'noise'] or segments
    return max(moving, key=lambda s: s.end_s - s.start_s)


def check_verdicts(family: str, count: int, seed: int) -> dict[str, Any]:
    """
    Return how often the longest segment that is not noise has the right verdict.

    Also how often a signal without a limit cycle has a segment with that verdict.
    """
    make, truth = FAMILIES[family]
    random = np.random.default_rng(seed)
    verdicts: Counter[str] = Counter()
    false_cycles = 0
    for _ in range(count):
        segments = judge_run(make(random))
        verdicts[_main_segment(segments).verdict] += 1
        false_cycles += truth != 'limit_cycle' and any(
            s.verdict == 'limit_cycle' for s in segments)
    return {'family': family, 'truth': truth, 'count': count, 'right': verdicts[truth],
            'false_limit_cycles': false_cycles, 'verdicts': dict(verdicts)}


def changes(run: Run) -> Iterator[Run]:
    """Yield a run cut at either end, with every second sample, with an offset, with a rest."""
    assert run.force_n is not None
    tenth = len(run) // 10
    yield from (run[tenth:], run[:-tenth], run[::2],
                replace(run, force_n=run.force_n + 10.0 * np.std(run.force_n)),
                with_rests(run, 0.0, 0.2))


def main_verdict(run: Run, undriven: bool = False) -> tuple[str, float]:
    """Return verdict and confidence of the longest segment that is not noise, as `judge_run`."""
    found = _main_segment(judge_run(run, undriven=undriven))
    return found.verdict, found.confidence


def check_robustness(family: str, count: int, seed: int) -> dict[str, Any]:
    """
    Return how many verdicts are sure, and how many of these survive all `changes`.

    For a limit cycle it is stated that nothing drove it: otherwise none without growth is sure.
    """
    make, truth = FAMILIES[family]
    stated = truth == 'limit_cycle'
    random = np.random.default_rng(seed)
    runs = [make(random) for _ in range(count)]
    given = [main_verdict(run, stated) for run in runs]
    sure = [(run, verdict) for run, (verdict, confidence) in zip(runs, given, strict=True)
            if confidence >= SURE]
    survived = sum(all(main_verdict(changed, stated)[0] == verdict for changed in changes(run))
                   for run, verdict in sure)
    return {'family': family, 'count': count, 'sure': len(sure), 'survived': survived}


def check(count: int, seed: int) -> dict[str, list[dict[str, Any]]]:
    """Return accuracy and verdicts, from `count` signals for each row."""
    grid = [(cycles, samples, snr) for cycles in (3.0, 10.0, 100.0, 300.0)
            for samples in (5.0, 12.0, 40.0) for snr in (10.0, 25.0, 40.0)]
    return {'accuracy': [check_accuracy(*case, count, seed + row)
                         for row, case in enumerate(grid)],
            'verdicts': [check_verdicts(family, count, seed + row)
                         for row, family in enumerate(FAMILIES)],
            'robustness': [check_robustness(family, max(count // CHANGED, 1), seed + row)
                           for row, family in enumerate(FAMILIES)]}


if __name__ == '__main__':
    parser = argparse.ArgumentParser(description=__doc__,
                                     prog='python -m bench.limit_cycle_verdicts')
    parser.add_argument('--count', type=int, default=100, help='signals of each row')
    parser.add_argument('--seed', type=int, default=1)
    given = parser.parse_args()
    print(json.dumps(check(given.count, given.seed), indent=1))
