"""Replay the recordings of a joint in MuJoCo: the error of its motion with an exported model."""

import math
from typing import Any, Final, NamedTuple

import numpy as np

from asi_analysis.arrays import Array
from asi_analysis.bags.run import Run
from asi_analysis.gap.answer.joint_model import JointModel
from asi_analysis.gap.diagnosis import Diagnosis
from asi_analysis.gap.prepare import Recording

# A motion that a force makes drifts from the recorded one: it is played in pieces from measured
# states, of at most the first; none shorter than the second.
PIECE_S: Final = 1.0
SHORTEST_S: Final = 0.1
LAGS: Final = 5.0        # time constants of a lag that are played before a piece


class Played(NamedTuple):
    """What is played of a recording: n commands, positions and velocities, `period_s` apart."""

    command: Array
    position: Array
    velocity: Array
    pieces: list[slice]
    period_s: float


def replay_error(diagnosis: Diagnosis, model: JointModel, xml: str) -> float:
    """
    Return the error (rms) of the motion in MuJoCo as a share of the motion, on report samples.

    xml: the model as MJCF. Of a joint moved by a force the recording is played in pieces, each
    from its measured state, and the motion counts from there. NaN if nothing is played. Needs the
    package mujoco; raises ValueError for a file that it does not load.
    """
    import mujoco
    engine = mujoco.MjModel.from_xml_string(xml)
    missed = moved = 0.0
    recordings = diagnosis.groups[-1].group.recordings
    driven = diagnosis.groups[0].group.channels[0] == 'valve'   # the drive makes the force
    loads = model.loads or (0.0,) * len(recordings)
    for run, recording, load in zip(diagnosis.runs, recordings, loads, strict=True):
        if not recording.report.any():
            continue
        played = _played(run, recording, model.kp > 0.0, driven)
        before = math.ceil((model.delay_s + LAGS * model.lag_s) / played.period_s)
        for piece in played.pieces:
            error = (_simulated(engine, played, piece, before, load) - played.position[piece])
            way = played.position[piece] - (
                played.position[piece.start] if model.kp == 0.0 else played.position.mean())
            known = recording.report[piece]
            missed += float(np.sum(error[known] ** 2))
            moved += float(np.sum(way[known] ** 2))
    return math.sqrt(missed / moved) if moved else math.nan


def _played(run: Run, recording: Recording, servo: bool, driven: bool) -> Played:
    """
    Return what is played of a recording; of a servo all of it, else the report's pieces.

    driven: the command is that of a drive; else the force is played.
    """
    times = run.time_s[0] + recording.time_s
    if servo:
        position = _at(times, run, 'position')
        return Played(_held(times, run, 'reference'), position, np.zeros_like(position),
                      [slice(0, times.size)], recording.period_s)
    motion = recording.moved
    assert recording.force is not None
    origin = 0.0 if run.position_m is None else float(np.nanmean(run.position_m))
    position = motion.position[motion.inner] + origin
    if driven:
        command = _held(times, run, 'command')
    else:
        taken = recording.taken
        command = (recording.force + taken.get('constant', 0.0)
                   + taken.get('gravity_sine', 0.0) * np.sin(position)
                   + taken.get('gravity_cosine', 0.0) * np.cos(position))
        if run.force_n is not None:   # measured, not held: its mean over each sample
            command = 0.5 * (command + np.append(command[1:], command[-1]))
    velocity = motion.velocity
    if motion.measured:   # a derivative of a position: fast noise of it would be the state
        velocity = np.fft.irfft(motion.velocity_spectrum * motion.judge, velocity.size)
    return Played(command, position, velocity[motion.inner], _pieces(recording),
                  recording.period_s)


def _pieces(recording: Recording) -> list[slice]:
    """Return the stretches of the report, cut into pieces."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], recording.report, [False]])))
    longest = round(PIECE_S / recording.period_s)
    pieces = [slice(start, min(start + longest, end)) for first, end in edges.reshape(-1, 2)
              for start in range(int(first), int(end), longest)]
    return [each for each in pieces
            if (each.stop - each.start) * recording.period_s >= SHORTEST_S]


def _at(times: Array, run: Run, name: str) -> Array:
    """Return a signal at times, by a line over what is missing."""
    values = run.signal(name)
    known = np.isfinite(values)
    return np.interp(times, run.time_s[known], values[known])


def _held(times: Array, run: Run, name: str) -> Array:
    """Return a signal at times, held from each sample to the next."""
    values = run.signal(name)
    known = np.flatnonzero(np.isfinite(values))
    before = np.searchsorted(run.time_s[known], times + 1e-9, side='right') - 1
    return values[known[np.clip(before, 0, None)]]


def _simulated(engine: Any, played: Played, piece: slice, before: int, load: float) -> Array:
    """
    Return the position in MuJoCo over a piece.

    For `before` samples the motion is as measured, while the drive takes up its command. load:
    constant, that this recording alone has.
    """
    import mujoco
    data = mujoco.MjData(engine)
    data.qfrc_applied[0] = -load
    count = round(played.period_s / engine.opt.timestep)
    out = np.empty(piece.stop - piece.start)
    for k in range(piece.start - before, piece.stop):
        at = max(k, 0)
        if k <= piece.start:
            data.qpos[0], data.qvel[0] = played.position[at], played.velocity[at]
        if k >= piece.start:
            out[k - piece.start] = data.qpos[0]
        data.ctrl[0] = played.command[at]
        mujoco.mj_step(engine, data, count)
    return out
