"""An experiment computed in one process, instead of over ROS: the same samples, the same bag."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Final

import numpy as np
import numpy.typing as npt

from asi_actuator.node_parameters import ACTUATOR_NODE_PARAMETERS
from asi_actuator.safety import Safety, State
from asi_analysis.arrays import Array
from asi_analysis.bags.bag import STATE, read_bag
from asi_analysis.bags.bag_writer import BagWriter, typestore
from asi_analysis.bags.encoding import Nanoseconds, encode, topic_values
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.experiments.experiment import Experiment, checked, information, planned
from asi_analysis.experiments.running import RunFailedError, directory_of, prepare
from asi_analysis.loop.closed_loop import LoopRun, Values, loop_pieces, simulate_loop
from asi_analysis.terminal import Progress, silent
from asi_common.parameter import completed
from asi_common.topics import TOPICS

# Control periods that are computed, then written.
PIECE: Final = 20_000
NODE: Final = 'asi_actuator'
DIAGNOSTICS: Final = '/diagnostics'

OK, ERROR = 0, 2

# By topic: stamps (ns) and bytes of its messages.
Messages = dict[str, tuple[Nanoseconds, npt.NDArray[np.uint8]]]


def simulate(actuator: Values, controller: Values, duration_s: float = 1.0,
             rate_hz: float = 5000.0, *, out: str | Path | None = None) -> Run:
    """
    Return the recording of an experiment, computed in this process.

    actuator, controller: parameters by name (doc/reference/parameters.md), the rest at their
    defaults; without `reference.shape` the reference is a step. rate_hz: control rate, Hz.
    Samples are those of `asi.run` in lock-step to the last bit. out: a directory that does not
    exist or is empty; gets the bag that `asi.run` would write, byte for byte. Raises InputError
    for a parameter that is not allowed, with `out` RunFailedError where the actuator's node would
    go into its state of fault.

    >>> import asi_analysis as asi
    >>> run = asi.simulate({'load.type': 'spring'}, {'reference.amplitude': 100.0}, 0.4)
    >>> print(f'{run.duration_s:g} s at {run.rate_hz:g} Hz, force {run.force_n[-1]:.0f} N')
    0.4 s at 5000 Hz, force 104 N
    """
    experiment = planned(actuator, controller, duration_s, 'lockstep', rate_hz)
    if out is not None:
        return read_bag(run_in_process(experiment, directory_of(experiment, out)))
    signals = simulate_loop(experiment.actuator, experiment.controller, duration_s, rate_hz)
    return Run(*signals, source='simulation', information=information(experiment))


def run_in_process(experiment: Experiment, out: Path, progress: Progress = silent) -> Path:
    """
    Compute an experiment in this process and return its bag: that of `run_experiment`.

    out: a directory that does not exist or is empty; gets `bag`, `experiment.json` and the
    parameter files with which the nodes repeat it. Raises InputError for an experiment that needs
    the nodes, RunFailedError if the actuator's node would go into its state of fault; the bag then
    ends there.
    """
    experiment = checked(experiment)
    safety = _safety(experiment)
    prepare(experiment, out)
    writer = BagWriter(out / 'bag')
    recorder = _Recorder(writer, safety, experiment.control_rate_hz)
    try:
        writer.add_information(information(experiment))
        _record(experiment, recorder, progress)
        writer.close()
    except KeyboardInterrupt:
        writer.close()
        raise
    except BaseException as error:
        writer.abandon(error)
        raise
    if recorder.ended:
        raise RunFailedError('the actuator ended in a fault, the valve command is 0: '
                             f'{safety.reason}; the bag so far: {out / "bag"}')
    return out / 'bag'


def _record(experiment: Experiment, recorder: '_Recorder', progress: Progress) -> None:
    """
    Compute an experiment piece by piece, to its end or to a fault.

    Another thread writes a piece while the next is computed; Ctrl-C does not interrupt it.
    """
    pieces = loop_pieces(experiment.actuator, experiment.controller, experiment.ticks,
                         experiment.control_rate_hz, PIECE)
    with ThreadPoolExecutor(1) as thread:
        writing = None
        for piece in pieces:
            if writing is not None:
                writing.result()
            if recorder.ended:
                return
            progress(f'in process: {recorder.ticks} of {experiment.ticks} ticks',
                     recorder.ticks / experiment.ticks)
            writing = thread.submit(recorder.write, piece)
        if writing is not None:
            writing.result()


def _safety(experiment: Experiment) -> Safety:
    """Return the safety logic of the actuator's node. Raises InputError for what needs nodes."""
    if experiment.plant != 'actuator':
        raise InputError(f'plant = {experiment.plant} needs the nodes: in one process there is '
                         'the actuator only')
    if experiment.mode != 'lockstep':
        raise InputError(f'mode = {experiment.mode} needs the nodes: in one process it is '
                         'lockstep')
    if experiment.controller['reference.shape'] == 'topic':
        raise InputError('reference.shape = topic needs the nodes: in one process there are no '
                         'topics')
    values = {**completed(experiment.node_parameters, ACTUATOR_NODE_PARAMETERS),
              **experiment.actuator}
    rate_hz, limit_n = experiment.control_rate_hz, float(experiment.actuator['command_limit'])
    if 2.0 * limit_n * rate_hz > float(values['limit.command_rate']):
        raise InputError(f'command_limit = {limit_n:g} N at {rate_hz:g} Hz needs the nodes, which '
                         f'limit the rate of the command to {values["limit.command_rate"]:g} N/s')
    return Safety(values, 1.0 / rate_hz, State.ENABLED, lambda: None)


def fault_of(experiment: Experiment, run: LoopRun) -> str:
    """Return why the actuator's node would shut its valve in this run of the loop; '' if not."""
    safety = _safety(experiment)
    _applied(safety, run, 0.0)
    return safety.reason


def _applied(safety: Safety, piece: LoopRun, before_n: float) -> Array:
    """Return the command (N) applied before each tick, up to a fault; before_n: the last one."""
    applied_n = []
    for command_n, force, valve, position, velocity in zip(
            [before_n, *piece.command_n[:-1].tolist()], piece.force_n.tolist(),
            piece.valve_position_m.tolist(), piece.position_m.tolist(),
            piece.velocity_m_s.tolist(), strict=True):
        applied_n.append(safety.command(command_n))
        safety.watch_state((force, valve, position, velocity), 1)
        if not safety.enabled:
            break
    return np.array(applied_n)


class _Recorder:
    """Writes a run as the recorder of `asi run` does, until the safety logic trips."""

    def __init__(self, writer: BagWriter, safety: Safety, rate_hz: float) -> None:
        self._writer, self._safety, self._rate_hz = writer, safety, rate_hz
        self._channels: dict[str, int] = {}
        self._states = self.ticks = 0
        self._command_n = self._valve_m = 0.0

    @property
    def ended(self) -> bool:
        """Whether the safety logic has tripped."""
        return self._safety.state is State.FAULT

    def write(self, piece: LoopRun) -> None:
        """Write the messages of the next ticks; up to a fault, after which none may follow."""
        applied_n = _applied(self._safety, piece, self._command_n)
        piece = LoopRun(*(column[:len(applied_n)] for column in piece))
        stamps = np.round((np.arange(len(applied_n)) + self.ticks + 1) * 1e9
                          / self._rate_hz).astype(np.int64)
        topics = topic_values(Run(*piece)) | {'clock': {}}
        topics['joint_states'] |= {
            'valve velocity': np.diff(piece.valve_position_m, prepend=self._valve_m)
            * self._rate_hz, 'valve effort': applied_n}
        messages = {name: (stamps, encode(TOPICS[name].type, stamps, topics[name]))
                    for name in TOPICS if name in topics}
        if not self.ticks:
            messages = self._begin(messages)
        self._writer.write_many({self._channels[name]: each for name, each in messages.items()})
        self._command_n = float(piece.command_n[-1])
        self._valve_m = float(piece.valve_position_m[-1])
        self.ticks += len(stamps)
        if self.ended and self.ticks > 1:
            self._write_state(int(stamps[-1]), State.FAULT, self._safety.reason)

    def _begin(self, messages: Messages) -> Messages:
        """Write the first tick, in which each topic is added with its message; return the rest."""
        for name, (stamps, table) in messages.items():
            self._channels[name] = self._writer.add_topic(f'/{name}', TOPICS[name].type)
            self._writer.write_many({self._channels[name]: (stamps[:1], table[:1])})
        self._channels[DIAGNOSTICS] = self._writer.add_topic(
            DIAGNOSTICS, TOPICS[DIAGNOSTICS].type)
        faulty = len(stamps) == 1 and self.ended
        self._write_state(int(stamps[0]), State.FAULT if faulty else State.ENABLED,
                          self._safety.reason if faulty else '')
        return {name: (stamps[1:], table[1:]) for name, (stamps, table) in messages.items()
                if len(stamps) > 1}

    def _write_state(self, stamp_ns: int, state: State, reason: str) -> None:
        """Write a change of the actuator's state at a stamp (ns)."""
        types = typestore().types
        header = types['std_msgs/msg/Header'](
            types['builtin_interfaces/msg/Time'](stamp_ns // 10**9, stamp_ns % 10**9), '')
        status = types['diagnostic_msgs/msg/DiagnosticStatus'](
            ERROR if state is State.FAULT else OK, NODE + STATE,
            f'{state}: {reason}' if reason else str(state), NODE,
            [types['diagnostic_msgs/msg/KeyValue'](*pair)
             for pair in (('state', str(state)), ('reason', reason))])
        type_ = TOPICS[DIAGNOSTICS].type
        data = bytes(typestore().serialize_cdr(types[type_](header, [status]), type_))
        self._states += 1
        # DDS sends multiples of four bytes.
        self._writer.write(self._channels[DIAGNOSTICS], stamp_ns, stamp_ns, self._states,
                           data + bytes(-len(data) % 4))
