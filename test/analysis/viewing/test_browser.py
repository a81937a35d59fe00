"""The live page in headless Chromium, over real nodes; skipped where there is no Chromium."""

import re
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from conftest import PATIENCE_S, NodeProcess, wait_until

pytest.importorskip('nicegui')
from asi_analysis.viewing.frames import CHARTS, LOOP
from bench.browser import CURVES, NoBrowserError, chromium

LOOP_PARAMETERS: dict[str, Any] = {'rate_hz': 500.0}
ANSWER_PATIENCE_S = 600.0
Curves = dict[str, dict[str, list[list[float]]]]


@pytest.fixture(scope='module')
def browser() -> Iterator[Any]:
    """Run Chromium."""
    try:
        with chromium() as found:
            yield found
    except NoBrowserError as error:
        pytest.skip(str(error))


class Tab:
    """The page in a tab of its own; a wait that takes PATIENCE_S fails."""

    def __init__(self, browser: Any, port: int) -> None:
        self.errors: list[str] = []
        self.page = browser.new_page(viewport={'width': 1500, 'height': 1250})
        self.page.set_default_timeout(1e3 * PATIENCE_S)
        self.page.on('pageerror', lambda error: self.errors.append(str(error)))
        self.page.goto(f'http://127.0.0.1:{port}')
        self.gain = self.page.get_by_role('textbox', name='gain', exact=True)
        self.gain.wait_for()

    def press(self, button: str) -> None:
        """Click on a button."""
        self.page.get_by_role('button', name=button, exact=True).click()

    def drag(self, slider: str, place: float) -> None:
        """Take the thumb of a slider from its left end to a place between 0 and 1."""
        box = self.page.get_by_role('slider', name=slider, exact=True).bounding_box()
        middle = box['y'] + box['height'] / 2
        self.page.mouse.move(box['x'], middle)
        self.page.mouse.down()
        self.page.mouse.move(box['x'] + place * box['width'], middle, steps=5)
        self.page.mouse.up()

    def shown_gain(self) -> float:
        """Return the number in the field of the gain."""
        self.page.wait_for_timeout(50)   # a plain sleep would stop the browser's events
        return float(self.gain.input_value())

    def wait_for(self, text: str | re.Pattern, patience_s: float = PATIENCE_S) -> str:
        """Return the element with a text, once it is on the page."""
        found = self.page.get_by_text(text).first
        found.wait_for(timeout=1e3 * patience_s)
        return str(found.inner_text())

    def wait_for_curves(self, condition: Callable[[Curves], Any], what: str) -> Curves:
        """Return what the charts show once it meets a condition."""
        def shown() -> Curves | None:
            self.page.wait_for_timeout(50)
            curves: Curves = self.page.evaluate(CURVES)
            return curves if len(curves) == 1 + len(CHARTS) and condition(curves) else None
        found: Curves = wait_until(shown, what)
        return found


def last(curve: list[list[float]]) -> float:
    return curve[-1][1] if curve else 0.0


@pytest.mark.timeout(2 * ANSWER_PATIENCE_S)
def test_a_dragged_slider_turns_the_gain_and_the_plots_show_the_step(
        browser: Any, serve: Callable, start_node: Callable[..., NodeProcess],
        get_parameters: Callable) -> None:
    start_node('asi_actuator.actuator_node', real_time_factor=1.0, **LOOP_PARAMETERS)
    controller = start_node('asi_controller.controller_node', **LOOP_PARAMETERS)
    port, process = serve()
    tab = Tab(browser, port)
    tab.drag('gain', 0.45)
    controller.wait_for('gain = ')
    # On its way the thumb passes smaller gains, which the node may have had too.
    wait_until(lambda: 1.0 < tab.shown_gain() < 100.0 and tab.shown_gain() == get_parameters(
        'asi_controller', ['gain'])['gain'], 'the gain of the node')
    assert 1.0 < tab.shown_gain() < 100.0
    tab.press('20 s')
    tab.press('Step')
    force, _ = CHARTS
    tab.wait_for_curves(lambda curves: last(curves[force]['force']) > 50.0 and all(
        len(points) > 50 for curve in curves.values() for points in curve.values()), 'the step')
    curves = tab.page.evaluate(CURVES)
    assert last(curves[force]['reference']) == 150.0
    assert last(curves[LOOP]['valve']) > 1.0   # um
    tab.press('Hide one')
    tab.wait_for('one effect is hidden')
    answer = 'refused: s are needed'
    while 's are needed' in answer:   # of the plant with the effect
        tab.press('How well?')
        tab.page.wait_for_timeout(500)
        # With a low priority: beside other tests the command gets little of the processor.
        answer = tab.wait_for(re.compile('asi analyze runs/|s are needed'), ANSWER_PATIENCE_S)
    assert 's at 500 Hz' in answer
    tab.press('Reveal and remove')
    tab.wait_for('; it is off')
    assert not tab.errors
    assert process.stop() == 0 and 'Traceback' not in process.text


@pytest.mark.slow
def test_two_tabs_of_a_pair_in_a_namespace_follow_each_other_and_nodes_that_start_again(
        browser: Any, serve: Callable, start_node: Callable[..., NodeProcess],
        get_parameters: Callable) -> None:
    left = ('-r', '__ns:=/left', '-r', '/clock:=clock')
    nodes = [start_node(module, *left, **LOOP_PARAMETERS, **more) for module, more in (
        ('asi_controller.controller_node', {'reference.shape': 'sine'}),
        ('asi_actuator.actuator_node', {'give_up_after': 0.0, 'real_time_factor': 1.0}))]
    port, process = serve('--namespace', 'left')
    first, second = tabs = [Tab(browser, port) for _ in range(2)]
    first.drag('gain', 0.4)
    wait_until(lambda: first.shown_gain() == second.shown_gain() > 0.0, 'the same gain')
    second.drag('gain', 0.7)
    wait_until(lambda: first.shown_gain() == second.shown_gain() > 50.0, 'the same gain')
    first.gain.fill('8\N{SUPERSCRIPT THREE} N/N')
    first.gain.press('Enter')
    first.wait_for('8\N{SUPERSCRIPT THREE} N/N')
    wait_until(lambda: first.gain.input_value() == str(
        get_parameters('left/asi_controller', ['gain'])['gain']), 'the gain that holds')
    for node in nodes:
        node.kill()
    first.wait_for('has ended, or is silent')
    second.page.close()
    start_node('asi_actuator.actuator_node', *left, real_time_factor=1.0, **LOOP_PARAMETERS)
    start_node('asi_controller.controller_node', *left, **LOOP_PARAMETERS)
    wait_until(lambda: first.shown_gain() == 0.0, 'the gain of the new controller')
    first.press('Step')
    force, _ = CHARTS
    first.wait_for_curves(lambda curves: last(curves[force]['force']) > 50.0, 'the step')
    assert not [error for tab in tabs for error in tab.errors]
    assert process.stop() == 0 and 'Traceback' not in process.text, process.text
