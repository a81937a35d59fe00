"""
`asi live`: the loop in the browser, with its parameters, questions and effects.

One process serves the page on 127.0.0.1 and hears the loop over DDS; it loads nothing from the
network.
"""

import contextlib
import json
import os
import random
import signal
import socket
import time
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, Final
from urllib.parse import urlsplit

from nicegui import app, ui
from starlette.middleware.trustedhost import TrustedHostMiddleware
from starlette.websockets import WebSocket, WebSocketDisconnect

from asi_actuator.model.effects import EFFECTS
from asi_analysis.errors import InputError
from asi_analysis.viewing.frames import CHARTS, LOOP, WINDOWS_S, Frames
from asi_analysis.viewing.link import ACTUATOR, LinkError
from asi_analysis.viewing.processes import ask
from asi_analysis.viewing.session import CONTROLLER, Session
from asi_analysis.viewing.sliders import choices_of, scale_of, typed, unit_of
from asi_common.executable import end_at_once
from asi_common.signals import SIGNALS, end_quietly

HOST: Final = '127.0.0.1'
SCRIPT: Final = Path(__file__).with_name('charts.js')
NICE: Final = 5
# A page that a busy machine has cut off for less is not built anew.
RECONNECT_S: Final = 30.0
REFRESH_S: Final = 0.5
# Seconds that a question is about: enough for a slow cycle and for the sweep of a chirp.
ASKED_S: Final = 10.0
LEAST_ASKED_S: Final = 2.0   # after a change of the actuator
# Without diagnostics for this long (s) a node has ended; they come twice a second.
SILENT_S: Final = 2.5
SILENCE: Final = ('no node is heard: ros2 run asi_actuator actuator, and controller; '
                  'or asi live --simulate', 'warning')
LEVELS: Final = ('positive', 'warning', 'negative', 'negative')
# Heading of the parameters without a block.
GENERAL: Final = 'general'


def serve(port: int, namespace: str, simulate: bool, show: bool) -> None:
    """
    Serve the page until SIGINT or SIGTERM, which end this process with status 0.

    simulate: start an actuator and a controller too. Raises InputError if the port is in use.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise InputError(f'--port {port} cannot be used: {error.strerror}; '
                             'name another one') from None
    session = Session(namespace, simulate)

    def leave(*_: object) -> None:
        end_quietly()   # at once if it comes again
        session.close()
        end_at_once(0)

    # The server ends when it gets one, and sends it again at its own end.
    for number in SIGNALS:
        signal.signal(number, leave)
    # On a busy machine the loop, whose processes are started already, goes first.
    os.nice(NICE)
    # Other host names are refused, against DNS rebinding by a foreign page.
    app.add_middleware(TrustedHostMiddleware, allowed_hosts=[HOST, 'localhost'])
    frames = Frames(session.link.recent)
    app.on_startup(frames.follow)

    @app.websocket('/frames')
    async def _(socket: WebSocket) -> None:
        await send_frames(socket, frames)

    print(f'http://{HOST}:{port} (Ctrl-C ends it)')
    try:
        ui.run(lambda: page(session), host=HOST, port=port, title='asi live', reload=False,
               show=show, show_welcome_message=False, reconnect_timeout=RECONNECT_S,
               ws_per_message_deflate=False)   # it takes longer than to draw
    finally:
        session.close()


async def send_frames(socket: WebSocket, frames: Frames) -> None:
    """Send a page of ours the next frame for each window (s) that it asks for."""
    if not _is_from_own_page(socket):
        await socket.close()
        return
    await socket.accept()
    heard = -1
    with contextlib.suppress(WebSocketDisconnect):
        while True:
            try:
                heard, frame = await frames.after(heard, float(await socket.receive_text()))
            except (ValueError, KeyError):   # not our page: no number, or (KeyError) bytes
                await socket.close()
                return
            await socket.send_bytes(frame)


def _is_from_own_page(socket: WebSocket) -> bool:
    """Return whether our page opened a WebSocket; any other page in the browser could, too."""
    try:
        origin = urlsplit(socket.headers.get('origin', '')).netloc
    except ValueError:   # no address
        return False
    return origin == socket.headers.get('host')


def page(session: Session) -> None:
    """Build the page of one browser."""
    with ui.row().classes('w-full items-center'):
        ui.label('asi live').classes('text-h6')
        status = ui.row()
        rate = ui.label().classes('text-grey')
    with ui.row().classes('w-full no-wrap items-start'):
        with ui.column().classes('w-2/3 sticky top-0 self-start'):
            _actions(session)
            _effects(session)
            _charts(rate)
        with ui.column().classes('w-1/3'):
            _parameters(session)

    shown: list[tuple[str, str]] = []

    def refresh() -> None:
        badges = [_badge(name, *said)
                  for name, said in sorted(session.link.diagnostics.items())] or [SILENCE]
        if badges == shown:
            return
        shown[:] = badges
        status.clear()
        with status:
            for text, colour in badges:
                ui.badge(text, color=colour)

    ui.timer(REFRESH_S, refresh)


def _badge(name: str, level: int, text: str, at_s: float) -> tuple[str, str]:
    """Return text and colour of the badge of a node's status."""
    if time.monotonic() - at_s > SILENT_S:
        return f'{name}: has ended, or is silent', 'negative'
    return f'{name}: {text}', LEVELS[min(level, 3)]


def _charts(rate: ui.label) -> None:
    window = ui.toggle(WINDOWS_S, value=1.0, on_change=lambda event: ui.run_javascript(
        f'asiLive.windowS = {event.value}')).props('dense')
    charts = []
    for title, names in (*CHARTS.items(), (LOOP, ['valve'])):
        chart = ui.element('canvas').classes('w-full h-64' if title == LOOP else 'w-full h-52')
        charts.append([chart.mark(title).html_id, title, '' if title == LOOP else 's',
                       list(names)])
    ui.add_head_html(f'<script>{SCRIPT.read_text()}</script>')
    ui.run_javascript(f'asiLive({json.dumps(charts)}, "{rate.html_id}", {window.value})')


async def _attempt(action: Awaitable[Any], done: str = '') -> bool:
    """Await an action and notify of its result; return whether it succeeded."""
    try:
        said = await action
    except (LinkError, InputError) as error:
        ui.notify(str(error), type='negative', timeout=10_000)
        return False
    if said or done:
        ui.notify(said or done, type='positive')
    return True


def _actions(session: Session) -> None:
    link = session.link
    with ui.row().classes('items-center'):
        target = ui.number('step to (N)', value=150.0, format='%g').classes('w-28').mark('target')
        ui.button('Step', on_click=lambda: _attempt(session.step(float(target.value or 0.0))))
        for label, node, service, data in (
                ('Pause', ACTUATOR, 'pause', True), ('Go on', ACTUATOR, 'pause', False),
                ('Reset', ACTUATOR, 'reset', None), ('Enable', ACTUATOR, 'enable', True),
                ('Disable', ACTUATOR, 'enable', False)):
            ui.button(label, on_click=lambda node=node, service=service, data=data: _attempt(
                link.serve(node, service, data))).props('outline')
        record = ui.button('Record', color='red', on_click=lambda: _attempt(session.record()))
        ui.timer(REFRESH_S, lambda: record.set_text(
            'End recording' if session.recorder else 'Record'))
    with ui.row().classes('items-center'):
        for label, question in (('Is it a limit cycle?', 'limit-cycle'),
                                ('Where is the gap?', 'gap'), ('How well?', 'analyze')):
            ui.button(label, on_click=lambda question=question: answered(question))
        busy = ui.spinner()
        busy.visible = False
    answer = ui.label().classes('whitespace-pre font-mono text-xs overflow-auto').mark('answer')

    async def answered(question: str) -> None:
        run, changed = link.recent.of_one_plant(ASKED_S)
        lasts_s = float(run.time_s[-1] - run.time_s[0]) if run is not None else 0.0
        why = ', since the actuator was changed' if changed else ''
        busy.visible, answer.text = True, f'asking about the last {lasts_s:.2g} s{why} …'
        try:
            if changed and lasts_s < LEAST_ASKED_S:
                raise InputError(f'{lasts_s:.2g} s of loop time{why}: {LEAST_ASKED_S:g} s are '
                                 'needed (Go on, if the loop is paused)')
            answer.text = await ask(question, run, session.nominal,
                                    lambda told: answer.set_text(f'{told} …'))
        except InputError as error:
            answer.text = str(error)
        finally:
            busy.visible = False


def _effects(session: Session) -> None:
    names = {effect.name: f'{effect.name}: {effect.description}' for effect in EFFECTS}
    with ui.row().classes('items-center'):
        chosen = ui.select(names, label='effect of the plant', value=EFFECTS[0].name
                           ).classes('w-80')
        ui.button('Inject', on_click=lambda: _attempt(session.inject(chosen.value, False)))
        ui.button('Hide one', on_click=lambda: _attempt(
            session.inject(random.choice(EFFECTS).name, True), 'one effect is hidden: where is '
            'the gap?'))
        ui.button('Reveal and remove', on_click=lambda: reveal()).props('outline')
        effect = ui.label().mark('effect')
        ui.timer(REFRESH_S, lambda: effect.set_text(
            '' if not session.effect else 'one effect is hidden' if session.hidden else
            f'with {session.effect}'))

    async def reveal() -> None:
        await _attempt(session.inject('', False), f'it was {session.effect}; it is off'
                     if session.effect else 'there was none')


def _parameters(session: Session) -> None:
    """Show the nodes' parameters, each block when it is opened."""
    panels = ui.column().classes('w-full')
    widgets: dict[tuple[str, str], Callable[[Any], None]] = {}
    known: dict[str, set[bytes]] = {}

    async def look() -> None:
        for node, ids in session.link.nodes().items():
            if known.get(node) == ids:
                continue
            try:
                await session.read(node)
            except LinkError:
                continue
            if node not in known:
                with panels, ui.column().classes('w-full gap-0') as section:
                    _blocks(session, node, widgets)
                if node == CONTROLLER:
                    section.move(target_index=0)   # what is turned most
            known[node] = ids
        values = session.shown
        for (node, name), update in widgets.items():
            update(values[node][name])

    ui.timer(REFRESH_S, look)


def _blocks(session: Session, node: str, widgets: dict) -> None:
    ui.label(node).classes('text-subtitle1')
    blocks: dict[str, list[str]] = {}
    described = session.link.descriptors[node]
    # First what can be turned.
    for name in sorted(described, key=lambda name: described[name].read_only):
        blocks.setdefault(name.partition('.')[0] if '.' in name else GENERAL, []).append(name)
    for block, names in blocks.items():
        with ui.expansion(block).classes('w-full').props('dense').mark(f'{node} {block}') as part:
            def fill(event: Any, part: ui.expansion = part, names: list[str] = names) -> None:
                if event.value and (node, names[0]) not in widgets:
                    with part:
                        for name in names:
                            widgets[node, name] = _widget(session, node, name)
            part.on_value_change(fill)
            part.value = (node, block) == (CONTROLLER, GENERAL)


def _widget(session: Session, node: str, name: str) -> Callable[[Any], None]:
    """Show one parameter; return the function that shows another value of it."""
    descriptor, value = session.link.descriptors[node][name], session.link.values[node][name]
    shown = session.shown[node][name]

    async def given(new: Any) -> None:
        if not await _attempt(session.change(node, name, new)):
            show(session.link.values[node][name])

    field: Any
    slider: ui.slider | None = None
    choices, scale = choices_of(descriptor), scale_of(descriptor, value)
    if isinstance(value, bool):
        field = ui.switch(name, value=shown)
        field.on('update:model-value', lambda event: given(event.args))
    elif choices:
        field = ui.select(choices, label=name, value=shown)
        field.on('update:model-value', lambda _: given(field.value))
    else:
        field = ui.input(name, value=str(shown), suffix=unit_of(descriptor) or None)
        for event in ('keydown.enter', 'blur'):
            field.on(event, lambda _: given(typed(field.value, value))
                     if field.value != str(session.link.values[node][name]) else None)
        if scale is not None:
            slider = ui.slider(min=0.0, max=1.0, step=0.002, value=scale.place(shown))
            slider.props['aria-label'] = name
            slider.on('update:model-value', lambda event: given(scale.value(event.args)),
                      throttle=0.1, leading_events=False)
    field.classes('w-full').props('dense').mark(name)
    with field:
        ui.tooltip(f'{descriptor.description}; {descriptor.additional_constraints}')
    for each in (field, slider):
        if each is not None and descriptor.read_only:
            each.disable()

    last = shown

    def show(new: Any) -> None:
        nonlocal last
        last = new
        field.value = new if choices or isinstance(value, bool) else str(new)
        if slider is not None and scale is not None:
            slider.value = scale.place(new)

    # Text that is being typed is kept until the value changes.
    return lambda new: show(new) if new != last else None
