"""
Whether a command answers the output, so that the loop is closed.

Noise in the loop shows it: the output explains the innovation of the command. A recording in which
the loop repeats itself exactly has no innovation; there a simple law of the output is sought which
gives the command: a relay, or proportional and integral action.
"""

from typing import Final

import numpy as np
from scipy import stats

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.measures.sinusoids.record import reduce
from asi_analysis.measures.sinusoids.sinusoid import fit

# Least share of the command's innovation that the output explains in a closed loop.
CLOSED: Final = 0.3
# Past samples from which the command is predicted, and most samples that are used.
LAGS: Final = 6
MOST_SAMPLES: Final = 20_000
# Share of the command's variance below which its innovation is a rounding error.
NO_INNOVATION: Final = 1e-12
# Levels of the command of a relay, and of one with a dead zone: three may also be those of a
# record that was rounded.
RELAY: Final = 2
SWITCHED: Final = 3
# Share of the samples in which a relay that is computed from the noisy output may differ, and
# relative error of a harmonic that a law need not explain: of the sampling.
RELAY_ERROR: Final = 0.05
LAW_ERROR: Final = 0.03
# Probability of a chi-square at which a law is refused.
REFUSED: Final = 1e-3


def follows_a_law(run: Run, name: str, start_s: float, end_s: float, frequency_hz: float) -> bool:
    """Return whether a relay, or a PI law, of the output gives the command."""
    inside = run.between(start_s, end_s + 0.5 * run.period_s)
    if inside.command_n is None or name == 'command':
        return False
    valid = np.isfinite(inside.command_n) & np.isfinite(inside.signal(name))
    t, command, output = (each[valid][-MOST_SAMPLES:] for each in (
        inside.time_s, inside.command_n, inside.signal(name)))
    if len(t) < 9 or np.ptp(command) == 0.0:
        return False
    if levels_of(command):
        return bool(_relay_error(command, output) < RELAY_ERROR)
    return _is_pi_law(t, command, output, frequency_hz)


def switches(run: Run, start_s: float, end_s: float) -> bool:
    """
    Return whether the command has the levels of a relay.

    If these repeat exactly, so do the outputs at which it switches, in an open loop too.
    """
    command = run.between(start_s, end_s + 0.5 * run.period_s).command_n
    return command is not None and levels_of(command) > 0


def levels_of(command: Array) -> int:
    """Return the number of levels of a switching controller's command; 0 if it is none."""
    levels = np.unique(command[np.isfinite(command)])
    return len(levels) if 2 <= len(levels) <= SWITCHED else 0


def _relay_error(command: Array, output: Array) -> float:
    """
    Return the share of samples in which a relay of the output differs from the command.

    A switch from one level to another one happens where the output crosses a threshold, which is
    estimated from all switches between these levels.
    """
    levels, state = np.unique(command, return_inverse=True)
    switches = np.flatnonzero(np.diff(state))
    thresholds: dict[tuple[int, int], tuple[float, float]] = {}
    for pair in {(int(state[k]), int(state[k + 1])) for k in switches}:
        at = [k for k in switches if (state[k], state[k + 1]) == pair]
        direction = np.sign(np.mean(output[np.add(at, 1)] - output[np.maximum(at, 3) - 3]))
        thresholds[pair] = (float(direction), float(np.mean(
            0.5 * (output[at] + output[np.add(at, 1)]))))
    now, different = int(state[0]), 0
    for k in range(1, len(output)):
        for (before, after), (direction, threshold) in thresholds.items():
            if before == now and direction * (output[k] - threshold) > 0.0:
                now = after
                break
        different += now != state[k]
    return different / len(output)


def _is_pi_law(t: Array, command: Array, output: Array, frequency_hz: float) -> bool:
    """
    Return whether a proportional and an integral action of the output give the command.

    They are compared at the harmonics that both have. The inverse of a process is no such law: its
    gain rises with the frequency. Proportional action alone must oppose the output.
    """
    found = []
    for each in (command, output):
        t_reduced, reduced = reduce(t, each, frequency_hz)
        oscillation = fit(t_reduced, reduced, frequency_hz)
        if oscillation is None:
            return False
        found.append((oscillation.harmonics, oscillation.noise * np.sqrt(2.0 / len(reduced))))
    (effects, effect_noise), (causes, cause_noise) = found
    common = min(len(effects), len(causes))
    effects, causes = effects[:common], causes[:common]
    order = np.arange(1, common + 1)
    heard = np.abs(causes) > 4.0 * cause_noise
    if heard.sum() < 2:
        return False
    causes, effects, order = causes[heard], effects[heard], order[heard]
    columns = np.column_stack([causes, causes / (1j * order)])
    spread = np.hypot(np.hypot(effect_noise, cause_noise * np.abs(effects / causes)),
                      LAW_ERROR * np.abs(effects))
    parts = [np.concatenate([each.real.T, each.imag.T], axis=-1).T for each in (
        columns / spread[:, None], effects / spread)]
    law = np.linalg.lstsq(parts[0], parts[1], rcond=None)[0]
    residual = parts[1] - parts[0] @ law
    fits_well = stats.chi2.sf(float(residual @ residual), len(residual) - 2) > REFUSED
    integral = abs(law[1]) > LAW_ERROR * abs(law[0])
    return bool(fits_well and (integral or law[0] < 0.0))


def explained_by_output(run: Run, name: str, start_s: float, end_s: float, frequency_hz: float
                        ) -> float | None:
    """
    Return the share of the command's innovation that the output explains: near 1 in a closed loop.

    The innovation is the error of a linear prediction of the command from its own past: the last
    samples and those one cycle ago. In a closed loop the output up to the same sample explains it
    (Granger causality: Granger, Econometrica 37, 1969), without feedback it explains nothing. None
    without a command that moves.
    """
    inside = run.between(start_s, end_s + 0.5 * run.period_s)
    if inside.command_n is None or name == 'command':
        return None
    valid = np.isfinite(inside.command_n) & np.isfinite(inside.signal(name))
    pair = [each[valid][-MOST_SAMPLES:] for each in (inside.command_n, inside.signal(name))]
    cycle = max(round(1.0 / (frequency_hz * run.period_s)) if frequency_hz > 0.0 else 0, LAGS)
    if len(pair[0]) < cycle + 10 * LAGS or np.ptp(pair[0]) == 0.0:
        return None
    commands, outputs = (np.lib.stride_tricks.sliding_window_view(
        (each - each.mean()) / max(float(each.std()), 1e-300), LAGS + 1)[:, ::-1]
        for each in pair)
    now, own = commands[cycle:, 0], [commands[cycle:, 1:], np.ones((len(commands) - cycle, 1))]
    if cycle > LAGS:
        own.append(commands[LAGS // 2:LAGS // 2 - cycle])

    def error(columns: list[Array]) -> float:
        given = np.hstack(columns)
        innovation = now - given @ np.linalg.lstsq(given, now, rcond=1e-10)[0]
        return float(innovation @ innovation) / max(len(innovation) - given.shape[1], 1)

    alone = error(own)
    # A command that its own past predicts exactly has no innovation.
    return max(1.0 - error([*own, outputs[cycle:]]) / alone, 0.0) if alone > NO_INNOVATION else 0.0
