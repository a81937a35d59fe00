"""What the live page starts: nodes, the recorder, and commands that answer a question."""

import asyncio
import re
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np

from asi_analysis.bags.bag import write_bag
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.experiments.running import PATIENCE_S, end_with_parent, free_directory
from asi_common.executable import interrupt_later

RUNS: Final = Path('runs')
# What a command that computes says every 30 s (`asi_analysis.terminal`).
PROGRESS: Final = re.compile(r'asi: (.*, after \d+ s)\s*')
# As `ros2 run` starts them; they end quietly at any time.
EXECUTABLES: Final = {'actuator': 'asi_actuator.executables',
                      'controller': 'asi_controller.executables',
                      'recorder': 'asi_analysis.bags.nodes.executables'}


class NodeProcess:
    """A node of ours in a process; `end` lets it end as Ctrl-C does, `wait` waits for that."""

    def __init__(self, name: str, namespace: str, **parameters: Any):
        """Start actuator, controller or recorder with parameters."""
        given = [part for key, value in parameters.items() for part in ('-p', f'{key}:={value}')]
        space = ['-r', f'__ns:={namespace}', '-r', '/clock:=clock'] if namespace else []
        with interrupt_later():
            self.process = subprocess.Popen(
                [sys.executable, '-c', f'import sys; from {EXECUTABLES[name]} import {name}; '
                 f'sys.exit({name}())', '--ros-args', *given, *space],
                stdin=subprocess.DEVNULL, start_new_session=True, preexec_fn=end_with_parent)

    def end(self) -> None:
        """Let it end; again does nothing more."""
        self.process.terminate()   # of SIGINT, a Python that only begins prints a traceback

    def wait(self) -> None:
        """Wait until it has ended, or kill it if that takes too long."""
        try:
            self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


async def ask(question: str, run: Run | None, nominal: Mapping[str, Any],
              tell: Callable[[str], object]) -> str:
    """
    Keep the last seconds as a bag, and return what `asi QUESTION BAG` says of it.

    nominal: parameters by node, as the bag tells them to `asi gap`; tell: gets what is being done
    while it takes long. Raises InputError without anything to ask about.
    """
    if run is None:
        raise InputError('there is nothing to analyse yet: no message of joint_states has come')
    if run.reference_n is not None:
        # From the first reference on: those before it are not missing samples.
        run = run[int(np.argmax(np.isfinite(run.reference_n))):]
    bag = free_directory(RUNS, 'live') / 'bag'
    bag.parent.mkdir(parents=True)
    await asyncio.to_thread(write_bag, run, bag, {
        name.removeprefix('asi_'): dict(values) for name, values in nominal.items()})
    process = await asyncio.create_subprocess_exec(
        sys.executable, '-m', 'asi_analysis.cli', question, str(bag), stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    said = ''
    try:
        assert process.stdout is not None
        async for line in process.stdout:
            text = line.decode(errors='replace')
            if progress := PROGRESS.fullmatch(text):
                tell(progress[1])
            else:
                said += text
        await process.wait()
    except asyncio.CancelledError:   # the page's server ends
        process.kill()
        raise
    return f'asi {question} {bag}\n\n{said}'
