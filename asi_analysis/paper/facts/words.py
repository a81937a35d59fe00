"""Descriptions of conditions that several facts share."""

from typing import Final

from asi_analysis.loop.bench import RATE_HZ
from asi_analysis.paper.facts.fact import Setup

PREDICTION: Final = (
    'harmonic balance, 1 + Kp H S N = 0, with the describing function of the hysteresis alone; '
    'valve, static gain and sensor linear, fluid a gain')


def locked_loop(setup: Setup) -> str:
    return f'piston locked, P with feed-forward {setup.conditions.feedforward:g}, {RATE_HZ:g} Hz'


def high_gain_cycle(setup: Setup) -> str:
    return (f'{locked_loop(setup)}; step of {setup.conditions.cycle_step_n:g} N, '
            f'{setup.conditions.cycle_gain:g} times the onset gain')
