"""Groups of channels of an actuator's recordings, for the block-wise model and the simulator."""

from collections.abc import Mapping, Sequence

from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.gap.inference import plausibility
from asi_analysis.gap.model.effects import MOTIONS
from asi_analysis.gap.model.group import Group, make_group, simulator_group
from asi_analysis.gap.model.predict import plant_record
from asi_analysis.gap.model.simulator import by_simulator, has_linear_laws, simulator_record
from asi_analysis.gap.prepare import prepare
from asi_common.parameter import Value


def actuator_groups(runs: Sequence[Run], nominal: Mapping[str, Value], tolerance: float,
                    held_out: Sequence[bool]) -> tuple[list[Group], list[str]]:
    """Return the groups of channels that recordings of the actuator allow, and notes."""
    for run in runs:
        plausibility.check_units(run)
    recordings = prepare(runs, 'valve', held_out)
    p = plant_record(nominal)
    notes, groups = [], []
    has = {name: all(getattr(r, name) is not None for r in recordings)
           for name in ('command', 'force', 'valve_position', 'motion')}
    for run, recording in zip(runs, recordings, strict=True):
        plausibility.check_excitation(recording)
        notes += plausibility.check_motion(run)
        notes += plausibility.check_origin(recording)
    if has['command'] and has['valve_position']:
        groups.append(make_group(p, recordings, ('valve',), tolerance))
    else:
        notes.append('without command and valve position the valve cannot be separated from the '
                     'hydraulics by its own signal')
    cut_off = [note for run in runs for note in plausibility.check_cut_off(run)]
    moves = (has['motion'] and has['force'] and not cut_off
             and nominal.get('load.type') != 'prescribed')
    channels = tuple(name for name, there in (
        ('force', has['force'] and (has['valve_position'] or has['command'])),
        ('load', moves))
        if there)
    if not has['force']:
        notes.append('without the force hydraulics, mechanics and sensor cannot be diagnosed')
    elif has['motion'] and cut_off:
        notes += cut_off
    elif not moves:
        notes.append('without the motion of the piston, backlash, compliance, a disturbance and '
                     'the gain of the force sensor cannot be separated from other causes; the '
                     'motion is simulated with the nominal load')
    if channels:
        groups.append(make_group(p, recordings, channels, tolerance))
    if not groups:
        raise InputError(f'{runs[0].source}: no block has both its input and its output recorded')
    return groups, notes


def simulated_groups(groups: Sequence[Group], nominal: Mapping[str, Value], tolerance: float
                     ) -> list[Group]:
    """
    Return the same groups with the simulator as the predictor; the load's channel is the motion.

    An empty list if that is not possible: with a partly simplified model, without the command, or
    if some recordings hold the velocity and others only the position.
    """
    recordings = groups[0].recordings
    moved = [channel for channel in MOTIONS
             if all(getattr(r, f'raw_{channel}') is not None for r in recordings)]
    moves = any('load' in group.channels for group in groups)
    linear = has_linear_laws(nominal)
    if (not (linear or by_simulator(nominal)) or any(r.command is None for r in recordings)
            or (moves and not moved)):
        return []
    p = simulator_record(nominal)
    return [simulator_group(p, group.recordings, tuple(
        moved[0] if channel == 'load' else channel for channel in group.channels), tolerance,
        linear) for group in groups]
