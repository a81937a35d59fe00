"""Tables of the effects that a diagnosis may name, and of their sizes, for doc/explanation."""

from collections.abc import Iterator
from typing import Final

import numpy as np

from asi_actuator.model.effects import EFFECTS
from asi_analysis.bags.run import Run
from asi_analysis.gap.model import forms
from asi_analysis.gap.model.effects import BLOCK_OF, GRAVITY, Effects
from asi_analysis.gap.model.joint import servo_effects
from asi_analysis.gap.model.joint_effects import joint_effects
from asi_analysis.gap.model.rattling import rattling_in
from asi_analysis.gap.model.servo.identification import Servo
from asi_analysis.gap.prepare import prepare
from asi_analysis.gap.words import SIZES, unit_of_free

TIME_S: Final = 0.01 * np.arange(400)
WAVE: Final = np.sin(6.0 * TIME_S)
# A joint that turns, with a command in volts: of it, sizes have the unit V.
UNITS: Final = {'command': 'V', 'force': 'Nm', 'reference': 'rad', 'position': 'rad'}


def effects_table() -> str:
    """Return the effects that a diagnosis may name as a Markdown table."""
    rows = [f'| `{effect.name}` | {effect.block.replace("_", " ")} | {effect.description} |'
            for effect in EFFECTS if effect.name in forms.EFFECTS]
    return '\n'.join(['| effect | block | in the real machine |', '|---|---|---|', *rows])


def sizes_table() -> str:
    """Return the sizes of the effects of a joint, with their units, as a Markdown table."""
    joints: dict[tuple[str, str], list[str]] = {}   # by effect and sizes: joints that have these
    for name, joint, sizes in _of_joints():
        joints.setdefault((name, sizes), []).append(joint)
    order = list(BLOCK_OF)
    rows = [f'| `{name}` | {BLOCK_OF[name].replace("_", " ")} | {", ".join(dict.fromkeys(which))} '
            f'| {sizes} |' for (name, sizes), which in sorted(
                joints.items(), key=lambda each: order.index(each[0][0]))]
    return '\n'.join(['| effect | block | joint | sizes |', '|---|---|---|---|', *rows])


def _of_joints() -> Iterator[tuple[str, str, str]]:
    """Yield each effect of each kind of joint with its sizes."""
    moved, drive, servo = (Run(TIME_S, **signals, information={'signals': UNITS}) for signals in (
        {'force_n': WAVE, 'position_m': WAVE}, {'command_n': WAVE, 'force_n': 0.9 * WAVE},
        {'reference_n': WAVE, 'position_m': 0.9 * WAVE}))
    period, travel = moved.period_s, float(np.ptp(WAVE))
    for effects in (GRAVITY, *(joint_effects(
            period, travel, True, measured, rattling_in(None)) for measured in (True, False))):
        yield from _of_a_joint('force or command', moved, 'load', effects)
    yield from _of_a_joint('command and force', drive, 'valve',
                           servo_effects(prepare([drive], 'drive'), True))
    recordings = prepare([servo], 'position')
    for joint, servos in (('servo', []), ('servo of second order', [Servo(20.0, 0.7)])):
        yield from _of_a_joint(joint, servo, 'valve', servo_effects(recordings, False, servos))


def _of_a_joint(joint: str, run: Run, channel: str, effects: Effects
                ) -> Iterator[tuple[str, str, str]]:
    """Yield the effects that act on a channel of a joint, each with its sizes."""
    for name, variants in effects.items():
        frees = {free.field: free for variant in variants if channel in variant.channels
                 for free in variant.free if free.field in SIZES}
        sizes = [f'`{field}`{f" ({unit})" if unit else ""}: {SIZES[field]}'
                 for field, free in frees.items()
                 for unit in [unit_of_free(free, channel, run, 'joint')]]
        if sizes:
            yield name, joint, '; '.join(sizes)
