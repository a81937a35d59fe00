"""The live page as a user sees it, over real nodes; by NiceGUI's simulation of a browser."""

import asyncio
import contextlib
import re
import socket
import time
from collections.abc import Awaitable, Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from conftest import PATIENCE_S, NodeProcess

pytest.importorskip('nicegui')
from nicegui import ui
from nicegui.testing import User
from nicegui.testing.user_simulation import user_simulation
from starlette.applications import Starlette
from starlette.routing import WebSocketRoute
from starlette.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

import asi_analysis as asi
from asi_actuator.model.effects import EFFECT
from asi_analysis.bags.bag import read_bag
from asi_analysis.bags.run import Run
from asi_analysis.errors import InputError
from asi_analysis.viewing import page as live
from asi_analysis.viewing import processes as started
from asi_analysis.viewing.frames import Frames, curves
from asi_analysis.viewing.recent import Recent, Taken, drawn
from asi_analysis.viewing.session import Session
from asi_analysis.viewing.sliders import Scale, choices_of, scale_of, typed, unit_of
from asi_common.node import messages as wire
from asi_common.node.ros_parameters import descriptor
from asi_controller.parameters import CONTROLLER_NODE_PARAMETERS, REFERENCE_PARAMETERS

LOOP = {'rate_hz': 500.0}


async def seen(condition: Callable[[], Any], what: str) -> Any:
    """Return condition() once it is true, and finds on the page what it looks for."""
    end = time.monotonic() + PATIENCE_S
    while time.monotonic() < end:
        with contextlib.suppress(AssertionError):
            if found := condition():
                return found
        await asyncio.sleep(0.05)
    raise AssertionError(f'not within {PATIENCE_S:g} s: {what}')


def one(user: User, marker: str, kind: type = ui.element) -> Any:
    """Return the only element with a mark."""
    element, = (each for each in user.find(marker=marker).elements if isinstance(each, kind))
    return element


def use(user_session: Callable[[User, live.Session], Awaitable[None]]) -> None:
    """Open the page of the loop that runs, and have a user work with it."""
    async def simulated() -> None:
        session = live.Session()
        try:
            async with user_simulation(root=lambda: live.page(session)) as user:
                await user.open('/')
                await seen(lambda: {'asi_actuator', 'asi_controller'} <= set(
                    session.link.values), 'the parameters of both nodes')
                await seen(lambda: session.link.recent.rate()[0] > 0.0, 'states')
                await user_session(user, session)
        finally:
            session.close()

    asyncio.run(simulated())


def test_a_user_turns_steps_records_and_asks_and_looks_for_what_is_hidden(
        start_node: Callable[..., NodeProcess], tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(live.random, 'choice', lambda _: EFFECT['stiction'])
    actuator = start_node('asi_actuator.actuator_node', real_time_factor=1.0, **LOOP)
    controller = start_node('asi_controller.controller_node', **LOOP)

    async def work(user: User, session: live.Session) -> None:
        html = (await user.http_client.get('/')).text
        assert re.findall(r'(?:src|href)="(?:https?:)?//', html) == []
        await seen(lambda: user.find(marker='asi_controller general').elements, 'the panel')
        one(user, 'asi_controller general', ui.expansion).value = True
        gain = await seen(lambda: one(user, 'gain', ui.input), 'the gain')
        gain.value = '8'
        user.find(marker='gain').trigger('keydown.enter')
        await asyncio.to_thread(controller.wait_for, 'gain = 8.0')
        gain.value = '-3'
        user.find(marker='gain').trigger('keydown.enter')
        await seen(lambda: user.notify.contains('value: -3.0'), 'the refusal')
        await seen(lambda: gain.value == '8.0', 'the value that holds')
        user.find('Step').click()
        await asyncio.to_thread(controller.wait_for, 'reference.amplitude = 150.0')
        await seen(lambda: curves(session.link.recent.run(1.0))[0][:, 1].max(initial=0.0) > 50.0,
                   'the step in a frame')
        assert curves(session.link.recent.run(1.0))[1][:, 1].max() == 150.0
        user.find('Record').click()
        await seen(lambda: session.recorder, 'the recorder')
        await seen(lambda: sum(file.stat().st_size for file in session.bag.glob('*')) > 100_000,
                   'messages in the bag')
        (await seen(lambda: user.find('End recording'), 'the end of the recording')).click()
        await seen(lambda: user.notify.contains('recorded'), 'its end')
        assert len(read_bag(session.bag)) > 0
        user.find('Is it a limit cycle?').click()
        answer = one(user, 'answer')
        await seen(lambda: answer.text.startswith('asi limit-cycle runs/'), 'the answer')
        assert 'asi: ' not in answer.text
        asked = read_bag(answer.text.split()[2])
        assert asked.information['controller']['gain'] == 8.0
        assert asked.force_n is not None and asked.force_n.max() > 50.0

    async def search(user: User, session: live.Session) -> None:
        user.find('Inject').click()
        await asyncio.to_thread(actuator.wait_for, 'command_path.delay = 0.002')
        first = await seen(lambda: session.link.recent._changed_ns, 'another plant')
        user.find('Hide one').click()
        await seen(lambda: session.hidden, 'the effect')
        await seen(lambda: session.link.recent._changed_ns > first, 'another plant')
        await asyncio.to_thread(actuator.wait_for, 'command_path.delay = 0.0\n')
        await seen(lambda: one(user, 'effect').text == 'one effect is hidden', 'that it is')
        name = min(session.withheld)
        block = name.partition('.')[0]
        one(user, f'asi_actuator {block}', ui.expansion).value = True
        field = await seen(lambda: one(user, name), 'the parameter')
        await asyncio.sleep(1.5)
        nominal = session.withheld[name]
        assert str(field.value) == str(nominal) != str(session.link.values['asi_actuator'][name])
        effect = session.effect
        user.find('Reveal and remove').click()
        await seen(lambda: user.notify.contains(f'it was {effect}; it is off'), 'the effect')
        assert session.link.values['asi_actuator'][name] == nominal

    use(work)
    use(search)


def test_what_is_being_done_is_told_while_an_answer_takes_long_and_is_not_in_it(
        tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    command = tmp_path / 'command'
    command.write_text('#!/bin/sh\necho "asi: fitting effects, 9%, after 30 s"\n'
                       'echo "asi: a note"\necho "stiction, $4"\n')
    command.chmod(0o755)
    monkeypatch.setattr(started, 'sys', SimpleNamespace(executable=str(command)))
    told: list[str] = []
    answer = asyncio.run(started.ask('gap', asi.simulate({}, {}, 0.1), {}, told.append))
    assert told == ['fitting effects, 9%, after 30 s']
    bag = answer.split()[2]
    assert answer == f'asi gap {bag}\n\nasi: a note\nstiction, {bag}\n'
    assert len(read_bag(bag)) > 0


def test_a_slider_has_the_range_of_the_parameter() -> None:
    for parameter in CONTROLLER_NODE_PARAMETERS + REFERENCE_PARAMETERS:
        described = descriptor(parameter)
        assert choices_of(described) == list(parameter.choices)
        scale = scale_of(described, parameter.default)
        assert unit_of(described) == (parameter.unit if scale else '')
        assert (scale is None) == isinstance(parameter.default, bool | str)
        for place in (0.0, 0.3, 1.0) if scale else ():
            assert scale and parameter.problem(scale.value(place)) is None
            assert abs(scale.place(scale.value(place)) - place) < 0.01 or scale.whole
    assert Scale(0.0, 1e4, True, False).value(0.5) == 10.0
    assert Scale(-1.0, 1.0, False, False).value(0.25) == -0.5
    assert (typed('8', 1.0), typed('8', 1), typed('fast', 1.0), typed('8', 'a')) == (
        8.0, 8, 'fast', '8')


@pytest.mark.parametrize('reference, start', [
    (None, 0.0), ([np.nan, np.nan], 0.0), ([20.0, np.nan], 20.0)])
def test_a_step_is_from_the_reference_that_is_known(reference: Any, start: float) -> None:
    given: dict[str, Any] = {}

    async def set_(_: str, values: dict[str, Any]) -> None:
        given.update(values)

    run = Run(np.arange(2) * 1e-3, None if reference is None else np.array(reference),
              force_n=np.zeros(2))
    session = SimpleNamespace(link=SimpleNamespace(
        set=set_, recent=SimpleNamespace(run=lambda _: run)))
    asyncio.run(live.Session.step(session, 150.0))
    assert given['reference.offset'] == start
    assert given['reference.amplitude'] == 150.0 - start


def test_a_loop_that_began_again_is_shown_from_there_on() -> None:
    recent = Recent()
    for stamps in ([5, 6, 7], [8, 9, 1, 2], [3, 4]):   # ms
        recent.add('joint_states', [
            Taken(wire.state(stamp * 10**6, float(stamp), 0.0, 0.0, 0.0, 0.0, 0.0)[0], 0, 0)
            for stamp in stamps])
    run = recent.run(1.0)
    assert run is not None and run.signal('position').tolist() == [1.0, 2.0, 3.0, 4.0]


def test_a_question_is_about_one_plant() -> None:
    recent = Recent()
    assert recent.of_one_plant(10.0) == (None, False)

    def add(*stamps: int) -> None:   # ms
        recent.add('joint_states', [
            Taken(wire.state(stamp * 10**6, float(stamp), 0.0, 0.0, 0.0, 0.0, 0.0)[0], 0, 0)
            for stamp in stamps])

    def asked(seconds: float) -> tuple[list[float], bool]:
        run, changed = recent.of_one_plant(seconds)
        assert run is not None
        return run.signal('position').tolist(), changed

    add(1, 2, 3)
    assert asked(10.0) == ([1.0, 2.0, 3.0], False)
    recent.plant_changed()
    add(4, 5)
    assert asked(10.0) == ([3.0, 4.0, 5.0], True)
    assert asked(0.001) == ([4.0, 5.0], False)
    add(1, 2)   # the loop began again
    assert asked(10.0) == ([1.0, 2.0], False)


def test_a_state_that_is_published_again_counts_once() -> None:
    recent = Recent()
    for stamps in ([1, 2, 2], [2, 3]):   # ms
        recent.add('joint_states', [
            Taken(wire.state(stamp * 10**6, float(stamp), 0.0, 0.0, 0.0, 0.0, 0.0)[0], 0, 0)
            for stamp in stamps])
    run = recent.run(1.0)
    assert run is not None and run.signal('position').tolist() == [1.0, 2.0, 3.0]


def test_a_reference_without_stamps_is_shown_where_it_was_published_and_grows_old() -> None:
    """As `ros2 topic pub` sends it."""
    recent = Recent()
    for k in range(1, 401):
        recent.add('joint_states', [Taken(
            wire.state(k * 10**8, float(k), 0.0, 0.0, 0.0, 0.0, 0.0)[0], k, 10**12 + k * 10**8)])
        recent.add('force_reference', [Taken(
            wire.answer(0, 0.0, float(k))[1], k, 10**12 + k * 10**8)])
    run = recent.run(1.0)
    assert run is not None and run.reference_n is not None
    assert run.reference_n.tolist() == run.position_m.tolist() == list(range(390, 401))
    assert len(recent._parts['force_reference']) <= 301


def test_fewer_points_keep_the_size_of_an_oscillation() -> None:
    time_s = np.arange(10_000) * 1e-4
    values = np.sin(2.0 * np.pi * 1234.0 * time_s)
    values[5000] = 7.0
    points = drawn(time_s, values, 100)
    assert len(points) <= 200 and points[:, 1].max() == 7.0
    assert np.all(np.diff(points[:, 0]) > 0.0)
    assert points[:, 1].min() == values.min()
    assert drawn(time_s[:50], values[:50], 100).tolist() == (
        np.column_stack([time_s, values])[:50].tolist())


def test_a_frame_has_the_points_of_each_curve_and_goes_to_pages_of_ours_alone() -> None:
    recent = Recent()
    frames = Frames(recent)
    app = Starlette(routes=[WebSocketRoute('/frames', lambda socket: live.send_frames(
        socket, frames))])
    with TestClient(app) as client:
        for origin in ('http://elsewhere.example', 'http://[', ''):
            with pytest.raises(WebSocketDisconnect), client.websocket_connect(
                    '/frames', headers={'origin': origin}):
                pass
        ours = {'host': 'here', 'origin': 'http://here'}
        with client.websocket_connect('/frames', headers=ours) as socket:
            socket.send_bytes(b'1.0')
            with pytest.raises(WebSocketDisconnect):
                socket.receive_bytes()
        with client.websocket_connect('/frames', headers=ours) as socket:
            socket.send_text('1.0')
            assert np.frombuffer(socket.receive_bytes(), np.float32).tolist() == [0.0] * 7
            recent.add('joint_states', [
                Taken(wire.state(k * 10**6, 0.0, 2e-6, 0.0, 0.0, 4.0, 8.0)[0], k, k * 10**6)
                for k in (1, 2, 3)])
            socket.send_text('1.0')
            frame = np.frombuffer(socket.receive_bytes(), np.float32)
            assert frame[:7] == pytest.approx([1000.0, 1.0, 0.0, 3.0, 0.0, 2.0, 2.0])
            assert frame[7:].reshape(-1, 2)[:, 1].tolist() == [4.0] * 3 + [8.0] * 2 + [2.0] * 2
            socket.send_text('1e9')
            with pytest.raises(WebSocketDisconnect):
                socket.receive_bytes()


@contextlib.contextmanager
def open_tab(port: int) -> Iterator[socket.socket]:
    """Hold a connection for frames, as a tab does, that asks for none."""
    with socket.create_connection(('127.0.0.1', port)) as tab:
        here = f'127.0.0.1:{port}'
        tab.sendall(f'GET /frames HTTP/1.1\r\nHost: {here}\r\nOrigin: http://{here}\r\n'
                    'Connection: Upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13\r\n'
                    'Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n'.encode())
        assert b'101' in tab.recv(1000)
        yield tab


def processes(text: str) -> list[str]:
    """Return the command lines of the processes that have a text in their environment."""
    found = []
    for folder in Path('/proc').glob('[0-9]*'):
        with contextlib.suppress(OSError):   # it has ended meanwhile
            if text.encode() in (folder / 'environ').read_bytes():
                found.append((folder / 'cmdline').read_text().replace('\0', ' '))
    return found


def test_ctrl_c_ends_the_page_and_all_that_it_started_with_a_tab_open(
        serve: Callable[..., tuple[int, NodeProcess]], ros_environment: dict[str, str],
        tmp_path: Path) -> None:
    ros_environment['ASI_TEST'] = mark = f'of {tmp_path}'
    port, process = serve('--simulate')
    process.wait_for('lockstep at')
    with open_tab(port):
        assert len(processes(mark)) == 3
        assert process.stop() == 0 and 'Traceback' not in process.text, process.text
    assert not processes(mark)


def test_a_port_in_use_and_a_missing_library_are_said(
        monkeypatch: Any, capsys: Any) -> None:
    from asi_analysis.cli import main
    with socket.socket() as taken:
        taken.bind(('127.0.0.1', 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(InputError, match=f'--port {port} cannot be used: Address already'):
            live.serve(port, '', False, False)
    monkeypatch.setitem(__import__('sys').modules, 'nicegui', None)
    monkeypatch.setattr('sys.argv', ['asi', 'live'])
    assert main() == 2
    assert 'pip install "asi_actuator[live]"' in capsys.readouterr().err


@pytest.mark.parametrize('namespace', ['½', '/left/ right', '-1'])
def test_a_namespace_that_is_none_is_refused(namespace: str) -> None:
    with pytest.raises(InputError, match='is not allowed: namespace must not'):
        Session(namespace, simulate=True)
