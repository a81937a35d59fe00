"""What is shipped for viewers fits the topics, joints and frames that the nodes publish."""

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml

from asi_common.node.diagnostics import LOOP, STATE
from asi_common.node.topics import message_class
from asi_common.topics import FRAME, JOINTS, TOPICS

CONFIG = Path(__file__).parents[1] / 'config'


def paths(file: str) -> list[str]:
    """Return the signals that a layout shows, as topic/field/field."""
    text = (CONFIG / file).read_text()
    if file.endswith('.json'):
        panels = json.loads(text)['configById'].values()
        return [re.sub(r'\.', '/', path['value']) for panel in panels
                for path in panel.get('paths', [])]
    return [curve.get('name', '') for curve in ElementTree.fromstring(text).iter('curve')]


@pytest.mark.parametrize('file', ['foxglove_layout.json', 'plotjuggler_layout.xml'])
def test_a_layout_shows_numbers_of_our_topics(file: str) -> None:
    shown = paths(file)
    assert {path.split('/')[1] for path in shown} == {
        'force', 'force_reference', 'valve_command', 'valve_position', 'velocity'}
    for path in shown:
        _, topic, *fields = path.split('/')
        value: Any = message_class(TOPICS[topic].type)()
        for field in fields:
            value = getattr(value, field)
        assert isinstance(value, float)


def test_foxglove_shows_each_panel_of_its_layout_once() -> None:
    layout = json.loads((CONFIG / 'foxglove_layout.json').read_text())

    def panels(tree: Any) -> list[str]:
        return [tree] if isinstance(tree, str) else panels(tree['first']) + panels(tree['second'])

    assert sorted(panels(layout['layout'])) == sorted(layout['configById'])
    assert layout['configById']['DiagnosticSummary!health']['topicToRender'] in TOPICS


def test_the_joints_and_the_frame_of_the_topics_are_in_one_tree() -> None:
    robot = ElementTree.parse(CONFIG / 'asi_actuator.urdf').getroot()
    parents = {child.get('link'): parent.get('link') for joint in robot.iter('joint')
               for child in joint.iter('child') for parent in joint.iter('parent')}
    links = {link.get('name') for link in robot.iter('link')}
    assert {joint.get('name') for joint in robot.iter('joint')
            if joint.get('type') == 'prismatic'} == set(JOINTS)
    assert FRAME in parents and set(parents) | set(parents.values()) == links
    assert links - set(parents) == {'actuator'}
    rviz = yaml.safe_load((CONFIG / 'asi_actuator.rviz').read_text())['Visualization Manager']
    assert rviz['Global Options']['Fixed Frame'] == 'actuator'
    topics = [display['Topic']['Value'] for display in rviz['Displays'] if 'Topic' in display]
    assert topics == ['force'] and set(topics) <= set(TOPICS)


def test_the_analyzers_take_every_status_of_the_nodes() -> None:
    analyzers = yaml.safe_load((CONFIG / 'diagnostic_aggregator.yaml').read_text())[
        'analyzers']['ros__parameters']
    prefixes = {analyzer['contains'][0]: analyzer['num_items'] for analyzer in analyzers.values()
                if isinstance(analyzer, dict)}
    published = ['asi_actuator' + LOOP, 'asi_actuator' + STATE, 'asi_controller' + LOOP]
    assert {prefix: sum(prefix in name for name in published) for prefix in prefixes} == prefixes
    assert all(any(prefix in name for prefix in prefixes) for name in published)
